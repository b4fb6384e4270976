"""What every page has in common: it stands alone, and is written whole or not at all."""

import base64
import csv
import dataclasses
import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from polar_bayes.paths import check_output, replace_file, temporary_folder, write_errors
from polar_bayes.reporting.style import ALWAYS

PAGE = "index.html"
MARK, HEAD = b'<meta name="generator" content="polar_bayes">', 1024
"""What every page of ours has among its first bytes."""


@dataclasses.dataclass(frozen=True)
class Picture:
    """A figure on the page."""

    source: str
    alternative: str
    caption: str
    wide: bool


def picture(figure: Figure, alternative: str, caption: str) -> Picture:
    """A figure as a part of the page."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(ALWAYS):
        # No date and a fixed salt: the same result gives the same page, byte for byte.
        figure.savefig(buffer, format="svg", dpi=160, metadata={"Date": None, "Creator": None})
    encoded = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Picture(
        source=f"data:image/svg+xml;base64,{encoded}",
        alternative=alternative,
        caption=caption,
        wide=figure.get_figwidth() > 7.0,
    )


def fill(template: str, content: Mapping[str, Any]) -> str:
    """A template with its content; every text is escaped."""
    environment = Environment(
        loader=PackageLoader("polar_bayes.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["plain_letters"] = lambda text: re.sub(r"[^a-z0-9]", "", text.lower())
    return environment.get_template(template).render(content)


def write_page(
    folder: Path, page: str, others: Mapping[str, Callable[[Path], object]] | None = None
) -> Path:
    """Write a page and the files that go with it; an older report in the folder is replaced."""
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
    """Whether a file is a page that `fill` made."""
    try:
        return MARK in file.read_bytes()[:HEAD]
    except OSError:
        return False


# --- Tables of a page as CSV files that the page itself holds: no second file, no network ---------


FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What a spreadsheet runs when a text begins with it."""


def csv_link(table: pd.DataFrame, first: str) -> str:
    """A table as the address of a link."""
    safe = table.map(_inert)
    if isinstance(table.index, pd.MultiIndex):
        safe.index = pd.MultiIndex.from_tuples(
            [tuple(map(_inert, row)) for row in table.index], names=table.index.names
        )
        labels: str | list[str] = [str(name) for name in table.index.names]
    else:
        safe.index, labels = pd.Index([_inert(name) for name in table.index]), first
    safe.columns = pd.Index([_inert(str(name)) for name in table.columns])
    text = safe.to_csv(index_label=labels, quoting=csv.QUOTE_NONNUMERIC)
    return f"data:text/csv;charset=utf-8;base64,{base64.b64encode(text.encode()).decode('ascii')}"


def _inert(value: object) -> object:
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else value
