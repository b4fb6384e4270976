"""The capture contract as data: names, units, ranges and dims, each written once."""

import dataclasses
import difflib
import re
from collections.abc import Sequence
from typing import Any, Literal

LEADING = ((), ("material",), ("patch",), ("y", "x"))
LABELS = ("material", "patch", "y", "x", "view")
SIGNALS = ("dop", "q", "intensity")
TRUTH = re.compile(r"true_[A-Za-z0-9_]{1,90}")
SPELLINGS = {
    "degree": ("degree", "degrees", "deg"),
    "1": ("1", "", "dimensionless"),
    "nm": ("nm", "nanometer", "nanometers"),
}

# q and u are measured one by one, so their noise may carry q^2 + u^2 a little past one.
EXCESS_POLARIZATION = 0.05


@dataclasses.dataclass(frozen=True)
class Interval:
    """The numbers that a variable may take; an open end is not itself allowed."""

    low: float
    high: float
    open_low: bool = False
    open_high: bool = False

    def contains(self, values: Any) -> Any:
        """True where a number, or each of an array, lies inside; NaN never does."""
        above = values > self.low if self.open_low else values >= self.low
        below = values < self.high if self.open_high else values <= self.high
        return above & below

    def __str__(self) -> str:
        """The interval as an inequality."""
        signs = ("<" if self.open_low else "<=", "<" if self.open_high else "<=")
        return f"{self.low:g} {signs[0]} value {signs[1]} {self.high:g}"


@dataclasses.dataclass(frozen=True)
class Variable:
    """One row of the contract."""

    name: str
    kind: Literal["geometry", "trust", "reading", "flag", "label"]
    units: str | None
    range: Interval
    meaning: str
    mend: str
    needs: str | None = None


ZENITH = Interval(0.0, 90.0, open_high=True)
AZIMUTH = Interval(-360.0, 360.0)
UNIT = Interval(0.0, 1.0)
SHARE = Interval(0.0, 1.0, open_low=True)
SIGNED_UNIT = Interval(-1.0, 1.0)
BRIGHTNESS = Interval(0.0, 1e30, open_high=True)
POSITIVE = Interval(0.0, 1e30, open_low=True, open_high=True)
# The inverse square of an error stays finite in double precision.
ERROR = Interval(1e-30, 1e30, open_low=True, open_high=True)

FROM_NORMAL = "give degrees from the surface normal"
AROUND_NORMAL = "give degrees around the surface normal"
MASK = "correct it or mark it valid=False"
FRACTION = f"give a fraction, not percent; {MASK}"
TRUST = "give 1 where the normal is sure; what is not to be trusted at all is valid=False"
SIGMA = f"give a standard deviation above zero; {MASK}"
ZERO_ONE = "give True or False, or 1 or 0"
NANOMETERS = "give nanometers above zero"

CONTRACT = (
    Variable("view_zenith", "geometry", "degree", ZENITH, "view zenith angle", FROM_NORMAL),
    Variable("view_azimuth", "geometry", "degree", AZIMUTH, "view azimuth", AROUND_NORMAL),
    Variable("light_zenith", "geometry", "degree", ZENITH, "light zenith angle", FROM_NORMAL),
    Variable("light_azimuth", "geometry", "degree", AZIMUTH, "light azimuth", AROUND_NORMAL),
    Variable("normal_confidence", "trust", "1", SHARE, "trust in the stated normal", TRUST),
    Variable("dop", "reading", "1", UNIT, "degree of linear polarization", FRACTION),
    Variable("q", "reading", "1", SIGNED_UNIT, "normalized Stokes q, s positive", FRACTION),
    Variable("u", "reading", "1", SIGNED_UNIT, "normalized Stokes u", FRACTION, "q"),
    Variable("intensity", "reading", None, BRIGHTNESS, "intensity", MASK),
    Variable("dop_error", "reading", "1", ERROR, "standard deviation of dop", SIGMA, "dop"),
    Variable("q_error", "reading", "1", ERROR, "standard deviation of q", SIGMA, "q"),
    Variable("u_error", "reading", "1", ERROR, "standard deviation of u", SIGMA, "u"),
    Variable(
        "intensity_error",
        "reading",
        None,
        ERROR,
        "standard deviation of intensity",
        SIGMA,
        "intensity",
    ),
    Variable("saturated", "flag", "1", UNIT, "the detector saturated", ZERO_ONE),
    Variable("valid", "flag", "1", UNIT, "measured, not missing", ZERO_ONE),
    Variable("interpolated", "flag", "1", UNIT, "filled in between readings", ZERO_ONE),
)
WAVELENGTH = Variable("wavelength", "label", "nm", POSITIVE, "wavelength", NANOMETERS)


def nearest_name(name: object, known: Sequence[str]) -> str | None:
    """The known name that is most like this one; None where it is known, or tells a truth."""
    if name in known or (isinstance(name, str) and TRUTH.fullmatch(name)):
        return None
    return difflib.get_close_matches(str(name), known, n=1, cutoff=0.0)[0]


@dataclasses.dataclass(frozen=True)
class Layout:
    """The dims of one capture, in canonical order."""

    leading: tuple[str, ...]
    spectral: bool

    @property
    def readings(self) -> tuple[str, ...]:
        """Dims of readings, their errors and flags."""
        return (*self.leading, "view", *(("wavelength",) if self.spectral else ()))

    def allowed(self, row: Variable) -> tuple[tuple[str, ...], ...]:
        """The dims, in canonical order, that a variable of the contract may have."""
        if row.kind == "geometry":
            return tuple(dict.fromkeys([("view",), (*self.leading, "view")]))
        if row.kind == "trust":
            return tuple(dict.fromkeys([self.leading, ("view",), (*self.leading, "view")]))
        if row.kind == "label":
            return ((row.name,),) if row.name in self.readings else ((),)
        return (self.readings,)
