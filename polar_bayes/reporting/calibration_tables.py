"""What a calibration says in numbers and sentences: its parameters, its fits, its rivals."""

import enum
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.calibration.joint import is_calibrated
from polar_bayes.diagnostics.coverage import INTERVALS
from polar_bayes.errors import one_line
from polar_bayes.pixels.importance import LARGEST_TRUSTED
from polar_bayes.pixels.outcome import Approach, Status
from polar_bayes.reporting.calibration_panels import Part
from polar_bayes.reporting.map_tables import APPROACHES, MOST_NAMED, share
from polar_bayes.reporting.tables import Row, Table, fact_rows
from polar_bayes.reporting.text import DASH, numbers, or_dash, spoken

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
        cells = [one_line(str(method)), chance(row["p_value"], bool(row["passes"])), row["ways"]]
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
