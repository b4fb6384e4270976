"""Style of figures: a color-blind safe palette, labels with units, and helpers.

A matplotlib style that the user has chosen is respected: the settings here fill in what it leaves
at its default. The colors of text and background follow that style; colors with a meaning stay.
Drawing changes matplotlib's settings for the time of one figure only, and no figure belongs to
pyplot.
"""

import functools
import io
import itertools
import math
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, override

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.errors import FitError, one_line

# Okabe and Ito, "Color universal design" (2008).
GRAY = "#6b6b6b"
ORANGE, SKY, GREEN, BLUE = "#e69f00", "#56b4e9", "#009e73", "#0072b2"
VERMILLION, PURPLE = "#d55e00", "#cc79a7"
CHAIN_COLORS = (BLUE, ORANGE, GREEN, PURPLE, VERMILLION, SKY)

MAX_PANELS = 12
"""Largest number of parameters in one figure."""

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
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "figure.labelsize": 9.0,
}
"""Default style; settings of the user replace these."""

FIXED_STYLE: Any = {
    # Names of captures and materials are text, whatever dollar signs they contain.
    "text.parse_math": False,
    "text.usetex": False,
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": True,
    "svg.hashsalt": "polar_bayes",
    "path.simplify": True,
}
"""Settings that apply to every style."""

QUANTITIES = {
    "dop": "degree of polarization",
    "q": "signed polarization q",
    "u": "signed polarization u",
    "intensity": "intensity",
}
SHORT = {**QUANTITIES, "dop": "DoP", "q": "q", "u": "u"}


type Look = dict[str, Any]
"""Keyword arguments of matplotlib."""


def styled[**P, R](draw: Callable[P, R]) -> Callable[P, R]:
    """Decorate a drawing function to use the user's style, and these defaults elsewhere."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(_settings()):
            return draw(*args, **kwargs)

    return wrapper


def _settings() -> Any:
    own: Any = matplotlib.rcParams
    default: Any = matplotlib.rcParamsDefault
    wanted = {**STYLE, **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), own["text.color"])}
    unset = {key: value if own[key] == default[key] else own[key] for key, value in wanted.items()}
    families = own["font.family"]
    # DejaVu Sans comes last, so that every letter of a name can be drawn.
    fonts = [*([] if families == default["font.family"] else families), "DejaVu Sans"]
    return {**unset, **FIXED_STYLE, "font.family": fonts}


def text_color() -> str:
    """Return the color of text and readings in the current style."""
    return str(matplotlib.colors.to_hex(matplotlib.rcParams["text.color"]))


def background() -> str:
    """Return the background color of the current style."""
    return str(matplotlib.colors.to_hex(matplotlib.rcParams["axes.facecolor"]))


def lighten(color: str, share: float) -> tuple[float, float, float]:
    """Mix a color with the background's, instead of transparency."""
    rgb, white = (np.array(matplotlib.colors.to_rgb(each)) for each in (color, background()))
    red, green, blue = rgb + (white - rgb) * share
    return float(red), float(green), float(blue)


# --- Figures and axes -----------------------------------------------------------------------------


class NotebookFigure(Figure):
    """A figure that notebooks show without pyplot, drawn in the style of its creation."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._style = {key: matplotlib.rcParams[key] for key in _settings()}

    @override
    def draw(self, renderer: RendererBase) -> None:
        # Spines lie on the panel, whose place a layout knows: to ask each of them is an eighth of
        # the time of a report.
        for spine in (spine for axes in self.axes for spine in axes.spines.values()):
            spine.set_in_layout(False)
        # matplotlib looks up the looks of ticks only now.
        with matplotlib.rc_context(self._style):
            super().draw(renderer)

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", facecolor=self.get_facecolor())
        return buffer.getvalue()


def grid(
    count: int, *, columns: int = 3, width: float = 8.2, panel_height: float, header: float = 0.0
) -> tuple[Figure, list[Axes]]:
    """Return a figure of equal panels in rows, unit inch."""
    columns = max(1, min(columns, count))
    rows = max(1, math.ceil(count / columns))
    figure = NotebookFigure(figsize=(width, rows * panel_height + header), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(count)]


def in_turn(names: Iterable[str], looks: Sequence[str]) -> dict[str, str]:
    """Assign a color or marker to each distinct name; they repeat where there are too few."""
    return dict(zip(dict.fromkeys(names), itertools.cycle(looks), strict=False))


def add_legend(figure: Figure, columns: int, colors: Mapping[str, str] = {}) -> None:
    """A legend above the panels: names by their colors, then each label that was drawn, once."""
    found: list[Artist] = [
        Line2D([], [], color=color, lw=2.0, label=label_text(name, 24))
        for name, color in colors.items()
    ]
    drawn: dict[object, Artist] = {}
    for handle in (
        handle for axes in figure.axes for handle in axes.get_legend_handles_labels()[0]
    ):
        drawn.setdefault(handle.get_label(), handle)
    if found := [*found, *drawn.values()]:
        place: Look = {"loc": "outside upper left", "ncols": columns, "frameon": False}
        figure.legend(handles=found, **place)


def set_panel_title(axes: Axes, title: str) -> None:
    """Set a title of at most two lines, as wide as one of three panels."""
    axes.set_title(wrap(title, 42), loc="left")


def plain_numbers(*axes: Axis) -> None:
    """Set tick labels of logarithmic axes without math text, which the style does not parse."""
    for axis in axes:
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())


def check_shown(shown: Sequence[str], known: Collection[str], what: str, where: str) -> None:
    """Refuse a figure of nothing, or of what a result does not have."""
    unknown = ", ".join(name for name in shown if name not in known)
    if unknown or not shown:
        missing = f"there is no {what} {unknown}" if unknown else f"there is no {what} to draw"
        raise FitError(missing, where=where, hint=f"give some of {', '.join(known)}")


def padded_range(values: np.ndarray, margin: float) -> tuple[float, float]:
    """Return limits of an axis around values; `margin` is a share of their range."""
    low, high = float(np.min(values)), float(np.max(values))
    pad = margin * (high - low) or 1.0
    return low - pad, high + pad


def write_in_panel(axes: Axes, text: str) -> None:
    """Write a text in place of a figure that cannot be drawn."""
    axes.text(0.5, 0.5, text, ha="center", transform=axes.transAxes, color=GRAY)


def true_value_style() -> Look:
    """Marker of a true value."""
    look: Look = {"marker": "d", "ls": "", "mfc": ORANGE, "mec": background(), "ms": 6.5}
    return {**look, "label": "true value"}


# --- Labels ---------------------------------------------------------------------------------------


def parameter_title(scalar: Scalar, posterior: xr.Dataset) -> str:
    """Return name, symbol, unit and coordinates: `refractive index n, 450 nm`."""
    attributes = posterior[scalar.name].attrs
    name = str(attributes.get("long_name", scalar.name.replace("_", " ")))
    name = {"absorption relative to scattering": "absorption"}.get(name, name)
    name = quantity_label(name, str(attributes.get("symbol", "")), attributes.get("units", "1"))
    return label_text(", ".join([name, *coordinate_labels(scalar)]))


def short_title(scalar: Scalar, posterior: xr.Dataset) -> str:
    """Return name, symbol and unit of a parameter, without coordinates."""
    return parameter_title(scalar, posterior).partition(", ")[0]


def quantity_label(name: str, symbol: str, unit: object) -> str:
    """Return a label such as `refractive index n` or `exposure [s]`."""
    label = f"{name} {'β' if symbol == 'beta' else symbol}".strip()
    return label if str(unit) == "1" else f"{label} [{unit}]"


def coordinate_labels(scalar: Scalar) -> list[str]:
    """Return every coordinate of a parameter with its unit or dimension."""
    return [coordinate_label(dim, label) for dim, label in scalar.labels.items()]


def coordinate_label(dim: str, label: str) -> str:
    """Return a label such as `450 nm` or `material leaf`."""
    if dim == "wavelength":
        return f"{label} nm"
    return label if dim.endswith(tuple("0123456789")) else f"{dim} {label}"


def label_text(text: str, longest: int = 60) -> str:
    """Return text on one line in letters of the font, truncated where it is too long."""
    known = _characters()
    drawn = "".join(c if ord(c) in known else "□" for c in one_line(text))
    return drawn if len(drawn) <= longest else f"{drawn[: longest - 1]}…"


def wrap(text: str, width: int, lines: int = 2) -> str:
    """Break text into short lines, truncated after a number of them."""
    return "\n".join(textwrap.wrap(text, width, max_lines=lines, placeholder="…"))


@functools.cache
def _characters() -> frozenset[int]:
    return frozenset(get_font(findfont("DejaVu Sans")).get_charmap())
