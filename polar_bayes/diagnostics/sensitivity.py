"""Prior against posterior, and the sensitivity of the posterior to its prior by power scaling.

`prior_inside` is the prior probability of the posterior's 95% interval: 0.95 where the data carry
no information, small where they do. Unlike a ratio of widths it is the same for a parameter and its
logarithm, and it does not take a posterior in the prior's tail for the prior. `width_left` is the
interval's width over that of the prior, `contraction` 1 - variance over prior variance. The two
sensitivities are the rates at which the posterior changes when the log priors (all together) or the
log likelihood are multiplied by a number near 1. Whether the data determine a parameter is decided
by `prior_inside` alone, and no remark contradicts it. The remark names a reading that alone knows a
parameter, such as the highlight that knows the roughness.

Source: Kallioinen et al. (2024), Statistics and Computing 34, 57 (power scaling).
"""

import math
from collections import Counter
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats

from polar_bayes.diagnostics.finding import join
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.parameters import MIN_DRAWS, SAMPLE_DIMS, Scalar
from polar_bayes.diagnostics.residuals import readings_alone, residuals_of
from polar_bayes.diagnostics.view import FitView, once
from polar_bayes.inference.result import CENTRAL_95

POWERS = (0.99, 1.01)
COLUMNS = (
    *("prior_q2.5", "prior_q97.5", "q2.5", "q97.5", "prior_inside", "width_left", "contraction"),
    *("verdict", "prior_sensitivity", "likelihood_sensitivity", "remark"),
)


@once
def sensitivity(fit: FitView) -> pd.DataFrame:
    """Return how much data and prior determine each parameter; empty for a point fit."""
    if fit.method == "point":
        return pd.DataFrame(columns=list(COLUMNS))
    groups = ("log_prior", "log_likelihood")
    weights = [_scaled_weights(total_density(fit.result, group)) for group in groups]
    alone = readings_alone(residuals_of(fit))
    rows = []
    for scalar, compared in _comparisons(fit):
        rates = [_sensitivity(scalar.draws, each) for each in weights]
        remarks = _remarks(scalar.draws, compared, *rates)
        if scalar.label in alone:
            reading, factor = alone[scalar.label]
            remarks.append(f"depends on {reading}: {factor:.1f} times as wide without it")
        rows.append([*compared, *rates, "; ".join(remarks)])
    index = pd.Index([scalar.label for scalar in fit.scalars])
    return pd.DataFrame(rows, columns=list(COLUMNS), index=index)


@once
def _comparisons(fit: FitView) -> list[tuple[Scalar, list[Any]]]:
    """Compare each parameter with its prior; the verdict is last."""
    priors = {label: scalar.draws for label, scalar in fit.prior.items()}
    return [(each, _compare(priors.get(each.label), each.draws)) for each in fit.scalars]


def _compare(prior: np.ndarray | None, posterior: np.ndarray) -> list[Any]:
    low, high = _interval(posterior)
    prior_low, prior_high = (math.nan, math.nan) if prior is None else _interval(prior)
    ends, prior_width = [prior_low, prior_high, low, high], prior_high - prior_low
    if prior is None or not np.isfinite([*ends, prior_width]).all() or not prior_width > 0.0:
        return [*ends, math.nan, math.nan, math.nan, "unknown"]
    inside = float(np.mean((prior >= low) & (prior <= high)))
    with np.errstate(all="ignore"):  # the variance of tiny numbers is zero
        contraction = 1.0 - float(np.var(posterior) / np.var(prior))
    verdict = "not determined"
    if inside <= LIMITS.partly:
        verdict = "determined" if inside <= LIMITS.determined else "partly"
    return [*ends, inside, (high - low) / prior_width, contraction, verdict]


def determination_sentences(fit: FitView) -> Iterator[str]:
    """Name the material parameters that the data determine in part or not, and what would help."""
    if fit.method == "point":
        return
    phrases = {
        "partly": "The data determine only in part: {}. There the prior still matters.",
        "not determined": "The data do not determine {}. There the interval is mostly the prior's: "
        "do not quote it as a measurement.",
    }
    material = [
        (scalar.name, found[-1]) for scalar, found in _comparisons(fit) if scalar.is_material
    ]
    total = Counter(name for name, _ in material)
    for verdict, phrase in phrases.items():
        names = Counter(name for name, judged in material if judged == verdict)
        if names:
            yield phrase.format(
                join([n if k == total[n] else f"{n} ({k} of {total[n]})" for n, k in names.items()])
            )
    full = fit.provenance.get("counts", {}).get("saturated")
    if full and not {verdict for _, verdict in material}.isdisjoint(phrases):
        yield f"Saturated readings: {full}. They tell little, so a shorter exposure may tell more."


def _interval(draws: np.ndarray) -> tuple[float, float]:
    if not draws.size or not np.isfinite(draws).all():
        return math.nan, math.nan
    low, high = np.quantile(draws, CENTRAL_95)
    return float(low), float(high)


def total_density(
    result: xr.DataTree, group: str, without: Collection[str] = ()
) -> np.ndarray | None:
    """Sum a group of log densities except for some names, (chain, draw)."""
    if group not in result.children or not result[group].data_vars:
        return None
    total: Any = 0.0
    for density in (x for name, x in result[group].data_vars.items() if name not in without):
        rest = [dim for dim in density.dims if dim not in SAMPLE_DIMS]
        total = total + density.sum(rest, skipna=False).transpose(*SAMPLE_DIMS).to_numpy()
    return np.asarray(total)


def _scaled_weights(log_density: np.ndarray | None) -> list[np.ndarray] | None:
    """Return weights of a posterior whose density is raised to each of `POWERS`."""
    if log_density is None or log_density.size < MIN_DRAWS or not np.isfinite(log_density).all():
        return None
    if np.ptp(log_density) < 1e-12:
        return None
    weights = []
    for power in POWERS:
        with np.errstate(all="ignore"):  # smoothing an extreme tail overflows inside ArviZ
            log_weight = array_stats.power_scale_lw(log_density, power, axis=(-2, -1))
        if not np.isfinite(log_weight).all():
            return None
        weight = np.exp(log_weight - log_weight.max())
        weights.append(weight / weight.sum())
    return weights


def _sensitivity(draws: np.ndarray, weights: list[np.ndarray] | None) -> float:
    if weights is None or not np.isfinite(draws).all() or not np.ptp(draws) > 0.0:
        return math.nan
    return float(array_stats.power_scale_sense(draws, *weights, *POWERS))


def _remarks(draws: np.ndarray, compared: list[Any], prior: float, likelihood: float) -> list[str]:
    prior_low, prior_high, *_, verdict = compared
    median, remarks = float(np.median(draws)), []
    if median < prior_low or median > prior_high:
        remarks.append("outside the prior's 95%")
    if prior >= LIMITS.sensitive:
        if likelihood >= LIMITS.sensitive:
            remarks.append("priors and data may conflict")
        elif verdict != "determined":
            remarks.append("depends on the priors")
    return remarks
