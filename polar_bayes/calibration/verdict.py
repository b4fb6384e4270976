"""What a calibration says, as a table and in words."""

import math

import numpy as np
import pandas as pd
import scipy.special
import scipy.stats
import xarray as xr

from polar_bayes.calibration.files import check_calibration
from polar_bayes.calibration.joint import FALSE_ALARMS, is_calibrated, which_stray
from polar_bayes.calibration.prediction import readings_verdict
from polar_bayes.calibration.uniformity import uniformity
from polar_bayes.diagnostics.coverage import INTERVALS
from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.errors import FitError
from polar_bayes.pixels.outcome import Status

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
            mend="give what polar_bayes.calibrate returned",
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
            "the model. Another method or longer chains may do; chains of a fit (pb.Nuts()) are "
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
