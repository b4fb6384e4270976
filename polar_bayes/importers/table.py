"""A capture from a table with one line for each reading and its directions.

    view_zenith, view_azimuth, dop, intensity
    10, 180, 0.021, 812
    20, 180, 0.043, 790

A line is a view. If there is a column `wavelength`, lines of the same directions are one view; a
line that repeats both begins another view. A column `patch` or `material` combines captures as
`polar_bayes.capture.combine` does. Entries that no line holds, and lines in which the cell of a
reading is blank, are `valid=False`. A reading with its uncertainty in one cell, such as 0.12(1) or
0.12±0.01, is reading and error. A column `aolp` (angle of linear polarization) makes q and u of
`dop`:

    q = dop cos(2 aolp),    u = dop sin(2 aolp)
"""

import os
import re
import sys
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.capture.combine import DIMS, PER_VIEW, combine
from polar_bayes.capture.schema import (
    CONTRACT,
    TURN,
    WAVELENGTH,
    Variable,
    check_choice,
    hint_for,
    nearest_name,
    validate,
)
from polar_bayes.errors import CaptureError
from polar_bayes.importers.columns import Table, check_column, counted, read_table
from polar_bayes.importers.mirror import as_incidence

KNOWN = {row.name: row for row in (*CONTRACT, WAVELENGTH)}
KNOWN["aolp"] = Variable(
    "aolp", "reading", "degree", TURN, "angle of linear polarization",
    "give degrees from the s axis, or from the p axis by aolp_from='p'", "dop",
)  # fmt: skip
AXES = {"s": 0.0, "p": 90.0}
"""Angle of each polarization axis from the s axis, degree."""
MUELLER = re.compile(r"[mM]_?\[?([0-4])_?,?([0-4])\]?")
"""Pattern of the name of an element of a Mueller matrix."""


def from_table(
    table: str | os.PathLike[str],
    *,
    columns: Mapping[str, str] | None = None,
    constants: Mapping[str, float] | None = None,
    ignored: Sequence[str] = (),
    angle: str | None = None,
    angle_is: str | None = None,
    aolp_from: str = "s",
    sheet: str | None = None,
    setup: str | None = None,
    angle_set_by: str = "hand",
    saturation_level: float | None = None,
    name: str | None = None,
) -> xr.Dataset:
    """Make a capture from a table with a line for each reading; see the module.

    Args:
        table: A text table or .xlsx workbook whose first line names the columns. Columns that are
            named as the variables of a capture (`view_zenith` in degrees, `dop`, ...) are these.
        columns: Column of a variable, where it has another name: `{"dop": "DoLP"}`. One column may
            be several. `aolp`, in degrees, is the angle of linear polarization.
        constants: Variables that are the same everywhere: `{"light_zenith": 45.0}`.
        ignored: Columns to leave out.
        angle: Column with the angle of a mirror: of view and light, on opposite sides.
        angle_is: What that angle is: "incidence" (whose absolute value is taken), "from-surface",
            "two-theta" or "deviation" (`polar_bayes.importers.mirror`); by default the angle of
            incidence, 0 or larger.
        aolp_from: The axis from which `aolp` counts: "s" (perpendicular to the plane of normal and
            viewer) or "p" (in that plane).
        sheet: Sheet of a workbook, where several hold something.
        setup: Which scene, links and limits a fit takes by default; None: those of "polarimeter".
        angle_set_by: How the angles were set: "stage", "hand" or "lens"; a fit takes the prior of
            `angle_zero` from it (`polar_bayes.priors.ANGLE_ZERO`).
        saturation_level: Intensity, > 0, at which the detector saturates.
        name: Name of the capture; default: that of the table.

    Returns:
        The validated capture, with dims ([patch or material,] view[, wavelength]).

    Raises:
        CaptureError: The column, or the line and number, that is wrong.
    """
    given, constants, used = dict(columns or {}), dict(constants or {}), {}
    check_choice(aolp_from, AXES, "aolp_from")
    if angle is not None:
        given |= {"view_zenith": angle, "light_zenith": angle}
        constants = {"view_azimuth": 180.0, "light_azimuth": 0.0, **constants}
    elif angle_is is not None:
        hint = "name the column by angle="
        raise CaptureError("the angle of a mirror is not named", where="angle_is", hint=hint)

    def chosen(names: list[str]) -> list[str]:
        """Return the columns to use; a line without the first one is left out."""
        used.update(_columns(names, given, ignored, str(table)))
        _check_constants(constants, used, str(table))
        order = sorted(used, key=lambda variable: variable != "view_zenith")
        return list(dict.fromkeys(used[variable] for variable in order))

    read = read_table(table, chosen, sheet=sheet, wanted=[*given.values(), *ignored])
    source = read.source
    values = {variable: read.columns[column] for variable, column in used.items()}
    if angle is not None:
        places = [f"{place}, column {angle}" for place in read.places]
        values["view_zenith"] = values["light_zenith"] = as_incidence(
            read.columns[angle], angle_is, places
        )
    values |= {variable: np.full(len(read.lines), float(x)) for variable, x in constants.items()}
    values |= _stated_errors(read, used, values)
    notes = [*read.notes, *_mask_blanks(values, used, read)]
    _check_values(values, used, read)
    if "aolp" in values:
        values |= _normalized_stokes(values, AXES[aolp_from], source)
        notes.append(f"q and u follow from dop and aolp, which counts from {aolp_from}")
    attributes = {"source": Path(source).name, "name": name or Path(source).stem}
    attributes |= {"angle_set_by": angle_set_by} | ({} if setup is None else {"setup": setup})
    attributes |= {"import_notes": "; ".join(notes)} if notes else {}
    capture = _of_materials(values, saturation_level, source).assign_attrs(attributes)
    return validate(capture, source=source)


# --- Columns --------------------------------------------------------------------------------------


def _columns(
    names: Sequence[str], columns: Mapping[str, str], ignored: Sequence[str], source: str
) -> dict[str, str]:
    """Return the column of each variable; every column is used or ignored."""
    for column in (*columns.values(), *ignored):
        check_column(column, names, source)
    for variable, column in columns.items():
        _check_name(variable, f"{source}: column {column}")
    used = dict(columns)
    if any(MUELLER.fullmatch(name) for name in names if name not in (*columns.values(), *ignored)):
        hint = "import it by pb.from_ellipsometer(mueller='column') if the light was unpolarized"
        raise CaptureError("it holds elements of Mueller matrices", where=source, hint=hint)
    for column in (name for name in names if name not in (*columns.values(), *ignored)):
        where = f"{source}: column {column}"
        _check_name(column, where, column)
        if column in used:
            what = f"{column} is the column {used[column]!r}, too"
            raise CaptureError(what, where=where, hint="leave one of both out by ignored=")
        used[column] = column
    return used


def _check_constants(
    constants: Mapping[str, float], columns: Mapping[str, str], source: str
) -> None:
    """Refuse constants that are not numbers or also columns, and missing directions."""
    for variable, value in constants.items():
        _check_name(variable, source)
        if not (isinstance(value, Real) and abs(value) <= sys.float_info.max):
            hint = "give a finite number"
            raise CaptureError(f"{variable} is {value!r}", where=source, hint=hint)
        if variable in columns:
            what = f"{variable} is a constant and the column {columns[variable]!r}"
            hint = "give one of both, or leave the column out by ignored="
            raise CaptureError(what, where=source, hint=hint)
    for row in CONTRACT:
        if row.kind == "geometry" and row.name not in {*columns, *constants}:
            mirror = "; or name the column of a mirror's angle by angle=" * ("zenith" in row.name)
            hint = (
                f"name its column by columns={{'{row.name}': COLUMN}}, or the value of all lines "
                f"by constants={{'{row.name}': NUMBER}} ({row.hint}){mirror}"
            )
            raise CaptureError(f"nothing gives {row.name}", where=source, hint=hint)


def _check_name(variable: str, where: str, column: str = "") -> None:
    if near := nearest_name(variable, [*KNOWN, *DIMS]):
        hint = f"name a variable (nearest: {near}), or call it true_<name>"
        if column:
            hint = (
                f"say which variable it is by columns={{VARIABLE: '{column}'}} (nearest: {near}), "
                f"leave it out by ignored=['{column}'], or import readings of s and p light by "
                "pb.from_goniometer"
            )
        raise CaptureError(f"a capture has no variable {variable!r}", where=where, hint=hint)


def _stated_errors(
    read: Table, columns: Mapping[str, str], values: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return errors that cells state, of variables that have no other errors."""
    found = {}
    for variable, column in columns.items():
        name, error = f"{variable}_error", read.errors[column]
        stated = np.isfinite(error)
        if name not in KNOWN or name in values or not stated.any():
            continue
        if (missing := ~stated & np.isfinite(values[variable])).any():
            what = f"it states no uncertainty, which {counted(int(stated.sum()), 'other')} do"
            where = f"{read.places[int(np.argmax(missing))]}, column {column}"
            raise CaptureError(what, where=where, hint="state that of every reading, or of none")
        found[name] = error
    return found


def _mask_blanks(
    values: dict[str, np.ndarray], columns: Mapping[str, str], read: Table
) -> list[str]:
    """Mark lines with blank readings as not valid; refuse other blanks."""
    blank = np.zeros(len(read.lines), bool)
    for variable, column in columns.items():
        missing = np.isnan(values[variable])
        if variable in KNOWN and KNOWN[variable].kind == "reading":
            blank |= missing
        elif missing.any() and not variable.startswith("true_"):
            where = f"{read.places[int(np.argmax(missing))]}, column {column}"
            hint = "fill it in, or take the line out (a # before it makes it a comment)"
            raise CaptureError(f"{variable} is blank", where=where, hint=hint)
    if not blank.any():
        return []
    values["valid"] = np.where(blank, 0.0, values.get("valid", 1.0))
    return [f"{counted(int(blank.sum()), 'line', 'with a blank reading')} masked"]


def _normalized_stokes(
    values: dict[str, np.ndarray], axis: float, source: str
) -> dict[str, np.ndarray]:
    """Return Stokes q and u, with errors, from degree and angle of polarization."""
    if "dop" not in values or "q" in values:
        hint = "give dop and aolp, or q and u"
        raise CaptureError("aolp makes q and u of dop alone", where=source, hint=hint)
    twice = np.deg2rad(2.0 * (values.pop("aolp") + axis))
    found = {"q": values["dop"] * np.cos(twice), "u": values["dop"] * np.sin(twice)}
    errors = ("q_error", "u_error") if "dop_error" in values else ()
    return found | {name: values["dop_error"] for name in errors}


def _check_values(
    values: Mapping[str, np.ndarray], columns: Mapping[str, str], read: Table
) -> None:
    """Check each number by the contract; readings are checked only where valid."""
    valid = values.get("valid", np.ones(len(read.lines))) != 0.0
    for variable in (name for name in values if name in KNOWN):
        row, numbers = KNOWN[variable], values[variable]
        wrong = ~row.range.contains(numbers) & (valid | (row.kind != "reading"))
        if wrong.any():
            first = int(np.argmax(wrong))
            column = f", column {columns[variable]}" if variable in columns else ""
            what = f"{variable} is {numbers[first]:g}, which is outside {row.range}"
            where = f"{read.places[first]}{column}"
            raise CaptureError(what, where=where, hint=hint_for(row, numbers[wrong]))


# --- Materials, and the lines of each -------------------------------------------------------------


def _of_materials(
    values: dict[str, np.ndarray], saturation_level: float | None, source: str
) -> xr.Dataset:
    leading = [dim for dim in DIMS if dim in values]
    if len(leading) > 1:
        hint = "leave one of both out by ignored="
        raise CaptureError("it has materials and patches", where=source, hint=hint)
    if leading:
        labels = values.pop(leading[0])
        parts = {
            # All digits: two numbers never have one label. Adding zero turns -0.0 into 0.0.
            repr(float(label) + 0.0).removesuffix(".0"): capture_of_lines(
                {name: x[labels == label] for name, x in values.items()}, saturation_level
            )
            for label in np.unique(labels)
        }
        return combine(parts, dim=leading[0])
    return capture_of_lines(values, saturation_level)


def capture_of_lines(
    values: dict[str, np.ndarray], saturation_level: float | None = None
) -> xr.Dataset:
    """Make a capture from lines of one material; lines of one direction are one view."""
    values = dict(values)
    waves = values.pop("wavelength", None)
    if waves is None or len(np.unique(waves)) == 1:
        capture = xr.Dataset({name: ("view", x) for name, x in values.items()})
        capture = capture if waves is None else capture.assign_coords(wavelength=waves[0])
    else:
        capture = _spectral(values, waves)
    if "intensity" in capture and saturation_level is not None:
        capture["intensity"].attrs["saturation_level"] = saturation_level
    return capture


def _spectral(values: dict[str, np.ndarray], waves: np.ndarray) -> xr.Dataset:
    """Arrange lines of several wavelengths; views are masked at wavelengths they lack."""
    lines = pd.DataFrame({"valid": 1.0, **values, "wavelength": waves}, dtype=float)
    directions = [name for name in PER_VIEW if name in values]
    # One view for each set of directions, and for each repetition of it.
    repetition = lines.groupby([*directions, "wavelength"], sort=False).cumcount()
    lines["view"] = lines.groupby([*directions, repetition], sort=False).ngroup()
    views = xr.Dataset.from_dataframe(lines.groupby("view")[directions].first())
    readings = lines.drop(columns=directions).set_index(["view", "wavelength"])
    unread = {name: 0.0 for name in readings if name in KNOWN and KNOWN[name].kind == "flag"}
    return views.merge(xr.Dataset.from_dataframe(readings).fillna(unread)).drop_vars("view")
