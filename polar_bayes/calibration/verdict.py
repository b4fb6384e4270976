"""Schema of a calibration in a file, its tables, and its verdict in sentences."""

import dataclasses
import functools
import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
import scipy.special
import scipy.stats
import xarray as xr

from polar_bayes.calibration.scores import (
    FALSE_ALARMS,
    coverage_p_value,
    is_calibrated,
    significance_level,
    spread_of_scores,
    uniformity,
)
from polar_bayes.diagnostics.coverage import INTERVALS, coverage_columns
from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.errors import FitError
from polar_bayes.inference.batching import Status
from polar_bayes.inference.files import (
    ANY,
    COMMON_PROVENANCE,
    EACH,
    FLAGS,
    TEXT,
    Group,
    Like,
    Schema,
)
from polar_bayes.inference.result import provenance_of
from polar_bayes.numerics.psis import LEVELS, MAX_PARETO_K

# --- Schema ---------------------------------------------------------------------------------------

_SIMULATION = ("simulation",)
_RANKS = Group(_SIMULATION, extra_dims=False)

CALIBRATION = Schema(
    kind="calibration",
    made_by="polar_bayes.calibrate or load",
    command="`polar-bayes calibrate`",
    groups={
        "prior_sbc": Group(_SIMULATION, required=True),
        "truth": Group(_SIMULATION, required=True, like=Like("prior_sbc", {"": ()}, required=True)),
        "marginals": Group(
            _SIMULATION,
            required=True,
            variables={"quantile": ("quantile",)},
            like=Like(
                "prior_sbc",
                {"": (), "_sd": (), "_crps": (), "_quantile": ("quantile",)},
                required=True,
            ),
        ),
        "fits": Group(
            required=True,
            variables={"status": _SIMULATION},
            kinds={"status": FLAGS, "method": FLAGS},
            names=("status", "method", "ess", "pareto_k"),
            dims=_SIMULATION,
            extra_dims=False,
            variable_attributes={"flag_meanings?": TEXT},
        ),
        "predictive_pit": _RANKS,
        "loo_pit": Group(
            _SIMULATION, extra_dims=False, like=Like("predictive_pit", {"": ()}, required=True)
        ),
        "readings": Group(
            _SIMULATION,
            extra_dims=False,
            like=Like("predictive_pit", {"_pareto_k": ()}, required=True),
        ),
    },
    provenance={**COMMON_PROVENANCE, "truth?": {EACH: ANY}, "why_not_ranked?": TEXT},
)


def check_calibration(tree: xr.DataTree, source: str = "calibration") -> None:
    """Raise FitError for a tree that is not a calibration or whose parts do not match."""
    CALIBRATION.check(tree, source)
    levels = tree["marginals"].to_dataset()["quantile"].to_numpy().tolist()
    if missing := [level for level in LEVELS if levels.count(level) != 1]:
        what = f"the level {missing[0]} is not there once"
        hint = f"give the tree as {CALIBRATION.made_by} returned it"
        raise FitError(what, where=f"{source}: marginals/quantile", hint=hint)
    groups = {"predictive_pit", "loo_pit", "readings"}
    if (there := groups & set(tree.children)) and there != groups:
        hint = f"give the tree as {CALIBRATION.made_by} returned it, or drop {min(there)}"
        raise FitError(f"it has no group {min(groups - there)}", where=source, hint=hint)


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationView:
    """A validated calibration; the tree must not change while the view is in use."""

    tree: xr.DataTree

    @functools.cached_property
    def scalars(self) -> list[tuple[Scalar, np.ndarray]]:
        """Every scalar parameter, with its ranks by simulation as draws, and its truths."""
        ranks, truths = (
            scalars(self.tree[group].to_dataset().rename(simulation="draw").expand_dims("chain"))
            for group in ("prior_sbc", "truth")
        )
        known = {each.label: each.draws[0] for each in truths}
        if any(each.label not in known for each in ranks):
            what = "its labels are not those of prior_sbc"
            hint = "give what polar_bayes.calibrate returned"
            raise FitError(what, where="calibration: truth", hint=hint)
        return [(each, known[each.label]) for each in ranks]

    @functools.cached_property
    def table(self) -> pd.DataFrame:
        """The table of `calibration_table`."""
        marginals = self.tree["marginals"].to_dataset()
        rows = {each.label: _parameter_row(each, true, marginals) for each, true in self.scalars}
        return pd.DataFrame.from_dict(rows, orient="index")


def calibration_view(calibration: xr.DataTree | CalibrationView) -> CalibrationView:
    """Return the view of a calibration after checking it."""
    if isinstance(calibration, CalibrationView):
        return calibration
    check_calibration(calibration)
    return CalibrationView(calibration)


# --- Tables ---------------------------------------------------------------------------------------

HALF = 0.5
"""Share of failed or untrusted fits from which the verdict suggests another method."""

MOMENT_LIMIT = 2.5
"""Standard errors from which a moment of the ranks is named as the deviation."""

TOO_FEW = "fewer than two fits have an answer"

READING_TESTS = {"predictive_pit": "fresh", "loo_pit": "left out"}
"""Groups of a calibration that hold PIT values of readings, and names of their tests."""


def calibration_table(calibration: xr.DataTree | CalibrationView) -> pd.DataFrame:
    """Return one row for each parameter of a calibration."""
    # Columns: `answered` and `failed` fits; `p_value` of uniform ranks; `rank_mean` (a half where
    # the posterior is neither too high nor too low) and `rank_spread` (above one: too narrow); for
    # 50, 80 and 95%, as `held_50`, the share of all fits whose interval holds the truth, failed
    # ones counted as misses, with Wilson's 95% interval, and as `p_held_50` the exact binomial test
    # of the same among the fits that have an answer; `spread`, sd of the normal scores of the ranks
    # (above one: truths scatter further than the posterior says), and its test, `p_spread`;
    # `width_95`, mean width of the 95% interval; `crps`, mean continuous ranked probability score.
    return calibration_view(calibration).table


def _parameter_row(scalar: Scalar, truth: np.ndarray, marginals: xr.Dataset) -> dict[str, float]:
    pit, index = scalar.draws[0], dict(scalar.index)
    own = marginals.isel(index)
    bounds = own[f"{scalar.name}_quantile"]
    columns = _rank_columns(pit)
    p_spread, spread = spread_of_scores(pit[np.isfinite(pit)])
    held = {}
    for percent, levels in INTERVALS.items():
        low, high = (bounds.sel(quantile=level).to_numpy() for level in levels)
        held[percent] = int(np.sum((low <= truth) & (truth <= high)))
    tests = {
        f"p_held_{percent}": coverage_p_value(hits, int(columns["answered"]), percent / 100.0)
        for percent, hits in held.items()
    }
    with np.errstate(invalid="ignore"):  # of infinite ends
        means = {"width_95": high - low, "crps": own[f"{scalar.name}_crps"].to_numpy()}
    return {
        **columns,
        **coverage_columns(held, pit.size),
        **tests,
        "p_spread": p_spread,
        "spread": spread,
        **{name: float(pd.Series(x[np.isfinite(x)]).mean()) for name, x in means.items()},
    }


def _rank_columns(pit: np.ndarray) -> dict[str, float]:
    finite = pit[np.isfinite(pit)]
    ranks = uniformity(finite)
    return {
        "answered": finite.size,
        "failed": pit.size - finite.size,
        "p_value": ranks.p_value,
        "rank_mean": ranks.mean,
        "rank_spread": ranks.spread,
    }


def calibration_readings(calibration: xr.DataTree | CalibrationView) -> pd.DataFrame:
    """Return two rows per recorded variable: one of replicated readings, one left out.

    Where model, prior, links and method are right, both have uniform PIT values in the fits'
    predictions. One entry is chosen in each simulation, so that simulations are independent and the
    test that `calibration_table` makes of parameters holds here as well.

    Args:
        calibration: What `polar_bayes.calibrate` returns.

    Returns:
        Columns `reading` and `test` ("fresh" for replicated, or "left out"); `answered` and
        `failed` (fits); `p_value` of uniform ranks; `rank_mean` (above a half predictions are too
        low) and `rank_spread` (above one they are too narrow, below too wide); `untrusted`, the
        number of readings left out whose Pareto k is above 0.7 (NaN for replicated ones, which need
        none): where it is large, the importance weights cause the deviation.

    Raises:
        FitError: It is no calibration, or readings were not ranked.

    Source:
        See `polar_bayes.calibration.predictive`.
    """
    tree = calibration_view(calibration).tree
    if not holds_readings(tree):
        hint = "give what polar_bayes.calibrate returns with readings=True"
        raise FitError("it holds no ranks of readings", where="calibration", hint=hint)
    rows = {}
    for label, pit in reading_ranks(tree).items():
        name, test = label.rsplit(", ", 1)
        pareto_k = tree["readings"][f"{name}_pareto_k"].to_numpy()
        untrusted = float(np.sum(pareto_k[np.isfinite(pit)] > MAX_PARETO_K))
        rows[label] = {
            "reading": name,
            "test": test,
            **_rank_columns(pit),
            "untrusted": untrusted if test == READING_TESTS["loo_pit"] else math.nan,
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def holds_readings(calibration: xr.DataTree) -> bool:
    """Return whether a calibration holds ranks of readings."""
    return set(READING_TESTS) <= set(calibration.children)


def reading_ranks(calibration: xr.DataTree) -> dict[str, np.ndarray]:
    """Return ranks of readings by their label in `calibration_readings`; NaN for failed fits."""
    return {
        f"{name}, {test}": calibration[group][name].to_numpy()
        for name in map(str, calibration["predictive_pit"].data_vars)
        for group, test in READING_TESTS.items()
    }


# --- Sentences ------------------------------------------------------------------------------------


def calibration_verdict(calibration: xr.DataTree | CalibrationView) -> list[str]:
    """State the result of a calibration in sentences, readings last."""
    calibration = calibration_view(calibration)
    table = calibration.table
    passed = is_calibrated(table)
    count = int(table["answered"].max() + table["failed"].min())
    sentences = [
        f"{'Calibrated' if passed else 'Not calibrated'}: the ranks, coverage and spread of "
        f"{len(table)} parameters in {count} simulations {'pass' if passed else 'fail'} a joint "
        f"test that a right method fails at most {FALSE_ALARMS:.0%} of the time.",
        *(
            f"{label}: {found}."
            for label, row in table.iterrows()
            if (found := parameter_deviation(row, significance_level(table)))
        ),
    ]
    statuses = calibration.tree["fits"]["status"].to_numpy()
    for status in Status:
        lost = int(np.sum(statuses == status))
        if status != Status.GOOD and lost:
            name = status.name.lower().replace("_", " ")
            sentences.append(f"{lost} of {statuses.size} fits: {name}.")
    if failed := int(table["failed"].max()):
        counted = f"{failed} of {statuses.size} fits have no answer, and count as misses of every"
        sentences.append(f"{counted} interval above.")
    if failed >= HALF * statuses.size:
        advice = "use method='nuts', whose chains begin at every mode"
        if provenance_of(calibration.tree).get("method") == "nuts":
            advice = "give longer chains, as in Nuts(most_draws=20000), or narrower priors"
        sentences.append(f"Half of the fits or more have failed: {advice}.")
    if np.mean(statuses == Status.NOT_TRUSTED) > HALF:
        sentences.append(
            "Most fits fail their own diagnostics: the ranks test the method, not the model. Use "
            "another method or longer chains; chains (method='nuts') are the slowest and the most "
            "reliable method."
        )
    return sentences + _reading_sentences(calibration)


def _reading_sentences(calibration: CalibrationView) -> list[str]:
    if not holds_readings(calibration.tree):
        reason = provenance_of(calibration.tree).get("why_not_ranked", "")
        return [f"Readings were not ranked: {reason}."] if reason else []
    table = calibration_readings(calibration)
    names = ", ".join(dict.fromkeys(table["reading"]))
    sentences = [
        f"Readings ({names}; fresh ones and ones left out) "
        f"{'pass' if is_calibrated(table) else 'fail'} a separate joint test that a right "
        f"model fails {FALSE_ALARMS:.0%} of the time."
    ]
    for label, row in table.iterrows():
        if not row["p_value"] >= significance_level(table):  # a row without p-value fails too
            p_value = f" (p = {row['p_value']:.2g})" if row["answered"] > 1 else ""
            sentences.append(f"{label}: {reading_deviation(row)}{p_value}.")
    sentences += [
        f"{label}: in {int(row['untrusted'])} of {int(row['answered'])} fits the weights "
        f"without it are unreliable (Pareto k above {MAX_PARETO_K:g})."
        for label, row in table[table["untrusted"] > 0].iterrows()
    ]
    return sentences


def parameter_deviation(row: pd.Series, level: float) -> str:
    """Describe which tests a parameter fails, and by how much; empty if it passes all."""
    count = row["answered"]
    if count < 2:
        return TOO_FEW
    found = []
    if not row["p_value"] >= level:
        expected = _spread_of_shifted(row["rank_mean"])
        shape = _deviation(row, expected, "the posterior is", "intervals")
        found.append(f"{shape} (p = {row['p_value']:.2g})")
    missed = [percent for percent in INTERVALS if not row[f"p_held_{percent}"] >= level]
    if missed:
        # Among the fits that have an answer, as the test.
        answered = (count + row["failed"]) / count
        shares = ", ".join(f"{answered * row[f'held_{percent}']:.1%}" for percent in missed)
        least = min(row[f"p_held_{percent}"] for percent in missed)
        named = ", ".join(f"{percent}%" for percent in missed)
        found.append(f"{named} intervals hold {shares} of the truths (p = {least:.2g})")
    if not row["p_spread"] >= level:
        found.append(
            f"the truths scatter {row['spread']:.2f} times as far as the posterior says "
            f"(p = {row['p_spread']:.2g})"
        )
    return "; ".join(found)


def reading_deviation(row: pd.Series) -> str:
    """Describe how the ranks of a reading deviate from the uniform distribution."""
    return _deviation(row, 1.0, "predictions are", "predictions")


def _deviation(row: pd.Series, expected_spread: float, location: str, width: str) -> str:
    count = row["answered"]
    if count < 2:
        return TOO_FEW
    shift = (row["rank_mean"] - 0.5) * math.sqrt(12.0 * count)
    # The standard error of the spread of n uniform ranks is 1 / sqrt(5 n).
    stretch = (row["rank_spread"] - expected_spread) * math.sqrt(5.0 * count)
    found = []
    if abs(shift) > MOMENT_LIMIT:
        found.append(f"{location} too {'low' if shift > 0.0 else 'high'}")
    if abs(stretch) > MOMENT_LIMIT:
        found.append(f"{width} are too {'narrow' if stretch > 0.0 else 'wide'}")
    if not found and "held_95" in row:
        share = row["held_95"] * (count + row["failed"]) / count
        excess = (share - 0.95) / math.sqrt(0.95 * 0.05 / count)
        if abs(excess) > 2.0:
            found.append(
                f"the tails of the posterior are too {'long' if excess > 0.0 else 'short'}"
            )
    return " and ".join(found) or "the ranks have another shape than the uniform"


def _spread_of_shifted(mean: float) -> float:
    """Return the spread of ranks, below 1, of shifted posteriors of correct width."""
    # With normal posteriors ranks are Phi(z), z of variance one and mean sqrt(2) Phi^-1(mean);
    # their second moment is in Owen's T function (Owen 1980, Commun. Stat. B 9, 389-419).
    height = scipy.stats.norm.ppf(np.clip(mean, 1e-6, 1.0 - 1e-6))
    second = scipy.stats.norm.cdf(height) - 2.0 * scipy.special.owens_t(height, 3.0**-0.5)
    return math.sqrt(12.0 * max(second - scipy.stats.norm.cdf(height) ** 2, 0.0))


# --- Calibrations of one layout by several methods ------------------------------------------------

PASSES = "all tests pass"


def compare_calibrations(
    calibrations: Mapping[str, xr.DataTree | CalibrationView],
) -> pd.DataFrame:
    """Compare calibrations of the same parameters by several methods.

    Give all of them the same seed: they are then of the same simulations, and scores are compared
    fit by fit, which resolves far smaller differences than their means do.

    Args:
        calibrations: Each what `polar_bayes.calibrate` returns, by a name such as its method. The
            first is the baseline of the scores of the others.

    Returns:
        A row for each parameter and method: the columns of `calibration_table`, and `passes`
        (whether each of its p-values is at least 5% over the number of all tests), `deviation`
        (which tests fail, and by how much), `score_change` (ranked score over that of the first
        method, minus one: below zero is better) and `score_change_error` (its standard error). The
        change is NaN where the simulations differ; a simulation counts where both methods have an
        answer.

    Raises:
        FitError: There is none, or they are not all calibrations of the same parameters.
    """
    if not calibrations:
        raise FitError(
            "there is nothing to compare", where="compare_calibrations", hint="give calibrations"
        )
    views = {name: calibration_view(each) for name, each in calibrations.items()}
    (first, baseline), *others = views.items()
    expected = baseline.table
    for name, view in others:
        if set(view.table.index) != set(expected.index):
            what = f"it has other parameters than {first}"
            hint = "calibrate the same model on the same layout"
            raise FitError(what, where=f"compare_calibrations: {name}", hint=hint)
    level = significance_level(expected)
    rows = {}
    for scalar, _ in baseline.scalars:
        for name, view in views.items():
            row = view.table.loc[scalar.label]
            deviation = parameter_deviation(row, level)
            change, error = _score_change(view.tree, baseline.tree, scalar)
            rows[scalar.label, name] = {
                **row,
                "passes": not deviation,
                "deviation": deviation or PASSES,
                "score_change": change,
                "score_change_error": error,
            }
    found = pd.DataFrame.from_dict(rows, orient="index")
    found.index = found.index.set_names(["parameter", "method"])
    return found.astype({"answered": int, "failed": int})


def comparison_sentences(compared: pd.DataFrame) -> list[str]:
    """State which parameters fail by which method, and how, and who passes.

    Args:
        compared: Of `compare_calibrations`.

    Returns:
        First how many parameters fail by each method, then a sentence for each parameter that
        fails by any.
    """
    fails = ~compared["passes"].astype(bool)
    counts = ", ".join(
        f"{count or 'none'} {'fail' if count > 1 else 'fails'} by {method}"
        for method, count in fails.groupby(level="method", sort=False).sum().items()
    )
    parameters = compared.groupby(level="parameter", sort=False)
    sentences = [f"Of {len(parameters)} parameters {counts}."]
    for label, rows in parameters:
        if not rows["passes"].all():
            parts = (
                f"by {name} {row['deviation']} (95% intervals hold {row['held_95']:.1%})"
                for (_, name), row in rows.iterrows()
            )
            sentences.append(f"{label}: {'; '.join(parts)}.")
    return sentences


def _score_change(
    calibration: xr.DataTree, baseline: xr.DataTree, scalar: Scalar
) -> tuple[float, float]:
    """Return the relative change of the mean CRPS from the baseline, and its standard error."""

    def values(tree: xr.DataTree, group: str, name: str) -> np.ndarray:
        return tree[group][name].isel(dict(scalar.index)).to_numpy().astype(float)

    truth, base_truth = (values(each, "truth", scalar.name) for each in (calibration, baseline))
    if not np.array_equal(truth, base_truth, equal_nan=True):
        return math.nan, math.nan
    name = f"{scalar.name}_crps"
    score, base = (values(each, "marginals", name) for each in (calibration, baseline))
    both = np.isfinite(score) & np.isfinite(base)
    if both.sum() < 2 or not base[both].mean() > 0.0:
        return math.nan, math.nan
    score, base = score[both], base[both]
    with np.errstate(over="ignore", invalid="ignore"):  # by a score near zero
        ratio = score.mean() / base.mean()
        # Standard error of the ratio of two correlated means, by the delta method.
        error = np.std(score - ratio * base, ddof=1) / (base.mean() * math.sqrt(both.sum()))
    return float(ratio - 1.0), float(error)
