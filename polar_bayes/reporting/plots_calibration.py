"""Figures of a calibration: ranks, coverage, and estimates against the truth.

In a notebook a figure is the last line of a cell; `figure.savefig("name.pdf")` writes it.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection, plot_dist, plot_ecdf_pit
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from polar_bayes.calibration.scores import EcdfBand, ecdf_band, histogram_band, significance_level
from polar_bayes.calibration.verdict import calibration_scalars, calibration_table
from polar_bayes.diagnostics.coverage import INTERVALS
from polar_bayes.errors import FitError
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
    ink,
    lighten,
    plain,
    quiet_ticks,
    styled,
    title_of,
    wrapped,
)
from polar_bayes.reporting.text import or_dash

# --- Panels of a calibration: one parameter each, drawn from the saved tree alone -----------------


MOST_BINS, FEWEST_BINS = 20, 5
IN_A_BIN = 15
MOST_SHOWN = 200
"""Simulations whose intervals are drawn: more would hide each other."""

LOGARITHMIC = 50.0
"""Truths that span a larger factor are drawn on a logarithmic axis."""

BARE = ("title", "xlabel", "ylabel", "suspicious_points", "p_value_text")
ONLY_BARS = ("title", "point_estimate", "point_estimate_text", "credible_interval", "remove_axis")


class Ranked(Protocol):
    """Whatever has ranks that should be uniform: a parameter, or a reading."""

    @property
    def label(self) -> str:
        """Its name."""

    @property
    def title(self) -> str:
        """In words."""

    @property
    def answered(self) -> np.ndarray:
        """Ranks of the fits that have an answer."""

    @property
    def row(self) -> pd.Series:
        """With its p-value."""

    @property
    def passes(self) -> bool:
        """Whether its ranks pass the joint test."""

    @property
    def level(self) -> float:
        """Of that test for one of them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """What a calibration knows of one parameter."""

    label: str
    title: str
    pit: np.ndarray
    truth: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    row: pd.Series
    passes: bool
    level: float

    @property
    def answered(self) -> np.ndarray:
        """Ranks of the fits that have an answer."""
        return self.pit[np.isfinite(self.pit)]


def parts_of(calibration: xr.DataTree, table: pd.DataFrame | None = None) -> dict[str, Part]:
    """Every parameter of a calibration by its label."""
    table = calibration_table(calibration) if table is None else table
    truths = {each.label: each.draws[0] for each in calibration_scalars(calibration, "truth")}
    ranks, marginals = (calibration[name].to_dataset() for name in ("prior_sbc", "marginals"))
    level = significance_level(table)
    found = {}
    for scalar in calibration_scalars(calibration, "prior_sbc"):
        place = dict(scalar.index)
        ends = marginals[f"{scalar.name}_quantile"].isel(place).sel(quantile=list(INTERVALS[80]))
        low, high = ends.transpose("quantile", "simulation").to_numpy()
        row = table.loc[scalar.label]
        found[scalar.label] = Part(
            label=scalar.label,
            title=title_of(scalar, ranks),
            pit=scalar.draws[0],
            truth=truths[scalar.label],
            mean=marginals[scalar.name].isel(place).to_numpy(),
            low=low,
            high=high,
            row=row,
            passes=bool(row["p_value"] >= level),
            level=level,
        )
    return found


def ecdf_panel(
    axes: Axes, part: Ranked, beside: Mapping[str, tuple[Ranked, str]] | None = None
) -> None:
    """Share of the ranks below each rank, minus the uniform share, in its band."""
    if part.answered.size < 2:
        _too_few(axes)
        return
    band = ecdf_band(part.answered.size, part.level)
    axes.fill_between(band.at, band.lower, band.upper, color=lighten(GRAY, 0.75), lw=0)
    color = BLUE if part.passes or beside else VERMILLION
    _ecdf(axes, part, color)
    for other, its_color in (beside or {}).values():
        if other.answered.size >= 2:
            _ecdf(axes, other, its_color)
    _mark_outside(axes, part, band)
    reach = [np.abs(np.asarray(line.get_ydata(), float)).max() for line in axes.lines]
    largest = 1.1 * max(*reach, np.abs(band.lower).max(), band.upper.max())
    axes.set(xlim=(0, 1), ylim=(-largest, largest), xticks=[0, 0.5, 1])
    axes.locator_params(axis="y", nbins=5)


def histogram_panel(axes: Axes, part: Part) -> None:
    """Histogram of the ranks, and how high the bars of a uniform one are."""
    count = part.answered.size
    if count < 2:
        _too_few(axes)
        return
    bins = int(np.clip(count // IN_A_BIN, FEWEST_BINS, MOST_BINS))
    low, high = histogram_band(count, bins)
    axes.axhspan(low, high, color=lighten(GRAY, 0.75), lw=0)
    axes.axhline(1.0, color=GRAY, lw=0.8, ls="--")
    color = BLUE if part.passes else VERMILLION
    plot_dist(
        _ranks(part),
        kind="hist",
        sample_dims=["simulation"],
        plot_collection=_collection(axes, part),
        stats={"dist": {"bins": np.linspace(0.0, 1.0, bins + 1)}},
        visuals={
            "dist": {"color": color, "width": 1.3},
            **dict.fromkeys(ONLY_BARS, False),
        },
    )
    axes.set(xlim=(0, 1), xticks=[0, 0.5, 1])
    axes.set_ylim(0.0, max(1.12 * high, 1.06 * axes.get_ylim()[1]))


def estimate_panel(axes: Axes, part: Part) -> None:
    """Posterior means and 80% intervals against the truth."""
    shown = np.unique(np.linspace(0, part.truth.size - 1, MOST_SHOWN).astype(int))
    truth, mean = part.truth[shown], part.mean[shown]
    low, high = part.low[shown], part.high[shown]
    works = np.isfinite(mean) & np.isfinite(low + high)
    held = works & (low <= truth) & (truth <= high)
    for which, color, order in ((held, BLUE, 2), (works & ~held, ORANGE, 3)):
        axes.vlines(
            truth[which], low[which], high[which], color=lighten(color, 0.5), lw=0.7, zorder=order
        )
        axes.plot(truth[which], mean[which], "o", color=color, ms=2.2, mew=0, zorder=order + 2)
    limits = _limits(truth, mean[works])
    axes.plot(limits, limits, color=GRAY, lw=0.9, ls="--", zorder=1)
    if limits[0] > 0.0 and limits[1] / limits[0] > LOGARITHMIC:
        axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):  # the style reads no formulas
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
    else:
        axes.locator_params(nbins=4)
    axes.set(xlim=limits, ylim=limits)
    if not works.all():
        style: Any = {"transform": axes.get_xaxis_transform(), "clip_on": False, "zorder": 6}
        axes.plot(truth[~works], 0.0 * truth[~works], "x", color=VERMILLION, ms=4, mew=1, **style)


def coverage_rows(
    axes: Axes, rows: Sequence[Sequence[tuple[pd.Series, str]]], titles: Sequence[str]
) -> None:
    """How often 50, 80 and 95% intervals hold the truth: a line for each parameter."""
    least = 0.4
    for percent in INTERVALS:
        axes.axvline(percent / 100.0, color=GRAY, lw=0.9, ls="--", zorder=1)
    for at, methods in enumerate(rows):
        steps = 0.22 * (np.arange(len(methods)) - (len(methods) - 1) / 2.0)
        for step, (row, color) in zip(steps, methods, strict=True):
            for percent in INTERVALS:
                held, low, high = (row[f"held_{percent}{end}"] for end in ("", "_low", "_high"))
                axes.plot([low, high], [at + step] * 2, color=color, lw=1.4, zorder=2)
                axes.plot([held], [at + step], "o", color=color, ms=3.6, mew=0, zorder=3)
                least = min(least, low)
    axes.set(xlim=(least - 0.02, 1.01), ylim=(len(rows) - 0.4, -0.6))
    axes.set_yticks(range(len(rows)), [wrapped(title, 30) for title in titles])
    ticks = [each / 100.0 for each in (*range(0, 50, 10), *INTERVALS) if each / 100.0 > least]
    axes.set_xticks(ticks, [f"{tick:.0%}" for tick in ticks])


def _ecdf(axes: Axes, part: Ranked, color: str) -> None:
    tree = xr.DataTree.from_dict({"prior_sbc": _ranks(part)})
    plot_ecdf_pit(
        tree,
        sample_dims=["simulation"],
        plot_collection=_collection(axes, part),
        # ArviZ's own band raises, and its test is another one than that of the verdict.
        visuals={
            "ecdf_lines": {"color": color, "width": 1.3},
            **dict.fromkeys(BARE, False),
        },
    )


def _mark_outside(axes: Axes, part: Ranked, band: EcdfBand) -> None:
    """Dots where the curve leaves the band, which is too narrow to see at its ends."""
    below = np.searchsorted(np.sort(part.answered), band.at[1:-1], side="left")
    away = below / part.answered.size - band.at[1:-1]
    outside = (away < band.lower[1:-1] - 1e-9) | (away > band.upper[1:-1] + 1e-9)
    if outside.any():
        axes.plot(band.at[1:-1][outside], away[outside], "o", color=ink(), ms=2.6, zorder=4)


def _ranks(part: Ranked) -> xr.Dataset:
    return xr.Dataset({"rank": ("simulation", part.answered)})


def _collection(axes: Axes, part: Ranked) -> PlotCollection:
    """ArviZ draws into axes of ours, so that no figure belongs to pyplot."""
    boxed = {key: np.array(None, dtype=object) for key in ("figure", "rank")}
    boxed["figure"][()], boxed["rank"][()] = axes.figure, axes
    viz = xr.DataTree.from_dict(
        {
            "/": xr.Dataset({"figure": ((), boxed["figure"])}),
            "plot": xr.Dataset({"rank": ((), boxed["rank"])}),
            "row": xr.Dataset({"rank": 0}),
            "col": xr.Dataset({"rank": 0}),
        }
    )
    return PlotCollection(_ranks(part), viz, aes_dt=xr.DataTree(), backend="matplotlib")


def _limits(truth: np.ndarray, mean: np.ndarray) -> tuple[float, float]:
    """Of both axes: all truths and means, whatever the longest intervals reach."""
    values = np.concatenate([truth[np.isfinite(truth)], mean])
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    if low > 0.0 and high / low > LOGARITHMIC:
        return low / 1.2, high * 1.2
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def _too_few(axes: Axes) -> None:
    axes.text(0.5, 0.5, "fewer than two answers", ha="center", transform=axes.transAxes, color=GRAY)
    axes.set(xticks=[], yticks=[])


# --- Figures of a calibration: ranks, coverage, and estimates against the truth -------------------


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
            hint=f"give some of {', '.join(parts)}",
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
