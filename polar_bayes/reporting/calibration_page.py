"""Report of a calibration: ranks, coverage, estimates, and status of its fits."""

import enum
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from polar_bayes.calibration.scores import significance_level
from polar_bayes.calibration.verdict import (
    CALIBRATION,
    PASSES,
    CalibrationView,
    calibration_readings,
    calibration_verdict,
    calibration_view,
    compare_calibrations,
    comparison_sentences,
    holds_readings,
    parameter_deviation,
    reading_deviation,
    reading_ranks,
)
from polar_bayes.diagnostics.coverage import INTERVALS
from polar_bayes.diagnostics.view import Provenance
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.inference.result import provenance_of
from polar_bayes.numerics.psis import MAX_PARETO_K
from polar_bayes.priors import short_numbers
from polar_bayes.reporting import page, text
from polar_bayes.reporting import plots_calibration as figures
from polar_bayes.reporting.maps import STATUS_MEANINGS, count_table, flag_meanings
from polar_bayes.reporting.plots_calibration import MAX_INTERVALS, Ranks
from polar_bayes.reporting.style import MAX_PANELS, QUANTITIES
from polar_bayes.reporting.text import DASH, column, number
from polar_bayes.repr_html import Table

MAX_OTHERS = 4


def calibration_page(
    calibration: xr.DataTree | CalibrationView, comparisons: Mapping[str, xr.DataTree] | None = None
) -> page.Page:
    """Return the page of a calibration, compared with others of the same layout."""
    view = calibration_view(calibration)
    tree, table = view.tree, view.table
    provenance = provenance_of(tree)
    method = one_line(str(provenance.get("method", "this calibration")))
    others = _others(comparisons or {}, method)
    ranks = figures.parameter_ranks(view)
    titles = {label: each.title for label, each in ranks.items()}
    readings = calibration_readings(view) if holds_readings(tree) else None
    headline, passed = text.calibration_headline(table, readings)
    first, *problems = text.verdict_after_headline(view)
    introduction = page.caption("calibration.introduction")
    comparison: list[page.Block] = []
    if others:
        compared = compare_calibrations({method: view, **others})
        comparison = [*comparison_sentences(compared), comparison_table(compared, titles)]
    shown = list(ranks.values())
    other_ranks = {name: figures.parameter_ranks(each) for name, each in others.items()}
    colors = f" Band and dots are those of {method}; the others are drawn over it."
    ecdf, coverage = (
        functools.partial(draw, others=other_ranks, method=method)
        for draw in (figures.ecdf_differences, figures.interval_coverage)
    )
    rank_figures = [
        *_paged(shown, ecdf, "ecdf", colors=colors if others else ""),
        *_paged(shown, figures.rank_histograms, "histograms"),
    ]
    estimates = _paged(shown, figures.estimates, "estimates", max_intervals=MAX_INTERVALS)
    simulations = next(iter(ranks.values())).pit.size
    elsewhere = " What it is compared with stays where it is." if others else ""
    fits: list[page.Block] = [*_fit_tables(tree, ranks), page.facts(_fit_facts(tree))]
    sections = [
        page.Section("parameters", "Parameters", [introduction, rank_table(table, ranks)]),
        page.Section("comparison", "Comparison with other methods", comparison),
        page.Section("ranks", "Ranks of the truth", rank_figures),
        page.Section("coverage", "Coverage of the intervals", _paged(shown, coverage, "coverage")),
        page.Section("estimates", "Estimates against the truth", estimates),
        page.Section("readings", "Readings", _readings(tree, readings, method)),
        page.Section("fits", "Status of the fits", fits),
        page.Section("provenance", "Provenance", _provenance_facts(provenance)),
    ]
    return page.Page(
        kind="Calibration report",
        name=text.capture_name(provenance),
        subtitles=[f"{simulations:,} simulations. {text.made_by(provenance, method)}"],
        headline=headline,
        passed=passed,
        problems=problems,
        sentences=[
            first,
            *text.wrong_on_purpose(provenance),
            *text.interval_sentences(table, titles),
        ],
        sections=sections,
        footer="Computed from calibration.nc, which lies in the same folder and holds every rank, "
        f"truth and interval.{elsewhere}",
    )


def calibration_card(calibration: xr.DataTree | CalibrationView) -> page.Card:
    """Return the card of a calibration."""
    view = calibration_view(calibration)
    _, passed = text.calibration_headline(view.table, None)
    table = rank_table(view.table, figures.parameter_ranks(view))
    return calibration_verdict(view), table, passed


def _others(given: Mapping[str, xr.DataTree], method: str) -> dict[str, CalibrationView]:
    """Return the other calibrations of a page, with names on one line."""
    where = "report: comparisons"
    others = {one_line(str(name)): each for name, each in given.items()}
    for name, each in others.items():
        if not CALIBRATION.describes(each):
            hint = "give what polar_bayes.calibrate returns"
            raise FitError("it is no calibration", where=f"{where}, {name}", hint=hint)
        if name == method:
            what = "the calibration itself is called so"
            raise FitError(what, where=f"{where}, {name}", hint="give it another name")
    if len(others) > MAX_OTHERS:
        what = f"{len(others)} calibrations are too many for one figure"
        raise FitError(what, where=where, hint=f"give at most {MAX_OTHERS}")
    return {name: calibration_view(each) for name, each in others.items()}


# --- Figures --------------------------------------------------------------------------------------


def _paged(
    ranks: Sequence[Ranks], draw: Callable[[Sequence[Ranks]], Figure], name: str, **values: Any
) -> Iterator[str]:
    """Yield figures of a few panels; the first caption explains them all."""
    for at in range(0, len(ranks), MAX_PANELS):
        some = ranks[at : at + MAX_PANELS]
        labels = text.join([each.label for each in some])
        key = f"calibration.figure_{name}"
        instead = f"The same of {labels}." if at else ""
        yield page.picture(draw(some), key, instead=instead, labels=labels, **values)


# --- Tables of parameters -------------------------------------------------------------------------


def _score_cells() -> page.Cells:
    """Return columns of coverage, ranks, width and score."""

    def held(level: int) -> Callable[[pd.Series], str]:
        def cell(row: pd.Series) -> str:
            share, low, high = (row[f"held_{level}{end}"] for end in ("", "_low", "_high"))
            return f"{share:.1%} ({100 * low:.1f}{DASH}{100 * high:.1f})"

        return cell

    return {
        **{f"{level}% hold": held(level) for level in INTERVALS},
        "mean rank": column("rank_mean", ".3f"),
        "spread": column("spread", ".3f"),
        "width": column("width_95", ".3g"),
        "score": column("crps", ".3g"),
    }


def rank_table(table: pd.DataFrame, ranks: Mapping[str, Ranks]) -> Table:
    """Return a table of parameters: uniformity of ranks, coverage, width and score."""
    level = significance_level(table)
    simulations = next(iter(ranks.values())).pit.size

    cells: page.Cells = {
        "p": text.p_value(level),
        "the tests": lambda row: parameter_deviation(row, level) or PASSES,
        "failed": lambda row: f"{int(row['failed']):,} of {simulations:,}",
        **_score_cells(),
    }
    titles = {label: each.title for label, each in ranks.items()}
    return page.make_table(
        *("calibration.parameter", cells, table.loc[list(ranks)]),
        descriptions=titles,
        prose=["the tests"],
        level=level,
    )


def comparison_table(compared: pd.DataFrame, titles: Mapping[str, str]) -> Table:
    """Return a table of every parameter by every method."""
    method_of_scores = compared.index.get_level_values("method")[0]
    first = one_line(str(method_of_scores))
    level = significance_level(compared.xs(method_of_scores, level="method"))
    cells: page.Cells = {
        "method": page.second_label,
        "p": text.p_value(level),
        "the tests": lambda row: row["deviation"],
        "failed": lambda row: f"{int(row['failed']):,}",
        f"score against {first}": _score_change,
        **_score_cells(),
    }
    return page.make_table(
        *("calibration.comparison", cells, compared),
        descriptions=titles,
        prose=["the tests"],
        first=first,
    )


def _score_change(row: pd.Series) -> str:
    change, error = 100.0 * row["score_change"], 100.0 * row["score_change_error"]
    if not math.isfinite(change) or error == 0.0:
        return DASH
    sign = "+" if change > 0.0 else ""
    return f"{sign}{number(change, error)}% ± {number(error, error)}"


# --- Readings and fits ----------------------------------------------------------------------------


def _readings(
    calibration: xr.DataTree, readings: pd.DataFrame | None, method: str
) -> list[page.Block]:
    if readings is None or readings.empty:
        return []
    level, pit = significance_level(readings), reading_ranks(calibration)
    titles = {
        str(label): f"{QUANTITIES.get(row['reading'], row['reading'])}, {row['test']}"
        for label, row in readings.iterrows()
    }
    ranks = [
        Ranks(str(label), titles[str(label)], pit[label], row, level)
        for label, row in readings.iterrows()
    ]
    pictures = _paged(ranks, lambda some: figures.ecdf_differences(some, {}, method), "readings")
    cells: page.Cells = {
        "p": text.p_value(level),
        "the ranks": lambda row: "uniform" if row["p_value"] >= level else reading_deviation(row),
        "failed": lambda row: f"{int(row['failed']):,} of {int(row['answered'] + row['failed']):,}",
        "mean rank": column("rank_mean", ".3f"),
        "spread": column("rank_spread", ".3f"),
        "untrusted": column("untrusted", ",.0f"),
    }
    table = page.make_table(
        *("calibration.reading", cells, readings),
        label="reading",
        descriptions=titles,
        prose=["the ranks"],
        level=level,
        largest_trusted=MAX_PARETO_K,
    )
    note = "Readings are judged by themselves; the verdict above is that of the parameters."
    return [note, table, *pictures]


def _fit_tables(calibration: xr.DataTree, ranks: Mapping[str, Ranks]) -> Iterator[Table]:
    """Return numbers of fits by status and by method."""
    fits = calibration["fits"].to_dataset()
    answered = np.all([np.isfinite(each.pit) for each in ranks.values()], axis=0)
    tables: dict[str, tuple[type[enum.IntEnum], Mapping[str, str]]] = {
        "status": (Status, STATUS_MEANINGS),
        "method": (MethodUsed, text.METHODS_USED),
    }
    for name, (known, meanings) in tables.items():
        if name not in fits:
            continue
        names = " ".join(each.name.lower() for each in known)
        flags = fits[name].assign_attrs({"flag_meanings": names} | fits[name].attrs)
        known_flags = flag_meanings(flags)
        found = pd.DataFrame({"fits": 1, "with ranks": answered.astype(int)}, flags.to_numpy())
        counts = found.groupby(level=0).sum().reindex(list(known_flags)).dropna().astype(int)
        yield count_table(f"calibration.{name}", counts.rename(known_flags), meanings)


def _fit_facts(calibration: xr.DataTree) -> dict[str, str]:
    """Return effective sample sizes and diagnostics of the fits."""
    fits = calibration["fits"].to_dataset()
    facts = {}
    if "ess" in fits:
        draws = fits["ess"].to_numpy()
        draws = draws[np.isfinite(draws)]
        if draws.size:
            low, middle = np.quantile(draws, [0.05, 0.5])
            facts["effective sample size: 5% of the fits have less than"] = f"{low:.0f}"
            facts["effective sample size: median"] = f"{middle:.0f}"
    if "pareto_k" in fits:
        k = fits["pareto_k"].dropna("simulation").to_numpy()
        above = int(np.sum(k > MAX_PARETO_K))
        share = f"{above:,} of {k.size:,} fits that know it ({text.count_percent(above, k.size)})"
        facts |= {f"Pareto k above {MAX_PARETO_K:g}": share} if k.size else {}
    return facts


def _provenance_facts(provenance: Provenance) -> Iterator[str]:
    """Return the provenance of the calibration in titled groups of names and values."""
    titles = {
        "truth": "What captures were simulated by, where it differs from what is fitted",
        "priors": "Priors",
        "links": "Likelihood links",
        "capture": "Capture, of which only the layout is used",
        "versions": "Versions",
        "timings": "Seconds, compilation included",
    }
    groups = {
        title: provenance[key]
        for key, title in titles.items()
        if isinstance(provenance.get(key), Mapping)
    }
    own = {
        "simulations" if key == "calibration" else key.replace("_", " "): value
        for key, value in provenance.items()
        if titles.get(key) not in groups
    }
    priors = groups.get(titles["priors"], {})
    groups |= {titles["priors"]: {n: short_numbers(str(x)) for n, x in priors.items()}}
    for title, values in {"Calibration": own, **groups}.items():
        yield page.facts(values, title)


REPORT = page.Report(
    calibration_page,
    calibration_card,
    figures.plot_calibration,
    ("comparisons",),
    "calibration.nc",
)
