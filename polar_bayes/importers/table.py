"""A capture from a table with one line for each reading and its directions.

    view_zenith, view_azimuth, dop, intensity
    10, 180, 0.021, 812
    20, 180, 0.043, 790

A line is a view. If there is a column `wavelength`, lines of the same directions are one view; a
line that repeats both begins another view. A column `patch` or `material` combines captures as
`polar_bayes.capture.combine` does. Entries that no line holds are `valid=False`.

The parser is our own and strict, since the well-kept ones guess: `csv.Sniffer` takes the separator
from letter frequencies and fails on short tables; `pandas.read_csv` fills short rows, turns a
surplus column into an index and names no line; `numpy.genfromtxt` turns text into NaN. None keeps
the printed digits, which give a reading's resolution.
"""

import dataclasses
import math
import os
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from decimal import Decimal
from numbers import Real
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.capture.combine import DIMS, PER_VIEW, combine
from polar_bayes.capture.schema import CONTRACT, WAVELENGTH, hint_for, nearest_name, validate
from polar_bayes.errors import CaptureError
from polar_bayes.paths import existing_file, system_error

KNOWN = {row.name: row for row in (*CONTRACT, WAVELENGTH)}


def from_table(
    table: str | os.PathLike[str],
    *,
    columns: Mapping[str, str] | None = None,
    constants: Mapping[str, float] | None = None,
    ignored: Sequence[str] = (),
    setup: str | None = None,
    angle_set_by: str = "hand",
    saturation_level: float | None = None,
    name: str | None = None,
) -> xr.Dataset:
    """A capture from a table with a line for each reading; see the module.

    Args:
        table: A text table of numbers whose first line names the columns. Columns that are named
            as the variables of a capture (`view_zenith` in degrees, `dop`, ...) are these.
        columns: Column of a variable, where it has another name: `{"dop": "DoLP"}`. One column may
            be several: the angle of a mirror is that of view and light.
        constants: Variables that are the same everywhere: `{"light_zenith": 45.0}`.
        ignored: Columns to leave out.
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
    source = str(table)
    names, rows = _read_cells(source)
    columns = _columns(names, columns or {}, ignored, source)
    constants = constants or {}
    _check_constants(constants, columns, source)
    read = _as_numbers(source, names, rows, columns.values())
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
    capture = capture.assign_attrs(
        source=Path(source).name, name=name or Path(source).stem, angle_set_by=angle_set_by
    )
    if setup is not None:
        capture.attrs["setup"] = setup
    return validate(capture, source=source)


# --- Columns --------------------------------------------------------------------------------------


def _columns(
    names: Sequence[str], columns: Mapping[str, str], ignored: Sequence[str], source: str
) -> dict[str, str]:
    """The column of each variable; every column is used or ignored."""
    for column in (*columns.values(), *ignored):
        _check_column(column, names, source)
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


def _check_column(column: str, names: Sequence[str], source: str) -> None:
    if column not in names:
        hint = f"choose from {', '.join(names)}"
        raise CaptureError(f"there is no column {column!r}", where=source, hint=hint)


def _check_constants(
    constants: Mapping[str, float], columns: Mapping[str, str], source: str
) -> None:
    """Refuse constants that are no numbers or also columns, and missing directions."""
    for variable, value in constants.items():
        _check_name(variable, source)
        if not (isinstance(value, Real) and abs(value) <= sys.float_info.max):
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
        hint = f"say what it is (nearest: {near}), call it true_<name> or ignore it"
        raise CaptureError(f"a capture has no variable {variable!r}", where=where, hint=hint)


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
            what = f"{variable} is {numbers[first]:g}, which is outside {row.range}"
            where = f"{source}: line {lines[first]}{column}"
            raise CaptureError(what, where=where, hint=hint_for(row, numbers[wrong]))


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
    directions = {name: values[name] for name in PER_VIEW if name in values}
    lines = pd.DataFrame({**directions, "column": column})
    lines["repetition"] = lines.groupby([*lines], sort=False).cumcount()
    return lines.groupby([*directions, "repetition"], sort=False).ngroup().to_numpy()


# --- Text tables of numbers, as detectors and spreadsheets write them -----------------------------

LARGEST_FILE = 50_000_000  # bytes
BLANKS = re.compile(r"[ \t]+")
# A decimal comma is between digits, so the comma of "10, 5" separates.
NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*|,[0-9]+)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")
EACH_READING = "give a line for each reading"

Row = tuple[int, list[str]]  # line of the file, cells


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of numbers, with their lines and the value of each last printed digit."""

    source: str
    columns: Mapping[str, np.ndarray]
    steps: Mapping[str, np.ndarray]
    lines: tuple[int, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns; without a header line column_1, column_2, ..."""
        return tuple(self.columns)


def read_table(path: str | os.PathLike[str], columns: Sequence[str] | None = None) -> Table:
    """A text table of numbers, by default with all its columns."""
    names, rows = _read_cells(path)
    return _as_numbers(str(path), names, rows, columns or names)


def _as_numbers(source: str, names: list[str], rows: list[Row], columns: Collection[str]) -> Table:
    """Some columns of a table of text."""
    if not rows:
        raise CaptureError("it holds names but no rows", where=source, hint=EACH_READING)
    has_points = any("." in cell for _, cells in rows for cell in cells)
    for line, cells in rows:
        where = f"{source}: line {line}"
        if len(cells) != len(names):
            what = f"it has another number of cells ({len(cells)}) than the first ({len(names)})"
            raise CaptureError(what, where=where, hint="give every line one cell for each column")
        if has_points and any("," in cell for cell in cells):  # "1,234" could be 1.234 or 1234
            what = "decimal commas stand beside decimal points"
            hint = "use one of them, and no mark for thousands"
            raise CaptureError(what, where=where, hint=hint)
    values, steps = {}, {}
    for name in columns:
        _check_column(name, names, source)
        k = names.index(name)
        pairs = [_number(cells[k], f"{source}: line {line}, column {name}") for line, cells in rows]
        values[name], steps[name] = np.array(pairs).T
    return Table(source, values, steps, tuple(line for line, _ in rows))


def _read_cells(path: str | os.PathLike[str]) -> tuple[list[str], list[Row]]:
    """Names of the columns of a text table, and the rows below them."""
    # Semicolons, tabs, commas or blanks separate the cells; runs of tabs or of blanks separate
    # once. The first line may name the columns. From a # to the end of its line is comment. Where
    # commas do not separate they may be decimal commas, in the whole table or not at all.
    file = existing_file(path, "table")
    lines = []
    for number, line in enumerate(re.split("\r\n|\r|\n", _text(file)), 1):
        if content := line.partition("#")[0].strip():
            lines.append((number, content))
    if not lines:
        raise CaptureError("it holds no rows", where=str(file), hint=EACH_READING)
    # The second line holds numbers, whether or not the first one holds names.
    separator = _separator(lines[min(1, len(lines) - 1)][1])
    rows = [(number, [_unquoted(x) for x in separator.split(line)]) for number, line in lines]
    return _take_header(rows, str(file))


def _text(file: Path) -> str:
    try:
        if file.stat().st_size > LARGEST_FILE:
            hint = "give a table of at most 50 MB"
            raise CaptureError("the file is too large", where=str(file), hint=hint)
        content = file.read_bytes()
    except OSError as error:
        raise system_error(error, file) from error
    if b"\0" in content:
        raise CaptureError("it is not text", where=str(file), hint="save the table as UTF-8 text")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:  # such as a degree sign in an old header; digits are ASCII anyway
        return content.decode("latin-1")


def _separator(line: str) -> re.Pattern[str]:
    if ";" in line:
        return re.compile(";")
    if "\t" in line:
        return re.compile(r"\t+")
    cells = BLANKS.split(line)
    decimal_commas = len(cells) > 1 and all(map(_is_number, cells))
    return re.compile(",") if "," in line and not decimal_commas else BLANKS


def _unquoted(cell: str) -> str:
    cell = cell.strip()
    quoted = len(cell) > 1 and cell[0] == cell[-1] == '"'
    return cell[1:-1].strip() if quoted else cell


def _take_header(rows: list[Row], source: str) -> tuple[list[str], list[Row]]:
    """Names of the columns and the rows below them."""
    line, first = rows[0]
    if not all(map(_is_name, filter(None, first))):
        return [f"column_{k}" for k in range(1, len(first) + 1)], rows
    names = [name or f"column_{k}" for k, name in enumerate(first, 1)]
    where = f"{source}: line {line}"
    if len(set(names)) != len(names):
        hint = "name each column once"
        raise CaptureError("two columns have the same name", where=where, hint=hint)
    if not all(name.isprintable() for name in names):
        hint = "save the table as UTF-8 text"
        raise CaptureError("a name is not printable text", where=where, hint=hint)
    return names, rows[1:]


def _is_name(cell: str) -> bool:
    """Whether a cell is a name rather than a mistyped number, which must not be lost."""
    lettered = any(character.isalpha() for character in cell)
    is_missing = cell.lower() in ("nan", "inf", "infinity", "na", "n/a", "none", "null")
    return lettered and cell[0] not in "0123456789+-.," and not is_missing


def _is_number(cell: str) -> bool:
    return len(cell) <= 64 and NUMBER.fullmatch(cell) is not None


def _number(cell: str, where: str) -> tuple[float, float]:
    """Value of a cell, and of its last printed digit."""
    if _is_number(cell):
        digits = cell.replace(",", ".")
        value = float(digits)
        step = float(f"1e{Decimal(digits).as_tuple().exponent}")
        if math.isfinite(value) and 0.0 < step < math.inf:
            return value, step
    hint = "correct it, or take the line out (a # before it makes it a comment)"
    raise CaptureError(f"{cell!r} is not a finite number", where=where, hint=hint)
