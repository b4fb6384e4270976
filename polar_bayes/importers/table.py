"""Any readings, listed a line each with their directions, as a capture.

    view_zenith, view_azimuth, dop, intensity
    10, 180, 0.021, 812
    20, 180, 0.043, 790

A line is a view. Where a column `wavelength` is there, lines of the same directions are one view; a
line that repeats both begins another. A column `patch` or `material` puts captures side by side, as
`polar_bayes.capture.combine` does. What no line holds is not made up: it is `valid=False`.
"""

import math
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from polar_bayes.capture.combine import DIMS, combine
from polar_bayes.capture.schema import CONTRACT, WAVELENGTH, Variable, nearest_name, validate
from polar_bayes.capture.table_reader import column_names, read_table
from polar_bayes.errors import CaptureError

KNOWN = {row.name: row for row in (*CONTRACT, WAVELENGTH)}
OF_A_VIEW = tuple(row.name for row in CONTRACT if row.kind in ("geometry", "trust"))
REQUIRED = tuple(row.name for row in CONTRACT if row.kind == "geometry")


class _Lines(NamedTuple):
    """What a table says."""

    values: dict[str, np.ndarray]
    columns: dict[str, str]
    numbers: np.ndarray


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
    lines = _read(source, dict(columns or {}), dict(constants or {}), ignored)
    _check(lines, source)
    attributes: dict[str, str] = {"source": Path(source).name}
    if setup is not None:
        attributes["setup"] = setup
    leading = [dim for dim in DIMS if dim in lines.values]
    if len(leading) > 1:
        hint = "ignore one of both"
        raise CaptureError("it has materials and patches", where=source, hint=hint)
    if leading:
        capture = _side_by_side(lines.values, leading[0], saturation_level)
    else:
        capture = _capture(lines.values, saturation_level)
    named = attributes | {"name": name or Path(source).stem}
    return validate(capture.assign_attrs(named), source=source)


def _read(
    source: str, columns: dict[str, str], constants: dict[str, float], ignored: Sequence[str]
) -> _Lines:
    """Values of each variable in each line."""
    taken = _taken(column_names(source), columns, ignored, source)
    for variable, value in constants.items():
        _check_name(variable, None, source)
        if not _is_finite(value):
            hint = "give a finite number"
            raise CaptureError(f"{variable} is {value!r}", where=source, hint=hint)
        if variable in taken:
            what = f"{variable} is a constant and the column {taken[variable]!r}"
            raise CaptureError(what, where=source, hint="give one of both, or ignore the column")
    for variable in REQUIRED:
        if variable not in taken and variable not in constants:
            hint = f"say which column it is, or give it as a constant: {KNOWN[variable].hint}"
            raise CaptureError(f"nothing gives {variable}", where=source, hint=hint)
    read = read_table(source, list(taken.values()))
    values = {variable: read.columns[column] for variable, column in taken.items()}
    count = len(read.lines)
    values |= {variable: np.full(count, float(x)) for variable, x in constants.items()}
    return _Lines(values, taken, np.array(read.lines))


def _is_finite(value: object) -> bool:
    """Whether it is a real number that a float can hold."""
    try:
        return isinstance(value, Real) and math.isfinite(value)
    except OverflowError:  # an integer beyond the largest float
        return False


def _taken(
    names: Sequence[str], columns: dict[str, str], ignored: Sequence[str], source: str
) -> dict[str, str]:
    """The column of each variable; every column is one or is ignored."""
    for column in (*columns.values(), *ignored):
        if column not in names:
            hint = f"choose from {', '.join(names)}"
            raise CaptureError(f"there is no column {column!r}", where=source, hint=hint)
    for variable, column in columns.items():
        _check_name(variable, column, source)
    taken = dict(columns)
    for column in (name for name in names if name not in (*columns.values(), *ignored)):
        _check_name(column, column, source)
        if column in taken:
            what = f"{column} is the column {taken[column]!r}, too"
            where = f"{source}: column {column}"
            raise CaptureError(what, where=where, hint="ignore one of both")
        taken[column] = column
    return taken


def _check_name(variable: str, column: str | None, source: str) -> None:
    if near := nearest_name(variable, [*KNOWN, *DIMS]):
        raise CaptureError(
            f"a capture has no variable {variable!r}",
            where=source if column is None else f"{source}: column {column}",
            hint=f"say what it is (nearest: {near}), call it true_<name> or ignore it",
        )


def _check(lines: _Lines, source: str) -> None:
    """Each number against the contract, by its line; what is not valid is not looked at."""
    valid = lines.values.get("valid", np.ones(len(lines.numbers))) != 0.0
    for variable, values in lines.values.items():
        row = KNOWN.get(variable)
        if row is None:
            continue
        wrong = np.flatnonzero(~row.range.contains(values) & (valid | (row.kind != "reading")))
        if not wrong.size:
            continue
        first = wrong[0]
        where = f"{source}: line {lines.numbers[first]}"
        if variable in lines.columns:
            where += f", column {lines.columns[variable]}"
        what = f"{variable} is {values[first]:g}, which is outside {row.range}"
        raise CaptureError(what, where=where, hint=row.hint)


def _side_by_side(
    values: dict[str, np.ndarray], dim: str, saturation_level: float | None
) -> xr.Dataset:
    """The lines of each patch or material, by its number."""
    rest = {name: x for name, x in values.items() if name != dim}
    parts = {}
    for number in np.unique(values[dim]):
        own = {name: x[values[dim] == number] for name, x in rest.items()}
        # All digits: two numbers never have one label.
        # Adding zero turns -0.0 into 0.0, which is the same patch.
        parts[repr(float(number) + 0.0).removesuffix(".0")] = _capture(own, saturation_level)
    return combine(parts, dim=dim)


def _capture(values: dict[str, np.ndarray], saturation_level: float | None) -> xr.Dataset:
    """The lines of one patch, or of all."""
    rest = {name: x for name, x in values.items() if name != "wavelength"}
    waves = values.get("wavelength")
    if waves is None or len(np.unique(waves)) == 1:
        capture = xr.Dataset({name: ("view", x) for name, x in rest.items()})
        capture = capture if waves is None else capture.assign_coords(wavelength=waves[0])
    else:
        capture = _spectral(rest, waves)
    if "intensity" in capture and saturation_level is not None:
        capture["intensity"].attrs["saturation_level"] = saturation_level
    return capture


def _spectral(values: dict[str, np.ndarray], waves: np.ndarray) -> xr.Dataset:
    """Lines of several wavelengths; of a view that lacks one, its entry is not valid."""
    label, column = np.unique(waves, return_inverse=True)
    row = _views(values, column)
    first = np.unique(row, return_index=True)[1]
    variables: dict[str, tuple] = {}
    for name, x in {"valid": np.ones(len(row)), **values}.items():
        if name in OF_A_VIEW:
            variables[name] = ("view", x[first])
            continue
        laid = np.full((len(first), len(label)), 0.0 if _is_flag(name) else np.nan)
        laid[row, column] = x
        variables[name] = (("view", "wavelength"), laid)
    return xr.Dataset(variables, {"wavelength": label})


def _is_flag(name: str) -> bool:
    row: Variable | None = KNOWN.get(name)
    return row is not None and row.kind == "flag"


def _views(values: dict[str, np.ndarray], column: np.ndarray) -> np.ndarray:
    """Number of the view of each line, in the order of their first lines."""
    # One for each set of directions, and one more for each time that a wavelength is repeated
    # there.
    numbers: dict[tuple, int] = {}
    seen: dict[tuple, int] = defaultdict(int)
    found = []
    for at, wave in enumerate(column):
        directions = tuple(values[name][at] for name in OF_A_VIEW if name in values)
        again = seen[directions, int(wave)]
        seen[directions, int(wave)] += 1
        found.append(numbers.setdefault((directions, again), len(numbers)))
    return np.array(found)
