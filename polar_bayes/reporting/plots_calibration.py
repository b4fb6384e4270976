"""Figures of a calibration: ranks, coverage, and estimates against the truth."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from polar_bayes.calibration.scores import EcdfBand, ecdf_band, histogram_band, significance_level
from polar_bayes.calibration.verdict import CalibrationView, calibration_view
from polar_bayes.diagnostics.coverage import INTERVALS
from polar_bayes.reporting import style
from polar_bayes.reporting.style import BLUE, GRAY, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from polar_bayes.reporting.text import or_dash

MAX_INTERVALS = 200
"""Largest number of simulations whose intervals are drawn: more would overlap."""

MAX_ROWS = 6
METHOD_COLORS = (ORANGE, GREEN, PURPLE, SKY)
"""Colors of the methods after the first."""

RANK = "rank of the truth among the draws (0 lowest, 1 highest)"
BELOW = "share below, minus rank"


@dataclasses.dataclass(frozen=True, eq=False)
class Ranks:
    """Ranks of a parameter or reading, uniform if calibrated; NaN where a fit failed.

    The estimates, shape (4, simulation), are truth, posterior mean and ends of the 80% interval;
    readings have ranks only.
    """

    label: str
    title: str
    pit: np.ndarray
    row: pd.Series
    level: float
    estimates: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((4, 0)))

    @property
    def answered(self) -> np.ndarray:
        """Ranks of fits that have an answer."""
        return self.pit[np.isfinite(self.pit)]

    @property
    def passes(self) -> bool:
        """True if the ranks pass the joint test."""
        return bool(self.row["p_value"] >= self.level)


def parameter_ranks(calibration: xr.DataTree | CalibrationView) -> dict[str, Ranks]:
    """Return ranks and estimates of every parameter of a calibration by its label."""
    calibration = calibration_view(calibration)
    table, tree = calibration.table, calibration.tree
    ranks, marginals = (tree[name].to_dataset() for name in ("prior_sbc", "marginals"))
    found = {}
    for scalar, truth in calibration.scalars:
        place = dict(scalar.index)
        ends = marginals[f"{scalar.name}_quantile"].isel(place).sel(quantile=list(INTERVALS[80]))
        mean = marginals[scalar.name].isel(place).to_numpy()
        found[scalar.label] = Ranks(
            label=scalar.label,
            title=style.parameter_title(scalar, ranks),
            pit=scalar.draws[0],
            row=table.loc[scalar.label],
            level=significance_level(table),
            estimates=np.stack([truth, mean, *ends.transpose("quantile", ...)]),
        )
    return found


# --- Panels ---------------------------------------------------------------------------------------


def ecdf_panel(
    axes: Axes, ranks: Ranks, others: Sequence[tuple[Ranks, str]] = (), *, several: bool = False
) -> None:
    """Draw the empirical distribution of ranks minus the uniform one, with its band."""
    if ranks.answered.size < 2:
        _too_few(axes)
        return
    band = ecdf_band(ranks.answered.size, ranks.level)
    axes.fill_between(band.at, band.lower, band.upper, color=style.lighten(GRAY, 0.75), lw=0)
    axes.axhline(0.0, color=GRAY, lw=0.8, ls="--")
    own = BLUE if ranks.passes or several else VERMILLION
    for each, color in ((ranks, own), *others):
        if each.answered.size >= 2:
            curve = array_stats.ecdf(each.answered, pit=True)
            axes.step(*curve, where="pre", color=color, lw=1.3, zorder=2)
    _mark_outside(axes, ranks, band)
    reach = [np.abs(np.asarray(line.get_ydata(), float)).max() for line in axes.lines]
    largest = 1.1 * max(*reach, np.abs(band.lower).max(), band.upper.max())
    axes.set(xlim=(0, 1), ylim=(-largest, largest), xticks=[0, 0.5, 1])
    axes.locator_params(axis="y", nbins=5)


def _mark_outside(axes: Axes, ranks: Ranks, band: EcdfBand) -> None:
    """Mark points where the curve leaves the band, which is narrow at its ends."""
    at = band.at[1:-1]
    below = np.searchsorted(np.sort(ranks.answered), at, side="left")
    difference = below / ranks.answered.size - at
    outside = (difference < band.lower[1:-1] - 1e-9) | (difference > band.upper[1:-1] + 1e-9)
    if outside.any():
        color = style.text_color()
        axes.plot(at[outside], difference[outside], "o", color=color, ms=2.6, zorder=4)


def histogram_panel(axes: Axes, ranks: Ranks) -> None:
    """Draw a histogram of ranks, with the range of bars of a uniform one."""
    count = ranks.answered.size
    if count < 2:
        _too_few(axes)
        return
    bins = int(np.clip(count // 15, 5, 20))
    low, high = histogram_band(count, bins)
    axes.axhspan(low, high, color=style.lighten(GRAY, 0.75), lw=0)
    axes.axhline(1.0, color=GRAY, lw=0.8, ls="--")
    color = BLUE if ranks.passes else VERMILLION
    heights, edges = np.histogram(ranks.answered, bins, range=(0.0, 1.0))
    axes.stairs(heights * bins / count, edges, baseline=None, color=color, lw=1.3)
    axes.set(xlim=(0, 1), xticks=[0, 0.5, 1])
    axes.set_ylim(0.0, max(1.12 * high, 1.06 * axes.get_ylim()[1]))


def _too_few(axes: Axes) -> None:
    style.write_in_panel(axes, "fewer than two answers")
    axes.set(xticks=[], yticks=[])


def estimate_panel(axes: Axes, ranks: Ranks) -> None:
    """Draw posterior means and 80% intervals against the truth."""
    last = ranks.estimates.shape[1] - 1
    shown = np.unique(np.linspace(0, last, MAX_INTERVALS).astype(int))
    truth, mean, low, high = ranks.estimates[:, shown]
    answered = np.isfinite(mean) & np.isfinite(low + high)
    held = answered & (low <= truth) & (truth <= high)
    for which, color, order, label in (
        (held, BLUE, 2, "holds the truth"),
        (answered & ~held, ORANGE, 3, "misses it"),
    ):
        dot: style.Look = {"ms": 2.2, "mew": 0, "zorder": order + 2, "label": label}
        light = style.lighten(color, 0.5)
        axes.vlines(truth[which], low[which], high[which], color=light, lw=0.7, zorder=order)
        axes.plot(truth[which], mean[which], "o", color=color, **dot)
    # Of both axes: all truths and means, whatever the longest intervals reach.
    values = np.concatenate([truth[np.isfinite(truth)], mean[answered]])
    values = values if values.size else np.array([0.0, 1.0])
    is_log = bool(values.min() > 0.0 and values.max() / values.min() > 50.0)
    if is_log:
        limits = float(values.min()) / 1.2, float(values.max()) * 1.2
        axes.set(xscale="log", yscale="log")
        axes.locator_params(numticks=4)  # labels of many decades would overlap
        style.plain_numbers(axes.xaxis, axes.yaxis)
    else:
        limits = style.padded_range(values, 0.05)
        axes.locator_params(nbins=4)
    axes.plot(limits, limits, color=GRAY, lw=0.9, ls="--", zorder=1, label="mean = truth")
    axes.set(xlim=limits, ylim=limits)
    failed = truth[~answered]
    if failed.size:
        below: style.Look = {"transform": axes.get_xaxis_transform(), "clip_on": False, "zorder": 6}
        below |= {"ms": 4, "mew": 1, "label": "fit failed"}
        axes.plot(failed, 0.0 * failed, "x", color=VERMILLION, **below)


# --- Figures --------------------------------------------------------------------------------------


@style.styled
def plot_calibration(
    calibration: xr.DataTree | CalibrationView, *, parameters: Sequence[str] | None = None
) -> Figure:
    """Plot ranks of the truth, their histograms, and estimates against the truth.

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
    ranks = parameter_ranks(calibration)
    shown = list(ranks)[:MAX_ROWS] if parameters is None else list(parameters)
    style.check_shown(shown, ranks, "parameter", "plot_calibration")
    figure, panels = style.grid(3 * len(shown), panel_height=1.7, header=0.3)
    for row, label in enumerate(shown):
        left, middle, right = panels[3 * row : 3 * row + 3]
        ecdf_panel(left, ranks[label])
        histogram_panel(middle, ranks[label])
        estimate_panel(right, ranks[label])
        left.set_title(_title_with_p(ranks[label]), loc="left")
        left.set_ylabel(BELOW, fontsize=8)
        middle.set_ylabel("density", fontsize=8)
        right.set_ylabel("posterior mean", fontsize=8)
    for axes, label in zip(panels[-3:], (*2 * ("rank of the truth",), "truth"), strict=True):
        axes.set_xlabel(label, fontsize=8)
    return figure


@style.styled
def ecdf_differences(
    ranks: Sequence[Ranks], others: Mapping[str, Mapping[str, Ranks]], method: str
) -> Figure:
    """Plot the empirical distribution of ranks minus the uniform one."""
    colors = style.in_turn(others, METHOD_COLORS)

    def panel(axes: Axes, each: Ranks) -> None:
        same = [(by_label[each.label], colors[name]) for name, by_label in others.items()]
        ecdf_panel(axes, each, same, several=bool(others))
        axes.set_title(_title_with_p(each), loc="left")

    figure = _panels(ranks, panel, (RANK, BELOW), 1.85, header=0.6 if others else 0.3)
    _name_methods(figure, method, colors)
    return figure


@style.styled
def rank_histograms(ranks: Sequence[Ranks]) -> Figure:
    """Plot histograms of the ranks."""
    return _panels(ranks, histogram_panel, (RANK, "density"), 1.5)


@style.styled
def interval_coverage(
    ranks: Sequence[Ranks], others: Mapping[str, Mapping[str, Ranks]], method: str
) -> Figure:
    """Plot the coverage of 50, 80 and 95% intervals, with a line for each parameter."""
    colors = style.in_turn(others, METHOD_COLORS)
    height = (0.3 + 0.12 * len(others)) * len(ranks) + 1.0
    figure = style.NotebookFigure(figsize=(8.2, height), layout="constrained")
    axes = figure.add_subplot()
    least = 0.4
    for level in INTERVALS:
        axes.axvline(level / 100.0, color=GRAY, lw=0.9, ls="--", zorder=1)
    steps = 0.22 * (np.arange(len(others) + 1) - len(others) / 2.0)
    for at, each in enumerate(ranks):
        own = BLUE if each.passes or others else VERMILLION
        rows = [(each.row, own)]
        rows += [(by_label[each.label].row, colors[name]) for name, by_label in others.items()]
        for step, (row, color) in zip(steps, rows, strict=True):
            for level in INTERVALS:
                held, low, high = (row[f"held_{level}{end}"] for end in ("", "_low", "_high"))
                axes.plot([low, high], [at + step] * 2, color=color, lw=1.4, zorder=2)
                axes.plot([held], [at + step], "o", color=color, ms=3.6, mew=0, zorder=3)
                least = min(least, low)
    axes.set(xlim=(least - 0.02, 1.01), ylim=(len(ranks) - 0.4, -0.6))
    axes.set_yticks(range(len(ranks)), [style.wrap(each.title, 30) for each in ranks])
    ticks = [each / 100.0 for each in (*range(0, 50, 10), *INTERVALS) if each / 100.0 > least]
    axes.set_xticks(ticks, [f"{tick:.0%}" for tick in ticks])
    axes.set_xlabel("share of all fits whose interval holds the truth", fontsize=9)
    _name_methods(figure, method, colors)
    return figure


@style.styled
def estimates(ranks: Sequence[Ranks]) -> Figure:
    """Plot posterior means with 80% intervals against the truth."""
    figure = _panels(ranks, estimate_panel, ("truth", "mean and 80% interval"), 2.3)
    style.add_legend(figure, columns=4 if figure.get_figwidth() > 6.0 else 2)
    return figure


def _panels(
    ranks: Sequence[Ranks],
    draw: Callable[[Axes, Ranks], None],
    labels: tuple[str, str],
    height: float,
    header: float = 0.3,
) -> Figure:
    """Return a figure with one panel per parameter, all of one size."""
    width = {1: 4.4, 2: 6.3}.get(len(ranks), 8.2)
    figure, panels = style.grid(len(ranks), width=width, panel_height=height, header=header)
    for axes, each in zip(panels, ranks, strict=True):
        style.set_panel_title(axes, each.title)
        draw(axes, each)
    figure.supxlabel(labels[0])
    figure.supylabel(labels[1])
    return figure


def _title_with_p(ranks: Ranks) -> str:
    return f"{style.wrap(ranks.title, 30)}\np = {or_dash(ranks.row['p_value'], '.2g')}"


def _name_methods(figure: Figure, method: str, colors: Mapping[str, str]) -> None:
    named = {method: BLUE, **colors} if colors else {}
    style.add_legend(figure, 4 if figure.get_figwidth() > 6.0 else 2, named)
