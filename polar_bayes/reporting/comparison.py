"""Report of several fits of one capture: predictive accuracy and differences of intervals."""

import operator
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from polar_bayes.diagnostics.compare import FitComparison, compare_fits
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.view import Provenance
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting import page, style, text
from polar_bayes.reporting.fit_page import fit_card
from polar_bayes.reporting.style import BLUE, GRAY, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from polar_bayes.reporting.text import DASH, column, digits, ends, or_dash, share
from polar_bayes.repr_html import Row, Table
from polar_bayes.scenes.sentences import CLEAR

COLORS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, GRAY)


@style.styled
def plot_comparison(comparison: FitComparison) -> Figure:
    """Plot means and 95% intervals of each parameter by every fit that has it.

    Args:
        comparison: Of `polar_bayes.diagnostics.compare_fits`.

    Returns:
        The figure, a panel for each of the first 12 parameters. Point fits have twice their
        standard error in place of an interval, drawn dashed.

    Raises:
        FitError: No parameter has a finite mean.
    """
    table, fits = comparison.parameters, list(comparison.verdicts)
    finite = table[np.isfinite(table["mean"])]
    labels = list(dict.fromkeys(finite.index.get_level_values("parameter")))[: style.MAX_PANELS]
    if not labels:
        raise FitError(
            "there is nothing to draw", where="plot_comparison", hint="give fits with finite draws"
        )
    colors = style.in_turn(fits, COLORS)
    figure, panels = style.grid(len(labels), panel_height=0.55 + 0.2 * len(fits), header=0.4)
    for axes, label in zip(panels, labels, strict=True):
        for name, row in finite.xs(label, level="parameter").iterrows():
            at, color = -fits.index(str(name)), colors[str(name)]
            ends = [row["q2.5"], row["q97.5"]]
            line: str | tuple[int, tuple[int, int]] = "-"
            if not np.isfinite(ends).all():  # a point fit
                ends = [row["mean"] - 2.0 * row["sd"], row["mean"] + 2.0 * row["sd"]]
                line = (0, (2, 1))
            axes.plot(ends, [at, at], color=color, lw=2.0, ls=line, solid_capstyle="butt")
            axes.plot([row["mean"]], [at], "o", color=color, ms=4.5)
        axes.set(ylim=(0.6 - len(fits), 0.4), yticks=[])
        axes.spines["left"].set_visible(False)
        axes.locator_params(axis="x", nbins=5)
        style.set_panel_title(axes, style.label_text(label.replace("_", " ")))
    style.add_legend(figure, 4, colors)
    return figure


def comparison_page(fits: Mapping[str, xr.DataTree]) -> page.Page:
    """Return the page of a comparison."""
    named = {one_line(str(name)): fit for name, fit in fits.items()}
    comparison = compare_fits(named)
    provenances = {name: provenance_of(fit) for name, fit in named.items()}
    verdicts = comparison.verdicts
    failed = {name: verdict for name, verdict in verdicts.items() if not verdict.passed}
    left_out = [f"{name}: {why}." if name else why for name, why in comparison.left_out.items()]
    loo = None if comparison.loo.empty else loo_table(comparison)
    predictions = [loo, page.block("bullets", sentences=left_out)]
    more = comparison.parameters.index.get_level_values("parameter").nunique() - style.MAX_PANELS
    note = f" {more} more parameters are in the table only." if more > 0 else ""
    figure = page.picture(plot_comparison(comparison), "comparison.figure_parameters", more=note)
    prior = [sensitivity_table(comparison)]
    sections = [
        page.Section("predictions", "Predictions", predictions),
        page.Section("parameters", "Parameters", [figure, parameter_table(comparison)]),
        page.Section("prior", "Prior and data", prior, "Prior and data"),
        page.Section("settings", "What differs", [settings_table(provenances)]),
    ]
    names = (text.capture_name(each, "") for each in provenances.values())
    return page.Page(
        kind="Comparison of fits",
        name=next(filter(None, names), "capture"),
        subtitles=[f"{len(named)} fits of one capture: {text.join(list(named))}."],
        headline=text.comparison_headline(comparison),
        passed=not failed,
        problems=[f"{name}: {each}" for name in failed for each in failed[name].problems],
        sentences=text.comparison_of_fits_sentences(comparison),
        cautions=[f"{name}: {each}" for name in verdicts for each in verdicts[name].cautions],
        sections=sections,
        footer="Computed from the results of the fits, which stay where they are.",
    )


def loo_table(comparison: FitComparison) -> Table:
    """Return a table of expected log densities, best first."""
    cells: page.Cells = {
        "elpd": text.elpd("se"),
        "difference": text.elpd_difference,
        "p": column("p", ".1f"),
        "weight": column("weight", ".2f"),
        "k > 0.7": column("unreliable", ".0f"),
    }
    return page.make_table("comparison.loo", cells, comparison.loo, label="fit", clear=CLEAR)


def parameter_table(comparison: FitComparison) -> Table:
    """Return a table of every parameter by every fit."""
    cells: page.Cells = {
        "fit": page.second_label,
        "mean": digits("mean"),
        "sd": digits("sd"),
        "95% interval": ends(scale=operator.itemgetter("sd")),
        "R-hat": column("r_hat", ".3f"),
        "ESS": lambda row: or_dash(np.floor(row["ess_bulk"]), ".0f"),
    }
    return page.make_table("comparison.parameter", cells, comparison.parameters, prose=["fit"])


def sensitivity_table(comparison: FitComparison) -> Table | None:
    """Return a table of prior sensitivity in each fit; None if no fit has draws."""
    known = comparison.parameters.dropna(subset=["prior_sensitivity"])
    if known.empty:
        return None
    cells: page.Cells = {
        "fit": page.second_label,
        "prior inside": share("prior_inside"),
        "by the data": lambda row: str(row["verdict"]),
        **text.SENSITIVITY_CELLS,
    }
    prose = ["fit", "remark"]
    return page.make_table(
        "comparison.sensitivity", cells, known, prose=prose, sensitive=LIMITS.sensitive
    )


def settings_table(provenances: Mapping[str, Provenance]) -> Table:
    """Return a table of the settings in which the fits differ."""
    settings = [_settings(each) for each in provenances.values()]
    rows = []
    for key in dict.fromkeys(key for each in settings for key in each):
        cells = tuple(each.get(key, DASH) for each in settings)
        if len(set(cells)) > 1:
            rows.append(Row(key, cells))
    caption = "Only what differs between the fits." if rows else "The fits were asked for the same."
    names: Sequence[str] = list(provenances)
    data = pd.DataFrame([row.cells for row in rows], [row.label for row in rows], names)
    return Table(("asked for", *names), tuple(rows), names, "settings", caption, data)


def _settings(provenance: Provenance) -> dict[str, str]:
    found = {}
    for key in (
        *("method", "settings", "model", "model_settings", "scene", "scene_parts", "links"),
        *("priors", "fixed", "largest_view_zenith", "seed", "precision"),
    ):
        value = provenance.get(key)
        for part, each in (value if isinstance(value, Mapping) else {"": value}).items():
            if each is not None:
                found[one_line(f"{key.replace('_', ' ')} {part}".strip())] = one_line(str(each))
    return found


REPORT = page.Report(comparison_page, fit_card, lambda fits: plot_comparison(compare_fits(fits)))
