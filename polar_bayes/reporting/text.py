"""Sentences of reports, and numbers as text.

Every conclusion that a report states is written here, by the kind of result: fits, comparisons of
fits, maps, calibrations and accuracy studies. Tables and captions belong to their pages.
"""

import itertools
import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.benchmark.advice import Study, accuracy_view
from polar_bayes.calibration.scores import is_calibrated, p_values, significance_level
from polar_bayes.calibration.verdict import CalibrationView, calibration_verdict
from polar_bayes.design.next_views import SMALL_GAIN, limits_sentences, quantity_sentences
from polar_bayes.diagnostics import convergence
from polar_bayes.diagnostics.compare import FitComparison
from polar_bayes.diagnostics.convergence import Verdict
from polar_bayes.diagnostics.criticism import criticize
from polar_bayes.diagnostics.finding import join
from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.diagnostics.population import Population, population_summary, populations
from polar_bayes.diagnostics.predictive import predictive_checks
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.diagnostics.view import FitView, Provenance
from polar_bayes.errors import one_line
from polar_bayes.inference.request import MIN_VIEWS
from polar_bayes.methods.registry import METHODS
from polar_bayes.numerics.psis import MAX_PARETO_K
from polar_bayes.reporting.page import INSTALL
from polar_bayes.reporting.style import QUANTITIES, coordinate_labels, short_title
from polar_bayes.results import MIN_GOOD_SHARE, verdict
from polar_bayes.scenes.sentences import is_apart

# --- Numbers as text, with the digits that they deserve -------------------------------------------

DASH = "\N{EN DASH}"
MAX_NAMED = 6
"""Number of names after which lists end with `and 3 more`."""


def number(value: float, scale: float) -> str:
    """Format a number with two digits of the scale (three if it begins with 1)."""
    decimals = 3
    if math.isfinite(scale) and scale > 0.0:
        decimals = min(max(1 - math.floor(math.log10(scale / 2.0)), 0), 8)
    # Adding zero turns a rounded -0.0 into 0.0.
    return f"{round(value, decimals) + 0.0:.{decimals}f}" if math.isfinite(value) else DASH


def numbers(values: Iterable[float], scale: float) -> list[str]:
    """Format several numbers with the digits of one scale."""
    return [number(value, scale) for value in values]


def interval(low: float, high: float, scale: float | None = None) -> str:
    """Format `[1.44, 1.52]` with the digits of a scale, by default a quarter of its width."""
    if not math.isfinite(high - low):
        return DASH
    return f"[{', '.join(numbers([low, high], (high - low) / 4.0 if scale is None else scale))}]"


def percent(share: float) -> str:
    """Format a share as `12%`, with one more digit below 10%."""
    if not math.isfinite(share):
        return DASH
    return f"{share:.1%}" if share < 0.0995 else f"{share:.0%}"


def count_percent(count: int, total: int) -> str:
    """Format a share in percent; it is never rounded to 0 or 100%."""
    if total == 0:
        return DASH
    text = percent(count / total)
    if count < total and text == "100%":
        return "above 99.5%" if count / total < 0.9995 else "above 99.9%"
    return "below 0.1%" if count > 0 and text == "0.0%" else text


def or_dash(value: float, form: str) -> str:
    """Format a number, or return a dash if it is not finite."""
    return format(value, form) if math.isfinite(value) else DASH


type Cell = Callable[[pd.Series], str]
"""Text of a cell from its row of numbers."""


def column(name: str, form: str) -> Cell:
    """Return a cell: one column of a row, or a dash."""
    return lambda row: or_dash(row[name], form)


def share(name: str) -> Cell:
    """Return a cell: one column in percent."""
    return lambda row: percent(row[name])


def digits(name: str, scale: str | Callable[[pd.Series], float] = "sd") -> Cell:
    """Return a cell: one column with the digits of another, or of a function of the row."""
    size = operator.itemgetter(scale) if isinstance(scale, str) else scale
    return lambda row: number(row[name], size(row))


def quarter(row: pd.Series) -> float:
    """Return a quarter of the width of a 95% interval: about one standard deviation."""
    return float(row["q97.5"] - row["q2.5"]) / 4.0


def ends(
    name: str = "q2.5",
    other: str = "q97.5",
    scale: Callable[[pd.Series], float | None] = lambda row: None,
) -> Cell:
    """Return a cell: an interval by the columns of its ends."""
    return lambda row: interval(row[name], row[other], scale(row))


def elpd(error: str) -> Cell:
    """Return a cell: an expected log density with its standard error, which is another column."""
    form = column(error, ".1f")
    return lambda row: f"{row['elpd']:.1f} ± {form(row)}" if math.isfinite(row["elpd"]) else DASH


def elpd_difference(row: pd.Series) -> str:
    """Format the difference in expected log density to the best, with standard error."""
    if row["dse"] == 0.0:
        return DASH
    return " ± ".join(numbers([row["elpd_diff"], row["dse"]], max(row["dse"], 0.2)))


SENSITIVITY_CELLS: Mapping[str, Cell] = {
    "to the priors": column("prior_sensitivity", ".3f"),
    "to the data": column("likelihood_sensitivity", ".3f"),
    "remark": lambda row: str(row["remark"]),
}


def p_value(level: float) -> Cell:
    """Return a cell: a p-value, marked where the test fails at a level."""
    p = column("p_value", ".2g")
    return lambda row: p(row) + (" (fails)" if row["p_value"] < level else "")


def join_first(names: Sequence[str]) -> str:
    """Join the first of many names: `a, b and 3 more`."""
    more = len(names) - MAX_NAMED
    return join([*names[:MAX_NAMED], *([f"{more} more"] if more > 0 else [])])


def capture_name(provenance: Provenance, default: str = "capture") -> str:
    """Return the name of the capture of a result."""
    capture = provenance.get("capture")
    name = capture.get("name") if isinstance(capture, Mapping) else capture
    return one_line(str(name or default))


# --- Fits -----------------------------------------------------------------------------------------

PLURALS = {"patch": "patches", "material": "materials"}

HELD, PRIOR = " held fixed", "prior of "

QUESTIONS = ("What is n?", "May I trust it?", "What should I measure next?")
"""Questions that the first screen of a report answers, in the words of its guide."""


def fit_headline(fit: FitView) -> str:
    """Return the verdict in one sentence."""
    method, verdict = fit.method, convergence.verdict(fit)
    name = METHODS[method].subject if method in METHODS else "The method"
    if not verdict.converged:
        failed = "did not converge" if method == "nuts" else "failed"
        return f"{name} {failed}: do not use these numbers."
    passed = {"nuts": "converged", "point": "met its tolerance"}.get(method, "raised no alarm")
    if not verdict.passed:
        against = "but the readings speak against the model: do not use these intervals."
        return f"{name} {passed}, {against}"
    return f"{name} {passed}." + (" Mind the cautions." if verdict.cautions else "")


def method_label(method: str) -> str:
    """Return the name of a method for readers."""
    return METHODS[method].label if method in METHODS else one_line(method)


def made_by(provenance: Provenance, method: str) -> str:
    """Return scene, model, method and seed in one line."""
    parts = {
        key: f"{key} {one_line(str(provenance[key]))}"
        for key in ("scene", "model", "seed")
        if provenance.get(key) is not None
    }
    order = [parts.get("scene", ""), parts.get("model", ""), method, parts.get("seed", "")]
    text = ", ".join(filter(None, order))
    return f"{text[:1].upper()}{text[1:]}."


def swapped_sentence(provenance: Provenance) -> str:
    """State what the user replaced."""
    if "swapped" not in provenance:
        return ""
    swapped = [str(name) for name in provenance["swapped"]]
    priors = [name.removeprefix(PRIOR) for name in swapped if name.startswith(PRIOR)]
    held = [name.removesuffix(HELD) for name in swapped if name.endswith(HELD)]
    parts = [f"the {n}" for n in swapped if not n.startswith(PRIOR) and not n.endswith(HELD)]
    if priors:
        parts.append(f"the prior{'s' if len(priors) > 1 else ''} of {join_first(priors)}")
    sentences = [f"Replaced by the user: {join(parts)}."] if parts else []
    sentences += [f"Held fixed: {join_first(held)}."] if held else []
    return " ".join(sentences) or (
        "No part of the model was replaced: scene, links and priors are the package's defaults."
    )


def determined(fit: FitView) -> list[str]:
    """Name the material parameters that the data determine; the verdict names the others."""
    if not convergence.verdict(fit).passed:
        return []
    found = sensitivity(fit)["verdict"]
    group = [x for x in fit.scalars if x.is_material and found.get(x.label) == "determined"]
    return [f"The data determine {parameter_names(group, fit.posterior)}."] if group else []


def between_members(fit: FitView) -> list[str]:
    """State how much members of each population differ, and the range of a new one."""
    summary = population_summary(fit)
    groups: dict[str, list[Population]] = {}
    for each in populations(fit):
        if np.isfinite(summary.loc[each.label, "between"]):
            groups.setdefault(each.name, []).append(each)
    return [_between(summary, group, fit.posterior) for group in groups.values()]


def _between(summary: pd.DataFrame, group: Sequence[Population], posterior: xr.Dataset) -> str:
    first = group[0]
    # Members along one axis are called after it.
    dims = [dim for dim in first.members[0].index if dim not in first.location.index]
    member = dims[0] if len(dims) == 1 and dims[0] in PLURALS else "member"
    row = summary.loc[first.label]
    scale = (row["between_q97.5"] - row["between_q2.5"]) / 4.0
    between, low, high = numbers([row["between"], row["between_q2.5"], row["between_q97.5"]], scale)
    factor = "a factor of about" if first.scale == "log" else "about"
    ranges = []
    # Of many colors the first and the last.
    for each in [group[0], group[-1]] if len(group) > 1 else [group[0]]:
        low_end, high_end = summary.loc[each.label, ["new_q2.5", "new_q97.5"]]
        ends = join(numbers([low_end, high_end], (high_end - low_end) / 4.0))
        places = coordinate_labels(each.location)
        ranges.append(f"between {ends}{' at ' + join(places) if places else ''}")
    return (
        f"Between the {len(first.members)} {PLURALS.get(member, 'members')} the "
        f"{short_title(first.members[0], posterior)} varies by {factor} {between} (95%: {low} to "
        f"{high}); a new {member} would lie {join(ranges)} (95%)."
    )


def pooling(fit: FitView) -> list[str]:
    """State, by population, whether readings or the population determine its members."""
    summary = population_summary(fit)
    groups: dict[bool, list[str]] = {}
    for each in populations(fit):
        factor = summary.loc[each.label, "pooling"]
        if np.isfinite(factor):
            names = [short_title(each.members[0], fit.posterior), *coordinate_labels(each.location)]
            name = f"{', '.join(names)} ({factor:.2f})"
            groups.setdefault(bool(factor > 0.5), []).append(name)
    phrases = {
        True: "The population determines {} more than the readings of a single member (pooling "
        "factor in brackets): quote such estimates as those of a member of this population.",
        False: "The readings of a single member determine {} more than the population (pooling "
        "factor in brackets).",
    }
    return [phrases[is_pooled].format(join(names)) for is_pooled, names in groups.items()]


def parameter_names(scalars: Sequence[Scalar], posterior: xr.Dataset) -> str:
    """Format `roughness r and refractive index n at 450, 550 and 650 nm`."""
    groups: dict[str, list[Scalar]] = {}
    for scalar in scalars:
        groups.setdefault(short_title(scalar, posterior), []).append(scalar)
    return join([f"{name}{_coordinates(group, posterior)}" for name, group in groups.items()])


def _coordinates(group: Sequence[Scalar], posterior: xr.Dataset) -> str:
    """Format ` at 450 and 550 nm`, ` (material leaf, 450 nm)`, or an empty text."""
    if not group[0].labels:
        return ""
    if list(group[0].labels) == ["wavelength"]:
        return f" at {join([scalar.labels['wavelength'] for scalar in group])} nm"
    if len(group) > 1 and len(group) * group[0].draws.size == posterior[group[0].name].size:
        return " (everywhere)"
    places = [", ".join(coordinate_labels(scalar)) for scalar in group]
    more = f"; {len(places) - MAX_NAMED} more" if len(places) > MAX_NAMED else ""
    return f" ({'; '.join(places[:MAX_NAMED])}{more})"


def predictive_sentences(fit: FitView) -> list[str]:
    """State whether the scatter of readings around predictions agrees with the model."""
    check = criticize(fit).loc["leave-one-out"]
    sentences = [str(check["sentence"])] if check["sentence"] else []
    if check["level"] == "passed" and math.isfinite(check["p_value"]):
        sentences.append(
            "The readings are distributed as the model expects (the check leave-one-out, "
            f"p = {check['p_value']:.2g})."
        )
    for each in predictive_checks(fit).values():
        if each.loo and each.loo.unreliable:
            effect = (
                "leave-one-out cannot be approximated with these draws, so its results on this "
                "page are unreliable."
                if 2 * each.loo.unreliable > each.count
                else "they are so influential that leave-one-out cannot be approximated for them. "
                "Inspect them first."
            )
            sentences.append(
                f"Pareto k is above 0.7 for {each.loo.unreliable} of {each.count} readings of "
                f"{QUANTITIES.get(each.name, each.name)}: {effect}"
            )
    return sentences


def index_sentences(fit: FitView) -> list[str]:
    """State the refractive index, or the range of several."""
    found = [scalar for scalar in fit.scalars if scalar.name == "refractive_index"]
    if not found or fit.method == "point":
        return []
    rows = convergence.summary(fit).loc[[scalar.label for scalar in found]]
    if len(found) > 4:
        low, high = numbers([rows["mean"].min(), rows["mean"].max()], rows["sd"].median())
        return [
            f"The refractive index n of {len(found)} entries lies between {low} and {high}; the "
            f"table below has the 95% interval of each."
        ]
    phrases = []
    for scalar, (_, row) in zip(found, rows.iterrows(), strict=True):
        places, ends = coordinate_labels(scalar), interval(row["q2.5"], row["q97.5"])
        at = f" at {join(places)}" if places else ""
        phrases.append(f"{number(row['mean'], row['sd'])}{at} (95% interval {ends})")
    return [f"The refractive index n is {join(phrases)}."]


def _views_sentence(result: xr.DataTree) -> str:
    """State what to measure next, if the result holds `polar_bayes.next_views`."""
    if "next_views" not in result.children:
        return (
            "What to measure next is not worked out here: polar-bayes report does it, or "
            "result['next_views'] = pb.next_views(result)."
        )
    found = result["next_views"].to_dataset()
    views = verdict(found).sentences[0].rstrip(".").replace("Look next", "Measure next")
    limits = "".join(f" {each}" for each in limits_sentences(found))
    of, before, after = _expected_widths(found)
    share = 1.0 - after / before
    if share.max() < SMALL_GAIN:
        return f"{views}: but 95% intervals{of} narrow by {percent(share.max())} at most.{limits}"
    if len(before) == 1:
        return (
            f"{views}: the 95% interval{of} is expected to narrow from {before[0]:.3g} to "
            f"{after[0]:.3g}.{limits}"
        )
    least, most = (f"{end(share):.0%}" for end in (np.min, np.max))
    by = least if least == most else f"{least} to {most}"
    return f"{views}: the 95% intervals{of} are expected to narrow by {by}.{limits}"


def _expected_widths(views: xr.Dataset) -> tuple[str, np.ndarray, np.ndarray]:
    """Return ` of n` and its 95% widths before and after views; those of all where n is known."""
    widths = views["interval_width"].transpose("step", "parameter").to_pandas()
    of_index = widths.filter(like="refractive_index")
    before, after = (of_index if of_index.size else widths).iloc[[0, -1]].to_numpy()
    return " of n" * bool(of_index.size), before, after


def next_sentences(fit: FitView) -> list[str]:
    """State what to measure next, and what of the set-up to know better."""
    sentences = [_views_sentence(fit.result)]
    if "next_views" in fit.result.children:
        sentences += quantity_sentences(fit.result["next_views"].to_dataset())
    return sentences


def trust(fit: FitView) -> str:
    """State whether the intervals can be trusted, as far as one fit can tell."""
    verdict = convergence.verdict(fit)
    if fit.method == "point":
        return (
            "The standard errors are those of least squares: they include no prior and no bounds, "
            "so do not read them as intervals."
        )
    if verdict.cautions:
        return "Use the intervals with care: see the cautions."
    return (
        f"{verdict.nothing_against} A calibration of this layout shows how "
        "often such intervals contain the truth, if the scene is the right one."
    )


def notes(verdict: Verdict) -> list[str]:
    """List remarks on a fit that do not affect its verdict."""
    return [f"Note: {finding}" for finding in verdict.findings]


def overconfidence(fit: FitView, compared: pd.DataFrame, part: str) -> list[str]:
    """State how to interpret a fit that leaves out a part of the instrument."""
    posterior = fit.posterior
    shared = [scalar for scalar in fit.scalars if scalar.label in compared.index]
    gain = {scalar: 1.0 - compared.loc[scalar.label, "width_ratio"] for scalar in shared}
    # Widths that differ by less are equal, as far as draws can tell.
    narrower = [scalar for scalar in shared if gain[scalar] > 0.05]
    others = [scalar for scalar in shared if gain[scalar] <= 0.05]
    sentences = []
    if narrower:
        shares = [gain[scalar] for scalar in narrower]
        least, most = min(shares), max(shares)
        by = f"{most:.0%}" if most - least < 0.01 else f"{least:.0%} to {most:.0%}"
        sentences.append(
            f"Without {part} the 95% {_intervals_are(narrower, posterior)} narrower by {by}. That "
            "is overconfident: the fit then counts errors of the instrument as knowledge about "
            "the material."
        )
    if others:
        sentences.append(
            f"Without {part} the 95% {_intervals_are(others, posterior)} not narrower, as it "
            "happens; still, that fit has no room for such errors of the instrument and holds "
            "only if there are none."
        )
    misses = (compared["mean"] < compared["q2.5_without"]) | (
        compared["mean"] > compared["q97.5_without"]
    )
    apart = [scalar for scalar in shared if misses[scalar.label]]
    if apart:
        sentences.append(
            f"The two fits disagree on {parameter_names(apart, posterior)}: the interval without "
            f"{part} does not contain the mean of this fit."
        )
    return [*sentences, f"Do not quote the numbers without {part}."]


def _intervals_are(scalars: Sequence[Scalar], posterior: xr.Dataset) -> str:
    names = parameter_names(scalars, posterior)
    return f"interval of {names} is" if len(scalars) == 1 else f"intervals of {names} are"


# --- Comparisons of fits --------------------------------------------------------------------------


def comparison_headline(comparison: FitComparison) -> str:
    """State which fit predicts best, or that the readings do not decide."""
    failed = [name for name, verdict in comparison.verdicts.items() if not verdict.passed]
    if failed:
        return f"Do not use the numbers of {join(failed)}: read why first."
    if len(comparison.loo) < 2:
        return "Predictions are not compared; parameters are."
    if not _is_clearly_worse(comparison.loo.iloc[1]):
        return "The readings do not decide which of these fits predicts best."
    return f"{comparison.loo.index[0]} predicts the readings best."


def _is_clearly_worse(row: pd.Series) -> bool:
    """Return whether a fit predicts significantly worse than the best."""
    return bool(is_apart(-float(row["elpd_diff"]), float(row["dse"])))


def comparison_of_fits_sentences(comparison: FitComparison) -> list[str]:
    """State the evidence of readings, and on which parameters fits disagree.

    Args:
        comparison: Of `polar_bayes.diagnostics.compare_fits`.

    Returns:
        Sentences.
    """
    sentences, alike, best = [], [], next(iter(comparison.loo.index), "")
    for name, row in list(comparison.loo.iterrows())[1:]:
        if not _is_clearly_worse(row):
            alike.append(str(name))
            continue
        difference, error = numbers([-row["elpd_diff"], row["dse"]], max(row["dse"], 0.2))
        sentences.append(
            f"{name} predicts left-out readings worse than {best}: their log density is lower by "
            f"{difference} ± {error} in all."
        )
    if alike:
        sentences.append(f"{join(alike)} predicts them about as well as {best}.")
    unreliable = comparison.loo.get("unreliable", pd.Series(dtype=float))
    if (unreliable > 0).any():
        counts = [f"{int(count)} of {name}" for name, count in unreliable.items() if count]
        sentences.append(
            f"Pareto k is above 0.7 for {join(counts)}: leave-one-out cannot be approximated for "
            "these readings, so differences may be off."
        )
    return [*sentences, *_disagreements(comparison.parameters)]


def _disagreements(table: pd.DataFrame) -> list[str]:
    """List pairs of intervals that do not overlap."""
    apart, shared = [], 0
    for label, own in table.groupby(level="parameter", sort=False):
        known = own.droplevel("parameter").dropna(subset=["q2.5", "q97.5"])
        shared += len(known) > 1
        for (one, a), (other, b) in itertools.combinations(known.iterrows(), 2):
            if a["q97.5"] < b["q2.5"] or b["q97.5"] < a["q2.5"]:
                apart.append(f"{label} ({one} and {other})")
    if apart:
        return [
            f"Their 95% intervals do not overlap for {join_first(apart)}: at least one of the fits "
            "leaves out something that matters."
        ]
    if not shared:
        return []
    return [f"The 95% intervals of all {shared} parameters that two fits share overlap."]


# --- Maps -----------------------------------------------------------------------------------------

SLIGHT = 0.01
"""Error of the coverage below which there is no warning, however many pixels show it."""

METHODS_USED = {
    "none": "no numbers",
    "laplace": "the normal approximation as it is",
    "importance": "weighted draws of normal approximations",
    "adapted": "a proposal fitted to its own draws and corrected by weights",
    "nuts": "sampling (NUTS)",
    "other": "a method of the user's own",
}


def map_headline(counts: pd.DataFrame) -> tuple[str, bool]:
    """State how many pixels have an answer, and whether they are enough."""
    by_status = counts.sum(axis=1)
    total, good = int(by_status.sum()), int(by_status.get("good", 0))
    read = total - int(by_status.get("masked", 0))
    if read == 0:
        return "No pixel was read: these maps are empty.", False
    if good == 0 and by_status.get("contradicted", 0):
        return "Readings contradict every pixel that has an answer: do not use these maps.", False
    if good == 0:
        return "No pixel has an answer: do not use these maps.", False
    if good == read:
        return "Every pixel that was read has an answer.", True
    if lost := int(by_status.get("not fitted", 0)):
        return f"{lost:,} of {total:,} pixels are not fitted: this map has holes.", False
    share = count_percent(good, read)
    headline = f"{good:,} of {read:,} pixels that were read have an answer ({share})."
    return headline, good >= MIN_GOOD_SHARE * read


def no_explorer() -> str:
    """Why a report has no map to point at."""
    return f"There is no map to point at, because Bokeh is not installed: {INSTALL}."


def pixel_sentences(counts: pd.DataFrame) -> list[str]:
    """State how many pixels have each status."""
    by_status = {str(status): int(number) for status, number in counts.sum(axis=1).items()}
    total, good = sum(by_status.values()), by_status.get("good", 0)
    sentences = []
    if good:
        by = {str(way): int(number) for way, number in counts.loc["good"].items() if number}
        ways = [
            f"{'all' if len(by) == 1 else format(number, ',')} by {METHODS_USED.get(way, way)}"
            for way, number in by.items()
        ]
        sentences.append(
            f"Of {total:,} pixels {good:,} are good ({count_percent(good, total)}): {join(ways)}."
        )
    phrases = {
        "masked": "masked: no reading there is valid.",
        "too few views": f"read in fewer than {MIN_VIEWS} views and not fitted.",
        "not converged": "not converged: no start led to an answer, and the maps are NaN there.",
        "not trusted": f"not trusted: Pareto k is above {MAX_PARETO_K:g}, or the effective "
        "sample size is too small, and no other method confirmed them. The maps show their numbers "
        "there; do not quote them.",
        "not fitted": "not fitted: they are called good without finite numbers, or were never "
        "written. Copy the store again, or make the map again.",
    }
    for status, phrase in phrases.items():
        if number := by_status.get(status):
            sentences.append(f"{number:,} {'pixels are' if number > 1 else 'pixel is'} {phrase}")
    return sentences


def coverage_error(row: pd.Series, claimed: int) -> int:
    """Return -1 if intervals contain the truth too rarely, 1 if too often, 0 otherwise."""
    error = row[f"held_{claimed}"] - claimed / 100
    if error < -SLIGHT and row[f"held_{claimed}_high"] < claimed / 100:
        return -1
    return int(error > SLIGHT and row[f"held_{claimed}_low"] > claimed / 100)


def coverage_sentences(titles: Mapping[str, str], coverage: pd.DataFrame) -> list[str]:
    """State whether 95% intervals contain the truth as often as they should."""
    groups: dict[int, list[str]] = {}
    for label, title in titles.items():
        if label in coverage.index and coverage.loc[label, "answered"]:
            row = coverage.loc[label]
            name = f"{title} ({row['held_95']:.1%})"
            groups.setdefault(coverage_error(row, 95), []).append(name)
    phrases = {
        0: "The 95% intervals hold the truth about as often as they say: {}.",
        1: "The 95% intervals hold the truth more often than they say: {}.",
        -1: "The 95% intervals hold the truth less often than they say: {}.",
    }
    return [
        phrases[error].format(join_first(groups[error])) for error in phrases if error in groups
    ]


def counted_pixels(coverage: pd.DataFrame) -> list[str]:
    """State which pixels the coverage counts, and which it leaves out."""
    sentences = []
    for counts, rows in coverage.groupby(["unknown", "masked", "unanswered", "answered"]):
        *others, answered = (int(count) for count in counts)
        reasons = ("of unknown truth", "masked", "read without an answer")
        aside = [f"{n:,} {why}" for n, why in zip(others, reasons, strict=True) if n]
        names = "" if len(rows) == len(coverage) else f"{join_first(list(rows.index))}: "
        left = f" Left out: {join(aside)}." if aside else " None is left out."
        sentences.append(f"{names}{answered:,} pixels with an answer are counted.{left}")
    return sentences


# --- Calibrations ---------------------------------------------------------------------------------


def calibration_headline(table: pd.DataFrame, readings: pd.DataFrame | None) -> tuple[str, bool]:
    """Return the verdict in a few words, and whether all tests pass."""
    passed = is_calibrated(table)
    answered = float((table["answered"] / (table["answered"] + table["failed"])).min())
    headline = "Calibrated" if passed else "Not calibrated"
    if passed and readings is not None and not is_calibrated(readings):
        headline, passed = "Parameters are calibrated, predicted readings are not", False
    if answered < MIN_GOOD_SHARE:
        link = ", but" if passed else ", and"
        return f"{headline}{link} {1.0 - answered:.0%} of the fits failed.", False
    return f"{headline}.", passed


def verdict_after_headline(calibration: CalibrationView) -> list[str]:
    """Return `calibration_verdict` without the words that the headline repeats."""
    first, *others = calibration_verdict(calibration)
    first = first.partition(": ")[2] or first
    return [f"{first[0].upper()}{first[1:]}", *others]


def wrong_on_purpose(provenance: Provenance) -> list[str]:
    """Return whether the simulating model differs from the fitted model."""
    differing = [one_line(str(name)) for name in provenance.get("truth") or {}]
    if not differing:
        return []
    return [
        "What captures were simulated by differs on purpose from what was fitted, in its "
        f"{join(differing)}: this calibration tests whether that mistake is detected."
    ]


def interval_sentences(table: pd.DataFrame, titles: Mapping[str, str]) -> list[str]:
    """State coverages of 95% intervals of parameters that fail, and failed fits."""
    failing = table[~(p_values(table) >= significance_level(table)).all(axis=1)]
    sentences = []
    if len(failing):
        shares = [
            f"the true {titles[str(label)]} in {share:.1%}"
            for label, share in failing["held_95"].iloc[:MAX_NAMED].items()
        ]
        more = len(failing) - MAX_NAMED
        others = f" ({more} more parameters fail)" if more > 0 else ""
        sentences.append(f"The 95% intervals hold {join(shares)} of all fits{others}.")
    if failed := int(table["failed"].max()):
        total = int((table["answered"] + table["failed"]).max())
        sentences.append(
            f"{failed:,} of {total:,} fits have no answer. The ranks are those of the others; the "
            "shares of intervals that hold the truth count them as misses."
        )
    return sentences


# --- Accuracy studies -----------------------------------------------------------------------------


def reference_sentence(result: Study) -> str:
    """State what the reference is, and how accurate it is."""
    view = accuracy_view(result)
    study = view.study.attrs
    sentence = (
        f"The reference is {study['reference_draws']:,} draws of {study['reference']} with an "
        f"effective sample size of {study['reference_ess']:,.0f}; its own Monte Carlo "
        f"error is at most {study['reference_error']:.2g} posterior sd."
    )
    return f"{sentence} There are doubts about it: {view.doubts}." if view.doubts else sentence
