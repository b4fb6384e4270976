"""The report of a calibration: verdict, ranks, coverage, estimates, and what became of the fits."""

import dataclasses
import enum
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from polar_bayes.calibration.files import is_calibration
from polar_bayes.calibration.scores import is_calibrated, significance_level
from polar_bayes.calibration.verdict import (
    calibration_readings,
    calibration_table,
    calibration_verdict,
    compare_calibrations,
    comparison_sentences,
    holds_readings,
    parameter_deviation,
    reading_deviation,
    reading_ranks,
)
from polar_bayes.diagnostics.coverage import INTERVALS
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.batch_result import Approach, Status
from polar_bayes.inference.psis import LARGEST_TRUSTED
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting import plots_calibration as figures
from polar_bayes.reporting.maps import APPROACHES, MOST_NAMED, share
from polar_bayes.reporting.page import Picture, fill, picture
from polar_bayes.reporting.plots_calibration import MOST_SHOWN, Part, Ranked, parts_of
from polar_bayes.reporting.style import QUANTITIES
from polar_bayes.reporting.tables import Row, Table, fact_rows, made_by
from polar_bayes.reporting.text import DASH, numbers, or_dash, spoken

# --- What a calibration says in numbers and sentences: its parameters, its fits, its rivals -------


FEW = 0.95
"""Below this share of fits with an answer, the page warns."""

NUMBERS = (*(f"{percent}% hold" for percent in INTERVALS), "mean rank", "spread", "width", "score")
FAILS = "(fails)"
STATUSES = {
    "good": "an answer that the checks let pass",
    "masked": "no valid reading",
    "too few views": "too few valid views",
    "not converged": "no mode was reached",
    "not trusted": "no check confirms its numbers",
}


def verdict_head(table: pd.DataFrame, readings: pd.DataFrame | None) -> tuple[str, bool]:
    """The verdict in a few words, and whether all is well."""
    passed = is_calibrated(table)
    answered = float((table["answered"] / (table["answered"] + table["failed"])).min())
    said = "Calibrated" if passed else "Not calibrated"
    if passed and readings is not None and not is_calibrated(readings):
        said, passed = "Parameters are calibrated, predicted readings are not", False
    if answered < FEW:
        return (
            f"{said}{', but' if passed else ', and'} {1.0 - answered:.0%} of the fits failed.",
            False,
        )
    return f"{said}.", passed


def verdict_words(said: Sequence[str]) -> list[str]:
    """Sentences of `calibration_verdict` below a headline that says the first words already."""
    first = said[0].partition(": ")[2] or said[0]
    return [f"{first[0].upper()}{first[1:]}", *said[1:]]


def interval_words(table: pd.DataFrame, parts: Mapping[str, Part]) -> list[str]:
    """How often the 95% intervals of parameters that fail hold the truth, and cautions."""
    failing = [part for part in parts.values() if not part.passes]
    said = []
    if failing:
        shares = [
            f"the true {part.title} in {part.row['held_95']:.1%}" for part in failing[:MOST_NAMED]
        ]
        more = len(failing) - MOST_NAMED
        others = f" ({more} more parameters fail)" if more > 0 else ""
        said.append(f"The 95% intervals hold {spoken(shares)} of all fits{others}.")
    failed = int(table["failed"].max())
    if failed:
        every = int((table["answered"] + table["failed"]).max())
        said.append(
            f"{failed:,} of {every:,} fits have no answer. The ranks are those of the others; the "
            "shares of intervals that hold the truth count them as misses."
        )
    return said


def calibration_rows(
    table: pd.DataFrame, parts: Mapping[str, Part], words: Mapping[str, str]
) -> Table:
    """Every parameter: uniform ranks, coverage, width and score."""
    rows = []
    for label, part in parts.items():
        row = table.loc[label]
        cells = [chance(row["p_value"], part.passes), words.get(label, "uniform")]
        cells.append(f"{int(row['failed']):,} of {part.pit.size:,}")
        rows.append(Row(label, part.title, tuple([*cells, *_numbers(row)])))
    heads = ("parameter", "p", "the ranks", "failed", *NUMBERS)
    level = next(iter(parts.values())).level
    caption = (
        f"p: how often uniform ranks stray as far; marked below {level:.2g} (5% shared by all "
        "parameters). Mean rank: above 0.5 the posterior is too low, below too high. Spread, over "
        "that of uniform ranks: above 1 intervals are too narrow, below too wide. Hold: share of "
        "all fits whose central interval holds the truth, failed ones counted as misses, and the "
        "95% range that so many simulations allow. Width of the 95% interval and ranked "
        "probability score: means over the fits, in the unit of the parameter; ranks cannot see a "
        "posterior that ignores the data, these can."
    )
    return Table(caption, heads, tuple(rows), table)


def comparison_rows(compared: pd.DataFrame, parts: Mapping[str, Part]) -> Table:
    """Every parameter by every method."""
    rows = []
    for (label, method), row in compared.iterrows():
        cells = [
            one_line(str(method)),
            chance(row["p_value"], bool(row["passes"])),
            row["deviation"],
        ]
        cells += [f"{int(row['failed']):,}", _change(row), *_numbers(row)]
        rows.append(Row(label, parts[label].title, tuple(cells)))
    first = one_line(str(compared.index.get_level_values("method")[0]))
    heads = ("parameter", "method", "p", "the ranks", "failed", f"score against {first}")
    caption = (
        f"The same by each method. Score against {first}: mean ranked score over that of {first}, "
        "fit by fit where both have an answer, minus one; below zero is better, the number after ± "
        "is its standard error; a dash where the simulations are not the same."
    )
    return Table(caption, (*heads, *NUMBERS), tuple(rows), compared)


def fit_tables(calibration: xr.DataTree, parts: Mapping[str, Part]) -> list[tuple[str, Table]]:
    """What became of the fits: by status and by approach."""
    fits = calibration["fits"].to_dataset()
    answered = np.all([np.isfinite(part.pit) for part in parts.values()], axis=0)
    wanted = {
        "status": (Status, STATUSES, "What became of each fit. With ranks: those of which every "
                   "parameter is ranked; the others count as misses in the table of parameters."),
        "approach": (Approach, APPROACHES, "How the numbers of each fit were found."),
    }  # fmt: skip
    found = []
    for name, (known, meanings, caption) in wanted.items():
        if name in fits:
            found.append((name, _flag_table(fits[name], known, meanings, caption, answered)))
    return found


def fit_facts(calibration: xr.DataTree) -> list[Row]:
    """What the fits are worth: effective draws, and how far they can be trusted."""
    fits = calibration["fits"].to_dataset()
    facts: dict[str, Any] = {}
    if "effective_draws" in fits:
        draws = fits["effective_draws"].to_numpy()
        draws = draws[np.isfinite(draws)]
        if draws.size:
            low, middle = np.quantile(draws, [0.05, 0.5])
            facts["effective draws: 5% of the fits have fewer than"] = f"{low:.0f}"
            facts["effective draws: median"] = f"{middle:.0f}"
    if "pareto_k" in fits:
        k = fits["pareto_k"].to_numpy()
        known = k[~np.isnan(k)]
        if known.size:
            above = int(np.sum(known > LARGEST_TRUSTED))
            facts[f"Pareto k above {LARGEST_TRUSTED:g}"] = (
                f"{above:,} of {known.size:,} fits that know it ({share(above, known.size)})"
            )
    return fact_rows(facts)


def calibration_groups(provenance: Mapping[str, Any]) -> list[tuple[str, list[Row]]]:
    """How the calibration was made, in titled groups of name and text."""
    titles = {
        "truth": "What captures were simulated by, where it differs from what is fitted",
        "priors": "Priors",
        "links": "Likelihood links",
        "capture": "Capture, of which only the layout is used",
        "versions": "Versions",
        "timings": "Seconds, compilation included",
    }
    own = {
        "simulations" if key == "calibration" else key.replace("_", " "): value
        for key, value in provenance.items()
        if not isinstance(value, Mapping) or key not in titles
    }
    groups = {"Calibration": fact_rows(own)}
    for key, title in titles.items():
        value = provenance.get(key)
        if isinstance(value, Mapping) and value:
            groups[title] = fact_rows(value)
    return [(title, rows) for title, rows in groups.items() if rows]


def chance(p_value: float, passes: bool) -> str:
    """A p-value, marked where it fails."""
    said = or_dash(p_value, "{:.2g}")
    return said if passes or not math.isfinite(p_value) else f"{said} {FAILS}"


def _flag_table(
    flags: xr.DataArray,
    known: type[enum.IntEnum],
    meanings: Mapping[str, str],
    caption: str,
    answered: np.ndarray,
) -> Table:
    """Counts by the words that the tree itself knows, whatever became of the code since."""
    names = str(flags.attrs.get("flag_meanings", " ".join(each.name for each in known)))
    words = [name.lower().replace("_", " ") for name in names.split()]
    places = np.asarray(flags.attrs.get("flag_values", range(len(words))))
    values = flags.to_numpy()
    rows, behind = [], {}
    for place, word in zip(places, words, strict=True):
        which = values == place
        count = int(which.sum())
        if count:
            behind[word] = [count, count / values.size, int(answered[which].sum())]
            cells = (f"{count:,}", share(count, values.size), f"{int(answered[which].sum()):,}")
            rows.append(Row(word, meanings.get(word, ""), cells))
    heads = ("fits", "share", "with ranks")
    frame = pd.DataFrame.from_dict(behind, orient="index", columns=list(heads))
    return Table(caption, (str(flags.name), *heads), tuple(rows), frame)


def _numbers(row: pd.Series) -> list[str]:
    """Cells below `NUMBERS`."""
    cells = [_held(row, percent) for percent in INTERVALS]
    cells += [or_dash(row[name], "{:.3f}") for name in ("rank_mean", "rank_spread")]
    return cells + [_small(row[name]) for name in ("width_95", "crps")]


def _held(row: pd.Series, percent: int) -> str:
    held, low, high = (row[f"held_{percent}{end}"] for end in ("", "_low", "_high"))
    return f"{held:.1%} ({100 * low:.1f}{DASH}{100 * high:.1f})"


def _small(value: float) -> str:
    return or_dash(value, "{:.3g}")


def _change(row: pd.Series) -> str:
    change, error = row["score_change"], row["score_change_error"]
    if not math.isfinite(change) or error == 0.0:
        return DASH
    said, scatter = numbers([100.0 * change, 100.0 * error], 100.0 * error)
    return f"{'+' if change > 0.0 else ''}{said}% ± {scatter}"


# --- What a calibration says of readings, on its page ---------------------------------------------


CAPTION = (
    "In each simulation one entry of each reading is looked at. Fresh: read once more from the "
    "same truth, and ranked among what the fit predicts. Left out: one that was fitted, ranked "
    "among what the fit of all the others predicts. p: how often uniform ranks stray as far; "
    "marked below {level:.2g} (5% shared by these rows, beside the 5% of the parameters). Mean "
    "rank: above 0.5 predictions are too low, below too high. Spread, over that of uniform ranks: "
    "above 1 predictions are too narrow, below too wide. Untrusted: fits whose weights without "
    "the reading say little (Pareto k above {k:g}); where they are many, the weights stray."
)


@dataclasses.dataclass(frozen=True, eq=False)
class ReadingRanks:
    """What a calibration knows of one reading."""

    label: str
    title: str
    answered: np.ndarray
    row: pd.Series
    passes: bool
    level: float


def ranks_of_readings(calibration: xr.DataTree) -> list[ReadingRanks]:
    """Every row of `calibration_readings` with its ranks."""
    table, ranks = calibration_readings(calibration), reading_ranks(calibration)
    level = significance_level(table)
    return [
        ReadingRanks(
            label=label,
            title=f"{QUANTITIES.get(row['reading'], row['reading'])}, {row['test']}",
            answered=ranks[label][np.isfinite(ranks[label])],
            row=row,
            passes=bool(row["p_value"] >= level),
            level=level,
        )
        for label, row in table.iterrows()
    ]


def reading_rows(parts: list[ReadingRanks]) -> Table:
    """Every reading: uniform ranks, and how far leaving it out can be trusted."""
    rows = []
    for part in parts:
        row = part.row
        words = "uniform" if part.passes else reading_deviation(row)
        every = int(row["answered"] + row["failed"])
        cells = [chance(row["p_value"], part.passes), words, f"{int(row['failed']):,} of {every:,}"]
        cells += [or_dash(row[name], "{:.3f}") for name in ("rank_mean", "rank_spread")]
        cells.append(DASH if np.isnan(row["untrusted"]) else f"{int(row['untrusted']):,}")
        rows.append(Row(part.label, part.title, tuple(cells)))
    heads = ("reading", "p", "the ranks", "failed", "mean rank", "spread", "untrusted")
    behind = pd.DataFrame({part.label: part.row for part in parts}).T
    caption = CAPTION.format(level=parts[0].level, k=LARGEST_TRUSTED)
    return Table(caption, heads, tuple(rows), behind)


# --- The report of a calibration: verdict, ranks, coverage, estimates, and what became of the fits


MOST_PANELS = 12
"""Parameters of one figure: more would be too small to read."""

MOST_RIVALS = 4

BROKEN = (
    "What captures were simulated by differs on purpose from what was fitted, in its {}: this "
    "calibration asks whether that mistake is seen."
)
SHAPES = (
    "A hump above zero on the left and a dip below it on the right: the truth lies too often at "
    "both ends, intervals are too narrow; dip first, then hump: too wide. All above zero: truths "
    "stand low among the draws, the posterior is too high; all below: too low."
)


def render_calibration(
    calibration: xr.DataTree, beside: Mapping[str, xr.DataTree] | None = None
) -> str:
    """The page of a calibration as text."""
    rivals = {one_line(str(name)): each for name, each in (beside or {}).items()}
    provenance = provenance_of(calibration)
    method = one_line(str(provenance.get("method", "this calibration")))
    _check_rivals(rivals, method)
    table = calibration_table(calibration)
    parts = parts_of(calibration, table)
    said = verdict_words(calibration_verdict(calibration))
    compared = compare_calibrations({method: calibration, **rivals}) if rivals else None
    words = {
        label: parameter_deviation(part.row) for label, part in parts.items() if not part.passes
    }
    others = {name: parts_of(each) for name, each in rivals.items()}
    has_readings = holds_readings(calibration)
    read = ranks_of_readings(calibration) if has_readings else []
    judged = calibration_readings(calibration) if has_readings else None
    headline, is_good = verdict_head(table, judged)
    content: dict[str, Any] = {
        "kind": "Calibration report",
        "name": _name(provenance),
        "under": [
            f"{next(iter(parts.values())).pit.size:,} simulations. {made_by(provenance, method)}"
        ],
        "headline": headline,
        "is_good": is_good,
        "said": [said[0], *_broken(provenance), *interval_words(table, parts)],
        "found": said[1:],
        "parameters": calibration_rows(table, parts, words),
        "comparison": None
        if compared is None
        else {
            "table": comparison_rows(compared, parts),
            "sentences": comparison_sentences(compared),
        },
        "readings": reading_rows(read) if read else None,
        "statuses": fit_tables(calibration, parts),
        "facts_of_fits": fit_facts(calibration),
        "groups": calibration_groups(provenance),
        "pictures": _pictures(list(parts.values()), others, method)
        | {"readings": list(_readings(read, method))},
    }
    return fill("calibration.html.j2", content)


def _check_rivals(rivals: Mapping[str, xr.DataTree], method: str) -> None:
    for name, each in rivals.items():
        where = f"report: beside {name}"
        if not is_calibration(each):
            raise FitError(
                "it is no calibration", where=where, hint="give what polar_bayes.calibrate returns"
            )
        if name == method:
            raise FitError(
                "the calibration itself is called so", where=where, hint="give it another name"
            )
    if len(rivals) > MOST_RIVALS:
        raise FitError(
            f"{len(rivals)} calibrations are too many for one figure",
            where="report: beside",
            hint=f"give at most {MOST_RIVALS}",
        )


def _name(provenance: Mapping[str, Any]) -> str:
    capture = provenance.get("capture")
    if isinstance(capture, Mapping):
        capture = capture.get("name")
    return one_line(str(capture or "capture"))


def _broken(provenance: Mapping[str, Any]) -> list[str]:
    differing = provenance.get("truth") or {}
    if not differing:
        return []
    return [BROKEN.format(spoken([one_line(str(name)) for name in differing]))]


def _pictures(
    parts: Sequence[Part], others: Mapping[str, Mapping[str, Part]], method: str
) -> dict[str, list[Picture]]:
    """Every figure by the section where it stands."""
    colored = "Black dots mark where it leaves the band, which is narrow at both ends. "
    by_color = (
        f" Band and dots are those of {method}; the others are drawn over it." if others else ""
    )
    return {
        "ecdf": list(
            _paged(
                parts,
                lambda some: figures.ecdf_differences(some, others, method),
                "Distribution of the ranks minus the uniform one",
                "Where the posterior is right, the rank of the truth among its draws is uniform, "
                "and the curve stays in the gray band: curves of all parameters together leave it "
                f"in at most one of twenty right calibrations. {colored}{SHAPES}{by_color}",
            )
        ),
        "histogram": list(
            _paged(
                parts,
                figures.rank_histograms,
                "Histograms of the ranks",
                "The same ranks as histograms. All bars of a uniform one stay in the gray band in "
                "at least 19 of 20 calibrations. High at both ends: intervals too narrow; high in "
                "the middle: too wide; high on the left: the posterior is too high; on the right: "
                "too low.",
            )
        ),
        "coverage": list(
            _paged(
                parts,
                lambda some: figures.interval_coverage(some, others, method),
                "Share of the fits whose 50, 80 and 95% intervals hold the truth",
                "A dot for each interval: the share of all fits, failed ones counted as misses, "
                "whose interval holds the truth; bars are the 95% ranges (Wilson) that so many "
                "simulations allow. Dots belong on the dashed lines at 50, 80 and 95%: left of "
                "them intervals are too narrow or miss their place, right of them too wide.",
            )
        ),
        "estimates": list(
            _paged(
                parts,
                figures.estimates,
                "Posterior means and 80% intervals against the truth",
                f"Of at most {MOST_SHOWN} simulations, evenly chosen, those that failed included. "
                "About one interval in five should miss the truth (orange). Points along the "
                "dashed line: the data say what the parameter is. A flatter cloud: estimates "
                "shrink towards the prior, fully so where it lies level, and intervals are long. A "
                "cloud beside the line: estimates are shifted.",
            )
        ),
    }


def _readings(read: Sequence[ReadingRanks], method: str) -> Iterator[Picture]:
    return _paged(
        read,
        lambda some: figures.ecdf_differences(some, {}, method),
        "Distribution of the ranks of readings minus the uniform one",
        "Where model, links and posterior are right, a reading stands uniformly among what is "
        "predicted of it, and the curve stays in the gray band: curves of all readings together "
        "leave it in at most one of twenty right calibrations. Black dots mark where it leaves "
        "the band. A hump above zero on the left and a dip below it on the right: readings lie "
        "too often at both ends, predictions are too narrow; dip first, then hump: too wide.",
    )


def _paged[T: Ranked](
    parts: Sequence[T],
    draw: Callable[[Sequence[T]], Figure],
    alternative: str,
    caption: str,
) -> Iterator[Picture]:
    """A few parameters at a time; the first caption says how to read them all."""
    for at in range(0, len(parts), MOST_PANELS):
        some = parts[at : at + MOST_PANELS]
        labels = spoken([part.label for part in some])
        said = caption if at == 0 else f"The same of {labels}."
        yield picture(draw(some), f"{alternative}: {labels}", said)
