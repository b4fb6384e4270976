"""Report pages: title, verdict, and sections of sentences, tables and figures.

A page is one HTML file without scripts or references to other files. `Page.html` fills the one
template; `write_page` writes the file, and the result that belongs to it, whole or not at all.
"""

import base64
import csv
import dataclasses
import functools
import importlib.resources
import importlib.util
import io
import pkgutil
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from polar_bayes.errors import FitError, one_line
from polar_bayes.paths import check_output, replace_file, temporary_folder, write_errors
from polar_bayes.reporting.style import FIXED_STYLE
from polar_bayes.repr_html import Row, Table
from polar_bayes.results import kind_of

PAGE = "index.html"

EXPLORER = "explore.html"
"""The page of a map that one can point at, beside the report."""

INSTALL = "pip install 'polar_bayes[explore]'"
"""What that page needs."""

type Card = tuple[list[str], Table, bool]
"""What `polar_bayes.show` has of a result: sentences, a table, and whether it may be used."""


class Report(NamedTuple):
    """Report of a kind of result: functions of its page, card and figure, and its file.

    Options are the arguments of the page besides the result.
    """

    page: Callable[..., "Page"]
    card: Callable[[Any], Card]
    plot: Callable[[Any], Figure]
    options: tuple[str, ...] = ()
    file: str = ""


def report_of(result: object) -> Report:
    """Return the report of a kind of result."""
    kind = kind_of(result)
    if not kind.reports:
        hint = "polar_bayes.summary has its table"
        raise FitError(f"a result of kind {kind.name} has no page", where="report", hint=hint)
    found: Report = pkgutil.resolve_name(f"polar_bayes.reporting.{kind.reports}:REPORT")
    return found


type Cells = Mapping[str, Callable[[pd.Series], str]]
"""Columns of a table: the text of a cell from its row of numbers (`polar_bayes.reporting.text`)."""


def make_table(
    key: str,
    cells: Cells,
    data: pd.DataFrame,
    *,
    name: str = "",
    label: str = "parameter",
    descriptions: Mapping[str, str] = {},
    groups: Mapping[str, str] = {},
    prose: Collection[str] = (),
    **values: object,
) -> Table:
    """Return a table with a row for each row of numbers; `label` heads their names.

    The key is that of its caption, which the values fill in; the table is called after it, unless
    it has another name.
    """
    rows = []
    for at, numbers in data.iterrows():
        row = str(at[0] if isinstance(at, tuple) else at)
        texts = tuple(cell(numbers) for cell in cells.values())
        rows.append(Row(row, texts, descriptions.get(row, ""), groups.get(row, "")))
    name = name or key.partition(".")[2]
    return Table((label, *cells), tuple(rows), prose, name, caption(key, **values), data)


def second_label(row: pd.Series) -> str:
    """Return the second level of the index, such as the fit in a table of fits."""
    label: Any = row.name
    return one_line(str(label[1]))


# --- Blocks of a page -----------------------------------------------------------------------------

type Block = str | Table
"""A sentence, a table, or what `block` returns."""


def block(macro: str, *texts: str, **values: object) -> str:
    """Return a macro of `blocks.html.j2`, filled in: a text that is not escaped again."""
    filled: str = getattr(template("blocks.html.j2").module, macro)(*texts, **values)
    return filled


@dataclasses.dataclass
class Section:
    """A section of a page, and its name in the menu. What is empty is left out."""

    id: str
    title: str
    blocks: Iterable[Block | None]
    link: str = ""

    def __post_init__(self) -> None:
        self.blocks = [block for block in self.blocks if block]


@dataclasses.dataclass(frozen=True)
class Page:
    """The content of a page."""

    kind: str
    name: str
    subtitles: Sequence[str]
    headline: str
    passed: bool
    sections: Sequence[Section]
    footer: str
    problems: Sequence[str] = ()
    answers: Sequence[tuple[str, str]] = ()
    sentences: Sequence[str] = ()
    cautions: Sequence[str] = ()
    beside: str = ""

    @property
    def html(self) -> str:
        """The page as HTML; every text is escaped."""
        return template("page.html.j2").render(page=self)


@functools.cache
def template(name: str) -> Template:
    """A page that is to be filled in; every text is escaped."""
    environment = Environment(
        loader=PackageLoader("polar_bayes.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Tables with more rows scroll in a box of their own.
    environment.globals |= {"csv_link": csv_link, "long_table": 40}
    return environment.get_template(name)


@functools.cache
def _captions() -> dict[str, Any]:
    return tomllib.loads(read_template("captions.toml"))


def read_template(name: str) -> str:
    """A file of `templates/` as it is."""
    file = importlib.resources.files("polar_bayes.reporting") / "templates" / name
    return file.read_text(encoding="utf-8")


def caption(key: str, **values: object) -> str:
    """Return a caption from `templates/captions.toml`, such as `fit.parameter`, with values."""
    kind, name = key.split(".")
    return str(_captions()[kind][name]).format(**values)


def picture(figure: Figure, key: str, *, instead: str = "", more: str = "", **values: Any) -> str:
    """Return a figure as a block of a page, with alternative text and caption."""
    kind, name = key.split(".")
    alternative, caption = (each.format(**values) for each in _captions()[kind][name])
    buffer = io.BytesIO()
    with matplotlib.rc_context(FIXED_STYLE):
        # No date and a fixed salt: the same result gives the same page, byte for byte. `savefig`
        # would draw a figure with a layout twice.
        figure.dpi = 160
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    encoded = base64.b64encode(buffer.getvalue()).decode("ascii")
    source = f"data:image/svg+xml;base64,{encoded}"
    is_wide = figure.get_figwidth() > 7.0
    return block("picture", source, alternative, (instead or caption) + more, is_wide=is_wide)


def facts(
    values: Mapping[str, Any], title: str = "", *, marked: Collection[str] = (), mark: str = ""
) -> str:
    """Return names and values as a block, marked names followed by `mark`; empty without any."""
    rows = [
        (name, _as_text(value), mark if name in marked else "") for name, value in values.items()
    ]
    return block("facts", rows=rows, title=title)


def _as_text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_as_text(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_as_text, value)) or "none"
    return str(value)


def has_explorer() -> bool:
    """Whether the library is installed by which a map becomes a page that one can point at."""
    return importlib.util.find_spec("bokeh") is not None


def write_page(
    folder: Path, page: str, others: Mapping[str, Callable[[Path], object]] | None = None
) -> Path:
    """Write a page and its files; an older report in the folder is replaced."""
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    is_report = is_page(folder / PAGE)
    names = (*(others or {}), PAGE)
    files = {name: check_output(folder / name, lambda _: is_report) for name in names}
    with write_errors(folder), temporary_folder(folder) as unfinished:
        (unfinished / PAGE).write_text(page, encoding="utf-8")
        for name, write in (others or {}).items():
            write(unfinished / name)
        for name, file in files.items():
            replace_file(unfinished / name, file)
    return folder / PAGE


def is_page(file: Path) -> bool:
    """Whether a file is a page of this package, which may be replaced."""
    try:
        return b'<meta name="generator" content="polar_bayes">' in file.read_bytes()[:1024]
    except OSError:
        return False


def csv_link(table: pd.DataFrame, first: str) -> str:
    """Return a table as the address of a link, without text that a spreadsheet would execute."""
    labels = [str(name) for name in table.index.names] if table.index.nlevels > 1 else [first]
    safe = table.reset_index(names=labels, allow_duplicates=True).map(_escape_formula)
    safe.columns = pd.Index([*labels, *(_escape_formula(str(name)) for name in table.columns)])
    text = safe.to_csv(index=False, quoting=csv.QUOTE_NONNUMERIC).encode(errors="backslashreplace")
    return f"data:text/csv;charset=utf-8;base64,{base64.b64encode(text).decode('ascii')}"


def _escape_formula(value: object) -> object:
    # A spreadsheet runs a text that begins with one of these.
    is_run = isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r"))
    return f"'{value}" if is_run else value
