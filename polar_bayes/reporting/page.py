"""What every page has in common: it stands alone, and is written whole or not at all."""

import base64
import dataclasses
import io
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from polar_bayes.errors import FitError
from polar_bayes.reporting.style import ALWAYS

PAGE = "index.html"


@dataclasses.dataclass(frozen=True)
class Picture:
    """A figure on the page.

    Args:
        source: The image itself, as a data URI.
        alternative: What it shows, for readers who cannot see it.
        caption: How to read it.
        wide: True for many panels; small screens scroll it in its own box.
    """

    source: str
    alternative: str
    caption: str
    wide: bool


def picture(figure: Figure, alternative: str, caption: str) -> Picture:
    """A figure as a part of the page.

    Args:
        figure: Any.
        alternative: What it shows, for readers who cannot see it.
        caption: How to read it.

    Returns:
        The picture; the same figure gives the same bytes.
    """
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
    """A template with its content; every text is escaped.

    Args:
        template: Name of a file in `templates`.
        content: All that it names.

    Returns:
        A whole HTML document.
    """
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
    """Write a page and what lies beside it; an older report in the folder is replaced.

    Args:
        folder: Made if it is not there.
        page: The document.
        others: By name of the file, what writes it.

    Returns:
        The path of the page.

    Raises:
        FitError: The folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as unfinished:
            (Path(unfinished) / PAGE).write_text(page, encoding="utf-8")
            for name, write in (others or {}).items():
                write(Path(unfinished) / name)
            for name in (*(others or {}), PAGE):
                (Path(unfinished) / name).replace(folder / name)
    except OSError as error:
        raise FitError(
            (error.strerror or str(error)).lower(),
            where=str(folder),
            mend="give a folder that can be written",
        ) from error
    return folder / PAGE
