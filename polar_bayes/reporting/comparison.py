"""Fits of one capture in a picture: the same parameter by each of them."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from polar_bayes.diagnostics.compare import FitComparison, compare_fits
from polar_bayes.diagnostics.sensitivity import SENSITIVE
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting.page import fill, picture
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    grid,
    plain,
    quiet_ticks,
    styled,
    wrapped,
)
from polar_bayes.reporting.tables import Row, Table, fact_rows
from polar_bayes.reporting.text import DASH, interval, numbers, or_dash, percent, spoken

COLORS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, GRAY)
MOST_PANELS = 12


@styled
def plot_comparison(comparison: FitComparison) -> Figure:
    """Means and 95% intervals of each parameter by every fit that has it.

    Args:
        comparison: Of `polar_bayes.diagnostics.compare_fits`.

    Returns:
        The figure, a panel for each of the first 12 parameters. Point fits have twice their
        standard error in place of an interval, drawn dashed.

    Raises:
        FitError: No parameter has a finite mean.
    """
    table = comparison.parameters
    fits = list(comparison.verdicts)
    finite = table[np.isfinite(table["mean"])]
    labels = list(dict.fromkeys(finite.index.get_level_values("parameter")))[:MOST_PANELS]
    if not labels:
        raise FitError(
            "there is nothing to draw", where="plot_comparison", hint="give fits with finite draws"
        )
    colors = {name: COLORS[at % len(COLORS)] for at, name in enumerate(fits)}
    height = 0.55 + 0.2 * len(fits)
    figure, panels = grid(len(labels), columns=3, width=8.2, panel_height=height, header=0.4)
    for axes, label in zip(panels, labels, strict=True):
        own = finite.xs(label, level="parameter")
        for name, row in own.iterrows():
            at = -fits.index(str(name))
            ends = [row["q2.5"], row["q97.5"]]
            is_point = not np.isfinite(ends).all()
            if is_point:
                ends = [row["mean"] - 2.0 * row["sd"], row["mean"] + 2.0 * row["sd"]]
            color, line = colors[str(name)], (0, (2, 1)) if is_point else "-"
            axes.plot(ends, [at, at], color=color, lw=2.0, ls=line, solid_capstyle="butt")
            axes.plot([row["mean"]], [at], "o", color=color, ms=4.5)
        axes.set(ylim=(0.6 - len(fits), 0.4), yticks=[])
        axes.spines["left"].set_visible(False)
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(wrapped(plain(label.replace("_", " ")), 38), loc="left")
    quiet_ticks(panels)
    handles = [
        Line2D([], [], color=color, marker="o", ms=4.5, lw=2.0, label=plain(name, 24))
        for name, color in colors.items()
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=4, frameon=False)
    return figure


# --- The report of several fits of one capture: which predicts better, and where they disagree ----


CLEAR = 4.0
"""Differences of the expected log density below it say little (Sivula et al. 2020), unit nat."""

MOST_NAMED = 6


def render_comparison(fits: Mapping[str, xr.DataTree]) -> str:
    """The page of a comparison as text."""
    named = {one_line(str(name)): fit for name, fit in fits.items()}
    comparison = compare_fits(named)
    told = {name: provenance_of(fit) for name, fit in named.items()}
    failed = [name for name, verdict in comparison.verdicts.items() if not verdict.converged]
    labels = comparison.parameters.index.get_level_values("parameter").unique()
    more = len(labels) - MOST_PANELS
    content: dict[str, Any] = {
        "kind": "Comparison of fits",
        "name": _capture(told),
        "under": [f"{len(named)} fits of one capture: {spoken(list(named))}."],
        "headline": headline(comparison),
        "is_good": not failed,
        "problems": [
            f"{name}: {problem}"
            for name in failed
            for problem in comparison.verdicts[name].problems
        ],
        "said": comparison_of_fits_sentences(comparison),
        "cautions": [
            f"{name}: {caution}"
            for name, verdict in comparison.verdicts.items()
            for caution in verdict.cautions
        ],
        "loo": None if comparison.loo.empty else loo_table(comparison),
        "left_out": _left_out(comparison),
        "picture": picture(
            plot_comparison(comparison),
            "Means and 95% intervals of each parameter by every fit",
            "Dots are posterior means, bars 95% intervals; dashed bars are twice the standard "
            "error of a point fit. Bars that do not overlap disagree by more than their "
            "uncertainty allows; a much shorter bar claims more knowledge, which the fit's own "
            "report should justify."
            + (f" {more} more parameters are in the table only." if more > 0 else ""),
        ),
        "parameters": parameter_table(comparison),
        "sensitivity": sensitivity_table(comparison),
        "settings": settings_table(told),
        "groups": [
            (name, fact_rows({k: each[k] for k in ("swapped", "scene_parts") if k in each}))
            for name, each in told.items()
        ],
    }
    return fill("comparison.html.j2", content)


def headline(comparison: FitComparison) -> str:
    """Which fit predicts best, or that this cannot be told."""
    table = comparison.loo
    failed = [name for name, verdict in comparison.verdicts.items() if not verdict.converged]
    if failed:
        return f"Do not use the numbers of {spoken(failed)}: read why first."
    if len(table) < 2:
        return "Predictions are not compared; parameters are."
    if not _is_clear(table.iloc[1]):
        return "The readings do not tell which of these fits predicts best."
    return f"{table.index[0]} predicts the readings best."


def _is_clear(row: pd.Series) -> bool:
    """Whether a fit predicts worse than the best beyond doubt."""
    return bool(-row["elpd_diff"] >= max(CLEAR, 2.0 * row["dse"]))


def comparison_of_fits_sentences(comparison: FitComparison) -> list[str]:
    """What the fits say about the readings, and on which parameters they disagree.

    Args:
        comparison: Of `polar_bayes.diagnostics.compare_fits`.

    Returns:
        Sentences.

    Raises:
        Nothing.
    """
    said, alike = [], []
    for name, row in list(comparison.loo.iterrows())[1:]:
        if not _is_clear(row):
            alike.append(str(name))
            continue
        difference, error = numbers([-row["elpd_diff"], row["dse"]], max(row["dse"], 0.2))
        said.append(
            f"{name} predicts left-out readings worse than {comparison.loo.index[0]}: their "
            f"log density is lower by {difference} ± {error} in all."
        )
    if alike:
        said.append(f"{spoken(alike)} predicts them about as well as {comparison.loo.index[0]}.")
    bad = comparison.loo.get("unreliable", pd.Series(dtype=float))
    if (bad > 0).any():
        counts = [f"{int(count)} of {name}" for name, count in bad.items() if count]
        said.append(
            f"Pareto k is above 0.7 for {spoken(counts)}: leaving out these readings cannot be "
            "imitated, so differences may be off."
        )
    return [*said, *_disagreements(comparison.parameters)]


def _disagreements(table: pd.DataFrame) -> list[str]:
    """Pairs of intervals that do not overlap, and how widths differ."""
    apart = []
    shared = 0
    for label, own in table.groupby(level="parameter", sort=False):
        known = own.droplevel("parameter").dropna(subset=["q2.5", "q97.5"])
        shared += len(known) > 1
        pairs = itertools.combinations(known.iterrows(), 2)
        for (one, a), (other, b) in pairs:
            if a["q97.5"] < b["q2.5"] or b["q97.5"] < a["q2.5"]:
                apart.append(f"{label} ({one} and {other})")
    if apart:
        return [
            f"Their 95% intervals do not overlap for {_few(apart)}: at least one of the fits "
            "leaves out something that matters."
        ]
    if not shared:
        return []
    return [f"The 95% intervals of all {shared} parameters that two fits share overlap."]


def _left_out(comparison: FitComparison) -> list[str]:
    return [f"{name}: {why}." if name else why for name, why in comparison.left_out.items()]


def _capture(told: Mapping[str, Mapping[str, Any]]) -> str:
    names = [(each.get("capture") or {}).get("name") for each in told.values()]
    return one_line(str(next(filter(None, names), "capture")))


def loo_table(comparison: FitComparison) -> Table:
    """Expected log densities, best first."""
    rows = []
    for name, row in comparison.loo.iterrows():
        scale = max(float(row["dse"]), 0.2)
        difference = (
            DASH
            if row["dse"] == 0.0
            else " ± ".join(numbers([row["elpd_diff"], row["dse"]], scale))
        )
        cells = (
            f"{row['elpd']:.1f} ± {or_dash(row['se'], '{:.1f}')}",
            difference,
            f"{row['p']:.1f}",
            f"{row['weight']:.2f}",
            f"{int(row['unreliable'])}",
        )
        rows.append(Row(str(name), str(name), cells))
    caption = (
        "elpd: log density of each reading given all others, summed over all variables (nat); "
        "higher is better. Difference: to the best, with its standard error; below "
        f"{CLEAR:g}, or below two standard errors, it says little. p: effective number of "
        "parameters. Weight: share in the mixture of fits that would predict best (stacking). "
        "k > 0.7: readings for which this cannot be trusted."
    )
    heads = ("fit", "elpd", "difference", "p", "weight", "k > 0.7")
    return Table(caption, heads, tuple(rows), comparison.loo)


def parameter_table(comparison: FitComparison) -> Table:
    """Every parameter by every fit."""
    rows = []
    for (label, name), row in comparison.parameters.iterrows():
        cells = [str(name), *numbers([row["mean"], row["sd"]], row["sd"])]
        cells += [interval(row["q2.5"], row["q97.5"], row["sd"])]
        cells += [or_dash(row["r_hat"], "{:.3f}"), or_dash(np.floor(row["ess_bulk"]), "{:.0f}")]
        rows.append(Row(str(label), str(label), tuple(cells)))
    heads = ("parameter", "fit", "mean", "sd", "95% interval", "R-hat", "ESS")
    caption = "Posterior mean, standard deviation and equal-tailed 95% interval by each fit."
    return Table(caption, heads, tuple(rows), comparison.parameters)


def sensitivity_table(comparison: FitComparison) -> Table | None:
    """What the priors did in each fit; None where no fit has draws."""
    known = comparison.parameters.dropna(subset=["prior_sensitivity"])
    if known.empty:
        return None
    rows = []
    for (label, name), row in known.iterrows():
        cells = [str(name), percent(row["prior_inside"]), str(row["verdict"])]
        cells += [or_dash(row[f"{part}_sensitivity"], "{:.3f}") for part in ("prior", "likelihood")]
        rows.append(Row(str(label), str(label), (*cells, str(row["remark"]))))
    heads = ("parameter", "fit", "prior inside", "by the data", "to the priors", "to the data")
    caption = (
        "Prior inside: the prior's probability of the 95% interval, 95% if the data said nothing. "
        "To the priors, to the data: how fast the posterior moves when all priors, or all data, "
        f"count a little more; from {SENSITIVE} on it matters."
    )
    return Table(caption, (*heads, "remark"), tuple(rows), known)


def settings_table(told: Mapping[str, Mapping[str, Any]]) -> Table:
    """What the fits were asked for, where it is not the same for all."""
    flat = {name: _flat(each) for name, each in told.items()}
    keys = list(dict.fromkeys(key for each in flat.values() for key in each))
    rows = []
    for key in keys:
        cells = tuple(each.get(key, DASH) for each in flat.values())
        if len(set(cells)) > 1:
            rows.append(Row(key, key, cells))
    caption = "Only what differs between the fits." if rows else "The fits were asked for the same."
    return Table(caption, ("asked for", *flat), tuple(rows))


def _flat(provenance: Mapping[str, Any]) -> dict[str, str]:
    keys: tuple[str, ...] = (
        "method",
        "settings",
        "model",
        "model_settings",
        "scene",
        "scene_parts",
        "links",
    )
    keys += ("priors", "fixed", "largest_view_zenith", "seed", "precision")
    found = {}
    for key in keys:
        value = provenance.get(key)
        parts = value if isinstance(value, Mapping) else {"": value}
        for part, each in parts.items():
            if each is not None:
                found[one_line(f"{key.replace('_', ' ')} {part}".strip())] = one_line(str(each))
    return found


def _few(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return spoken([*names[:MOST_NAMED], *([f"{more} more"] if more > 0 else [])])
