"""Text tables of numbers, as detectors and spreadsheets write them.

The parser is our own and strict, since the well-kept ones guess: `csv.Sniffer` takes the separator
from letter frequencies and fails on short tables; `pandas.read_csv` fills short rows, turns a
surplus column into an index and names no line; `numpy.genfromtxt` turns text into NaN. None keeps
the printed digits, which give a reading's resolution.
"""

import dataclasses
import math
import os
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from polar_bayes.errors import CaptureError
from polar_bayes.paths import existing_file, system_error

LARGEST_FILE = 50_000_000  # bytes
BLANKS = re.compile(r"[ \t]+")
# A decimal comma stands between digits, so that in "10, 5" it separates.
NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*|,[0-9]+)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")
LONGEST_NUMBER = 64  # characters
MISSING = frozenset({"nan", "inf", "infinity", "na", "n/a", "none", "null"})
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
    """A text table of numbers."""
    # Semicolons, tabs, commas or blanks separate the cells; runs of tabs or of blanks separate
    # once. The first line may name the columns. From a # to the end of its line is comment. Where
    # commas do not separate they may be decimal commas, in the whole table or not at all.
    source, names, rows = _parts(path)
    if not rows:
        raise CaptureError("it holds names but no rows", where=source, hint=EACH_READING)
    for line, cells in rows:
        if len(cells) != len(names):
            what = f"it has another number of cells ({len(cells)}) than the first ({len(names)})"
            hint = "give every line one cell for each column"
            raise CaptureError(what, where=f"{source}: line {line}", hint=hint)
    has_points = any("." in cell for _, cells in rows for cell in cells)
    for line, cells in rows:
        if has_points and any("," in cell for cell in cells):  # "1,234" could be 1.234 or 1234
            what = "decimal commas stand beside decimal points"
            hint = "use one of them, and no mark for thousands"
            raise CaptureError(what, where=f"{source}: line {line}", hint=hint)
    pairs = {}
    for name in columns or names:
        if name not in names:
            hint = f"choose from {', '.join(names)}"
            raise CaptureError(f"there is no column {name!r}", where=source, hint=hint)
        k = names.index(name)
        pairs[name] = np.array(
            [_number(cells[k], f"{source}: line {line}, column {name}") for line, cells in rows]
        )
    return Table(
        source=source,
        columns={name: pair[:, 0] for name, pair in pairs.items()},
        steps={name: pair[:, 1] for name, pair in pairs.items()},
        lines=tuple(line for line, _ in rows),
    )


def column_names(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Names of the columns of a text table, as `read_table` reads it."""
    return tuple(_parts(path)[1])


def _parts(path: str | os.PathLike[str]) -> tuple[str, list[str], list[Row]]:
    """Path, names of the columns, and the rows below them."""
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
    return str(file), *_take_header(rows, str(file))


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
    return lettered and cell[0] not in "0123456789+-.," and cell.lower() not in MISSING


def _is_number(cell: str) -> bool:
    return len(cell) <= LONGEST_NUMBER and NUMBER.fullmatch(cell) is not None


def _number(cell: str, where: str) -> tuple[float, float]:
    """Value of a cell, and of its last printed digit."""
    if _is_number(cell):
        digits = cell.replace(",", ".")
        value = float(digits)
        step = float(f"1e{Decimal(digits).as_tuple().exponent}")
        if math.isfinite(value) and 0.0 < step < math.inf:
            return value, step
    raise CaptureError(
        f"{cell!r} is not a finite number",
        where=where,
        hint="correct it, or take the line out (a # before it makes it a comment)",
    )
