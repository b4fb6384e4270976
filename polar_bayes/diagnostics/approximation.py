"""How far the draws of an approximation are from the posterior, by their importance weights.

Source: Vehtari et al. (2024), JMLR 25(72) (Pareto k).
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from polar_bayes.diagnostics.finding import listed
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.parameters import APPROXIMATIONS, Scalar
from polar_bayes.diagnostics.view import FitView, once
from polar_bayes.numerics.psis import MAX_PARETO_K, smooth


@once
def smoothed_weights(fit: FitView) -> tuple[np.ndarray, float]:
    """Return smoothed weights of approximate draws, and Pareto k; empty and NaN without weights."""
    # $$ w = p(z | data) / q(z) $$
    # Source: Vehtari et al. (2024), JMLR 25(72).
    if "log_weight" not in fit.stats or fit.method not in APPROXIMATIONS:
        return np.empty(0), math.nan
    log_weight = fit.stats["log_weight"].to_numpy().astype(float).ravel()
    if np.any(np.isnan(log_weight) | np.isposinf(log_weight)) or np.all(np.isneginf(log_weight)):
        return np.empty(0), math.nan
    if np.ptp(log_weight) < 1e-12:
        return np.full(log_weight.size, 1.0 / log_weight.size), -math.inf
    weights, pareto_k = smooth(log_weight[None])
    return weights[0], float(pareto_k[0])


def approximation_cautions(fit: FitView) -> Iterator[str]:
    """Tell in what an approximation differs from the posterior; nothing for other methods."""
    if fit.method not in APPROXIMATIONS or "log_weight" not in fit.stats:
        return
    weights, pareto_k = smoothed_weights(fit)
    if pareto_k <= MAX_PARETO_K:
        yield from _corrections(weights, fit.scalars)
    else:
        draws, shape = ("the guide's draws", "the guide")
        if fit.method == "laplace":
            draws, shape = ("the Laplace draws", "a normal distribution")
        yield (
            f"Pareto k of {draws} is {pareto_k:.2f} (at most {MAX_PARETO_K}): the posterior is "
            f"not close to {shape}; use method='nuts' for intervals."
        )


def _corrections(weights: np.ndarray, found: Sequence[Scalar]) -> Iterator[str]:
    """List means and sds of an approximation that its smoothed weights change."""
    changes = []
    for scalar in found:
        draws = scalar.draws.ravel()
        if not np.isfinite(draws).all() or not np.ptp(draws) > 0.0:
            continue
        draws = draws / np.abs(draws).max()  # squares do not vanish; shift and ratio are the same
        mean = weights @ draws
        sd = math.sqrt(weights @ (draws - mean) ** 2)
        shift, ratio = abs(mean - draws.mean()) / sd, draws.std() / sd
        if shift > LIMITS.large_correction or abs(math.log(ratio)) > LIMITS.large_correction:
            text = f"{scalar.label} (mean by {shift:.1f} sd, sd {ratio - 1.0:+.0%})"
            changes.append((shift + abs(math.log(ratio)), text))
    if changes:
        names = listed(text for _, text in sorted(changes, reverse=True))
        yield (
            f"Importance weights correct the approximation: {names}; use "
            "method='importance' or 'nuts' where that matters."
        )
