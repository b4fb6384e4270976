"""What a calibration says, as a table and in words."""

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
import scipy.special
import scipy.stats
import xarray as xr

from polar_bayes.calibration.files import check_calibration
from polar_bayes.calibration.predictive import readings_verdict
from polar_bayes.calibration.scores import (
    FALSE_ALARMS,
    is_calibrated,
    limit_of,
    uniformity,
    which_stray,
)
from polar_bayes.diagnostics.coverage import INTERVALS
from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.errors import FitError
from polar_bayes.inference.batch_result import Status

MOST = 0.5
"""Share of fits that are not trusted above which their ranks say nothing of the model."""


def calibration_table(calibration: xr.DataTree) -> pd.DataFrame:
    """One row for each parameter of a calibration.

    Args:
        calibration: What `polar_bayes.calibrate` returns.

    Returns:
        Columns `answered` and `failed` (fits); `p_value` of uniform ranks; `rank_mean` (a half
        where the posterior is neither too high nor too low) and `rank_spread` (one where it is
        neither too narrow, above, nor too wide); for 50, 80 and 95%, as `held_50`, the share of all
        fits whose interval holds the truth, failed ones counted as misses, with its 95% interval
        `_low` and `_high` (Wilson's); `width_95`, mean width of the 95% interval; `crps`, mean
        ranked score.

    Raises:
        FitError: It is no calibration.
    """
    found = calibration_scalars(calibration, "prior_sbc")
    truths = {each.label: each.draws[0] for each in calibration_scalars(calibration, "truth")}
    marginals = calibration["marginals"].to_dataset()
    if any(each.label not in truths for each in found):
        raise FitError(
            "its labels are not those of prior_sbc",
            where="calibration: truth",
            hint="give what polar_bayes.calibrate returned",
        )
    rows = {each.label: _row(each, truths[each.label], marginals) for each in found}
    return pd.DataFrame.from_dict(rows, orient="index")


def calibration_verdict(calibration: xr.DataTree) -> list[str]:
    """What a calibration says, in sentences.

    Args:
        calibration: What `polar_bayes.calibrate` returns.

    Returns:
        First whether the ranks pass, then each parameter that does not and how it strays, then the
        fits that failed (and a word where most are not trusted), then what the readings say, which
        are judged by themselves.

    Raises:
        FitError: It is no calibration.
    """
    table = calibration_table(calibration)
    passed = is_calibrated(table)
    count = int(table["answered"].max() + table["failed"].min())
    said = [
        f"{'Calibrated' if passed else 'Not calibrated'}: the ranks of {len(table)} parameters in "
        f"{count} simulations {'pass' if passed else 'fail'} a joint test that a right method "
        f"fails {FALSE_ALARMS:.0%} of the time."
    ]
    said += which_stray(table, how_ranks_stray)
    statuses = calibration["fits"]["status"].to_numpy()
    for status in Status:
        lost = int(np.sum(statuses == status))
        if status != Status.GOOD and lost:
            said.append(f"{lost} of {statuses.size} fits: {status.name.lower().replace('_', ' ')}.")
    if np.mean(statuses == Status.NOT_TRUSTED) > MOST:
        said.append(
            "Most fits say themselves that they cannot be trusted: the ranks judge the method, not "
            "the model. Another method or longer chains may do; chains of a fit (pb.methods.Nuts()) are "
            "the slowest and the surest."
        )
    return said + readings_verdict(calibration)


def how_ranks_stray(row: pd.Series) -> str:
    """In which way the ranks of a parameter stray."""
    count = row["answered"]
    if count < 2:
        return "fewer than two fits have an answer"
    shift = (row["rank_mean"] - 0.5) * math.sqrt(12.0 * count)
    usual = _spread_at(row["rank_mean"])
    stretch = (row["rank_spread"] - usual) * math.sqrt(5.0 * count)  # sd of the spread: 1/sqrt(5 n)
    ways = []
    if abs(shift) > 2.5:
        ways.append("the posterior is too low" if shift > 0.0 else "the posterior is too high")
    if abs(stretch) > 2.5:
        ways.append("intervals are too narrow" if stretch > 0.0 else "intervals are too wide")
    if not ways:
        share = row["held_95"] * (count + row["failed"]) / count
        beyond = (share - 0.95) / math.sqrt(0.95 * 0.05 / count)
        if abs(beyond) > 2.0:
            ways.append(f"the tails of the posterior are too {'long' if beyond > 0.0 else 'short'}")
    return " and ".join(ways) or "the ranks have another shape than the uniform"


def _spread_at(mean: float) -> float:
    """Spread of the ranks where posteriors are shifted and no more: it presses them together."""
    # With normal posteriors ranks are Phi(z), z of variance one and mean sqrt(2) Phi^-1(mean);
    # their second moment is in Owen's T function (Owen 1980, Commun. Stat. B 9, 389-419).
    height = scipy.stats.norm.ppf(np.clip(mean, 1e-6, 1.0 - 1e-6))
    second = scipy.stats.norm.cdf(height) - 2.0 * scipy.special.owens_t(height, 3.0**-0.5)
    return math.sqrt(12.0 * max(second - scipy.stats.norm.cdf(height) ** 2, 0.0))


def calibration_scalars(calibration: xr.DataTree, group: str) -> list[Scalar]:
    """Every scalar of `prior_sbc` or `truth`, with simulations in place of draws."""
    check_calibration(calibration)
    dataset = calibration[group].to_dataset()
    return scalars(dataset.rename(simulation="draw").expand_dims("chain"))


def _row(scalar: Scalar, truth: np.ndarray, marginals: xr.Dataset) -> dict[str, float]:
    pit = scalar.draws[0]
    answered = pit[np.isfinite(pit)]
    where = dict(scalar.index)
    told = uniformity(answered) if answered.size > 1 else (math.nan,) * 3
    row = {
        "answered": answered.size,
        "failed": pit.size - answered.size,
        **dict(zip(("p_value", "rank_mean", "rank_spread"), told, strict=True)),
    }
    bounds = marginals[f"{scalar.name}_quantile"].isel(where)
    for percent, (low, high) in INTERVALS.items():
        least, most = (bounds.sel(quantile=level).to_numpy() for level in (low, high))
        held = int(np.sum((least <= truth) & (truth <= most)))
        sure = scipy.stats.binomtest(held, pit.size).proportion_ci(0.95, method="wilson")
        row[f"held_{percent}"] = held / pit.size
        row[f"held_{percent}_low"], row[f"held_{percent}_high"] = sure.low, sure.high
    row["width_95"] = _mean(most - least)
    row["crps"] = _mean(marginals[f"{scalar.name}_crps"].isel(where).to_numpy())
    return row


def _mean(values: np.ndarray) -> float:
    """Of the fits that have an answer."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


# --- Calibrations of one layout by several methods, side by side ----------------------------------


PASSES = "the ranks pass"


def compare_calibrations(calibrations: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    """Calibrations of the same parameters, side by side.

    Give all of them the same seed: they are then of the same simulations, and scores are compared
    fit by fit, which tells far smaller differences than their means do.

    Args:
        calibrations: Each what `polar_bayes.calibrate` returns, by a name such as its method. The
            first is what the scores of the others are compared with.

    Returns:
        A row for each parameter and method: the columns of `calibration_table`, and `passes`
        (whether its p-value is at least 5% over the number of parameters), `ways` (in words, how
        its ranks stray), `score_change` (ranked score over that of the first method, minus one:
        below zero is better) and `score_change_error` (its standard error). The change is NaN
        where the simulations differ; a simulation counts where both methods have an answer.

    Raises:
        FitError: There is none, or they are not all calibrations of the same parameters.
    """
    if not calibrations:
        raise FitError(
            "there is nothing to compare", where="compare_calibrations", hint="give calibrations"
        )
    tables = {name: calibration_table(each) for name, each in calibrations.items()}
    (first, expected), *others = tables.items()
    for name, table in others:
        if set(table.index) != set(expected.index):
            raise FitError(
                f"it has other parameters than {first}",
                where=f"compare_calibrations: {name}",
                hint="calibrate the same model on the same layout",
            )
    limit = limit_of(expected)
    rows = {}
    for scalar in calibration_scalars(calibrations[first], "truth"):
        for name, calibration in calibrations.items():
            row = tables[name].loc[scalar.label]
            passes = bool(row["p_value"] >= limit)
            change, error = _score_change(calibration, calibrations[first], scalar)
            rows[scalar.label, name] = {
                **row,
                "passes": passes,
                "ways": PASSES if passes else how_ranks_stray(row),
                "score_change": change,
                "score_change_error": error,
            }
    found = pd.DataFrame.from_dict(rows, orient="index")
    found.index = found.index.set_names(["parameter", "method"])
    return found.astype({"answered": int, "failed": int})


def comparison_sentences(compared: pd.DataFrame) -> list[str]:
    """Which parameters fail by which method, how, and what the other methods make of them.

    Args:
        compared: Of `compare_calibrations`.

    Returns:
        First how many parameters fail by each method, then a sentence for each parameter that
        fails by any.

    Raises:
        Nothing.
    """
    methods = list(compared.index.get_level_values("method").unique())
    labels = list(compared.index.get_level_values("parameter").unique())
    fails = {
        method: int((~compared.xs(method, level="method")["passes"].astype(bool)).sum())
        for method in methods
    }
    counts = ", ".join(
        f"{count or 'none'} {'fail' if count > 1 else 'fails'} by {method}"
        for method, count in fails.items()
    )
    said = [f"Of {len(labels)} parameters {counts}."]
    for label in labels:
        own = compared.loc[label]
        if not own["passes"].all():
            ways = "; ".join(f"by {method} {_way(row)}" for method, row in own.iterrows())
            said.append(f"{label}: {ways}.")
    return said


def _way(row: pd.Series) -> str:
    chance = "" if row["passes"] or row["answered"] < 2 else f"p = {row['p_value']:.2g}, "
    return f"{row['ways']} ({chance}95% intervals hold {row['held_95']:.1%})"


def _score_change(
    calibration: xr.DataTree, first: xr.DataTree, scalar: Scalar
) -> tuple[float, float]:
    """Mean ranked score over that of the first, minus one, and its standard error."""
    own, other = (_of(each, "truth", scalar.name, scalar) for each in (calibration, first))
    if own.shape != other.shape or not np.array_equal(own, other, equal_nan=True):
        return math.nan, math.nan
    score, base = (
        _of(each, "marginals", f"{scalar.name}_crps", scalar) for each in (calibration, first)
    )
    both = np.isfinite(score) & np.isfinite(base)
    if both.sum() < 2 or not base[both].mean() > 0.0:
        return math.nan, math.nan
    score, base = score[both], base[both]
    ratio = score.mean() / base.mean()
    # The ratio of two means that go together, by the delta method.
    error = np.std(score - ratio * base, ddof=1) / (base.mean() * math.sqrt(both.sum()))
    return float(ratio - 1.0), float(error)


def _of(tree: xr.DataTree, group: str, name: str, scalar: Scalar) -> np.ndarray:
    return tree[group][name].isel(dict(scalar.index)).to_numpy().astype(float)
