"""Several captures as one: materials or patches side by side, to be fitted together."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from polar_bayes.capture.schema import CONTRACT, SIGNALS, TRUTH, WAVELENGTH, validate
from polar_bayes.errors import CaptureError

DIMS = ("material", "patch")

# What a capture that says nothing means, and what an entry holds that no capture measured. The
# directions and the trust of such an entry are those of the last view: any would do.
SILENT = {"valid": True, "saturated": False, "interpolated": False, "normal_confidence": 1.0}
UNMEASURED = {"valid": False, "saturated": False, "interpolated": False}
ANYTHING = tuple(row.name for row in CONTRACT if row.kind in ("geometry", "trust"))


def combine(
    captures: Mapping[str, xr.Dataset], *, dim: str = "material", drop: Sequence[str] = ()
) -> xr.Dataset:
    """One capture that holds several, side by side along a leading dim.

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
        _check_alike(label, capture, first, pattern)
        _check_labels(label, capture, first, pattern)
    together = list(checked.values())
    longest = max(capture.sizes["view"] for capture in together)
    variables = {
        name: _side_by_side(name, together, dim, longest)
        for name in dict.fromkeys(
            ["valid", *(str(name) for each in together for name in each.data_vars)]
        )
    }
    coordinates = {name: variable.variable for name, variable in pattern.coords.items()}
    coordinates[dim] = xr.Variable((dim,), np.array(list(checked), dtype=np.str_))
    attributes = _shared([capture.attrs for capture in together]) | {"name": ", ".join(checked)}
    return validate(xr.Dataset(variables, coordinates, attributes), source="combine")


# --- what fits together -------------------------------------------------------------------------


def _checked(
    captures: Mapping[str, xr.Dataset], dim: str, drop: Sequence[str]
) -> dict[str, xr.Dataset]:
    """The captures, validated, none with a leading dim."""
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


def _check_alike(label: str, capture: xr.Dataset, first: str, pattern: xr.Dataset) -> None:
    """Refuse a capture that does not stand beside the first."""
    where = f"combine: {label}"
    for name in _required([pattern, capture]):
        if (name in capture) != (name in pattern):
            with_, without = (label, first) if name in capture else (first, label)
            hint = f"add it there, or {_leave_out(name)}"
            raise CaptureError(f"{without} has no {name}, and {with_} has", where=where, hint=hint)
    for name in map(str, pattern.data_vars):
        for attribute in ("units", "saturation_level") if name in capture else ():
            mine, its = (each[name].attrs.get(attribute) for each in (capture, pattern))
            if mine != its:
                raise CaptureError(
                    f"{attribute} of {name} is {_said(mine)}, that of {first} {_said(its)}",
                    where=where,
                    hint=f"bring both to one, or {_leave_out(name)}",
                )


def _check_labels(label: str, capture: xr.Dataset, first: str, pattern: xr.Dataset) -> None:
    """Refuse other colors, and labels that cannot be those of both."""
    for name in dict.fromkeys(map(str, [*pattern.coords, *capture.coords])):
        mine, its = (each.variables.get(name) for each in (capture, pattern))
        if mine is None or its is None or not mine.equals(its):
            hint = f"drop the label with drop_vars({name!r})"
            if name == WAVELENGTH.name:
                hint = "give captures of the same wavelengths, or select those that all have"
            raise CaptureError(
                f"{name} is {_said(mine)}, that of {first} {_said(its)}",
                where=f"combine: {label}",
                hint=hint,
            )


def _required(captures: Sequence[xr.Dataset]) -> list[str]:
    """Readings and directions, which captures must have in common; each once."""
    found = (str(name) for capture in captures for name in capture.data_vars)
    return list(
        dict.fromkeys(name for name in found if name not in SILENT and not TRUTH.fullmatch(name))
    )


def _leave_out(name: str) -> str:
    return f"leave it out of all with drop=[{name!r}], in a command --drop {name}"


def _said(value: Any) -> str:
    if value is None:
        return "not stated"
    if isinstance(value, xr.Variable):
        items = np.atleast_1d(value.values).tolist()
        return ", ".join(map(str, items[:4])) + (", ..." if len(items) > 4 else "")
    return str(value)


# --- side by side -------------------------------------------------------------------------------


def _side_by_side(name: str, captures: list[xr.Dataset], dim: str, views: int) -> xr.Variable:
    """One variable of all captures, in their order."""
    there = [capture[name].variable for capture in captures if name in capture]
    order = [*next(captures[0][signal].dims for signal in SIGNALS if signal in captures[0])]
    if name in SILENT and name != "normal_confidence":
        dims = order
    else:
        dims = [each for each in order if any(each in variable.dims for variable in there)]
    rows = [_row(name, capture, dims, views) for capture in captures]
    attributes = _shared([variable.attrs for variable in there])
    return xr.Variable((dim, *dims), np.stack(rows), attributes)


def _row(name: str, capture: xr.Dataset, dims: list[Any], views: int) -> np.ndarray:
    """One capture's part of a variable, filled up to a number of views."""
    sizes = {each: capture.sizes[each] for each in dims}
    variable = capture[name].variable if name in capture else xr.Variable((), _silent(name))
    values = variable.set_dims(sizes).transpose(*dims).values
    if "view" not in sizes:
        return values
    widths = [(0, views - size if each == "view" else 0) for each, size in sizes.items()]
    if name in ANYTHING:
        return np.pad(values, widths, mode="edge")
    return np.pad(values, widths, constant_values=UNMEASURED.get(name, np.nan))


def _silent(name: str) -> bool | float:
    return SILENT.get(name, np.nan)


def _shared(attributes: Sequence[Mapping[Any, Any]]) -> dict[Any, Any]:
    """The attributes that are equal in all."""
    first, *others = attributes or ({},)
    return {
        name: value
        for name, value in first.items()
        if all(name in other and other[name] == value for other in others)
    }
