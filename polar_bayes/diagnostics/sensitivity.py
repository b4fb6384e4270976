"""What did the data say? Prior against posterior, and what a bent prior would change."""

import math
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats

from polar_bayes.diagnostics.parameters import SAMPLE_DIMS, method_of, posterior_scalars, scalars

DETERMINED = 0.5
"""Prior probability inside the posterior's 95% interval; normal ones, a third as wide, have it."""
PARTLY = 0.85
"""The same at three quarters of the width; a posterior equal to its prior has 0.95."""
SENSITIVE = 0.05
POWERS = (0.99, 1.01)
INTERVAL = (0.025, 0.975)
COLUMNS = (
    "prior_q2.5",
    "prior_q97.5",
    "q2.5",
    "q97.5",
    "prior_inside",
    "width_left",
    "contraction",
    "verdict",
    "prior_sensitivity",
    "likelihood_sensitivity",
    "remark",
)


def sensitivity(result: xr.DataTree) -> pd.DataFrame:
    """How much of each answer came from the data, and how much from the prior."""
    # `prior_inside` is the prior probability of the posterior's 95% interval: 0.95 when the data
    # said nothing, small when they did. Unlike a ratio of widths it is the same for a parameter and
    # its logarithm, and it does not mistake a posterior in the prior's tail for the prior. The
    # verdict is "determined" up to 0.5, "partly" up to 0.85, else "not determined". `width_left` is
    # the interval's width over that of the prior, `contraction` 1 - variance over prior variance.
    # The two sensitivities say how fast the posterior moves when the log priors (all together) or
    # the log likelihood are multiplied by a number near 1.
    # Source: Kallioinen et al. (2024), Statistics and Computing 34, 57 (power scaling).
    found = posterior_scalars(result)
    if method_of(result) == "point":
        return pd.DataFrame(columns=list(COLUMNS))
    before = {}
    if "prior" in result.children:
        before = {scalar.label: scalar.draws for scalar in scalars(result["prior"].to_dataset())}
    weights = {
        group: _bent_weights(_total(result, group)) for group in ("log_prior", "log_likelihood")
    }
    rows = []
    for scalar in found:
        widths = _compare(before.get(scalar.label), scalar.draws)
        bent = [_sense(scalar.draws, weights[group]) for group in weights]
        rows.append([*widths, *bent, _remark(scalar.draws, widths, *bent)])
    index = pd.Index([scalar.label for scalar in found])
    return pd.DataFrame(rows, columns=list(COLUMNS), index=index)


def _compare(prior: np.ndarray | None, posterior: np.ndarray) -> list[Any]:
    low, high = _interval(posterior)
    before = _interval(prior) if prior is not None else (math.nan, math.nan)
    widths = [before[1] - before[0], high - low]
    if prior is None or not np.isfinite(widths).all() or not widths[0] > 0.0:
        return [*before, low, high, math.nan, math.nan, math.nan, "unknown"]
    inside = float(np.mean((prior >= low) & (prior <= high)))
    with np.errstate(all="ignore"):  # the variance of huge numbers overflows
        contraction = 1.0 - float(np.var(posterior) / np.var(prior))
    word = "not determined"
    if inside <= PARTLY:
        word = "determined" if inside <= DETERMINED else "partly"
    return [*before, low, high, inside, widths[1] / widths[0], contraction, word]


def _interval(draws: np.ndarray) -> tuple[float, float]:
    if not np.isfinite(draws).all():
        return math.nan, math.nan
    low, high = np.quantile(draws, INTERVAL)
    return float(low), float(high)


def _total(result: xr.DataTree, group: str) -> np.ndarray | None:
    """The sum of a group of log densities, shape (chain, draw)."""
    if group not in result.children or not result[group].data_vars:
        return None
    total: Any = 0.0
    for density in result[group].data_vars.values():
        rest = [dim for dim in density.dims if dim not in SAMPLE_DIMS]
        total = total + density.sum(rest, skipna=False).transpose(*SAMPLE_DIMS).to_numpy()
    return np.asarray(total)


def _bent_weights(log_density: np.ndarray | None) -> list[np.ndarray] | None:
    """Importance weights of a posterior whose density is raised to each of `POWERS`."""
    if log_density is None or log_density.size < 100 or not np.isfinite(log_density).all():
        return None
    if np.ptp(log_density) < 1e-12:
        return None
    bent = []
    for power in POWERS:
        with np.errstate(all="ignore"):  # smoothing an extreme tail overflows inside ArviZ
            log_weight = array_stats.power_scale_lw(log_density, power, axis=(-2, -1))
        if not np.isfinite(log_weight).all():
            return None
        weight = np.exp(log_weight - log_weight.max())
        bent.append(weight / weight.sum())
    return bent


def _sense(draws: np.ndarray, weights: list[np.ndarray] | None) -> float:
    if weights is None or not np.isfinite(draws).all() or not np.ptp(draws) > 0.0:
        return math.nan
    return float(array_stats.power_scale_sense(draws, *weights, *POWERS))


def _remark(draws: np.ndarray, widths: list[Any], prior: float, likelihood: float) -> str:
    middle = float(np.median(draws))
    remarks = []
    if middle < widths[0] or middle > widths[1]:
        remarks.append("outside the prior's 95%")
    if prior >= SENSITIVE:
        pulled = likelihood >= SENSITIVE
        remarks.append("priors and data may pull apart" if pulled else "leans on the priors")
    return "; ".join(remarks)
