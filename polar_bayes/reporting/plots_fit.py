"""Figures of a fit: parameters, checks, and members of populations."""

import itertools

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.ticker import LogLocator

from polar_bayes.diagnostics.parameters import Scalar, is_hyperparameter
from polar_bayes.diagnostics.population import (
    Population,
    population_summary,
    populations,
    shrinkage,
)
from polar_bayes.diagnostics.predictive import pit_band, predictive_checks
from polar_bayes.diagnostics.view import FitView, once, view_of
from polar_bayes.errors import FitError
from polar_bayes.reporting import style
from polar_bayes.reporting.style import (
    BLUE,
    CHAIN_COLORS,
    GRAY,
    MAX_PANELS,
    ORANGE,
    PURPLE,
    QUANTITIES,
    VERMILLION,
    lighten,
    parameter_title,
)


@once
def drawable(fit: FitView, *, material: bool = False) -> list[Scalar]:
    """Return the parameters that figures show: finite scalars that are not constant."""
    found = [
        scalar
        for scalar in fit.scalars
        if np.isfinite(scalar.draws).all()
        and np.ptp(scalar.draws) > 0.0
        and (scalar.is_material or not material)
        and not any(dim.startswith(f"{scalar.name}_") for dim in scalar.index)
    ]
    return sorted(found, key=_first_material_first)


def _first_material_first(scalar: Scalar) -> tuple[bool, list[int]]:
    """Sort parameters by material, since figures show only the first few."""
    places = [at for dim, at in scalar.index.items() if dim != "wavelength"]
    return not scalar.is_material, places


@style.styled
def plot_pairs(result: xr.DataTree | FitView) -> Figure:
    """Plot joint draws and correlations of up to 8 parameters of the first material.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        The figure: draws below the diagonal, correlations above it. Diverging draws are marked.

    Raises:
        FitError: Fewer than two material parameters have draws.
    """
    fit = view_of(result)
    found = drawable(fit, material=True)
    found = [s for s in found if _first_material_first(s) == _first_material_first(found[0])]
    found = found[:8]
    if len(found) < 2:
        raise _nothing_to_draw("plot_pairs", "two material parameters with draws")
    titles = [parameter_title(scalar, fit.posterior).split(", ") for scalar in found]
    labels = ["\n".join(style.wrap(part, 19) for part in title) for title in titles]
    size = len(found)
    lines = max(label.count("\n") for label in labels) + 1
    # Placed by hand: a layout engine takes seconds for this many axes.
    side, margin = max(5.6, min(1.35 * size + 0.9, 9.6)), 0.42 + 0.16 * lines
    figure = style.NotebookFigure(figsize=(side, side))
    places = figure.add_gridspec(
        *(size, size), left=(margin + 0.25) / side, bottom=margin / side, right=0.985, top=0.99,
        hspace=0.12, wspace=0.12,
    )  # fmt: skip
    draws = np.stack([scalar.draws.ravel() for scalar in found])
    shown = np.linspace(0, draws.shape[1] - 1, min(800, draws.shape[1])).astype(int)
    diverging = np.flatnonzero(np.asarray(fit.stats.get("diverging", np.empty(0))))
    correlation = np.corrcoef(draws)
    limits = [style.padded_range(values, 0.04) for values in draws]
    truths = [fit.truth(scalar) for scalar in found]
    for row, column in itertools.combinations(range(size), 2):
        _write_correlation(figure, places[row, column], correlation[row, column])
    for row, column in ((at, other) for at in range(size) for other in range(at + 1)):
        axes = figure.add_subplot(places[row, column])
        axes.set_xlim(limits[column])
        if row == column:
            counts, edges = np.histogram(draws[row], 30, range=limits[row])
            axes.stairs(counts, edges, fill=True, color=lighten(BLUE, 0.45))
            axes.set_ylim(0, 1.08 * counts.max())
            _draw_truth(axes, truths[row], np.nan)
        else:
            axes.set_ylim(limits[row])
            xy = draws[[column, row]]
            axes.plot(*xy[:, shown], "o", color=BLUE, ms=1.6, mew=0, alpha=0.4, rasterized=True)
            if diverging.size:
                cross: style.Look = {"color": VERMILLION, "ms": 4, "mew": 1.2}
                axes.plot(*xy[:, diverging], "x", rasterized=True, **cross)
            _draw_truth(axes, truths[column], truths[row])
        _pair_ticks(axes, row, column, size)
        if row == size - 1:
            axes.set_xlabel(labels[column], fontsize=8)
        if column == 0:
            axes.set_ylabel(labels[row] if row else "share of draws", fontsize=8)
    figure.align_labels()
    return figure


@style.styled
def plot_ranks(result: xr.DataTree | FitView) -> Figure:
    """Plot ranks of each chain's draws among all draws: flat, overlapping lines are good.

    Args:
        result: A tree with at least two chains.

    Returns:
        The figure, a panel for each parameter (the 12 of largest R-hat, if there are more).

    Raises:
        FitError: There is one chain only, or no parameter moves.
    """
    fit = view_of(result)
    found = drawable(fit)
    if not found or found[0].draws.shape[0] < 2:
        raise _nothing_to_draw("plot_ranks", "two chains")
    r_hat = array_stats.rhat(np.stack([scalar.draws for scalar in found]))
    worst = np.sort(np.argsort(-r_hat, kind="stable")[:MAX_PANELS])
    found = [found[i] for i in worst]
    figure, panels = style.grid(len(found), panel_height=1.35, header=0.5)
    chains, length = found[0].draws.shape
    edges = np.linspace(0.0, 1.0, 21)
    for axes, scalar in zip(panels, found, strict=True):
        order = np.argsort(np.argsort(scalar.draws.ravel(), kind="stable")) / scalar.draws.size
        for chain, own in enumerate(order.reshape(chains, length)):
            share = np.histogram(own, edges)[0] * (len(edges) - 1) / length
            color = CHAIN_COLORS[chain % len(CHAIN_COLORS)]
            label = f"chain {chain + 1}" if chain < len(CHAIN_COLORS) else ""
            axes.stairs(share, edges, color=color, lw=1.1, baseline=None, label=label)
        axes.axhline(1.0, color=GRAY, lw=0.8, ls="--")
        axes.set(xlim=(0, 1), ylim=(0, max(2.0, axes.get_ylim()[1])), xticks=[0, 0.5, 1])
        style.set_panel_title(axes, parameter_title(scalar, fit.posterior))
    figure.supxlabel("rank among the draws of all chains (0 lowest, 1 highest)")
    figure.supylabel("density")
    style.add_legend(figure, columns=6)
    return figure


@style.styled
def plot_prior_posterior(result: xr.DataTree | FitView) -> Figure:
    """Plot prior against posterior: the information in the data.

    Args:
        result: A tree with draws of the prior.

    Returns:
        The figure, a panel for each parameter (at most 12, at most 6 of them of populations and
        processes). Each curve is scaled to the same
        height; the bar below is the posterior's 95% interval.

    Raises:
        FitError: The tree holds no prior, or no parameter moves.
    """
    fit = view_of(result)
    shown = drawable(fit)
    limits = {
        scalar.label: style.padded_range(
            np.concatenate([np.quantile(x, [0.01, 0.99]), scalar.draws.ravel()]), 0.04
        )
        for scalar in shown
        if scalar.label in fit.prior and np.isfinite(x := fit.prior[scalar.label].draws).all()
    }
    found = [each for each in shown if np.isfinite(limits.get(each.label, np.nan)).all()]
    if not found:
        raise _nothing_to_draw("plot_prior_posterior", "draws of the prior")
    # Populations and processes, which concern all members, before the first members.
    names = set(map(str, fit.posterior.data_vars))
    common = [s for s in found if is_hyperparameter(s.name, names)][: MAX_PANELS // 2]
    own = [s for s in found if not is_hyperparameter(s.name, names)]
    found = [*common, *own][:MAX_PANELS]
    figure, panels = style.grid(len(found), panel_height=1.5, header=0.5)
    for axes, scalar in zip(panels, found, strict=True):
        draws, ends = scalar.draws.ravel(), limits[scalar.label]
        _scaled_histogram(axes, fit.prior[scalar.label].draws, ends, GRAY, 0.72, "prior")
        _scaled_histogram(axes, draws, ends, BLUE, 0.45, "posterior")
        low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975])
        bar: style.Look = {"color": BLUE, "lw": 3, "solid_capstyle": "butt"}
        bar["label"] = "posterior median and 95% interval"
        axes.plot([low, high], [-0.09, -0.09], **bar)
        axes.plot([middle], [-0.09], "|", color=style.text_color(), ms=8)
        true = fit.truth(scalar)
        if np.isfinite(true):
            axes.axvline(true, color=ORANGE, lw=1.6, ls="--", label="true value")
        axes.set(xlim=ends, ylim=(-0.18, 1.08), yticks=[])
        axes.spines["left"].set_visible(False)
        axes.locator_params(axis="x", nbins=5)
        style.set_panel_title(axes, parameter_title(scalar, fit.posterior))
    style.add_legend(figure, columns=4)
    return figure


@style.styled
def plot_pit(result: xr.DataTree | FitView) -> Figure:
    """Plot PIT and leave-one-out PIT of every variable minus the uniform distribution.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        The figure: a row for each variable, bands that hold the whole curve with 95%.

    Raises:
        FitError: No variable has two readings and enough draws.
    """
    rows = [check for check in predictive_checks(result).values() if check.pit.size >= 2]
    if not rows:
        raise _nothing_to_draw("plot_pit", "two readings and 100 draws")
    figure = style.NotebookFigure(figsize=(8.2, 2.1 * len(rows) + 0.5), layout="constrained")
    panels = figure.subplots(len(rows), 2, sharex=True, sharey="row", squeeze=False)
    for row, check in enumerate(rows):
        parts = {"PIT": check.pit, "leave-one-out PIT": check.loo.pit if check.loo else None}
        for axes, (kind, values) in zip(panels[row], parts.items(), strict=True):
            _pit_panel(axes, values)
            axes.set_title(f"{QUANTITIES.get(check.name, check.name)}: {kind}", loc="left")
        panels[row, 0].set_ylabel("share below, minus uniform")
    figure.supxlabel("PIT: share of the prediction below the reading")
    return figure


def _pit_panel(axes: Axes, values: np.ndarray | None) -> None:
    band = pit_band(values) if values is not None else None
    if band is None:
        style.write_in_panel(axes, "not available")
        return
    axes.fill_between(band.at, band.lower, band.upper, color=lighten(GRAY, 0.75), lw=0, step="mid")
    axes.axhline(0.0, color=GRAY, lw=0.8)
    axes.step(band.at, band.difference, where="mid", color=BLUE, lw=1.4)
    axes.set_xlim(0, 1)


def _scaled_histogram(
    axes: Axes,
    values: np.ndarray,
    limits: tuple[float, float],
    color: str,
    share: float,
    label: str,
) -> None:
    """Return a histogram over its own range, scaled to height 1."""
    inside = values[(values >= limits[0]) & (values <= limits[1])]
    bins = 16 if inside.size < 1000 else 30
    largest = np.abs(inside).max(initial=0.0)
    counts, edges = np.array([inside.size]), np.array(limits)
    if inside.size and np.ptp(inside) > 4.0 * bins * np.spacing(largest):  # numbers between them
        counts, edges = np.histogram(inside, bins)
    heights = counts / max(counts.max(), 1)  # nothing may be inside
    axes.stairs(heights, edges, fill=True, color=lighten(color, share), label=label)
    axes.stairs(heights, edges, color=color, lw=0.8)


def _draw_truth(axes: Axes, x: float, y: float) -> None:
    line: style.Look = {"color": ORANGE, "lw": 1.2, "ls": "--", "zorder": 3}
    if np.isfinite(x):
        axes.axvline(x, **line)
    if np.isfinite(y):
        axes.axhline(y, **line)


def _write_correlation(figure: Figure, place: SubplotSpec, value: float) -> None:
    strength, box = min(abs(value), 1.0), place.get_position(figure)
    text = "0.00" if abs(value) < 0.005 else f"{value:+.2f}".replace("-", "\N{MINUS SIGN}")
    color = style.text_color() if strength > 0.3 else GRAY
    at = (box.x0 + box.x1) / 2.0, (box.y0 + box.y1) / 2.0
    figure.text(*at, text, ha="center", va="center", fontsize=8.0 + 3.0 * strength, color=color)


def _pair_ticks(axes: Axes, row: int, column: int, size: int) -> None:
    axes.locator_params(nbins=3)
    axes.tick_params(labelsize=7, length=2, color=GRAY)
    axes.tick_params(axis="x", labelbottom=row == size - 1, labelrotation=45)
    axes.tick_params(axis="y", labelleft=column == 0 and row > 0)
    if row == column:
        axes.set_yticks([])


def _nothing_to_draw(what: str, needed: str) -> FitError:
    return FitError("there is nothing to draw", where=what, hint=f"give a result that has {needed}")


# --- Shrinkage: members of a population without and with pooling ----------------------------------

MAX_MEMBERS = 60


@style.styled
def plot_shrinkage(result: xr.DataTree | FitView, label: str) -> Figure:
    """Plot members of a population alone (hollow) and pooled (filled), and the population.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        label: Of the population, such as `refractive_index` or `refractive_index[450]`.

    Returns:
        The figure: members sorted by their pooled mean, at most 60, taken evenly.

    Raises:
        FitError: The result has no such population, or its draws are not finite.
    """
    fit = view_of(result)
    summary, members = population_summary(fit), shrinkage(fit)
    found = {each.label: each for each in populations(fit)}
    if label not in found or label not in summary.index:
        hint = f"choose one of {', '.join(summary.index) or 'none'}"
        what = f"{label!r} is no pooled parameter"
        raise FitError(what, where="plot_shrinkage: label", hint=hint)
    population, whole = found[label], summary.loc[label]
    rows = members.loc[[scalar.label for scalar in population.members]].reset_index(drop=True)
    if not np.isfinite(rows["mean"]).all():
        what = "its draws are not finite on the population's scale"
        raise FitError(what, where=f"plot_shrinkage: {label}", hint="see the verdict")
    rows["true"] = [fit.truth(scalar) for scalar in population.members]
    rows["name"] = [_member_name(scalar, population) for scalar in population.members]
    rows = rows.sort_values("mean", kind="stable", ignore_index=True)
    count = len(rows)
    chosen = np.linspace(0, count - 1, min(count, MAX_MEMBERS)).astype(int)
    rows = rows.iloc[chosen].reset_index(drop=True)
    is_dense = len(rows) > 30
    height = (0.17 if is_dense else 0.24) * len(rows)
    figure = style.NotebookFigure(figsize=(7.0, max(height, 0.7) + 1.5), layout="constrained")
    axes = figure.subplots()
    axes.set_xlim(_shrinkage_limits(axes, population, whole, rows))
    for part, share, label in (
        ("new", 0.85, "a new member, 95%"),
        ("location", 0.6, "location of the population, 95%"),
    ):
        ends = whole[f"{part}_q2.5"], whole[f"{part}_q97.5"]
        axes.axvspan(*ends, color=lighten(GRAY, share), lw=0, label=label)
    axes.axvline(whole["location"], color=GRAY, lw=0.9)
    for at, row in rows.iterrows():
        _draw_member(axes, float(at), row, size=3.6 if is_dense else 5.0)
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_yticks(range(len(rows)), list(rows["name"]))
    axes.spines["left"].set_visible(False)
    names = [style.short_title(population.members[0], fit.posterior)]
    names += map(style.label_text, style.coordinate_labels(population.location))
    part = f" ({len(rows)} of {count}, evenly from low to high)" if count > len(rows) else ""
    axes.set_xlabel(", ".join(names) + part)
    axes.tick_params(axis="y", length=0, labelsize=6.0 if is_dense else 7.5)
    style.add_legend(figure, columns=2)
    return figure


def _member_name(scalar: Scalar, population: Population) -> str:
    """Return what identifies a member, such as `patch 3`; a unique material's name alone."""
    names = [
        style.coordinate_label(dim, label) if label.isdigit() else label
        for dim, label in scalar.labels.items()
        if dim not in population.location.labels
    ]
    return style.label_text(", ".join(names), 24)


def _shrinkage_limits(
    axes: Axes, population: Population, whole: pd.Series, rows: pd.DataFrame
) -> tuple[float, float]:
    """Return limits around pooled values, the truth, and unpooled values not too far off."""
    pooled = np.concatenate(
        [rows[["q2.5", "q97.5"]].to_numpy().ravel(), whole[["new_q2.5", "new_q97.5"]]]
    ).astype(float)
    is_log = bool(
        population.scale == "log" and pooled.min() > 0 and np.ptp(np.log(pooled)) > np.log(15.0)
    )
    if is_log:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        style.plain_numbers(axes.xaxis)
    forward, inverse = (np.log, np.exp) if is_log else (np.asarray, np.asarray)
    pooled = forward(pooled)
    width = np.ptp(pooled) or 1.0
    # A log axis has no values below zero: estimates alone that reach there are drawn at its end.
    with np.errstate(all="ignore"):
        others = forward(rows[["true", "unpooled", "unpooled_q2.5", "unpooled_q97.5"]].to_numpy())
    reach = 1.2 * width
    near = np.clip(others[np.isfinite(others)], pooled.min() - reach, pooled.max() + reach)
    low, high = style.padded_range(np.concatenate([pooled, near]), 0.03)
    return float(inverse(low)), float(inverse(high))


def _draw_member(axes: Axes, at: float, row: pd.Series, *, size: float) -> None:
    low, high = axes.get_xlim()
    above, below = at + 0.17, at - 0.17  # alone and pooled
    faint: style.Look = {"color": lighten(PURPLE, 0.25), "lw": 0.9, "zorder": 2}
    if np.isfinite(row["unpooled"]):
        seen = float(np.clip(row["unpooled"], low, high))
        marker = "<" if row["unpooled"] < low else ">" if row["unpooled"] > high else "o"
        axes.plot([seen, row["mean"]], [above, below], color=GRAY, lw=0.7, zorder=2)
        axes.plot([row["unpooled_q2.5"], row["unpooled_q97.5"]], [above] * 2, **faint)
        hollow: style.Look = {"mfc": style.background(), "mec": PURPLE, "mew": 1.1, "ms": size}
        hollow["label"] = "alone, without the population: about, 95%"
        axes.plot([seen], [above], marker, zorder=4, clip_on=False, **hollow)
    else:
        nothing = {**faint, "ls": (0, (1, 3)), "label": "alone it says nothing"}
        axes.plot([low, high], [above] * 2, **nothing)
    axes.plot([row["q2.5"], row["q97.5"]], [below] * 2, color=BLUE, lw=1.8, zorder=3)
    pooled: style.Look = {"ms": size, "mew": 0, "zorder": 5, "label": "pooled: mean and 95%"}
    axes.plot([row["mean"]], [below], "o", color=BLUE, **pooled)
    if np.isfinite(row["true"]):
        truth = {**style.true_value_style(), "ms": size + 1.2, "mew": 0.6}
        axes.plot([row["true"]], [below], zorder=6, **truth)
