"""Text tables of numbers, as detectors and spreadsheets write them.

The parser is our own and strict, since the well-kept ones guess: `csv.Sniffer` takes the separator
from letter frequencies and fails on short tables; `pandas.read_csv` fills short rows, turns a
surplus column into an index and names no line; `numpy.genfromtxt` turns words into NaN. None keeps
the printed digits, which tell a reading's resolution.
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
SEMICOLON, TABS, COMMA = re.compile(";"), re.compile(r"\t+"), re.compile(",")
BLANKS = re.compile(r"[ \t]+")
# A decimal comma stands between digits, so that in "10, 5" it separates.
NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*|,[0-9]+)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")
LONGEST_NUMBER = 64  # characters
MISSING = frozenset({"nan", "inf", "infinity", "na", "n/a", "none", "null"})
EACH_READING = "give a line for each reading"

Row = tuple[int, list[str]]  # line of the file, cells


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of numbers, with where they stood and how finely they were printed."""

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
    source, names, body = _parts(path)
    if not body:
        raise CaptureError("it holds names but no rows", where=source, hint=EACH_READING)
    for line, cells in body:
        if len(cells) != len(names):
            what = f"it has another number of cells ({len(cells)}) than the first ({len(names)})"
            hint = "give every line one cell for each column"
            raise CaptureError(what, where=f"{source}: line {line}", hint=hint)
    _check_decimal_marks(body, source)
    kept = _positions(columns, names, source)
    pairs = {
        name: np.array(
            [_number(cells[k], f"{source}: line {line}, column {name}") for line, cells in body]
        )
        for name, k in kept.items()
    }
    return Table(
        source=source,
        columns={name: pair[:, 0] for name, pair in pairs.items()},
        steps={name: pair[:, 1] for name, pair in pairs.items()},
        lines=tuple(line for line, _ in body),
    )


def column_names(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Names of the columns of a text table, as `read_table` reads it."""
    return tuple(_parts(path)[1])


def _parts(path: str | os.PathLike[str]) -> tuple[str, list[str], list[Row]]:
    """Path, names of the columns, and the rows below them."""
    file = existing_file(path, "table")
    rows = _split_rows(_rows(_text(file)))
    if not rows:
        raise CaptureError("it holds no rows", where=str(file), hint=EACH_READING)
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


def _rows(text: str) -> list[tuple[int, str]]:
    """Lines that hold something, without comments, each with its number from 1."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    bare = ((number, line.partition("#")[0].strip()) for number, line in enumerate(lines, 1))
    return [(number, line) for number, line in bare if line]


def _split_rows(rows: list[tuple[int, str]]) -> list[Row]:
    if not rows:
        return []
    # The second line holds numbers, whether or not the first one holds names.
    separator = _separator(rows[min(1, len(rows) - 1)][1])
    return [(line, [_bare(cell) for cell in separator.split(text)]) for line, text in rows]


def _separator(line: str) -> re.Pattern[str]:
    if ";" in line:
        return SEMICOLON
    if "\t" in line:
        return TABS
    words = BLANKS.split(line)
    decimal_commas = len(words) > 1 and all(map(_is_number, words))
    return COMMA if "," in line and not decimal_commas else BLANKS


def _bare(cell: str) -> str:
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
    """Words are names; what looks like a number gone wrong is not, lest a reading get lost."""
    lettered = any(character.isalpha() for character in cell)
    return lettered and cell[0] not in "0123456789+-.," and cell.lower() not in MISSING


def _is_number(cell: str) -> bool:
    return len(cell) <= LONGEST_NUMBER and NUMBER.fullmatch(cell) is not None


def _check_decimal_marks(body: list[Row], source: str) -> None:
    """Where both marks occur, "1,234" could be 1.234 or 1234."""
    point = any("." in cell for _, cells in body for cell in cells)
    for line, cells in body:
        if point and any("," in cell for cell in cells):
            what = "decimal commas stand beside decimal points"
            hint = "use one of them, and no mark for thousands"
            raise CaptureError(what, where=f"{source}: line {line}", hint=hint)


def _positions(columns: Sequence[str] | None, names: list[str], source: str) -> dict[str, int]:
    for name in columns or ():
        if name not in names:
            what = f"there is no column {name!r}"
            raise CaptureError(what, where=source, hint=f"choose from {', '.join(names)}")
    return {name: names.index(name) for name in columns or names}


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
