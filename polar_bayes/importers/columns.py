"""Columns of numbers from a text table or a sheet, in the notations that people use.

What is more than a number a cell, such as lines above the names of the columns, units below them, a
mark for thousands or a cell without a reading, is read or left out, counted, and told in
`Table.notes`. What could mean two things is refused: "1,234" beside decimal points.

The parser is our own, since the well-kept ones guess in silence: `csv.Sniffer` takes the separator
from letter frequencies and fails on short tables; `pandas.read_csv` fills short rows, turns a
surplus column into an index and names no line; `numpy.genfromtxt` turns text into NaN. None keeps
the printed digits, which give a reading's resolution, or an uncertainty behind a reading. Quotes
are undone by `csv`, workbooks are opened by `openpyxl`.
"""

import collections
import csv
import dataclasses
import importlib
import io
import itertools
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np

from polar_bayes.errors import CaptureError
from polar_bayes.paths import existing_file, system_error

LARGEST_FILE = 50_000_000  # bytes
EACH_READING = "give a line for each reading"
AS_TEXT = "save the table as UTF-8 text, such as CSV, or as .xlsx"
NO_READING = frozenset(("", "-", "--", "nan", "na", "n/a", "#n/a", "none", "null"))
"""Cells, in lower case, that hold no reading."""
STATISTICS = frozenset(
    "average avg count max maximum mean median min minimum n sd sem std stdev stddev sum".split()
)
"""Words in the place of an angle, in lower case, that mark a line of statistics."""

# A decimal comma is between digits, so the comma of "10, 5" separates.
DIGITS = r"[+-]?(?:[0-9]+(?:\.[0-9]*|,[0-9]+)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?"
NUMBER = re.compile(rf"({DIGITS})()()")
WITH_ERROR = re.compile(rf"({DIGITS}) ?(?:± ?({DIGITS})|\(([0-9]+(?:[.,][0-9]+)?)\))")
# A run of digits in groups of three, whose mark is no decimal one: 1'234, or 1 234 with a blank
# that does not break.
GROUPS = re.compile(r"(?<=[0-9])[\u00a0\u2009\u202f'\u2019](?=[0-9]{3}(?![0-9]))")
END = r"(?:[eE][+-]?[0-9]{1,3}|±.*|\(.*)?"
THOUSANDS = {
    mark: re.compile(rf"[+-]?[1-9][0-9]{{0,2}}(?:\{mark}[0-9]{{3}})+(?:\{other}[0-9]*)?{END}")
    for mark, other in ((",", "."), (".", ","))
}
"""Patterns of numbers with thousands separators, by separator."""


class Line(NamedTuple):
    """A line of a file: its number, its cells, and whether it is a comment."""

    number: int
    cells: list[str]
    is_comment: bool = False


class Cells(NamedTuple):
    """The lines of a file, with its name in errors, the separator of cells, and notes."""

    source: str
    lines: list[Line]
    separator: str
    notes: list[str]


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of numbers, with their lines and the value of each last printed digit.

    Args:
        source: The file, and the sheet of a workbook, as errors name it.
        columns: Numbers, NaN where a cell holds no reading. Shape (line,) each.
        steps: Value of the last printed digit of each number.
        errors: The uncertainty that a cell states behind its reading, NaN where it states none.
        lines: Number of each line in the file.
        notes: What was read other than as a plain number, or left out, each with its count.
        above: The cells above the first reading, names of columns included.
    """

    source: str
    columns: Mapping[str, np.ndarray]
    steps: Mapping[str, np.ndarray]
    errors: Mapping[str, np.ndarray]
    lines: tuple[int, ...]
    notes: tuple[str, ...] = ()
    above: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns; column_1, column_2, ... without a header line."""
        return tuple(self.columns)

    @property
    def places(self) -> list[str]:
        """Each line, as errors name it."""
        return [f"{self.source}: line {line}" for line in self.lines]


def read_table(
    path: str | os.PathLike[str],
    columns: Sequence[str] | Callable[[list[str]], Sequence[str]] = (),
    *,
    sheet: str | None = None,
    wanted: Sequence[str] = (),
    kind: str | None = None,
) -> Table:
    """Read columns from a text table or a sheet.

    Args:
        path: Of a text table or an .xlsx workbook. Semicolons, tabs, commas or blanks separate the
            cells of text; runs of blanks separate once. From a # to the end of its line is comment.
        columns: The columns that are read, or a function that gives them from the names of all; by
            default all. A line whose first one is blank, or names a statistic, holds no reading.
        sheet: Name of a sheet of a workbook, where several hold something.
        kind: Lines begin with a word, and those of another word are left out.
        wanted: Names by which the line of names is found below other text; by default `columns`.

    Raises:
        CaptureError: The file, line or cell that is wrong.
    """
    file = existing_file(path, "table")
    content = _content(file)
    if content[:4] == b"PK\3\4":
        found = _workbook(file, content, sheet)
    elif sheet is not None:
        hint = "leave it out: a text table has one"
        raise CaptureError("the file is no workbook", where=f"{file}: sheet", hint=hint)
    else:
        found = _text_lines(file, content)
    if all(line.is_comment for line in found.lines):
        raise CaptureError("it holds no rows", where=found.source, hint=EACH_READING)
    wanted = wanted or (() if callable(columns) else columns)
    found, others = _of_kind(found, kind)
    names, rows, left_out = _below_names(found.lines, wanted, found.source)
    chosen = list((columns(names) if callable(columns) else columns) or names)
    for column in chosen:
        check_column(column, names, found.source)
    if not rows or not chosen:
        raise CaptureError("it holds names but no rows", where=found.source, hint=EACH_READING)
    rows, more = _with_readings(rows, names, chosen[0], found.source)
    cells = {name: [line.cells[names.index(name)] for line in rows] for name in chosen}
    above = [cell for line in found.lines if line < rows[0] for cell in line.cells]
    read = _as_numbers(found, cells, rows, (*found.notes, *others, *left_out, *more))
    return dataclasses.replace(read, above=tuple(above))


def check_column(column: str, names: Sequence[str], source: str) -> None:
    """Refuse the name of a column that a table does not have."""
    if column not in names:
        hint = f"choose from {', '.join(names)}"
        raise CaptureError(f"there is no column {column!r}", where=source, hint=hint)


def counted(count: int, noun: str, rest: str = "") -> str:
    """Format a count with its noun, such as "2 lines of units"."""
    return f"{count} {noun}{'' if count == 1 else 's'} {rest}".rstrip()


def _left_out(lines: Sequence[Line], what: str) -> list[str]:
    """Note which lines are left out, by their numbers; empty if none are."""
    if not lines:
        return []
    numbers = [line.number for line in lines]
    listed = ", ".join(map(str, numbers[:4])) + (", ..." if len(numbers) > 4 else "")
    return [f"{counted(len(numbers), 'line', what)} left out (number {listed})"]


# --- Lines and cells ------------------------------------------------------------------------------


def _content(file: Path) -> bytes:
    try:
        if file.stat().st_size > LARGEST_FILE:
            hint = "give a table of at most 50 MB"
            raise CaptureError("the file is too large", where=str(file), hint=hint)
        return file.read_bytes()
    except OSError as error:
        raise system_error(error, file) from error


def _text_lines(file: Path, content: bytes) -> Cells:
    """Split a text table into lines, without blank ones."""
    notes: list[str] = []
    try:
        if content[:2] in (b"\xff\xfe", b"\xfe\xff"):  # "Unicode text" of a spreadsheet
            text = content.decode("utf-16")
            notes.append("the text was read as UTF-16")
        else:
            text = content.decode("utf-8-sig")
    except UnicodeDecodeError:  # such as a degree sign in an old header; digits are ASCII anyway
        text = content.decode("latin-1")
    if "\0" in text:
        raise CaptureError("it is not text", where=str(file), hint=AS_TEXT)
    plain, comments = [], []
    for number, line in enumerate(re.split("\r\n|\r|\n", text), 1):
        before, _, comment = line.partition("#")
        if before.strip():
            signs = re.sub(r"[ \t]*(?:±|\+/-|\+-)[ \t]*", "±", before.strip(" "))
            plain.append((number, signs))
        elif comment.strip():
            comments.append((number, comment.strip()))
    try:
        separator = _separator([each for _, each in plain])
        found = [
            Line(number, _split_by(separator, each), is_comment)
            for is_comment, part in ((False, plain), (True, comments))
            for number, each in part
        ]
    except csv.Error as error:
        raise CaptureError(f"it cannot be split ({error})", where=str(file), hint=AS_TEXT) from None
    return Cells(str(file), sorted(found), separator, notes)


def _separator(contents: list[str]) -> str:
    """Return the separator of cells in most lines that consist of numbers."""
    votes = collections.Counter(
        mark
        for content in contents[:1000]
        for mark in [_mark(content)]
        if all(map(_is_blank_or_number, _split_by(mark, content)))
    )
    some = contents[min(1, len(contents) - 1)] if contents else ""
    mark = max(votes, key=votes.__getitem__) if votes else _mark(some)
    # Tabs stand for blank cells, unless a column would have no name or no first reading.
    is_run = mark == "\t" and "" in contents[0].rstrip("\t").split("\t")
    return "\t+" if is_run else mark


def _mark(content: str) -> str:
    """Return the separator of cells in one line."""
    for mark in ";\t":
        if mark in content:
            return mark
    cells = content.split()
    decimal_commas = len(cells) > 1 and all(map(_is_blank_or_number, cells))
    return "," if "," in content and not decimal_commas else " "


def _split_by(mark: str, content: str) -> list[str]:
    if mark in (" ", "\t+"):
        runs = content.split() if mark == " " else re.split(mark, content.strip("\t"))
        return [_unquoted(cell) for cell in runs]
    (cells,) = csv.reader([content], delimiter=mark, skipinitialspace=True)
    return [_unquoted(cell) for cell in cells]


def _unquoted(cell: str) -> str:
    cell = cell.strip()
    quoted = len(cell) > 1 and cell[0] == cell[-1] == '"'
    return cell[1:-1].strip() if quoted else cell


def _workbook(file: Path, content: bytes, sheet: str | None) -> Cells:
    """Read the lines of one sheet of an .xlsx workbook."""
    try:
        openpyxl = importlib.import_module("openpyxl")
    except ImportError as error:
        what = f"the library for workbooks is not installed ({error.name})"
        hint = "pip install 'polar_bayes[excel]', or save the sheet as CSV"
        raise CaptureError(what, where=str(file), hint=hint) from error
    try:
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
        sheets = {
            str(each.title): [[_text_of(cell) for cell in row] for row in each.values]
            for each in book.worksheets
        }
    except Exception as error:  # a broken workbook raises nearly every type
        raise CaptureError("it cannot be read as .xlsx", where=str(file), hint=AS_TEXT) from error
    filled = [name for name, rows in sheets.items() if any(map(any, rows))]
    if sheet is None and len(filled) > 1:
        what, hint = f"it has {len(filled)} sheets", f"give sheet=, one of {', '.join(filled)}"
        raise CaptureError(what, where=str(file), hint=hint)
    name = sheet if sheet is not None else (filled or list(sheets))[0]
    if name not in sheets:
        hint = f"choose from {', '.join(sheets)}"
        raise CaptureError(f"there is no sheet {name!r}", where=str(file), hint=hint)
    width = max(map(len, sheets[name]), default=0)
    lines = [
        Line(k, [*cells, *[""] * (width - len(cells))])
        for k, cells in enumerate(sheets[name], 1)
        if any(cells)
    ]
    return Cells(f"{file}: sheet {name}", lines, "", [f"sheet {name!r} was read"])


def _text_of(value: object) -> str:
    """Format a cell of a workbook; a spreadsheet computes with 15 digits."""
    if value is None:
        return ""
    return f"{value:.15g}" if isinstance(value, float) else str(value).strip()


def _of_kind(found: Cells, kind: str | None) -> tuple[Cells, list[str]]:
    """Return lines of one kind (first word removed) with lines without numbers, and notes."""
    if not any(line.cells[0] == kind for line in found.lines):
        return found, []
    lines: list[Line] = []
    others: dict[str, list[Line]] = {}
    for line in found.lines:
        numbers = len(line.cells) > 2 and all(map(_is_blank_or_number, line.cells[1:]))
        if not numbers or not _is_name(line.cells[0]):
            lines.append(line)
        elif line.cells[0] == kind:
            lines.append(line._replace(cells=line.cells[1:]))
        else:
            others.setdefault(line.cells[0], []).append(line)
    notes = [note for word, left in others.items() for note in _left_out(left, f"of kind {word}")]
    return found._replace(lines=lines), notes


# --- Names of the columns, and lines that hold no reading -----------------------------------------


def _below_names(
    lines: list[Line], wanted: Sequence[str], source: str
) -> tuple[list[str], list[Line], list[str]]:
    """Return names of the columns, the lines below them, and notes of what was left out."""
    plain = [line for line in lines if not line.is_comment]
    data = [line for line in plain if _is_data(line)]
    data = data or [line for line in plain if not _is_name(next(filter(None, line.cells), ""))]
    width = max((len(_trimmed(line.cells)) for line in data), default=0)
    header = _header(lines, data[:1], width, wanted)
    if header is None or header.is_comment:
        known = itertools.takewhile(
            lambda x: len(x.cells) != width and _is_name(x.cells[0]), plain if data else ()
        )
        above = list(known)
    else:
        above = [line for line in plain if line < header]
    rows = [line for line in plain[len(above) :] if line != header]
    units = list(itertools.takewhile(_is_units, rows if header else ()))
    rows = rows[len(units) :]
    names = [f"column_{k}" for k in range(1, width + 1)]
    again = []
    if header is not None:
        names = [name or f"column_{k}" for k, name in enumerate(_trimmed(header.cells), 1)]
        _check_names(names, f"{source}: line {header.number}")
        again = [line for line in rows if line.cells == header.cells]
    skipped = {line.number for line in again}
    left_out = (
        *_left_out(above, "above the names"),
        *_left_out(units, "of units"),
        *_left_out(again, "that repeats the names"),
    )
    return names, [line for line in rows if line.number not in skipped], [*left_out]


def _header(lines: list[Line], first: list[Line], width: int, wanted: Sequence[str]) -> Line | None:
    """Return the line that names the columns: one with the names wanted, or names alone."""
    plain = [line for line in lines if not line.is_comment]
    for line in (*plain, *lines) if wanted else ():
        if set(wanted) <= set(line.cells):
            return line
    above = [line for line in lines if not first or line < first[0]]
    named = [line for line in above if all(map(_is_name, filter(None, line.cells)))]
    fitting = [line for line in named if len(_trimmed(line.cells)) == width]
    last = [line for line in above if not line.is_comment][-1:]
    others = [x for x in last if x in named and (len(x.cells) > 1 or not width)]
    found = (
        [x for x in fitting if not x.is_comment] or others or [x for x in fitting if x == above[-1]]
    )
    return found[0] if found else None


def _trimmed(cells: list[str]) -> list[str]:
    """Remove blank cells at the end."""
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


def _check_names(names: list[str], where: str) -> None:
    if len(set(names)) != len(names):
        hint = "name each column once"
        raise CaptureError("two columns have the same name", where=where, hint=hint)
    if not all(name.isprintable() for name in names):
        raise CaptureError("a name is not printable text", where=where, hint=AS_TEXT)


def _with_readings(
    rows: list[Line], names: list[str], key: str, source: str
) -> tuple[list[Line], list[str]]:
    """Return lines with a cell per name, without those whose key is blank or a word."""
    k = names.index(key)
    keys = [line.cells[k].lower().rstrip(":") if len(line.cells) > k else None for line in rows]
    without = list(itertools.compress(rows, (cell in NO_READING for cell in keys)))
    statistics = list(itertools.compress(rows, (cell in STATISTICS for cell in keys)))
    skipped = {line.number for line in (*without, *statistics)}
    if len(skipped) == len(rows):
        raise CaptureError(f"no line has a number for {key}", where=source, hint=EACH_READING)
    kept = [line for line in rows if line.number not in skipped]
    for line in kept:
        cells, width = len(line.cells), len(names)
        if cells < width or len(_trimmed(line.cells)) > width:
            what = f"it has another number of cells ({cells}) than the first ({width})"
            hint = "give every line one cell for each column"
            raise CaptureError(what, where=f"{source}: line {line.number}", hint=hint)
    notes = [
        *_left_out(without, f"without {key}"),
        *_left_out(statistics, f"of statistics in place of {key}"),
    ]
    return kept, notes


def _is_data(line: Line) -> bool:
    return any(map(_is_number, line.cells)) and all(map(_is_blank_or_number, line.cells))


def _is_units(line: Line) -> bool:
    """Return whether a line below the names holds units: words or signs, and no digit."""
    blank = all(cell.lower() in NO_READING for cell in line.cells)
    return not blank and not any(character.isdigit() for x in line.cells for character in x)


def _is_name(cell: str) -> bool:
    """Return whether a cell is a name rather than a mistyped number, which must be reported."""
    lettered = any(character.isalpha() for character in cell)
    is_missing = cell.lower() in {*NO_READING, "inf", "infinity"}
    return lettered and cell[0] not in "0123456789+-.," and not is_missing


def _is_blank_or_number(cell: str) -> bool:
    return cell.lower() in NO_READING or _is_number(cell)


# --- Numbers --------------------------------------------------------------------------------------


def _plain(cell: str) -> str:
    """Replace typographic signs in a number; commas and points are unchanged."""
    cell = GROUPS.sub("", cell.replace("\N{MINUS SIGN}", "-"))
    return re.sub(r"(?<=[0-9.,])[dD](?=[+-]?[0-9])", "e", cell)


def _is_number(cell: str) -> bool:
    plain = _plain(cell)
    if any(pattern.fullmatch(plain) for pattern in THOUSANDS.values()):
        return len(cell) <= 64
    return len(cell) <= 64 and bool(NUMBER.fullmatch(plain) or WITH_ERROR.fullmatch(plain))


def _as_numbers(
    found: Cells, cells: Mapping[str, list[str]], rows: list[Line], notes: tuple[str, ...]
) -> Table:
    """Convert columns of text to numbers."""
    plain = {name: [_plain(cell) for cell in column] for name, column in cells.items()}
    told = collections.Counter[tuple[str, str]]()
    mark = _thousands_mark(rows, plain, found)
    read = {}
    for name, column in plain.items():
        numbers = []
        for line, cell, text in zip(rows, cells[name], column, strict=True):
            if cell.lower() in NO_READING:
                told["blank cell", f"of {name} taken as no reading"] += 1
                numbers.append((math.nan, math.nan, math.nan))
                continue
            without = text.replace(mark, "") if mark else text
            told["number", "freed of marks for thousands"] += len(without) < len(cell)
            told["number", "with a Fortran exponent (D)"] += "d" in cell.lower() and "e" in text
            number = _number(without)
            if number is None:
                hint = "correct it, or take the line out (a # before it makes it a comment)"
                where = f"{found.source}: line {line.number}, column {name}"
                raise CaptureError(f"{cell!r} is not a finite number", where=where, hint=hint)
            told["reading", f"of {name} with its error in the cell"] += not math.isnan(number[2])
            numbers.append(number)
        read[name] = np.array(numbers).T
    did = [counted(count, *what) for what, count in told.items() if count]
    return Table(
        found.source,
        {name: value for name, (value, _, _) in read.items()},
        {name: step for name, (_, step, _) in read.items()},
        {name: stated for name, (_, _, stated) in read.items()},
        tuple(line.number for line in rows),
        (*notes, *did),
    )


def _thousands_mark(rows: list[Line], columns: Mapping[str, list[str]], found: Cells) -> str:
    """Return the thousands separator of a table, "" without any."""
    cells = [
        (line.number, cell)
        for column in columns.values()
        for line, cell in zip(rows, column, strict=True)
    ]
    marked = {mark: [each for each in cells if mark in each[1]] for mark in THOUSANDS}
    for mark, other in ((",", "."), (".", ",")):
        groups = [bool(THOUSANDS[mark].fullmatch(cell)) for _, cell in marked[mark]]
        certain = (other in cell or cell.count(mark) > 1 for _, cell in marked[mark])
        if any(itertools.compress(certain, groups)) and all(groups):
            return mark
    commas = marked[","]
    where = f"{found.source}: line {commas[0][0]}" if commas else found.source
    if commas and marked["."]:
        what = "decimal commas stand beside decimal points"
        hint = "use one of them, and no mark for thousands"
        raise CaptureError(what, where=where, hint=hint)
    if commas and all(THOUSANDS[","].fullmatch(cell) for _, cell in commas):
        if found.separator == ",":  # where commas separate, points are decimal
            return ","
        numbers = [
            [x for x in column if x.lower() not in NO_READING] for column in columns.values()
        ]
        if any("," in "".join(column) and any("," not in x for x in column) for column in numbers):
            what = f"{commas[0][1]!r} could be a thousand, or have a decimal comma"
            hint = "print all decimals, and no mark for thousands"
            raise CaptureError(what, where=where, hint=hint)
    return ""


def _number(text: str) -> tuple[float, float, float] | None:
    """Return value, last digit and stated error of a cell; None if it is not a number."""
    match = NUMBER.fullmatch(text) or WITH_ERROR.fullmatch(text)
    if match is None or len(text) > 64:
        return None
    reading, error, digits = [each and each.replace(",", ".") for each in match.groups()]
    value, step, stated = float(reading), last_digit(reading), math.nan
    if error or digits:
        stated = float(error or digits) * (step if digits and "." not in digits else 1.0)
        if not 0.0 < stated < math.inf:
            return None
    return (value, step, stated) if math.isfinite(value) and 0.0 < step < math.inf else None


def last_digit(digits: str) -> float:
    """Return the value of the last printed digit of a number."""
    return float(f"1e{Decimal(digits).as_tuple().exponent}")
