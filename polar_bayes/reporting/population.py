"""Shrinkage: what each member of a population says alone, and what it says among the others."""

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from polar_bayes.diagnostics.parameters import truth_of
from polar_bayes.diagnostics.population import (
    Population,
    population_summary,
    populations,
    shrinkage,
)
from polar_bayes.errors import FitError
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    ORANGE,
    PURPLE,
    Drawing,
    lighten,
    paper,
    place_of,
    plain,
    quiet_ticks,
    styled,
    title_of,
)

MOST_MEMBERS = 60
ROW, LOW_ROW = 0.24, 0.17
APART = 0.17
"""Alone above, pooled below the middle of a row, unit of rows."""
REACH = 1.2
"""How far the axis follows estimates alone, in widths of what is pooled."""
WIDE = 15.0
"""From this ratio of largest to smallest value on, a positive parameter has a log axis."""


@styled
def plot_shrinkage(
    result: xr.DataTree,
    label: str,
    summary: pd.DataFrame | None = None,
    members: pd.DataFrame | None = None,
) -> Figure:
    """Every member of one population: alone (hollow), pooled (filled), and the population.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        label: Of the population, such as `refractive_index` or `refractive_index[450]`.
        summary: That of `population_summary`, where it is there already.
        members: That of `shrinkage`, where it is there already.

    Returns:
        The figure: members sorted by their pooled mean, at most 60, taken evenly.

    Raises:
        FitError: The result has no such population, or its draws are not finite.
    """
    summary = population_summary(result) if summary is None else summary
    members = shrinkage(result) if members is None else members
    found = {each.label: each for each in populations(result)}
    if label not in found or label not in summary.index:
        raise FitError(
            f"{label!r} is no pooled parameter",
            where="plot_shrinkage: label",
            mend=f"choose one of {', '.join(summary.index) or 'none'}",
        )
    population, whole = found[label], summary.loc[label]
    rows = members.loc[[scalar.label for scalar in population.members]].reset_index(drop=True)
    if not np.isfinite(rows["mean"]).all():
        raise FitError(
            "its draws are not finite on the population's scale",
            where=f"plot_shrinkage: {label}",
            mend="see the verdict",
        )
    rows["true"] = [truth_of(result, scalar) for scalar in population.members]
    rows["name"] = _names(population)
    rows = rows.sort_values("mean", kind="stable", ignore_index=True)
    count = len(rows)
    rows = rows.iloc[np.unique(np.linspace(0, count - 1, min(count, MOST_MEMBERS)).astype(int))]
    return _draw(result, population, whole, rows.reset_index(drop=True), count)


def _names(population: Population) -> list[str]:
    """What tells the members apart; the population's own place stands in the title."""
    return [
        plain(", ".join(_short(d, x) for d, x in s.labels.items() if d not in shared), 24)
        for shared in [population.location.labels]
        for s in population.members
    ]


def _short(dim: str, label: str) -> str:
    """`patch 3`, but the name alone where a material has one."""
    return place_of(dim, label) if label.isdigit() else label


def _draw(
    result: xr.DataTree, population: Population, whole: pd.Series, rows: pd.DataFrame, count: int
) -> Figure:
    height = ROW if len(rows) <= 30 else LOW_ROW
    figure = Drawing(figsize=(7.0, max(height * len(rows), 0.7) + 1.5), layout="constrained")
    axes = figure.subplots()
    axes.set_xlim(_limits(axes, population, whole, rows))
    axes.axvspan(whole["new_q2.5"], whole["new_q97.5"], color=lighten(GRAY, 0.85), lw=0)
    axes.axvspan(whole["location_q2.5"], whole["location_q97.5"], color=lighten(GRAY, 0.6), lw=0)
    axes.axvline(whole["location"], color=GRAY, lw=0.9)
    is_dense = len(rows) > 30
    for at, row in rows.iterrows():
        _draw_member(axes, float(at), row, small=is_dense)
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_yticks(range(len(rows)), list(rows["name"]))
    axes.spines["left"].set_visible(False)
    posterior = result["posterior"].to_dataset()
    first = population.members[0]
    places = [place_of(dim, text) for dim, text in population.location.labels.items()]
    words = title_of(first, posterior).partition(", ")[0]
    part = f" ({len(rows)} of {count}, evenly from low to high)" if count > len(rows) else ""
    axes.set_xlabel(", ".join([words, *map(plain, places)]) + part)
    quiet_ticks(axes)
    axes.tick_params(axis="y", length=0, labelsize=6.0 if is_dense else 7.5)
    figure.legend(handles=_legend(rows), loc="outside upper left", ncols=2, frameon=False)
    return figure


def _limits(
    axes: Axes, population: Population, whole: pd.Series, rows: pd.DataFrame
) -> tuple[float, float]:
    """All that is pooled, the truth, and estimates alone that are not too far away."""
    pooled = np.concatenate(
        [rows[["q2.5", "q97.5"]].to_numpy().ravel(), whole[["new_q2.5", "new_q97.5"]]]
    ).astype(float)
    is_log = (
        population.scale == "log" and pooled.min() > 0 and np.ptp(np.log(pooled)) > np.log(WIDE)
    )
    if is_log:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    forward, back = (np.log, np.exp) if is_log else (np.asarray, np.asarray)
    pooled = forward(pooled)
    width = np.ptp(pooled) or 1.0
    # Nothing is below zero on a log axis: what alone reaches there stays outside.
    with np.errstate(all="ignore"):
        others = forward(rows[["true", "alone", "alone_q2.5", "alone_q97.5"]].to_numpy())
    others = others[np.isfinite(others)]
    low = max(min(pooled.min(), others.min(initial=np.inf)), pooled.min() - REACH * width)
    high = min(max(pooled.max(), others.max(initial=-np.inf)), pooled.max() + REACH * width)
    margin = 0.03 * (high - low) or 1.0
    low, high = (float(value) for value in back(np.array([low - margin, high + margin])))
    return low, high


def _draw_member(axes: Axes, at: float, row: pd.Series, *, small: bool) -> None:
    size = 3.6 if small else 5.0
    low, high = axes.get_xlim()
    faint = lighten(PURPLE, 0.25)
    if np.isfinite(row["alone"]):
        seen = float(np.clip(row["alone"], low, high))
        outside = {True: "o", row["alone"] < low: "<", row["alone"] > high: ">"}[True]
        axes.plot([seen, row["mean"]], [at + APART, at - APART], color=GRAY, lw=0.7, zorder=2)
        axes.plot(
            [row["alone_q2.5"], row["alone_q97.5"]], [at + APART] * 2, color=faint, lw=0.9, zorder=2
        )
        style: dict[str, Any] = {"mfc": paper(), "mec": PURPLE, "mew": 1.1, "clip_on": False}
        axes.plot([seen], [at + APART], outside, ms=size, zorder=4, **style)
    else:
        axes.plot([low, high], [at + APART] * 2, color=faint, lw=0.9, ls=(0, (1, 3)), zorder=2)
    axes.plot([row["q2.5"], row["q97.5"]], [at - APART] * 2, color=BLUE, lw=1.8, zorder=3)
    axes.plot([row["mean"]], [at - APART], "o", color=BLUE, ms=size, mew=0, zorder=5)
    if np.isfinite(row["true"]):
        axes.plot(
            [row["true"]],
            [at - APART],
            "d",
            mfc=ORANGE,
            mec=paper(),
            mew=0.6,
            ms=size + 1.2,
            zorder=6,
        )


def _legend(rows: pd.DataFrame) -> list[Line2D | Patch]:
    hollow: dict[str, Any] = {"mfc": paper(), "mec": PURPLE, "mew": 1.1, "ms": 5}
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=BLUE, lw=1.8, marker="o", ms=5, label="pooled: mean and 95%"),
    ]
    if np.isfinite(rows["alone"]).any():
        color = lighten(PURPLE, 0.25)
        label = "alone, without the population: about, 95%"
        handles.append(Line2D([], [], color=color, lw=0.9, marker="o", label=label, **hollow))
    if not np.isfinite(rows["alone"]).all():
        label = "alone it says nothing"
        handles.append(Line2D([], [], color=PURPLE, lw=0.9, ls=(0, (1, 3)), label=label))
    handles += [
        Patch(color=lighten(GRAY, 0.6), label="location of the population, 95%"),
        Patch(color=lighten(GRAY, 0.85), label="a new member, 95%"),
    ]
    if np.isfinite(rows["true"]).any():
        handles.append(
            Line2D([], [], ls="", marker="d", mfc=ORANGE, mec=paper(), ms=6.5, label="true value")
        )
    return handles
