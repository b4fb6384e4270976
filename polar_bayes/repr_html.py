"""HTML representations of values in notebooks, in one style and without scripts.

Colors are the notebook's own, so that they suit light and dark themes. Every text is escaped, since
names of captures, materials and parameters come from files. `repr` is not changed: a terminal, a
log and a saved result show the expression that makes the value.
"""

import dataclasses
import functools
import html
import importlib.resources
import inspect
import io
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self, TextIO, override

import rich.table
from rich.console import Console

from polar_bayes.errors import one_line

if TYPE_CHECKING:
    from polar_bayes.frames import Frame

WARNING = re.compile(r"not determined|.*\((outside|too few|fails)\)")
"""Cells that pages show in red."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table as text: label, meaning of the label, and other cells."""

    label: str
    cells: tuple[str, ...]
    description: str = ""
    group: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Table:
    """Rows of text under columns of numbers, or of prose if named in `prose`.

    A page also has a caption, and `data`, the numbers with every digit, as a file.
    """

    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    prose: Collection[str] = ()
    name: str = ""
    caption: str = ""
    data: Any = None  # pandas.DataFrame

    @classmethod
    def of_frame(
        cls, frame: "Frame", text: Callable[[object], str], prose: Collection[str] = ()
    ) -> Self:
        """Return the table of a data frame, each cell as a text."""
        rows = (Row(str(label), tuple(map(text, cells))) for label, *cells in frame.itertuples())
        return cls(("", *frame.columns), tuple(rows), prose)

    def first(self, count: int) -> Self:
        """Return the table with its first rows only."""
        return dataclasses.replace(self, rows=self.rows[:count])

    def __html__(self) -> str:
        """Return the table as HTML; Jinja calls this method."""
        styles = [' class="prose"' if column in self.prose else "" for column in self.columns]
        head = "".join(
            f'<th scope="col"{style}>{_escaped(column)}</th>'
            for column, style in zip(self.columns, styles, strict=True)
        )
        groups: dict[str, list[Row]] = {}
        for row in self.rows:
            groups.setdefault(row.group, []).append(row)
        bodies = "".join(self._body(group, rows, styles) for group, rows in groups.items())
        identifier = f' id="{_escaped(self.name)}-table"' if self.name else ""
        return f"<table{identifier}><thead><tr>{head}</tr></thead>{bodies}</table>"

    def _body(self, group: str, rows: Sequence[Row], styles: Sequence[str]) -> str:
        """Return the rows of a group; the first group, which has no title, is the main one."""
        lines = []
        if group:
            head = f'<th scope="rowgroup" colspan="{len(self.columns)}">{_escaped(group)}</th>'
            lines.append(f"<tr>{head}</tr>")
        for row in rows:
            meaning = ""
            if row.description and _letters(row.description) != _letters(row.label):
                meaning = f"<small>{_escaped(row.description)}</small>"
            cells = f'<th scope="row"{styles[0]}><code>{_escaped(row.label)}</code>{meaning}</th>'
            for cell, style in zip(row.cells, styles[1:], strict=True):
                warns = not style and not group and WARNING.fullmatch(cell)
                cells += f"<td{' class="warning"' if warns else style}>{_escaped(cell)}</td>"
            lines.append(f"<tr>{cells}</tr>")
        titled = f' data-group="{_escaped(group)}"' if group else ""
        return f"<tbody{titled}>{''.join(lines)}</tbody>"

    def _columns(self) -> rich.table.Table:
        """Return columns, with numbers aligned right, labels and prose left."""
        grid = rich.table.Table(box=None, pad_edge=False)
        for at, column in enumerate(self.columns):
            grid.add_column(column, justify="right" if at and column not in self.prose else "left")
        for row in self.rows:
            grid.add_row(one_line(row.label), *map(one_line, row.cells))
        return grid

    def to_text(self, stream: TextIO | None = None) -> str:
        """Return aligned columns that fit the width of a terminal."""
        width = None if stream is not None and stream.isatty() else 1000
        console = Console(
            file=stream or io.StringIO(), width=width, markup=False, highlight=False, emoji=False,
            force_jupyter=False,
        )  # fmt: skip
        with console.capture() as printed:
            console.print(self._columns())
        return "\n".join(line.rstrip() for line in printed.get().splitlines())


@dataclasses.dataclass(frozen=True, repr=False)
class DisplaySummary:
    """A title, sentences and tables: HTML in a notebook, text everywhere else."""

    title: str
    sentences: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    good: bool | None = None

    @override
    def __repr__(self) -> str:
        text = "\n".join([one_line(self.title), *self.sentences])
        return "\n\n".join([text, *(table.to_text() for table in self.tables)])

    def _repr_html_(self) -> str:
        parts = [f"<h4>{_escaped(self.title)}</h4>"]
        parts += [f"<p>{_escaped(sentence)}</p>" for sentence in self.sentences]
        parts += [table.__html__() for table in self.tables]
        return _card("".join(parts), self.good)


class HTMLRepr:
    """A base class of frozen dataclasses whose fields notebooks show as HTML."""

    def _repr_html_(self) -> str:
        title = f"<h4>{_escaped(type(self).__name__)}</h4><p><small>{_summary(self)}</small></p>"
        tables = self.extra_tables()
        fields = _fields(self, with_parameters=not tables)
        return _card(title + fields + "".join(table.__html__() for table in tables))

    def extra_tables(self) -> tuple[Table, ...]:
        """Return tables to show below the fields."""
        return ()


def _card(inside: str, good: bool | None = None) -> str:
    """Return a card with its style, for a notebook may show any of them alone."""
    kind = {None: "", True: " good", False: " bad"}[good]
    return f'<div class="pb-card{kind}"><style>\n{_style()}</style>{inside}</div>'


@functools.cache
def _style() -> str:
    return importlib.resources.files("polar_bayes").joinpath("card.css").read_text("utf-8")


def _escaped(text: object) -> str:
    """Escape any text as HTML on one line."""
    return html.escape(one_line(str(text)))


def _letters(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _summary(value: object) -> str:
    """Return the first line of the docstring of a value's class."""
    return _escaped((inspect.getdoc(type(value)) or "").partition("\n")[0])


def _fields(value: object, *, with_parameters: bool = True) -> str:
    """Return a row for each field of a dataclass, and the parameters that it reads."""
    rows = {
        field.name.replace("_", " "): _cell(getattr(value, field.name))
        for field in dataclasses.fields(value)  # type: ignore[arg-type]
        if field.repr
    }
    parameters: tuple[str, ...] = getattr(value, "parameters", ()) if with_parameters else ()
    if parameters:
        rows["reads"] = ", ".join(f"<code>{_escaped(name)}</code>" for name in parameters)
    cells = "".join(
        f'<tr><th scope="row">{_escaped(name)}</th><td class="prose">{cell}</td></tr>'
        for name, cell in rows.items()
    )
    return f"<table><tbody>{cells}</tbody></table>" if rows else ""


def _cell(value: object) -> str:
    """Return a value as HTML, with members of a tuple or mapping on separate lines."""
    if value is None:
        return "<small>none</small>"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        name = f"{_escaped(type(value).__name__)} <small>{_summary(value)}</small>"
        inside = _fields(value)
        return f"<details><summary>{name}</summary>{inside}</details>" if inside else name
    if isinstance(value, Mapping) and value:
        return "<br>".join(f"{_escaped(key)}: {_cell(item)}" for key, item in value.items())
    if isinstance(value, tuple) and value:
        return "<br>".join(map(_cell, value))
    return _escaped(value_text(value))


@functools.singledispatch
def value_text(value: object) -> str:
    """Return a value without members as text; who knows a kind of value registers its text."""
    return f"{value:g}" if isinstance(value, float) else str(value)
