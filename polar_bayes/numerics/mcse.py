"""Effective sample sizes, R-hat and Monte Carlo standard errors of draws.

Source:
    Vehtari, Gelman, Simpson, Carpenter & Buerkner (2021), Bayesian Analysis 16(2), 667-718.
"""

from typing import NamedTuple

import numpy as np
import scipy.stats
from arviz_stats.base import array_stats
from jaxtyping import Float

LARGEST_R_HAT, SMALLEST_ESS = 1.01, 400
"""Limits beyond which chains have not converged."""

TAILS = (0.05, 0.95)
"""Quantiles whose effective sample sizes are the tail ESS."""

FALSE_ALARMS = 0.01
"""Share of fits in which some mean or standard deviation may deviate more than expected."""


class Mixing(NamedTuple):
    """R-hat and effective sample sizes, one row per coordinate."""

    bulk: Float[np.ndarray, " coordinate"]
    tail: Float[np.ndarray, " coordinate"]
    r_hat: Float[np.ndarray, " coordinate"]


def measure(draws: Float[np.ndarray, "coordinate chain draw"]) -> Mixing:
    """Compute effective sample sizes and R-hat, which monotone maps do not change."""
    return Mixing(
        bulk=np.array([array_stats.ess(x, method="bulk") for x in draws]),
        tail=np.array([array_stats.ess(x, method="tail", prob=TAILS) for x in draws]),
        r_hat=np.array([array_stats.rhat(x) for x in draws]),
    )


def standard_errors(
    draws: Float[np.ndarray, "coordinate chain draw"],
) -> tuple[np.ndarray, np.ndarray]:
    """Return Monte Carlo standard errors of mean and sd, in posterior sds."""
    sd = draws.reshape(len(draws), -1).std(axis=-1)
    with np.errstate(all="ignore"):
        return (
            np.array([array_stats.mcse(x, method="mean") for x in draws]) / sd,
            np.array([array_stats.mcse(x, method="sd") for x in draws]) / sd,
        )


def weighted_standard_errors(
    draws: Float[np.ndarray, "coordinate draw"], weights: Float[np.ndarray, " draw"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return Monte Carlo standard errors of self-normalized weighted draws."""
    # Source: Owen (2013), Monte Carlo theory, methods and examples, section 9.2: the delta method.
    apart = draws - (draws @ weights)[:, None]
    variance = apart**2 @ weights
    with np.errstate(all="ignore"):
        mean = np.sqrt(apart**2 @ weights**2 / variance)
        sd = np.sqrt((apart**2 - variance[:, None]) ** 2 @ weights**2) / (2.0 * variance)
    return mean, sd


def largest_error(mean: np.ndarray, sd: np.ndarray) -> float:
    """Return the error of a mean or sd that 1% of fits exceed, from standard errors."""
    # Each of the 2P standard errors times the normal quantile of 0.5% / (2P) (Bonferroni). Bias
    # is not seen here.
    errors = np.concatenate([mean, sd])
    if not np.isfinite(errors).all():
        return float("inf")
    return float(errors.max() * quantile(len(errors)))


def quantile(count: int) -> float:
    """Return the number of standard errors that 99% of the largest of so many errors stay below."""
    return float(scipy.stats.norm.isf(0.5 * FALSE_ALARMS / count))


def draws_needed(tolerance: float, count: int) -> int:
    """Return independent draws that reach a tolerance, for normal parameters."""
    return int(np.ceil((quantile(2 * count) / tolerance) ** 2))
