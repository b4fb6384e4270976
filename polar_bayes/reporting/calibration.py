"""Figures of a calibration: ranks, coverage, and estimates against the truth.

In a notebook a figure is the last line of a cell; `figure.savefig("name.pdf")` writes it.
"""

from collections.abc import Mapping, Sequence

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from polar_bayes.errors import FitError
from polar_bayes.reporting.calibration_panels import (
    Part,
    Ranked,
    coverage_rows,
    ecdf_panel,
    estimate_panel,
    histogram_panel,
    parts_of,
)
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Drawing,
    grid,
    plain,
    quiet_ticks,
    styled,
    wrapped,
)
from polar_bayes.reporting.text import or_dash

METHOD_COLORS = (BLUE, ORANGE, GREEN, PURPLE, SKY)
MOST_ROWS = 6
COLUMNS = 3

RANK = "rank of the truth among the draws (0 lowest, 1 highest)"
BELOW = "share below, minus rank"


@styled
def plot_calibration(
    calibration: xr.DataTree, *, parameters: Sequence[str] | None = None
) -> Figure:
    """Ranks of the truth, their histogram, and estimates against the truth.

    Args:
        calibration: What `polar_bayes.calibrate` returns, or one read back from a file.
        parameters: Labels of those that are drawn, as in `calibration_table`; by default the first
            six.

    Returns:
        The figure: a row for each parameter. Left: share of the ranks below each rank, minus the
        uniform share, in the band that all parameters together leave in one of twenty right
        calibrations. Middle: histogram of the ranks; gray, where all bars of a uniform one are in
        19 of 20. Right: posterior means with 80% intervals (of at most 200 simulations), orange
        where the interval misses the truth; crosses below are fits that failed. Red: not uniform.

    Raises:
        FitError: It is no calibration, or has no such parameter.
    """
    parts = parts_of(calibration)
    shown = list(parts)[:MOST_ROWS] if parameters is None else list(parameters)
    strange = [label for label in shown if label not in parts]
    if strange or not shown:
        raise FitError(
            f"there is no parameter {', '.join(strange)}" if strange else "nothing is asked for",
            where="plot_calibration",
            mend=f"give some of {', '.join(parts)}",
        )
    figure, panels = grid(3 * len(shown), columns=3, width=8.2, panel_height=1.7, header=0.3)
    heads = (BELOW, "density", "posterior mean")
    for row, label in enumerate(shown):
        own = panels[3 * row : 3 * row + 3]
        ecdf_panel(own[0], parts[label])
        histogram_panel(own[1], parts[label])
        estimate_panel(own[2], parts[label])
        own[0].set_title(_title(parts[label]), loc="left")
        for axes, head in zip(own, heads, strict=True):
            axes.set_ylabel(head, fontsize=8)
    for axes, words in zip(
        panels[-3:], ("rank of the truth", "rank of the truth", "truth"), strict=True
    ):
        axes.set_xlabel(words, fontsize=8)
    quiet_ticks(panels)
    return figure


@styled
def ecdf_differences(
    parts: Sequence[Ranked], beside: Mapping[str, Mapping[str, Ranked]], method: str
) -> Figure:
    """Share of the ranks below each rank, minus the uniform share."""
    figure, panels = _panels(len(parts), panel_height=1.85, header=0.6 if beside else 0.3)
    colors = colors_of(beside)
    for axes, part in zip(panels, parts, strict=True):
        others = {name: (each[part.label], colors[name]) for name, each in beside.items()}
        ecdf_panel(axes, part, others)
        axes.set_title(_title(part), loc="left")
    quiet_ticks(panels)
    figure.supxlabel(RANK, fontsize=9)
    figure.supylabel(BELOW, fontsize=9)
    _name_methods(figure, method, colors)
    return figure


@styled
def rank_histograms(parts: Sequence[Part]) -> Figure:
    """Histograms of the ranks."""
    figure, panels = _panels(len(parts), panel_height=1.5, header=0.3)
    for axes, part in zip(panels, parts, strict=True):
        histogram_panel(axes, part)
        axes.set_title(wrapped(part.title, 38), loc="left")
    quiet_ticks(panels)
    figure.supxlabel(RANK, fontsize=9)
    figure.supylabel("density", fontsize=9)
    return figure


@styled
def interval_coverage(
    parts: Sequence[Part], beside: Mapping[str, Mapping[str, Part]], method: str
) -> Figure:
    """How often 50, 80 and 95% intervals hold the truth."""
    colors = colors_of(beside)
    tall = 0.3 + 0.12 * len(beside)
    figure = Drawing(figsize=(8.2, tall * len(parts) + 1.0), layout="constrained")
    axes = figure.add_subplot()
    rows = []
    for part in parts:
        own = BLUE if part.passes or beside else VERMILLION
        others = [(each[part.label].row, colors[name]) for name, each in beside.items()]
        rows.append([(part.row, own), *others])
    coverage_rows(axes, rows, [part.title for part in parts])
    axes.set_xlabel("share of all fits whose interval holds the truth", fontsize=9)
    quiet_ticks(axes)
    _name_methods(figure, method, colors)
    return figure


@styled
def estimates(parts: Sequence[Part]) -> Figure:
    """Posterior means with 80% intervals against the truth."""
    figure, panels = _panels(len(parts), panel_height=2.3, header=0.3)
    for axes, part in zip(panels, parts, strict=True):
        estimate_panel(axes, part)
        axes.set_title(wrapped(part.title, 38), loc="left")
    quiet_ticks(panels)
    figure.supxlabel("truth", fontsize=9)
    figure.supylabel("mean and 80% interval", fontsize=9)
    handles = [
        Line2D([], [], color=BLUE, marker="o", ms=3, label="holds the truth"),
        Line2D([], [], color=ORANGE, marker="o", ms=3, label="misses it"),
        Line2D([], [], color=GRAY, ls="--", label="mean = truth"),
    ]
    if any(part.answered.size < part.pit.size for part in parts):
        handles.append(Line2D([], [], color=VERMILLION, marker="x", ls="", label="fit failed"))
    _legend(figure, handles)
    return figure


def _panels(count: int, *, panel_height: float, header: float) -> tuple[Figure, list[Axes]]:
    """Panels of one size, however few there are."""
    width = {1: 4.4, 2: 6.3}.get(count, 8.2)
    return grid(count, columns=COLUMNS, width=width, panel_height=panel_height, header=header)


def _legend(figure: Figure, handles: list[Line2D]) -> None:
    columns = 4 if figure.get_figwidth() > 6.0 else 2
    figure.legend(handles=handles, loc="outside upper left", ncols=columns, frameon=False)


def colors_of(beside: Mapping[str, object]) -> dict[str, str]:
    """A color for each other method: `METHOD_COLORS` after the first."""
    own = METHOD_COLORS[1:]
    return {name: own[at % len(own)] for at, name in enumerate(beside)}


def _title(part: Ranked) -> str:
    chance = or_dash(part.row["p_value"], "{:.2g}")
    return f"{wrapped(part.title, 30)}\np = {chance}"


def _name_methods(figure: Figure, method: str, colors: Mapping[str, str]) -> None:
    if colors:
        named = {method: BLUE, **colors}
        handles = [
            Line2D([], [], color=color, label=plain(name, 24)) for name, color in named.items()
        ]
        _legend(figure, handles)
