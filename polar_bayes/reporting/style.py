"""How figures look: colors that everybody can tell apart, labels in words with units.

Whoever has chosen a matplotlib style, by `matplotlib.style.context` or for good, gets it: the house
style fills in what they left alone. Ink and paper follow the style; colors that stand for something
stay. Nothing here changes matplotlib's settings for longer than one figure takes, and no figure
belongs to pyplot, so drawing leaves a notebook as it was.
"""

import functools
import io
import math
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font

from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.errors import one_line

# Okabe and Ito, "Color universal design" (2008).
GRAY = "#6b6b6b"
ORANGE, SKY, GREEN, BLUE = "#e69f00", "#56b4e9", "#009e73", "#0072b2"
VERMILLION, PURPLE = "#d55e00", "#cc79a7"
CHAIN_COLORS = (BLUE, ORANGE, GREEN, PURPLE, VERMILLION, SKY)

STYLE: Any = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GRAY,
    "xtick.color": GRAY,
    "ytick.color": GRAY,
}
"""Of the house, each where the user has not said otherwise."""

ALWAYS: Any = {
    # Names of captures and materials are text, whatever dollar signs they contain.
    "text.parse_math": False,
    "text.usetex": False,
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": True,
    "svg.hashsalt": "polar_bayes",
    "path.simplify": True,
}
"""Whatever the user's style says."""

QUANTITIES = {
    "dop": "degree of polarization",
    "q": "signed polarization q",
    "u": "signed polarization u",
    "intensity": "intensity",
}
SHORT = {**QUANTITIES, "dop": "DoP", "q": "q", "u": "u"}
GREEK = {"beta": "β"}


def styled[**P, R](draw: Callable[P, R]) -> Callable[P, R]:
    """Run a drawing function in the user's style, the house's beneath it; settings stay."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(_settings()):
            return draw(*args, **kwargs)

    return wrapper


def in_house_style[**P, R](write: Callable[P, R]) -> Callable[P, R]:
    """Run what writes a report in the house style alone: the same result gives the same page."""

    @functools.wraps(write)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.style.context("default"):
            return write(*args, **kwargs)

    return wrapper


def _settings() -> Any:
    """What the user has set, and where they have not, what the house does."""
    own: Any = matplotlib.rcParams
    default: Any = matplotlib.rcParamsDefault
    wanted = {**STYLE, **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), own["text.color"])}
    house = {key: value for key, value in wanted.items() if own[key] == default[key]}
    families = own["font.family"]
    # Every letter of a name can be drawn, whatever font comes first.
    fonts = [*([] if families == default["font.family"] else families), "DejaVu Sans"]
    return {**house, **ALWAYS, "font.family": fonts}


def ink() -> str:
    """The color of text and readings, in the style that is drawn in."""
    return str(matplotlib.colors.to_hex(matplotlib.rcParams["text.color"]))


def paper() -> str:
    """The color behind them."""
    return str(matplotlib.colors.to_hex(matplotlib.rcParams["axes.facecolor"]))


class Drawing(Figure):
    """A figure that a notebook shows by itself, whether pyplot is there or not."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", facecolor=self.get_facecolor())
        return buffer.getvalue()


def grid(
    count: int, *, columns: int, width: float, panel_height: float, header: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """A figure of equal panels in rows."""
    columns = max(1, min(columns, count))
    rows = max(1, math.ceil(count / columns))
    figure = Drawing(figsize=(width, rows * panel_height + header), layout="constrained")
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(count)]
    return figure, axes


def title_of(scalar: Scalar, posterior: xr.Dataset) -> str:
    """A parameter in words with its unit: `refractive index n, 450 nm`."""
    attributes = posterior[scalar.name].attrs
    words = str(attributes.get("long_name", scalar.name.replace("_", " ")))
    words = {"absorption relative to scattering": "absorption"}.get(words, words)
    symbol = str(attributes.get("symbol", ""))
    places = [place_of(dim, label) for dim, label in scalar.labels.items()]
    unit = str(attributes.get("units", "1"))
    name = f"{words} {GREEK.get(symbol, symbol)}".strip() + (f" [{unit}]" if unit != "1" else "")
    return plain(", ".join([name, *places]))


def place_of(dim: str, label: str) -> str:
    """One coordinate in words: `450 nm`, `material leaf`."""
    if dim == "wavelength":
        return f"{label} nm"
    return label if dim.endswith(tuple("0123456789")) else f"{dim} {label}"


def plain(text: str, longest: int = 60) -> str:
    """Text that the figure's font can draw, on one line and not too long."""
    line = one_line(text)
    known = _characters()
    drawn = "".join(c if ord(c) in known else "□" for c in line)
    return drawn if len(drawn) <= longest else f"{drawn[: longest - 1]}…"


def wrapped(text: str, width: int, lines: int = 2) -> str:
    """Text broken into short lines, cut where there are too many."""
    return "\n".join(textwrap.wrap(text, width, max_lines=lines, placeholder="…"))


def lighten(color: str, share: float) -> tuple[float, float, float]:
    """A color mixed with the paper's, so that areas need no transparency (print, old readers)."""
    rgb, white = (np.array(matplotlib.colors.to_rgb(each)) for each in (color, paper()))
    red, green, blue = rgb + (white - rgb) * share
    return float(red), float(green), float(blue)


def quiet_ticks(axes: Axes | Sequence[Axes]) -> None:
    """Fix tick sizes now: matplotlib would look them up only when the figure is drawn."""
    for axis in [axes] if isinstance(axes, Axes) else axes:
        axis.tick_params(labelsize=matplotlib.rcParams["xtick.labelsize"], length=3.0, color=GRAY)


@functools.cache
def _characters() -> frozenset[int]:
    return frozenset(get_font(findfont("DejaVu Sans")).get_charmap())
