"""The contract of a capture, and its validation.

A capture is an `xarray.Dataset`; `CONTRACT` lists its variables. Every capture is validated once,
where it enters; later code relies on it. *Readings*, their errors and flags share the dims
(leading..., view[, wavelength]); *geometry* has (view) or (leading..., view); the confidence in the
stated normal has (leading...), (view) or both. Leading dims are none (one material), material,
patch, or y and x. A dim may have labels: a coordinate of its own name, or the single label that
`isel` leaves; the dim wavelength must, in nanometers. Known truth is stored as `true_<anything>`,
over any of the capture's dims, NaN where it is not known.
"""

import contextlib
import dataclasses
import difflib
import os
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr

from polar_bayes.errors import CaptureError

LEADING = ((), ("material",), ("patch",), ("y", "x"))
LABELS = ("material", "patch", "y", "x", "view")
SIGNALS = ("dop", "q", "intensity")
TRUTH = re.compile(r"true_[A-Za-z0-9_]{1,90}")
SPELLINGS = {
    "degree": ("degree", "degrees", "deg"),
    "1": ("1", "", "dimensionless"),
    "nm": ("nm", "nanometer", "nanometers"),
}

SMALLEST_SCAN, LARGEST_SCAN_END = 0.1, 0.2
"""Smallest span and largest end of a scan whose zeniths, in radians, would be mistaken for a few
degrees."""

# q and u are measured one by one, so their noise may carry q^2 + u^2 a little past one.
EXCESS_POLARIZATION = 0.05


@dataclasses.dataclass(frozen=True)
class Interval:
    """A range of allowed numbers; an open end is itself excluded."""

    low: float
    high: float
    open_low: bool = False
    open_high: bool = False

    def contains(self, values: Any) -> Any:
        """Return True for numbers inside, False for others and NaN; any shape."""
        above = values > self.low if self.open_low else values >= self.low
        below = values < self.high if self.open_high else values <= self.high
        return above & below

    def check(self, value: object, where: str) -> float:
        """Return a number given by the user, or refuse it if it lies outside."""
        if isinstance(value, Real) and not isinstance(value, bool) and self.contains(value):
            return float(value)
        raise CaptureError(f"it is {value!r}", where=where, hint=f"give {self}")

    def check_fields(self, owner: object, *names: str) -> None:
        """Refuse an object with a field that is not a number inside."""
        for name in names:
            self.check(getattr(owner, name), f"{type(owner).__name__}: {name}")

    def __str__(self) -> str:
        """The interval as an inequality."""
        signs = ("<" if self.open_low else "<=", "<" if self.open_high else "<=")
        return f"{self.low:g} {signs[0]} value {signs[1]} {self.high:g}"


@dataclasses.dataclass(frozen=True)
class Variable:
    """One variable of a capture: its dims, unit and range."""

    name: str
    kind: Literal["geometry", "trust", "reading", "flag", "label"]
    units: str | None
    range: Interval
    meaning: str
    hint: str
    needs: str | None = None


ZENITH, TURN = Interval(0.0, 90.0, open_high=True), Interval(-360.0, 360.0)
UNIT = Interval(0.0, 1.0)
SIGNED_UNIT = Interval(-1.0, 1.0)
BRIGHTNESS = Interval(0.0, 1e30, open_high=True)
POSITIVE = Interval(0.0, 1e30, open_low=True, open_high=True)
# The inverse square of an error stays finite in double precision.
ERROR = Interval(1e-30, 1e30, open_low=True, open_high=True)

FROM_NORMAL = "give degrees from the surface normal"
AROUND_NORMAL = "give degrees around the surface normal"
MASK = "correct it or mark it valid=False"
FRACTION = f"give a fraction, not percent; {MASK}"


def _error(name: str, units: str | None) -> Variable:
    """Return the variable of the standard error of a reading."""
    meaning, hint = f"standard deviation of {name}", f"give a standard deviation above zero; {MASK}"
    return Variable(f"{name}_error", "reading", units, ERROR, meaning, hint, name)


def _flag(name: str, meaning: str) -> Variable:
    return Variable(name, "flag", "1", UNIT, meaning, "give True or False, or 1 or 0")


CONTRACT = (
    Variable("view_zenith", "geometry", "degree", ZENITH, "view zenith angle", FROM_NORMAL),
    Variable("view_azimuth", "geometry", "degree", TURN, "view azimuth", AROUND_NORMAL),
    Variable("light_zenith", "geometry", "degree", ZENITH, "light zenith angle", FROM_NORMAL),
    Variable("light_azimuth", "geometry", "degree", TURN, "light azimuth", AROUND_NORMAL),
    Variable(
        "normal_confidence",
        "trust",
        "1",
        Interval(0.0, 1.0, open_low=True),
        "trust in the stated normal",
        "give 1 where the normal is sure; what is not to be trusted at all is valid=False",
    ),
    Variable("dop", "reading", "1", UNIT, "degree of linear polarization", FRACTION),
    Variable("q", "reading", "1", SIGNED_UNIT, "normalized Stokes q, s positive", FRACTION),
    Variable("u", "reading", "1", SIGNED_UNIT, "normalized Stokes u", FRACTION, "q"),
    Variable("intensity", "reading", None, BRIGHTNESS, "intensity", MASK),
    _error("dop", "1"),
    _error("q", "1"),
    _error("u", "1"),
    _error("intensity", None),
    _flag("saturated", "the detector saturated"),
    _flag("valid", "measured, not missing"),
    _flag("interpolated", "filled in between readings"),
)
WAVELENGTH = Variable(
    "wavelength",
    "label",
    "nm",
    # Shorter light is X-rays, whose polarization no set-up here measures.
    dataclasses.replace(POSITIVE, low=10.0, open_low=False),
    "wavelength",
    "give nanometers: a number around 0.5 is micrometers, to be multiplied by 1000, and one below "
    "1e-5 is meters",
)


def as_numbers(values: object) -> np.ndarray:
    """Convert to an array of float64; return a single NaN for anything that is not numbers."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.asarray(np.nan)


def check_choice(value: object, among: Iterable[str | None], where: str) -> None:
    """Refuse an option that is none of these; None among them stands for one left out."""
    if value not in (choices := list(among)):
        names = list(filter(None, choices))
        hint = f"give {' or '.join(names)}" if len(names) < 3 else f"give one of {', '.join(names)}"
        raise CaptureError(f"it is {value!r}", where=where, hint=hint)


def nearest_name(name: object, known: Sequence[str]) -> str | None:
    """Return the most similar known name; None if the name is known or names a truth."""
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
        """Dims of readings, of their errors and of their flags."""
        return (*self.leading, "view", *(("wavelength",) if self.spectral else ()))

    def allowed(self, row: Variable) -> tuple[tuple[str, ...], ...]:
        """Return the dims that a variable may have, in canonical order."""
        if row.kind == "geometry":
            return tuple(dict.fromkeys([("view",), (*self.leading, "view")]))
        if row.kind == "trust":
            return tuple(dict.fromkeys([self.leading, ("view",), (*self.leading, "view")]))
        if row.kind == "label":
            return ((row.name,),) if row.name in self.readings else ((),)
        return (self.readings,)


# --- Attributes: text and numbers, which every file format can hold -------------------------------


def clean_attributes(attributes: Mapping[Any, object], where: str) -> dict[str, str | int | float]:
    """Convert attributes to plain text and numbers, which files return unchanged."""
    # xarray gives these a meaning of its own when it writes netCDF.
    reserved = {"add_offset", "coordinates", "dtype", "missing_value", "scale_factor"}
    allowed = re.compile(r"[A-Za-z][A-Za-z0-9_.+-]{0,99}")
    # Numbers become Python numbers, truth values 0 or 1; bytes and arrays of numbers or text
    # become text.
    for name in attributes:
        if not isinstance(name, str) or not allowed.fullmatch(name) or name in reserved:
            what = f"the attribute name {name!r} cannot be stored"
            hint = "rename it: a letter, then letters, digits or any of _ . + -"
            raise CaptureError(what, where=where, hint=hint)
    return {name: _clean_value(x, f"{where}: attribute {name}") for name, x in attributes.items()}


def _clean_value(value: object, where: str) -> str | int | float:
    array = np.array(None)
    if isinstance(value, str | bytes | bool | int | float | list | tuple | np.generic | np.ndarray):
        with contextlib.suppress(ValueError):  # nested lists of unequal length
            array = np.asarray(value)
    if isinstance(value, int) and not isinstance(value, bool):
        return int(value) if -(2**63) <= value < 2**63 else str(value)
    if array.dtype.kind not in "biufSU":
        what = f"the value is a {type(value).__name__}, neither a number nor text"
        raise CaptureError(what, where=where, hint="give a number or text, for instance JSON")
    item = value if isinstance(value, str | bytes) else array.tolist()
    if isinstance(item, bytes):
        item = item.decode("utf-8", "backslashreplace")
    if isinstance(item, str | list):
        # UTF-8 and C strings cannot hold lone surrogates and NUL, which are escaped.
        text = str(item).encode("utf-8", "backslashreplace").decode("utf-8")
        return text.replace("\0", "\\x00")
    if isinstance(item, int):
        return int(item) if item < 2**63 else str(item)
    return float(item)


# --- Validation -----------------------------------------------------------------------------------


def validate(dataset: xr.Dataset, *, source: str = "capture") -> xr.Dataset:
    """Check a capture against the contract and return it in canonical form.

    Canonical: float64 numbers, boolean flags, dims in the order (leading..., view[, wavelength]),
    `units` and `long_name` of the contract, attributes of text and numbers only. No number is
    changed and none is dropped. Readings in entries marked `valid=False` are not checked: they
    may be NaN. A second call changes nothing.

    Args:
        dataset: The capture, in memory or lazy (then it is loaded).
        source: Its name in errors, for instance the file.

    Returns:
        A new dataset; the given one is not changed.

    Raises:
        CaptureError: The first departure from the contract, with its variable and index.
    """
    if not isinstance(dataset, xr.Dataset):
        what, hint = f"a {type(dataset).__name__} is not a capture", "give an xarray.Dataset"
        if isinstance(dataset, str | os.PathLike):
            read = "load_capture" if Path(dataset).suffix in ("", ".nc") else "from_table"
            hint = f"read it first: pb.{read}({os.fspath(dataset)!r})"
        raise CaptureError(what, where=source, hint=hint)
    _check_names(dataset, source)
    layout = _layout(dataset, source)
    present = [row for row in CONTRACT if row.name in dataset]
    flags = [row for row in present if row.kind == "flag"]
    found = {row.name: _entries(dataset, row, layout, source) for row in flags}
    valid = np.ones([dataset.sizes[dim] for dim in layout.readings], dtype=bool)
    if "valid" in found:
        valid = found["valid"].values
    if not valid.any():
        hint = "mark what was measured valid=True"
        raise CaptureError("every view is masked", where=f"{source}: valid", hint=hint)
    rest = [row for row in present if row.kind != "flag"]
    numbers = {row.name: _entries(dataset, row, layout, source, valid) for row in rest}
    _check_degrees(numbers, source)
    _check_polarization(numbers, layout, valid, source)
    _check_intensity_units(numbers, source)
    # By a rotary stage, by hand, or through a lens.
    set_by = dataset.attrs.get("angle_set_by", "hand")
    check_choice(set_by, ("stage", "hand", "lens"), f"{source}: attribute angle_set_by")
    names = [str(name) for name in dataset.variables if TRUTH.fullmatch(str(name))]
    truths = {name: _truth(dataset.variables[name], name, layout, source) for name in names}
    labels, attributes = _labels(dataset, layout, source), clean_attributes(dataset.attrs, source)
    return xr.Dataset({**numbers, **found, **truths}, labels, attributes)


def count(capture: xr.Dataset) -> dict[str, int]:
    """Count the entries of a capture, those that are masked, and those that are saturated.

    Args:
        capture: A validated capture.

    Returns:
        `views`: all entries; `masked`: those with `valid=False`; `saturated`: those flagged.
    """
    signal = next(capture[name] for name in SIGNALS if name in capture)
    return {
        "views": int(signal.size),
        "masked": int((~capture["valid"]).sum()) if "valid" in capture else 0,
        "saturated": int(capture["saturated"].sum()) if "saturated" in capture else 0,
    }


def _check_names(dataset: xr.Dataset, source: str) -> None:
    known = [*(row.name for row in CONTRACT), WAVELENGTH.name, *LABELS]
    for name in dataset.variables:
        if near := nearest_name(name, known):
            what = "a capture has no such variable"
            hint = f"rename it (nearest known name: {near}), call it true_<name> or drop it"
            raise CaptureError(what, where=f"{source}: {name}", hint=hint)
    for row in CONTRACT:
        if row.kind == "geometry" and row.name not in dataset:
            hint = f"add {row.name} in degree, with dim view"
            raise CaptureError("it is missing", where=f"{source}: {row.name}", hint=hint)
        if row.name in dataset and row.needs and row.needs not in dataset:
            what = f"it has no meaning without {row.needs}"
            hint = f"add {row.needs} or drop {row.name}"
            raise CaptureError(what, where=f"{source}: {row.name}", hint=hint)
    if not any(name in dataset for name in SIGNALS):
        raise CaptureError("no reading is there", where=source, hint="add dop, q or intensity")


def _layout(dataset: xr.Dataset, source: str) -> Layout:
    name = next(name for name in SIGNALS if name in dataset)
    dims = dataset[name].dims
    rest = [dim for dim in dims if dim not in ("view", "wavelength")]
    leading = next((option for option in LEADING if _same_dims(rest, option)), None)
    if leading is None or "view" not in dims or len(set(dims)) != len(dims):
        hint = "use view[, wavelength], alone or behind material, patch, or y and x together"
        raise CaptureError(f"its dims are {dims_text(dims)}", where=f"{source}: {name}", hint=hint)
    for dim in dims:
        if dataset.sizes[dim] == 0:
            hint = f"give at least one {dim}"
            raise CaptureError("its length is 0", where=f"{source}: dim {dim}", hint=hint)
    if "wavelength" in dims and "wavelength" not in dataset.variables:
        hint = "add a coordinate wavelength in nm"
        raise CaptureError("it has no coordinate", where=f"{source}: dim wavelength", hint=hint)
    return Layout(leading, "wavelength" in dims)


def _ordered(variable: xr.Variable, row: Variable, layout: Layout, source: str) -> xr.Variable:
    """Transpose a variable to the canonical order of dims."""
    options = layout.allowed(row)
    for dims in options:
        if _same_dims(variable.dims, dims):
            return variable.transpose(*dims)
    what = f"its dims are {dims_text(variable.dims)}"
    hint = f"give it {' or '.join(dims_text(dims) for dims in options)}"
    raise CaptureError(what, where=f"{source}: {row.name}", hint=hint)


def _same_dims(dims: Sequence[Hashable], wanted: Sequence[str]) -> bool:
    return len(dims) == len(wanted) and set(dims) == set(wanted)


def dims_text(dims: Iterable[Hashable]) -> str:
    """Format dims as `(view, wavelength)`."""
    return f"({', '.join(map(str, dims))})"


def _entries(
    dataset: xr.Dataset, row: Variable, layout: Layout, source: str, valid: np.ndarray | bool = True
) -> xr.Variable:
    """Return a variable in canonical form; only valid readings are checked."""
    variable = _ordered(dataset[row.name].variable, row, layout, source)
    values, is_flag = variable.values, row.kind == "flag"
    if not is_flag or values.dtype.kind != "b":  # netCDF has no truth values, only 0 and 1
        values = _floats(values, f"{source}: {row.name}")
        allowed = np.isin(values, (0.0, 1.0)) if is_flag else row.range.contains(values)
        if row.kind == "reading":
            allowed = allowed | np.logical_not(valid)
        if not allowed.all():
            index = np.unravel_index(np.argmin(allowed), allowed.shape)
            where = f"{source}: {_entry(row.name, variable.dims, index)}"
            what = f"{values[index]:g} is outside {row.range}"
            raise CaptureError(what, where=where, hint=hint_for(row, values[~allowed]))
    values = values.astype(bool) if is_flag else values
    return xr.Variable(variable.dims, values, _attributes(variable, row, source))


def hint_for(row: Variable, wrong: np.ndarray) -> str:
    """Suggest a remedy for numbers outside their range, by their likely cause."""
    if row.name in SIGNALS and np.isnan(wrong).any():
        return f"{MASK}, as by capture['valid'] = capture[{row.name!r}].notnull()"
    is_polarization = row.kind == "reading" and row.hint == FRACTION
    # Beyond 1.5 it is percent rather than noise or an instrument error of a few percent.
    if is_polarization and np.all(np.abs(wrong) <= 1.5):  # False where one is NaN
        return f"no light has it: check dark level, background and channel gains; {MASK}"
    return row.hint


def _check_degrees(numbers: Mapping[str, xr.Variable], source: str) -> None:
    """Refuse zeniths that look like radians: a scan of views with no angle above pi/2."""
    zeniths = {name: numbers[name] for name in ("view_zenith", "light_zenith")}
    if any(zenith.values.max() > np.pi / 2.0 for zenith in zeniths.values()):
        return
    for name, zenith in zeniths.items():
        values = np.unique(zenith.values)
        is_scan = zenith.sizes["view"] > 2 and len(values) > 2
        if is_scan and values[-1] > LARGEST_SCAN_END and np.ptp(values) > SMALLEST_SCAN:
            what = f"{values[0]:g} to {values[-1]:g} looks like radians, and no zenith is larger"
            hint = (
                "convert the angles to degrees; where the views really are within 1.6 degrees of "
                "the normal, say so by one view at 10 degrees or more that is marked valid=False"
            )
            raise CaptureError(what, where=f"{source}: {name}", hint=hint)


def _check_polarization(
    numbers: Mapping[str, xr.Variable], layout: Layout, valid: np.ndarray, source: str
) -> None:
    if "u" not in numbers:
        return
    with np.errstate(invalid="ignore", over="ignore"):  # masked entries may hold anything
        excess = numbers["q"].values ** 2 + numbers["u"].values ** 2 - 1.0
        wrong = valid & (excess > EXCESS_POLARIZATION)
    if wrong.any():
        index = np.unravel_index(np.argmax(wrong), wrong.shape)
        raise CaptureError(
            f"q^2 + u^2 = {1.0 + excess[index]:g} is more than light can have",
            where=f"{source}: {_entry('u', layout.readings, index)}",
            hint=f"{MASK} (noise may carry the sum to {1.0 + EXCESS_POLARIZATION:g})",
        )


def _truth(variable: xr.Variable, name: str, layout: Layout, source: str) -> xr.Variable:
    where = f"{source}: {name}"
    dims = [dim for dim in layout.readings if dim in variable.dims]
    if not _same_dims(variable.dims, dims):
        hint = f"give it any of {dims_text(layout.readings)}"
        raise CaptureError(f"its dims are {dims_text(variable.dims)}", where=where, hint=hint)
    values = _floats(variable.transpose(*dims).values, where)
    if np.isinf(values).any():
        hint = "give a number, or NaN where the truth is not known"
        raise CaptureError("a value is infinite", where=where, hint=hint)
    default = {"units": "1", "long_name": f"known {name.removeprefix('true_')}"}
    attributes = default | clean_attributes(variable.attrs, where)
    return xr.Variable(dims, values, attributes | {key: str(attributes[key]) for key in default})


def _floats(values: np.ndarray, where: str) -> np.ndarray:
    if values.dtype.kind not in "iuf":
        what = f"it holds {values.dtype.name}, not real numbers"
        raise CaptureError(what, where=where, hint="store floating-point numbers")
    with np.errstate(over="ignore"):  # a wider float may become inf, which the range refuses
        return values.astype(np.float64)


def _labels(dataset: xr.Dataset, layout: Layout, source: str) -> dict[str, xr.Variable]:
    """Return coordinates that label a dim, or hold the single label that a selection left."""
    labels = {}
    for name in (name for name in LABELS if name in dataset.variables):
        row = Variable(name, "label", None, UNIT, name, "")
        variable = _ordered(dataset[name].variable, row, layout, source)
        values = _label_values(variable.values, f"{source}: {name}")
        labels[name] = xr.Variable(variable.dims, values, _attributes(variable, row, source))
    if WAVELENGTH.name in dataset.variables:
        labels[WAVELENGTH.name] = _entries(dataset, WAVELENGTH, layout, source)
    return labels


def _label_values(values: np.ndarray, where: str) -> np.ndarray:
    items = values.ravel().tolist()
    if all(isinstance(item, str) and item and item.isprintable() for item in items):
        labels = np.array(items, dtype=np.str_)
    elif values.dtype.kind in "iu" and all(abs(item) < 2**63 for item in items):
        labels = values.ravel().astype(np.int64)
    elif values.dtype.kind == "f" and np.isfinite(values).all():
        labels = values.ravel().astype(np.float64)
    else:
        what = "a label is neither a finite number nor printable text"
        hint = "give each a number or a name, or drop the coordinate"
        raise CaptureError(what, where=where, hint=hint)
    if len(set(labels.tolist())) != labels.size:
        hint = "give each its own, or drop the coordinate"
        raise CaptureError("two labels are the same", where=where, hint=hint)
    return labels.reshape(values.shape)


def _attributes(variable: xr.Variable, row: Variable, source: str) -> dict[str, str | int | float]:
    where = f"{source}: {row.name}"
    attributes = clean_attributes(variable.attrs, where)
    given = str(attributes.get("units", "")).strip()
    if row.units is not None and "units" in attributes and given not in SPELLINGS[row.units]:
        hint = f"convert it to units {row.units}"
        raise CaptureError(f"its units are {given!r}", where=where, hint=hint)
    if row.name == "intensity" and "saturation_level" in attributes:
        attributes["saturation_level"] = _saturation_level(attributes["saturation_level"], where)
    units = row.units or given or ("arbitrary" if row.kind == "reading" else "1")
    return {**attributes, "units": units, "long_name": row.meaning}


def _saturation_level(level: str | int | float, where: str) -> float:
    if isinstance(level, str) or not 0.0 < level < BRIGHTNESS.high:
        hint = "give the reading, above zero, at which the detector saturates"
        raise CaptureError(f"saturation_level is {level!r}", where=where, hint=hint)
    return float(level)


def _check_intensity_units(numbers: dict[str, xr.Variable], source: str) -> None:
    """Give an error without units those of the intensity; refuse other units."""
    if "intensity_error" not in numbers:
        return
    intensity, error = numbers["intensity"].attrs, numbers["intensity_error"].attrs
    if error["units"] == "arbitrary":
        error["units"] = intensity["units"]
    if error["units"] != intensity["units"]:
        what = f"its units are {error['units']!r}, those of intensity {intensity['units']!r}"
        hint = "give both in the same units"
        raise CaptureError(what, where=f"{source}: intensity_error", hint=hint)


def _entry(name: str, dims: Sequence[Hashable], index: Sequence[int | np.intp]) -> str:
    """Name an entry of a variable, such as `dop[patch=2, view=3]`."""
    if not dims:
        return name
    positions = (f"{dim}={int(position)}" for dim, position in zip(dims, index, strict=True))
    return f"{name}[{', '.join(positions)}]"
