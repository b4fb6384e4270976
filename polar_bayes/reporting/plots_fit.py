"""Figures of a fit: each is drawn from the saved tree alone.

`plot_readings` (its own file) shows the data; here are the parameters and the checks. In a notebook
a figure is the last line of a cell; `figure.savefig("name.pdf")` writes it.
"""

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from polar_bayes.diagnostics.parameters import (
    Scalar,
    is_hyperparameter,
    posterior_scalars,
    scalars,
    stats_of,
    truth_of,
)
from polar_bayes.diagnostics.population import (
    Population,
    population_summary,
    populations,
    shrinkage,
)
from polar_bayes.diagnostics.predictive import PredictiveCheck, pit_band, predictive_checks
from polar_bayes.errors import FitError
from polar_bayes.reporting.style import (
    BLUE,
    CHAIN_COLORS,
    GRAY,
    ORANGE,
    PURPLE,
    QUANTITIES,
    VERMILLION,
    Drawing,
    grid,
    ink,
    lighten,
    paper,
    place_of,
    plain,
    quiet_ticks,
    styled,
    title_of,
    wrapped,
)

MOST_PAIRED = 8
MOST_PANELS = 12
MOST_POINTS = 800
RANK_BINS = 20
MINUS = "\N{MINUS SIGN}"


def drawable(result: xr.DataTree, *, material: bool = False) -> list[Scalar]:
    """The parameters that figures show: single numbers that are finite and move."""
    found = [
        scalar
        for scalar in posterior_scalars(result)
        if np.isfinite(scalar.draws).all()
        and np.ptp(scalar.draws) > 0.0
        and (scalar.is_material or not material)
        and not any(dim.startswith(f"{scalar.name}_") for dim in scalar.index)
    ]
    return sorted(found, key=_first_material_first)


def _first_material_first(scalar: Scalar) -> tuple[bool, list[int]]:
    """Figures have room for a few: all parameters of one material, then those of the next."""
    places = [at for dim, at in scalar.index.items() if dim != "wavelength"]
    return not scalar.is_material, places


@styled
def plot_pairs(result: xr.DataTree) -> Figure:
    """Joint draws of the material parameters (the first material, at most 8), and correlations.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        The figure: draws below the diagonal, correlations above it. Diverging draws are marked.

    Raises:
        FitError: Fewer than two material parameters have draws.
    """
    found = drawable(result, material=True)
    found = [s for s in found if _first_material_first(s) == _first_material_first(found[0])]
    found = found[:MOST_PAIRED]
    if len(found) < 2:
        raise _nothing("plot_pairs", "two material parameters with draws")
    posterior = result["posterior"].to_dataset()
    labels = [_narrow(title_of(scalar, posterior)) for scalar in found]
    size = len(found)
    figure, panels = _square(size, lines=max(label.count("\n") for label in labels) + 1)
    draws = np.stack([scalar.draws.ravel() for scalar in found])
    shown = np.linspace(0, draws.shape[1] - 1, min(MOST_POINTS, draws.shape[1])).astype(int)
    diverging = _diverging(result)
    correlation = np.corrcoef(draws)
    limits = [_range(values) for values in draws]
    truths = [truth_of(result, scalar) for scalar in found]
    for row in range(size):
        for column in range(size):
            axes = panels[row, column]
            axes.set_xlim(limits[column])
            if row == column:
                _histogram(axes, draws[row], limits[row], truths[row])
            elif row > column:
                axes.set_ylim(limits[row])
                _scatter(axes, draws[[column, row]], shown, diverging)
                _cross(axes, truths[column], truths[row])
            else:
                _correlation(axes, correlation[row, column])
            _pair_ticks(axes, row, column, size)
        panels[-1, row].set_xlabel(labels[row], fontsize=8)
        if row:
            panels[row, 0].set_ylabel(labels[row], fontsize=8)
    panels[0, 0].set_ylabel("share of draws", fontsize=8)
    figure.align_labels()
    return figure


@styled
def plot_ranks(result: xr.DataTree) -> Figure:
    """How each chain's draws rank among all draws: flat and overlapping lines are good.

    Args:
        result: A tree with at least two chains.

    Returns:
        The figure, a panel for each parameter (the 12 of largest R-hat, if there are more).

    Raises:
        FitError: There is one chain only, or no parameter moves.
    """
    found = drawable(result)
    if not found or found[0].draws.shape[0] < 2:
        raise _nothing("plot_ranks", "two chains")
    r_hat = array_stats.rhat(np.stack([scalar.draws for scalar in found]))
    worst = np.sort(np.argsort(-r_hat, kind="stable")[:MOST_PANELS])
    found = [found[i] for i in worst]
    posterior = result["posterior"].to_dataset()
    figure, panels = grid(len(found), columns=3, width=8.2, panel_height=1.35, header=0.5)
    chains, length = found[0].draws.shape
    edges = np.linspace(0.0, 1.0, RANK_BINS + 1)
    for axes, scalar in zip(panels, found, strict=True):
        order = np.argsort(np.argsort(scalar.draws.ravel(), kind="stable")) / scalar.draws.size
        for chain, own in enumerate(order.reshape(chains, length)):
            share = np.histogram(own, edges)[0] * RANK_BINS / length
            color = CHAIN_COLORS[chain % len(CHAIN_COLORS)]
            axes.stairs(share, edges, color=color, lw=1.1, baseline=None)
        axes.axhline(1.0, color=GRAY, lw=0.8, ls="--")
        axes.set(xlim=(0, 1), ylim=(0, max(2.0, axes.get_ylim()[1])), xticks=[0, 0.5, 1])
        axes.set_title(wrapped(title_of(scalar, posterior), 38), loc="left")
    quiet_ticks(panels)
    figure.supxlabel("rank among the draws of all chains (0 lowest, 1 highest)", fontsize=9)
    figure.supylabel("density", fontsize=9)
    handles = [
        Line2D([], [], color=color, label=f"chain {i + 1}")
        for i, color in enumerate(CHAIN_COLORS[:chains])
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=6, frameon=False)
    return figure


@styled
def plot_prior_posterior(result: xr.DataTree) -> Figure:
    """Prior against posterior: what the data added.

    Args:
        result: A tree with draws of the prior.

    Returns:
        The figure, a panel for each parameter (at most 12, at most 6 of them of populations and
        processes). Each curve is scaled to the same
        height; the bar below is the posterior's 95% interval.

    Raises:
        FitError: The tree holds no prior, or no parameter moves.
    """
    found, before = drawable(result), {}
    if "prior" in result.children:
        before = {s.label: s.draws for s in scalars(result["prior"].to_dataset())}
    found = [scalar for scalar in found if scalar.label in before]
    if not found:
        raise _nothing("plot_prior_posterior", "draws of the prior")
    posterior = result["posterior"].to_dataset()
    # Populations and processes, which concern all members, before the first members.
    names = set(map(str, posterior.data_vars))
    common = [s for s in found if is_hyperparameter(s.name, names)][: MOST_PANELS // 2]
    own = [s for s in found if not is_hyperparameter(s.name, names)]
    found = [*common, *own][:MOST_PANELS]
    figure, panels = grid(len(found), columns=3, width=8.2, panel_height=1.5, header=0.5)
    any_truth = False
    for axes, scalar in zip(panels, found, strict=True):
        prior, draws = before[scalar.label].ravel(), scalar.draws.ravel()
        limits = _range(np.concatenate([np.quantile(prior, [0.01, 0.99]), draws]))
        _hill(axes, prior, limits, GRAY, 0.72)
        _hill(axes, draws, limits, BLUE, 0.45)
        low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975])
        axes.plot([low, high], [-0.09, -0.09], color=BLUE, lw=3, solid_capstyle="butt")
        axes.plot([middle], [-0.09], "|", color=ink(), ms=8)
        true = truth_of(result, scalar)
        if np.isfinite(true):
            any_truth = True
            axes.axvline(true, color=ORANGE, lw=1.6, ls="--")
        axes.set(xlim=limits, ylim=(-0.18, 1.08), yticks=[])
        axes.spines["left"].set_visible(False)
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(wrapped(title_of(scalar, posterior), 38), loc="left")
    quiet_ticks(panels)
    handles: list[Patch | Line2D] = [
        Patch(color=lighten(GRAY, 0.72), label="prior"),
        Patch(color=lighten(BLUE, 0.45), label="posterior"),
        Line2D([], [], color=BLUE, lw=3, label="posterior median and 95% interval"),
    ]
    if any_truth:
        handles.append(Line2D([], [], color=ORANGE, ls="--", label="true value"))
    figure.legend(handles=handles, loc="outside upper left", ncols=4, frameon=False)
    return figure


@styled
def plot_pit(result: xr.DataTree, checks: dict[str, PredictiveCheck] | None = None) -> Figure:
    """PIT and leave-one-out PIT of every variable: distance from the uniform distribution.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        checks: Those of `predictive_checks(result)`, where they are there already.

    Returns:
        The figure: a row for each variable, bands that hold the whole curve with 95%.

    Raises:
        FitError: No variable has two readings and enough draws.
    """
    checks = predictive_checks(result) if checks is None else checks
    rows = [check for check in checks.values() if check.pit.size >= 2]
    if not rows:
        raise _nothing("plot_pit", "two readings and 100 draws")
    figure = Drawing(figsize=(8.2, 2.1 * len(rows) + 0.5), layout="constrained")
    panels = figure.subplots(len(rows), 2, sharex=True, sharey="row", squeeze=False)
    for row, check in enumerate(rows):
        parts = {"PIT": check.pit, "leave-one-out PIT": check.loo.pit if check.loo else None}
        for axes, (kind, values) in zip(panels[row], parts.items(), strict=True):
            _pit_panel(axes, values)
            axes.set_title(f"{QUANTITIES.get(check.name, check.name)}: {kind}", loc="left")
        panels[row, 0].set_ylabel("share below, minus uniform")
    quiet_ticks(list(panels.flat))
    figure.supxlabel("PIT: share of the prediction below the reading", fontsize=9)
    return figure


def _square(size: int, *, lines: int) -> tuple[Figure, np.ndarray]:
    """Panels for pairs, placed by hand: a layout engine takes seconds for this many axes."""
    side = max(5.6, min(1.35 * size + 0.9, 9.6))
    margin = 0.42 + 0.16 * lines
    figure = Drawing(figsize=(side, side))
    place = {"left": (margin + 0.25) / side, "bottom": margin / side, "right": 0.985, "top": 0.99}
    panels = figure.subplots(
        size, size, squeeze=False, gridspec_kw={**place, "hspace": 0.12, "wspace": 0.12}
    )
    return figure, panels


def _pit_panel(axes: Axes, values: np.ndarray | None) -> None:
    band = pit_band(values) if values is not None else None
    if band is None:
        axes.text(0.5, 0.5, "not available", ha="center", transform=axes.transAxes, color=GRAY)
        return
    color = VERMILLION if band.rejects_uniformity else BLUE
    axes.fill_between(band.at, band.lower, band.upper, color=lighten(GRAY, 0.75), lw=0, step="mid")
    axes.axhline(0.0, color=GRAY, lw=0.8)
    axes.step(band.at, band.difference, where="mid", color=color, lw=1.4)
    axes.set_xlim(0, 1)


def _diverging(result: xr.DataTree) -> np.ndarray:
    stats = stats_of(result)
    if "diverging" not in stats:
        return np.empty(0, int)
    return np.flatnonzero(stats["diverging"].to_numpy().ravel())


def _range(values: np.ndarray) -> tuple[float, float]:
    low, high = float(np.min(values)), float(np.max(values))
    margin = 0.04 * (high - low) or 1.0
    return low - margin, high + margin


def _histogram(
    axes: Axes, values: np.ndarray, limits: tuple[float, float], true: float = np.nan
) -> None:
    counts, edges = np.histogram(values, 30, range=limits)
    axes.stairs(counts, edges, fill=True, color=lighten(BLUE, 0.45))
    axes.set_ylim(0, 1.08 * counts.max())
    if np.isfinite(true):
        axes.axvline(true, color=ORANGE, lw=1.4, ls="--")


def _hill(
    axes: Axes, values: np.ndarray, limits: tuple[float, float], color: str, share: float
) -> None:
    """A histogram over its own range, scaled to height 1."""
    inside = values[(values >= limits[0]) & (values <= limits[1])]
    counts, edges = np.histogram(inside, 16 if inside.size < 1000 else 30)
    axes.stairs(counts / counts.max(), edges, fill=True, color=lighten(color, share))
    axes.stairs(counts / counts.max(), edges, color=color, lw=0.8)


def _scatter(axes: Axes, xy: np.ndarray, shown: np.ndarray, diverging: np.ndarray) -> None:
    axes.plot(*xy[:, shown], "o", color=BLUE, ms=1.6, mew=0, alpha=0.4, rasterized=True)
    if diverging.size:
        axes.plot(*xy[:, diverging], "x", color=VERMILLION, ms=4, mew=1.2, rasterized=True)


def _cross(axes: Axes, x: float, y: float) -> None:
    style: dict[str, Any] = {"color": ORANGE, "lw": 1.2, "ls": "--", "zorder": 3}
    if np.isfinite(x):
        axes.axvline(x, **style)
    if np.isfinite(y):
        axes.axhline(y, **style)


def _correlation(axes: Axes, value: float) -> None:
    axes.axis("off")
    strength = min(abs(value), 1.0)
    axes.text(
        0.5,
        0.5,
        "0.00" if abs(value) < 0.005 else f"{value:+.2f}".replace("-", MINUS),
        ha="center",
        va="center",
        transform=axes.transAxes,
        fontsize=8.0 + 3.0 * strength,
        color=ink() if strength > 0.3 else GRAY,
    )


def _pair_ticks(axes: Axes, row: int, column: int, size: int) -> None:
    axes.locator_params(nbins=3)
    axes.tick_params(labelsize=7, length=2, color=GRAY)
    axes.tick_params(axis="x", labelbottom=row == size - 1, labelrotation=45)
    axes.tick_params(axis="y", labelleft=column == 0 and row > 0)
    if row == column:
        axes.set_yticks([])


def _narrow(text: str) -> str:
    """Break a label at its commas, and long parts at a space, for narrow panels."""
    return "\n".join(wrapped(part, 19) for part in text.split(", "))


def _nothing(what: str, needed: str) -> FitError:
    return FitError("there is nothing to draw", where=what, hint=f"give a result that has {needed}")


# --- Shrinkage: what each member of a population says alone, and what it says among the others ----


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
            hint=f"choose one of {', '.join(summary.index) or 'none'}",
        )
    population, whole = found[label], summary.loc[label]
    rows = members.loc[[scalar.label for scalar in population.members]].reset_index(drop=True)
    if not np.isfinite(rows["mean"]).all():
        raise FitError(
            "its draws are not finite on the population's scale",
            where=f"plot_shrinkage: {label}",
            hint="see the verdict",
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
        others = forward(rows[["true", "unpooled", "unpooled_q2.5", "unpooled_q97.5"]].to_numpy())
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
    if np.isfinite(row["unpooled"]):
        seen = float(np.clip(row["unpooled"], low, high))
        outside = {True: "o", row["unpooled"] < low: "<", row["unpooled"] > high: ">"}[True]
        axes.plot([seen, row["mean"]], [at + APART, at - APART], color=GRAY, lw=0.7, zorder=2)
        axes.plot(
            [row["unpooled_q2.5"], row["unpooled_q97.5"]],
            [at + APART] * 2,
            color=faint,
            lw=0.9,
            zorder=2,
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
    if np.isfinite(rows["unpooled"]).any():
        color = lighten(PURPLE, 0.25)
        label = "alone, without the population: about, 95%"
        handles.append(Line2D([], [], color=color, lw=0.9, marker="o", label=label, **hollow))
    if not np.isfinite(rows["unpooled"]).all():
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
