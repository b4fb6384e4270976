"""Replicate consistency (Birge ratio), and coverage of proxies of the truth, for real captures."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import scipy.stats
import xarray as xr

from polar_bayes.calibration.scores import significance_level
from polar_bayes.diagnostics.coverage import INTERVALS, coverage_columns
from polar_bayes.diagnostics.view import view_of
from polar_bayes.errors import FitError

MAX_DRAWS = 4000
SEED = 31


def retest(results: Sequence[xr.DataTree]) -> pd.DataFrame:
    """Replicate consistency: do fits of repeated captures scatter as their intervals predict?

    Where only the noise of the readings differs between repeats, posterior means m_i scatter about
    their common value with the posterior standard deviations s_i, and

        chi_square = sum (m_i - m)^2 / s_i^2,    m = sum(m_i / s_i^2) / sum(1 / s_i^2)

    follows the chi-square distribution with one degree of freedom less than repeats. Intervals also
    contain the uncertainty that all repeats share (the prior, one setting of the instrument):
    repeats then scatter less, and the test is conservative.

    Args:
        results: Two or more trees of `polar_bayes.fit`, of captures of the same object.

    Returns:
        A row for each parameter that every fit has: `repeats` with a finite posterior and `failed`
        ones; their weighted `mean`; `scatter`, the standard deviation of the means; `expected`, the
        root mean square of the posterior standard deviations; `ratio` of the two; `chi_square` and
        its `p_value` (small where repeats scatter more than the intervals say); `pairs` and
        `agreeing`, the share of them whose 95% interval of the difference holds zero; `conclusion`.

    Raises:
        FitError: There are fewer than two, one holds no posterior, or they share no parameter.

    Source:
        Birge (1932), Phys. Rev. 40, 207-227: internal and external consistency.
    """
    if len(results) < 2:
        raise FitError(
            "a single fit has nothing to agree with", where="retest", hint="give two or more"
        )
    found = [{each.label: each for each in view_of(result).scalars} for result in results]
    common = [label for label in found[0] if all(label in each for each in found[1:])]
    if not common:
        hint = "give fits of the same model to captures of the same layout"
        raise FitError("these fits share no parameter", where="retest", hint=hint)
    columns = "repeats failed mean scatter expected ratio chi_square p_value pairs agreeing".split()
    rows = {label: _compare([each[label].draws.ravel() for each in found]) for label in common}
    table = pd.DataFrame.from_dict(rows, orient="index").reindex(columns=columns)
    level = significance_level(table)
    table["conclusion"] = [_conclusion(row, level) for _, row in table.iterrows()]
    return table


def proxy_scores(
    results: Sequence[xr.DataTree],
    proxies: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
) -> pd.DataFrame:
    """Return the quantile of each parameter's proxy in its posterior, fit by fit.

    Args:
        results: Trees of `polar_bayes.fit`.
        proxies: Values by parameter (`refractive_index`, or one entry as `refractive_index[450]`),
            for all fits or a mapping for each; None takes the variables `true_<parameter>` of the
            captures.

    Returns:
        A row for each fit and parameter whose proxy is known: `fit` (its number), `parameter`,
        `proxy`, posterior `mean` and `sd`, `z` ((proxy - mean) / sd) and `below`, the share of the
        posterior below the proxy. Where a fit failed the last four are NaN.

    Raises:
        FitError: No proxy is known, or there is not one mapping for each fit.
    """
    given = list(proxies) if isinstance(proxies, Sequence) else [proxies] * len(results)
    if len(given) != len(results):
        what = f"{len(given)} mappings do not go with {len(results)} fits"
        raise FitError(what, where="proxies", hint="give one mapping for all fits, or one for each")
    rows = []
    for at, (result, values) in enumerate(zip(results, given, strict=True)):
        fit = view_of(result)
        for scalar in fit.scalars:
            if values is None:
                proxy = fit.truth(scalar)
            else:
                proxy = float(values.get(scalar.label, values.get(scalar.name, math.nan)))
            if math.isfinite(proxy):
                row = {"fit": at, "parameter": scalar.label, "proxy": proxy}
                rows.append(row | _position(proxy, scalar.draws.ravel()))
    if not rows:
        hint = "give values by parameter, or captures with `true_<parameter>`"
        raise FitError("no proxy is known of any parameter", where="proxies", hint=hint)
    return pd.DataFrame(rows)


def proxy_coverage(
    results: Sequence[xr.DataTree],
    proxies: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
) -> pd.DataFrame:
    """Return how often intervals of fits of real captures contain a proxy of the truth.

    A proxy, such as the index in a data sheet, has an error of its own that these numbers do not
    include: where it is as large as the intervals, coverage is below the nominal one.

    Args:
        results: As for `proxy_scores`.
        proxies: As for `proxy_scores`.

    Returns:
        A row for each parameter: `fits` whose proxy is known and the `failed` ones among them; for
        50, 80 and 95%, as `held_50`, the share of all these fits whose central interval holds the
        proxy, failed ones counted as misses, with its 95% interval `_low` and `_high` (Wilson's);
        `z_mean` and `z_rms` of the z-scores (0 and 1 where all is right).

    Raises:
        FitError: No proxy is known, or there is not one mapping for each fit.
    """
    scores = proxy_scores(results, proxies)
    rows = {}
    for label, own in scores.groupby("parameter", sort=False):
        below, z = own["below"].to_numpy(), own["z"].to_numpy()
        held = {
            percent: int(np.sum((low <= below) & (below <= high)))
            for percent, (low, high) in INTERVALS.items()
        }
        row: dict[str, float] = {"fits": len(own), "failed": int(np.isnan(below).sum())}
        row |= coverage_columns(held, len(own))
        z = z[np.isfinite(z)]
        row["z_mean"] = float(z.mean()) if z.size else math.nan
        row["z_rms"] = float(np.sqrt(np.mean(z**2))) if z.size else math.nan
        rows[label] = row
    return pd.DataFrame.from_dict(rows, orient="index").astype({"fits": int, "failed": int})


def _compare(draws: Sequence[np.ndarray]) -> dict[str, float]:
    finite = [each for each in draws if np.isfinite(each).all() and each.std() > 0.0]
    row: dict[str, float] = {"repeats": len(finite), "failed": len(draws) - len(finite), "pairs": 0}
    if len(finite) < 2:
        return row
    means = np.array([each.mean() for each in finite])
    sds = np.array([each.std(ddof=1) for each in finite])
    mean = np.sum(means / sds**2) / np.sum(1.0 / sds**2)
    chi_square = np.sum(((means - mean) / sds) ** 2)
    # As many draws of every fit, each in a random order of its own: fits are independent.
    random = np.random.default_rng(SEED)
    count = min(MAX_DRAWS, *(each.size for each in finite))
    shuffled = [random.permutation(each)[:count] for each in finite]
    agreeing = []
    for one, other in itertools.combinations(shuffled, 2):
        low, high = np.quantile(one - other, INTERVALS[95])
        agreeing.append(low <= 0.0 <= high)
    scatter, expected = means.std(ddof=1), np.sqrt(np.mean(sds**2))
    return row | {
        "mean": float(mean),
        "scatter": float(scatter),
        "expected": float(expected),
        "ratio": float(scatter / expected),
        "chi_square": float(chi_square),
        "p_value": float(scipy.stats.chi2.sf(chi_square, len(finite) - 1)),
        "pairs": len(agreeing),
        "agreeing": float(np.mean(agreeing)),
    }


def _conclusion(row: pd.Series, level: float) -> str:
    if row["repeats"] < 2:
        return "too few repeats have an answer"
    if row["p_value"] < level:
        return f"repeats scatter {row['ratio']:.1f} times more than the intervals predict"
    if row["p_value"] > 1.0 - level:
        return (
            f"repeats scatter only {row['ratio']:.2g} times as much as the intervals predict: the "
            "rest of the intervals is what all repeats share"
        )
    return "repeats scatter about as much as the intervals predict"


def _position(proxy: float, draws: np.ndarray) -> dict[str, float]:
    if not np.isfinite(draws).all() or not draws.std() > 0.0:
        return dict.fromkeys(("mean", "sd", "z", "below"), math.nan)
    mean, sd = float(draws.mean()), float(draws.std(ddof=1))
    return {
        "mean": mean,
        "sd": sd,
        "z": (proxy - mean) / sd,
        "below": float(np.mean(draws < proxy)),
    }
