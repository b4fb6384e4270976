"""How a notebook shows values of this package: one small card in one style, and no script.

Colors are the notebook's own, so that cards suit light and dark themes. Every text is escaped:
names of captures, materials and parameters come from files. `repr` is untouched: a terminal, a
log and a saved result show what one would write to make the value again.
"""

import dataclasses
import html
import inspect
from collections.abc import Iterator, Mapping
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
"""One for all cards; a page may hold it many times."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """Rows of texts under heads; the first cell of a row names it."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: bool = False

    @property
    def html(self) -> str:
        """As an HTML table."""
        head = "".join(f'<th scope="col">{escaped(text)}</th>' for text in self.heads)
        rows = "".join(
            f'<tr><th scope="row">{escaped(first)}</th>'
            f"{''.join(f'<td>{escaped(cell)}</td>' for cell in cells)}</tr>"
            for first, *cells in self.rows
        )
        kind = ' class="numbers"' if self.numeric else ""
        return f"<table{kind}><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"

    @property
    def text(self) -> str:
        """In columns of a terminal, numbers to the right."""
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
class Card:
    """A title, sentences and tables: HTML in a notebook, text everywhere else."""

    title: str
    said: tuple[str, ...] = ()
    grids: tuple[Grid, ...] = ()
    good: bool | None = None

    @override
    def __repr__(self) -> str:
        parts = ["\n".join([one_line(self.title), *self.said]), *(grid.text for grid in self.grids)]
        return "\n\n".join(parts)

    def _repr_html_(self) -> str:
        said = "".join(f"<p>{escaped(sentence)}</p>" for sentence in self.said)
        return framed(
            f"<h4>{escaped(self.title)}</h4>{said}{''.join(grid.html for grid in self.grids)}",
            self.good,
        )


class HTMLRepr:
    """A frozen value that a notebook shows as a card: its fields, and theirs."""

    def _repr_html_(self) -> str:
        more = self.more_on_card()
        grids = "".join(grid.html for grid in more)
        return framed(f"{_title(self)}{_fields(self, reads=not more)}{grids}")

    def more_on_card(self) -> tuple[Grid, ...]:
        """Tables below the fields."""
        return ()


def framed(inside: str, good: bool | None = None) -> str:
    """HTML in the frame of a card."""
    kind = {None: "", True: " good", False: " bad"}[good]
    return f'<div class="pb-card{kind}">{STYLE}{inside}</div>'


def escaped(text: object) -> str:
    """Any text as HTML that runs nothing, on one line."""
    return html.escape(one_line(str(text)))


def _title(value: object) -> str:
    return f"<h4>{escaped(type(value).__name__)}</h4><p><small>{_about(value)}</small></p>"


def _about(value: object) -> str:
    """The first line of its documentation."""
    return escaped((inspect.getdoc(type(value)) or "").partition("\n")[0])


def _fields(value: object, *, reads: bool = True) -> str:
    """A row for each field of a dataclass, and the parameters that it reads."""
    rows = [
        (field.name.replace("_", " "), _cell(getattr(value, field.name)))
        for field in dataclasses.fields(value)  # type: ignore[arg-type]
        if field.repr
    ]
    read = getattr(value, "parameters", ()) if reads else ()
    rows += [("reads", ", ".join(f"<code>{escaped(name)}</code>" for name in read))] if read else []
    cells = "".join(
        f'<tr><th scope="row">{escaped(name)}</th><td>{cell}</td></tr>' for name, cell in rows
    )
    return f"<table><tbody>{cells}</tbody></table>" if rows else ""


def _cell(value: object) -> str:
    if value is None:
        return "<small>none</small>"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        name = f"{escaped(type(value).__name__)} <small>{_about(value)}</small>"
        inside = _fields(value)
        return f"<details><summary>{name}</summary>{inside}</details>" if inside else name
    parts = list(_parts(value))
    if parts:
        return "<br>".join(parts)
    return escaped(f"{value:g}" if isinstance(value, float) else value)


def _parts(value: object) -> Iterator[str]:
    """Members of a tuple or mapping, each as a cell of its own."""
    if isinstance(value, Mapping):
        yield from (f"{escaped(key)}: {_cell(item)}" for key, item in value.items())
    elif isinstance(value, tuple):
        yield from map(_cell, value)
