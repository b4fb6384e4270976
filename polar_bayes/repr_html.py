"""HTML representations of values in a notebook: one style, no script.

Colors are the notebook's own, so that they suit light and dark themes. Every text is escaped, since
names of captures, materials and parameters come from files. `repr` is not changed: a terminal, a
log and a saved result show the expression that makes the value.
"""

import dataclasses
import html
import inspect
from collections.abc import Mapping
from typing import override

from polar_bayes.errors import one_line

STYLE = """<style>
.pb-card { font: 13px/1.45 system-ui, sans-serif; max-width: 62em; overflow-x: auto;
  padding: .5em .9em; border: 1px solid rgba(128, 128, 128, .4); border-radius: 6px; }
.pb-card h4 { font-size: 1.08em; margin: 0 0 .2em; }
.pb-card p { margin: .25em 0; max-width: 52em; }
.pb-card small { opacity: .72; }
.pb-card table { border-collapse: collapse; margin: .3em 0; font: inherit;
  font-variant-numeric: tabular-nums; }
.pb-card table :is(td, th) { text-align: left; vertical-align: top; padding: .1em 1.1em .1em 0;
  background: none; border: 0; border-top: 1px solid rgba(128, 128, 128, .22);
  white-space: normal; max-width: none; }
.pb-card thead th { border-top: 0; }
.pb-card tbody th { font-weight: 500; white-space: nowrap; }
.pb-card table.numbers td { text-align: right; white-space: nowrap; }
.pb-card table.numbers thead th + th { text-align: right; }
.pb-card details { display: inline-block; vertical-align: top; }
.pb-card summary { cursor: pointer; }
.pb-card.good { border-left: 5px solid #009e73; }
.pb-card.bad { border-left: 5px solid #d55e00; }
</style>"""
"""Repeated in each representation, since a notebook may show any of them alone."""


@dataclasses.dataclass(frozen=True)
class DisplayTable:
    """A table of texts with column heads; the first cell of a row is its label."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: bool = False

    @property
    def html(self) -> str:
        """As an HTML table."""
        head = "".join(f'<th scope="col">{_escaped(text)}</th>' for text in self.heads)
        rows = "".join(
            f'<tr><th scope="row">{_escaped(first)}</th>'
            f"{''.join(f'<td>{_escaped(cell)}</td>' for cell in cells)}</tr>"
            for first, *cells in self.rows
        )
        kind = ' class="numbers"' if self.numeric else ""
        return f"<table{kind}><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"

    @property
    def text(self) -> str:
        """As aligned columns for a terminal, numbers to the right."""
        lines = [self.heads, *self.rows]
        widths = [max(len(line[at]) for line in lines) for at in range(len(self.heads))]
        return "\n".join(
            "  ".join(
                cell.rjust(width) if self.numeric and at else cell.ljust(width)
                for at, (cell, width) in enumerate(zip(line, widths, strict=True))
            ).rstrip()
            for line in lines
        )


@dataclasses.dataclass(frozen=True, repr=False)
class DisplaySummary:
    """A title, sentences and tables: HTML in a notebook, text everywhere else."""

    title: str
    sentences: tuple[str, ...] = ()
    tables: tuple[DisplayTable, ...] = ()
    good: bool | None = None

    @override
    def __repr__(self) -> str:
        text = "\n".join([one_line(self.title), *self.sentences])
        return "\n\n".join([text, *(table.text for table in self.tables)])

    def _repr_html_(self) -> str:
        parts = [f"<h4>{_escaped(self.title)}</h4>"]
        parts += [f"<p>{_escaped(sentence)}</p>" for sentence in self.sentences]
        parts += [table.html for table in self.tables]
        return _card("".join(parts), self.good)


class HTMLRepr:
    """A frozen dataclass whose fields, nested ones included, a notebook shows as HTML."""

    def _repr_html_(self) -> str:
        title = f"<h4>{_escaped(type(self).__name__)}</h4><p><small>{_summary(self)}</small></p>"
        tables = self.extra_tables()
        fields = _fields(self, with_parameters=not tables)
        return _card(title + fields + "".join(table.html for table in tables))

    def extra_tables(self) -> tuple[DisplayTable, ...]:
        """Tables below the fields."""
        return ()


def _card(inside: str, good: bool | None = None) -> str:
    kind = {None: "", True: " good", False: " bad"}[good]
    return f'<div class="pb-card{kind}">{STYLE}{inside}</div>'


def _escaped(text: object) -> str:
    """Any text as HTML that runs nothing, on one line."""
    return html.escape(one_line(str(text)))


def _summary(value: object) -> str:
    """The first line of the docstring of a value's class."""
    return _escaped((inspect.getdoc(type(value)) or "").partition("\n")[0])


def _fields(value: object, *, with_parameters: bool = True) -> str:
    """A row for each field of a dataclass, and the parameters that it reads."""
    rows = {
        field.name.replace("_", " "): _cell(getattr(value, field.name))
        for field in dataclasses.fields(value)  # type: ignore[arg-type]
        if field.repr
    }
    parameters: tuple[str, ...] = getattr(value, "parameters", ()) if with_parameters else ()
    if parameters:
        rows["reads"] = ", ".join(f"<code>{_escaped(name)}</code>" for name in parameters)
    cells = "".join(
        f'<tr><th scope="row">{_escaped(name)}</th><td>{cell}</td></tr>'
        for name, cell in rows.items()
    )
    return f"<table><tbody>{cells}</tbody></table>" if rows else ""


def _cell(value: object) -> str:
    """A value as HTML; members of a tuple or mapping on lines of their own."""
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
    return _escaped(f"{value:g}" if isinstance(value, float) else value)
