"""What a set-up is known to: the input quantities of an uncertainty budget.

A capture states angles and readings as if the instrument were perfect. Each quantity here says what
the capture would have been had the set-up been off by some amount, so that its standard uncertainty
can be propagated to the parameters of the material.

Source: JCGM 100:2008 (GUM), 4.1 and 4.3: input quantities, and type B evaluation of their standard
uncertainty.
"""

import abc
import dataclasses
import math
from numbers import Real
from typing import ClassVar, Self, override

import numpy as np
import xarray as xr

from polar_bayes.errors import FitError

__all__ = [
    "AmbientLight",
    "AnalyzerRoll",
    "LightAzimuth",
    "LightZenith",
    "PolarizationGain",
    "SampleLean",
    "ToneCurve",
    "ViewZenithScale",
]

POLARIZATION = ("dop", "q", "u")


def check_uncertainty(u: object, where: str, unit: str = "") -> None:
    """Raise FitError where a value is no standard uncertainty."""
    if not (isinstance(u, Real) and 0.0 < float(u) < math.inf):
        raise FitError(f"it is {u!r}", where=where, hint=f"give a number above 0{unit}")


@dataclasses.dataclass(frozen=True)
class AbstractInputQuantity(abc.ABC):
    """Something that a set-up is known to.

    Args:
        standard_uncertainty: Of its value, in `unit`, above 0.
    """

    standard_uncertainty: float

    name: ClassVar[str]
    unit: ClassVar[str]
    meaning: ClassVar[str]

    def __post_init__(self) -> None:
        where = f"{type(self).__name__}: standard_uncertainty"
        check_uncertainty(self.standard_uncertainty, where, f" ({self.unit})")

    def as_stated(self, capture: xr.Dataset) -> Self:
        """The same with the standard uncertainty that a capture states, as `<name>_uncertainty`."""
        u = capture.attrs.get(f"{self.name}_uncertainty", self.standard_uncertainty)
        return dataclasses.replace(self, standard_uncertainty=u)

    def acts_on(self, capture: xr.Dataset) -> bool:
        """Whether readings of a capture may depend on it."""
        del capture
        return True

    @abc.abstractmethod
    def shifted(self, capture: xr.Dataset, amount: float) -> xr.Dataset:
        """The capture of a perfect instrument where this one is off by some amount (`unit`)."""


@dataclasses.dataclass(frozen=True)
class _Angle(AbstractInputQuantity):
    """An angle of the capture, by its name, is that much larger than stated."""

    unit = "degree"

    @override
    def shifted(self, capture: xr.Dataset, amount: float) -> xr.Dataset:
        return capture.assign({self.name: capture[self.name] + amount})


@dataclasses.dataclass(frozen=True)
class LightZenith(_Angle):
    """The light is that much further from the normal than stated."""

    name = "light_zenith"
    meaning = "zenith of the light"


@dataclasses.dataclass(frozen=True)
class LightAzimuth(_Angle):
    """The light is turned about the normal by that much."""

    name = "light_azimuth"
    meaning = "azimuth of the light"


@dataclasses.dataclass(frozen=True)
class ViewZenithScale(AbstractInputQuantity):
    """Zeniths of the views grow by that share: a focal length, a gear, a printed scale."""

    name = "view_zenith_scale"
    unit = "1"
    meaning = "scale of the viewing zenith"

    @override
    def shifted(self, capture: xr.Dataset, amount: float) -> xr.Dataset:
        return capture.assign(view_zenith=capture["view_zenith"] * (1.0 + amount))


@dataclasses.dataclass(frozen=True)
class SampleLean(AbstractInputQuantity):
    """The normal of the sample leans away from the light, in its plane, by that much."""

    name = "sample_lean"
    unit = "degree"
    meaning = "lean of the sample in the plane of the light"

    @override
    def shifted(self, capture: xr.Dataset, amount: float) -> xr.Dataset:
        apart = np.cos(np.radians(capture["view_azimuth"] - capture["light_azimuth"]))
        return capture.assign(
            light_zenith=capture["light_zenith"] + amount,
            view_zenith=capture["view_zenith"] + amount * apart,
        )


@dataclasses.dataclass(frozen=True)
class AnalyzerRoll(AbstractInputQuantity):
    """The analyzer's zero is turned by that much, which mixes q and u."""

    name = "analyzer_roll"
    unit = "degree"
    meaning = "roll of the analyzer"

    @override
    def acts_on(self, capture: xr.Dataset) -> bool:
        return "q" in capture and "u" in capture

    @override
    def shifted(self, capture: xr.Dataset, amount: float) -> xr.Dataset:
        turn = 2.0 * np.radians(amount)
        q, u = capture["q"], capture["u"]
        return capture.assign(
            q=q * np.cos(turn) + u * np.sin(turn), u=u * np.cos(turn) - q * np.sin(turn)
        )


@dataclasses.dataclass(frozen=True)
class PolarizationGain(AbstractInputQuantity):
    """Polarizations are read too large by that share: an analyzer's extinction, a sensor's."""

    name = "polarization_gain"
    unit = "1"
    meaning = "gain of polarization"

    @override
    def shifted(self, capture: xr.Dataset, amount: float) -> xr.Dataset:
        names = [name for name in POLARIZATION if name in capture]
        return capture.assign({name: capture[name] / (1.0 + amount) for name in names})


@dataclasses.dataclass(frozen=True)
class AmbientLight(AbstractInputQuantity):
    """Unpolarized light was subtracted in excess: that share of the brightest reading."""

    name = "ambient_light"
    unit = "of the brightest reading"
    meaning = "ambient light"

    @override
    def shifted(self, capture: xr.Dataset, amount: float) -> xr.Dataset:
        light = capture["intensity"] if "intensity" in capture else xr.DataArray(1.0)
        lost = amount * light.max()
        names = [name for name in POLARIZATION if name in capture]
        whole = xr.where(light > 0.0, light / (light + lost), 1.0)
        new = {name: (capture[name] * whole).transpose(*capture[name].dims) for name in names}
        return capture.assign(new | ({"intensity": light + lost} if "intensity" in capture else {}))


@dataclasses.dataclass(frozen=True)
class ToneCurve(AbstractInputQuantity):
    """Counts grow as a power of light, whose exponent (gamma) is that much above 1."""

    name = "tone_curve"
    unit = "1"
    meaning = "exponent of the sensor's tone curve"

    @override
    def shifted(self, capture: xr.Dataset, amount: float) -> xr.Dataset:
        # The two frames of which q is the contrast have the ratio exp(2 artanh q).
        power = 1.0 / (1.0 + amount)

        def straight(reading: xr.DataArray) -> xr.DataArray:
            inside = abs(reading) < 1.0  # noise beyond full polarization stays as it is
            return reading.where(~inside, np.tanh(power * np.arctanh(reading.where(inside, 0.0))))

        new = {name: straight(capture[name]) for name in POLARIZATION if name in capture}
        if "intensity" in capture:
            intensity = capture["intensity"]
            brightest = float(intensity.max())
            new["intensity"] = brightest * (intensity / brightest).clip(0.0) ** power
        return capture.assign(new)


type InputQuantities = tuple[AbstractInputQuantity, ...]
