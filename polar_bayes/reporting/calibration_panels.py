"""Panels of a calibration: one parameter each, drawn from the saved tree alone."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import pandas as pd
import xarray as xr
from arviz_plots import PlotCollection, plot_dist, plot_ecdf_pit
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from polar_bayes.calibration.bands import EcdfBand, ecdf_band, histogram_band
from polar_bayes.calibration.joint import limit_of
from polar_bayes.calibration.verdict import calibration_scalars, calibration_table
from polar_bayes.diagnostics.coverage import INTERVALS
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    ORANGE,
    VERMILLION,
    ink,
    lighten,
    title_of,
    wrapped,
)

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
    level = limit_of(table)
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
