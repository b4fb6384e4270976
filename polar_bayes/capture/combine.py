"""Combine captures along a leading dim, material or patch, to fit them together."""

from collections.abc import Hashable, Mapping, Sequence

import numpy as np
import xarray as xr

from polar_bayes.capture.schema import CONTRACT, SIGNALS, TRUTH, WAVELENGTH, validate
from polar_bayes.errors import CaptureError

DIMS = ("material", "patch")

# The values of a variable that a capture lacks, and those of the views that pad a shorter capture.
# Directions and confidence of such views are those of the last view; their values do not matter.
DEFAULTS = {"valid": True, "saturated": False, "interpolated": False, "normal_confidence": 1.0}
FLAGS = tuple(row.name for row in CONTRACT if row.kind == "flag")
PER_VIEW = tuple(row.name for row in CONTRACT if row.kind in ("geometry", "trust"))


def combine(
    captures: Mapping[str, xr.Dataset], *, dim: str = "material", drop: Sequence[str] = ()
) -> xr.Dataset:
    """Combine captures into one along a leading dim.

    All must have the same readings, wavelengths, units and saturation level: a fit shares the
    instrument and the noise among them. Directions may differ, and so may the number of views:
    shorter captures are filled up with entries marked `valid=False`. A flag that one lacks is
    False there, `valid` True, `normal_confidence` 1, and a `true_<name>` NaN. No number is
    changed.

    Args:
        captures: Captures without a leading dim, by the labels that they get.
        dim: "material" or "patch".
        drop: Variables to leave out, with what has no meaning without them: `["intensity"]` where
            it was recorded in units that have nothing to do with each other.

    Returns:
        A validated capture with dims (dim, view[, wavelength]). Of the attributes those are kept
        that are equal in all; `name` lists the labels.

    Raises:
        CaptureError: Nothing to combine, another dim, a capture that has a leading dim already, or
            two that do not fit together.
    """
    checked = _checked(captures, dim, drop)
    (first, pattern), *others = checked.items()
    for label, capture in others:
        _check_variables(label, capture, first, pattern)
        _check_labels(label, capture, first, pattern)
    parts = list(checked.values())
    names = dict.fromkeys(["valid", *(str(name) for part in parts for name in part.data_vars)])
    coordinates = {name: variable.variable for name, variable in pattern.coords.items()}
    coordinates[dim] = xr.Variable((dim,), np.array(list(checked), dtype=np.str_))
    attributes = _common([part.attrs for part in parts]) | {"name": ", ".join(checked)}
    variables = {name: _stacked(name, parts, dim) for name in names}
    return validate(xr.Dataset(variables, coordinates, attributes), source="combine")


# --- Checks ---------------------------------------------------------------------------------------


def _checked(
    captures: Mapping[str, xr.Dataset], dim: str, drop: Sequence[str]
) -> dict[str, xr.Dataset]:
    """Validate the captures, and refuse those with a leading dim."""
    if dim not in DIMS:
        hint = f"give {' or '.join(map(repr, DIMS))}"
        what = "captures do not stand side by side along that"
        raise CaptureError(what, where=f"dim={dim!r}", hint=hint)
    if not isinstance(captures, Mapping) or not captures:
        hint = "give a mapping such as {'glass': capture, 'plexiglas': other}"
        raise CaptureError("there is nothing to combine", where="combine", hint=hint)
    dropped = list(drop)
    for row in CONTRACT:  # in which q comes before u, and u before its error
        dropped += [row.name] if row.needs in dropped else []
    checked = {}
    for label, capture in captures.items():
        if not isinstance(label, str) or not label:
            hint = "name every capture by a text"
            raise CaptureError(f"{label!r} is no label", where="combine", hint=hint)
        where = f"combine: {label}"
        valid = validate(capture, source=where)
        valid = validate(valid.drop_vars(dropped, errors="ignore"), source=where)
        for leading in (name for name in ("material", "patch", "y", "x") if name in valid.sizes):
            hint = f"select one with isel({leading}=0), or combine what it was made of"
            raise CaptureError(f"it has the dim {leading} already", where=where, hint=hint)
        # A label that selection left behind gives way to the new one.
        checked[label] = valid.drop_vars(dim, errors="ignore")
    return checked


def _check_variables(label: str, capture: xr.Dataset, first: str, pattern: xr.Dataset) -> None:
    """Refuse a capture whose variables or units differ from those of the first."""
    where = f"combine: {label}"
    for name in dict.fromkeys(map(str, [*pattern.data_vars, *capture.data_vars])):
        drop = f"leave it out of all with drop=[{name!r}], in a command --drop {name}"
        if (name in capture) != (name in pattern):
            if name in DEFAULTS or TRUTH.fullmatch(name):
                continue
            with_, without = (label, first) if name in capture else (first, label)
            hint = f"add it there, or {drop}"
            raise CaptureError(f"{without} has no {name}, and {with_} has", where=where, hint=hint)
        for attribute in ("units", "saturation_level", "channel"):
            own, other = (each[name].attrs.get(attribute) for each in (capture, pattern))
            if own != other:
                what = f"{attribute} of {name} is {_text(own)}, that of {first} {_text(other)}"
                raise CaptureError(what, where=where, hint=f"bring both to one, or {drop}")


def _check_labels(label: str, capture: xr.Dataset, first: str, pattern: xr.Dataset) -> None:
    """Refuse captures of different wavelengths, or with labels that conflict."""
    for name in dict.fromkeys(map(str, [*pattern.coords, *capture.coords])):
        own, other = (each.variables.get(name) for each in (capture, pattern))
        if own is None or other is None or not own.equals(other):
            hint = f"drop the label with drop_vars({name!r})"
            if name == WAVELENGTH.name:
                hint = "give captures of the same wavelengths, or select those that all have"
            what = f"{name} is {_text(own)}, that of {first} {_text(other)}"
            raise CaptureError(what, where=f"combine: {label}", hint=hint)


def _text(value: object) -> str:
    if value is None:
        return "not stated"
    if isinstance(value, xr.Variable):
        items = np.atleast_1d(value.values).tolist()
        return ", ".join(map(str, items[:4])) + (", ..." if len(items) > 4 else "")
    return str(value)


# --- Stacking -------------------------------------------------------------------------------------


def _stacked(name: str, captures: list[xr.Dataset], dim: str) -> xr.Variable:
    """Stack one variable of all captures in order, each padded to the largest number of views."""
    found = [capture[name].variable for capture in captures if name in capture]
    dims = [*next(captures[0][signal].dims for signal in SIGNALS if signal in captures[0])]
    if name not in FLAGS:
        dims = [each for each in dims if any(each in variable.dims for variable in found)]
    views = max(capture.sizes["view"] for capture in captures)
    rows = [_padded(name, capture, dims, views) for capture in captures]
    return xr.Variable((dim, *dims), np.stack(rows), _common([x.attrs for x in found]))


def _padded(name: str, capture: xr.Dataset, dims: list[Hashable], views: int) -> np.ndarray:
    """Pad a variable of one capture to a number of views."""
    default = xr.Variable((), DEFAULTS.get(name, np.nan))
    variable = capture[name].variable if name in capture else default
    sizes = {each: capture.sizes[each] for each in dims}
    values = variable.set_dims(sizes).transpose(*dims).values
    if "view" not in sizes:
        return values
    widths = [(0, views - size if each == "view" else 0) for each, size in sizes.items()]
    if name in PER_VIEW:
        return np.pad(values, widths, mode="edge")
    return np.pad(values, widths, constant_values=False if name in FLAGS else np.nan)


def _common(attributes: Sequence[Mapping[Hashable, object]]) -> dict[Hashable, object]:
    """Return the attributes that are equal in all captures."""
    first, *others = attributes or ({},)
    return {n: x for n, x in first.items() if all(n in each and each[n] == x for each in others)}
