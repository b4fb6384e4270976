"""How well chains have mixed, number by number."""

from typing import NamedTuple

import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Float

TAILS = (0.05, 0.95)


class Mixing(NamedTuple):
    """Of every coordinate."""

    bulk: Float[np.ndarray, " coordinate"]
    tail: Float[np.ndarray, " coordinate"]
    r_hat: Float[np.ndarray, " coordinate"]


def measure(draws: Float[np.ndarray, "coordinate chain draw"]) -> Mixing:
    """Effective sample sizes and R-hat, which monotone maps of a coordinate do not change."""
    # Source: Vehtari et al. (2021), Bayesian Analysis 16(2).
    return Mixing(
        bulk=np.array([array_stats.ess(x, method="bulk") for x in draws]),
        tail=np.array([array_stats.ess(x, method="tail", prob=TAILS) for x in draws]),
        r_hat=np.array([array_stats.rhat(x) for x in draws]),
    )


def standard_errors(
    draws: Float[np.ndarray, "coordinate chain draw"],
) -> tuple[np.ndarray, np.ndarray]:
    """Monte Carlo standard errors of mean and standard deviation, in standard deviations."""
    # Source: Vehtari et al. (2021), Bayesian Analysis 16(2).
    sd = draws.reshape(len(draws), -1).std(axis=-1)
    with np.errstate(all="ignore"):
        return (
            np.array([array_stats.mcse(x, method="mean") for x in draws]) / sd,
            np.array([array_stats.mcse(x, method="sd") for x in draws]) / sd,
        )
