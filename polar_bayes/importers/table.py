"""A capture from a table with one line for each reading and its directions.

    view_zenith, view_azimuth, dop, intensity
    10, 180, 0.021, 812
    20, 180, 0.043, 790

A line is a view. If there is a column `wavelength`, lines of the same directions are one view; a
line that repeats both begins another view. A column `patch` or `material` combines captures as
`polar_bayes.capture.combine` does. Entries that no line holds are `valid=False`.
"""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path

import numpy as np
import xarray as xr

from polar_bayes.capture.combine import DIMS, combine
from polar_bayes.capture.schema import CONTRACT, WAVELENGTH, Interval, nearest_name, validate
from polar_bayes.capture.table_reader import column_names, read_table
from polar_bayes.errors import CaptureError

KNOWN = {row.name: row for row in (*CONTRACT, WAVELENGTH)}
PER_VIEW = tuple(row.name for row in CONTRACT if row.kind in ("geometry", "trust"))
LARGEST = float(np.finfo(np.float64).max)
FINITE = Interval(-LARGEST, LARGEST)


def from_table(
    table: str | os.PathLike[str],
    *,
    columns: Mapping[str, str] | None = None,
    constants: Mapping[str, float] | None = None,
    ignored: Sequence[str] = (),
    setup: str | None = None,
    saturation_level: float | None = None,
    name: str | None = None,
) -> xr.Dataset:
    """A capture from a table with a line for each reading; the module tells how.

    Args:
        table: A text table of numbers whose first line names the columns. Columns that are named
            as the variables of a capture (`view_zenith` in degrees, `dop`, ...) are these.
        columns: Column of a variable, where it has another name: `{"dop": "DoLP"}`. One column may
            be several: the angle of a mirror is that of view and light.
        constants: Variables that are the same everywhere: `{"light_zenith": 45.0}`.
        ignored: Columns to leave out.
        setup: Which scene, links and limits a fit takes by default; None: the paper's.
        saturation_level: Intensity, > 0, at which the detector saturates.
        name: Name of the capture; default: that of the table.

    Returns:
        The validated capture, with dims ([patch or material,] view[, wavelength]).

    Raises:
        CaptureError: The column, or the line and number, that is wrong.
    """
    source = str(table)
    columns = _columns(column_names(source), columns or {}, ignored, source)
    constants = constants or {}
    _check_constants(constants, columns, source)
    read = read_table(source, list(columns.values()))
    values = {variable: read.columns[column] for variable, column in columns.items()}
    values |= {variable: np.full(len(read.lines), float(x)) for variable, x in constants.items()}
    _check_values(values, columns, read.lines, source)
    leading = [dim for dim in DIMS if dim in values]
    if len(leading) > 1:
        hint = "ignore one of both"
        raise CaptureError("it has materials and patches", where=source, hint=hint)
    if leading:
        labels = values.pop(leading[0])
        parts = {
            # All digits: two numbers never have one label. Adding zero turns -0.0 into 0.0.
            repr(float(label) + 0.0).removesuffix(".0"): _capture(
                {name: x[labels == label] for name, x in values.items()}, saturation_level
            )
            for label in np.unique(labels)
        }
        capture = combine(parts, dim=leading[0])
    else:
        capture = _capture(values, saturation_level)
    capture = capture.assign_attrs(source=Path(source).name, name=name or Path(source).stem)
    if setup is not None:
        capture.attrs["setup"] = setup
    return validate(capture, source=source)


# --- Columns --------------------------------------------------------------------------------------


def _columns(
    names: Sequence[str], columns: Mapping[str, str], ignored: Sequence[str], source: str
) -> dict[str, str]:
    """The column of each variable; every column is used or ignored."""
    for column in (*columns.values(), *ignored):
        if column not in names:
            hint = f"choose from {', '.join(names)}"
            raise CaptureError(f"there is no column {column!r}", where=source, hint=hint)
    for variable, column in columns.items():
        _check_name(variable, f"{source}: column {column}")
    used = dict(columns)
    for column in (name for name in names if name not in (*columns.values(), *ignored)):
        where = f"{source}: column {column}"
        _check_name(column, where)
        if column in used:
            what = f"{column} is the column {used[column]!r}, too"
            raise CaptureError(what, where=where, hint="ignore one of both")
        used[column] = column
    return used


def _check_constants(
    constants: Mapping[str, float], columns: Mapping[str, str], source: str
) -> None:
    """Refuse constants that are no numbers or also columns, and missing directions."""
    for variable, value in constants.items():
        _check_name(variable, source)
        if not (isinstance(value, Real) and FINITE.contains(value)):
            hint = "give a finite number"
            raise CaptureError(f"{variable} is {value!r}", where=source, hint=hint)
        if variable in columns:
            what = f"{variable} is a constant and the column {columns[variable]!r}"
            raise CaptureError(what, where=source, hint="give one of both, or ignore the column")
    for row in CONTRACT:
        if row.kind == "geometry" and row.name not in {*columns, *constants}:
            hint = f"say which column it is, or give it as a constant: {row.hint}"
            raise CaptureError(f"nothing gives {row.name}", where=source, hint=hint)


def _check_name(variable: str, where: str) -> None:
    if near := nearest_name(variable, [*KNOWN, *DIMS]):
        raise CaptureError(
            f"a capture has no variable {variable!r}",
            where=where,
            hint=f"say what it is (nearest: {near}), call it true_<name> or ignore it",
        )


def _check_values(
    values: Mapping[str, np.ndarray], columns: Mapping[str, str], lines: Sequence[int], source: str
) -> None:
    """Check each number against the contract, by its line; readings only where they are valid."""
    valid = values.get("valid", np.ones(len(lines))) != 0.0
    for variable in (name for name in values if name in KNOWN):
        row, numbers = KNOWN[variable], values[variable]
        wrong = ~row.range.contains(numbers) & (valid | (row.kind != "reading"))
        if wrong.any():
            first = int(np.argmax(wrong))
            column = f", column {columns[variable]}" if variable in columns else ""
            raise CaptureError(
                f"{variable} is {numbers[first]:g}, which is outside {row.range}",
                where=f"{source}: line {lines[first]}{column}",
                hint=row.hint,
            )


# --- Lines of one material ------------------------------------------------------------------------


def _capture(values: dict[str, np.ndarray], saturation_level: float | None) -> xr.Dataset:
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
    """Lines of several wavelengths; the entry of a view that lacks one is not valid."""
    label, column = np.unique(waves, return_inverse=True)
    view = _views(values, column)
    first = np.unique(view, return_index=True)[1]
    variables: dict[str, tuple] = {}
    for name, x in {"valid": np.ones(len(view)), **values}.items():
        if name in PER_VIEW:
            variables[name] = ("view", x[first])
            continue
        is_flag = name in KNOWN and KNOWN[name].kind == "flag"
        filled = np.full((len(first), len(label)), 0.0 if is_flag else np.nan)
        filled[view, column] = x
        variables[name] = (("view", "wavelength"), filled)
    return xr.Dataset(variables, {"wavelength": label})


def _views(values: dict[str, np.ndarray], column: np.ndarray) -> np.ndarray:
    """The view of each line: one for each set of directions, and one more for each repetition."""
    numbers: dict[tuple, int] = {}
    repetitions: Counter[tuple] = Counter()
    views = []
    directions = [values[name] for name in PER_VIEW if name in values]
    for line in zip(*directions, column, strict=True):
        key = (*line[:-1], repetitions[line])
        repetitions[line] += 1
        views.append(numbers.setdefault(key, len(numbers)))
    return np.array(views)
