"""How well chains have mixed, number by number."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
import scipy.stats
from arviz_stats.base import array_stats
from jaxtyping import Float

from polar_bayes.inference.compile import TRACING_LOCK
from polar_bayes.inference.method import PosteriorDraws
from polar_bayes.inference.program import Program, parameters_of
from polar_bayes.observation.data import Observations

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


# --- How far means and standard deviations may be off, as the draws themselves tell ---------------


FALSE_ALARMS = 0.01
"""How often some mean or standard deviation of one fit may stray further than expected."""


def expected_error(answer: PosteriorDraws, program: Program, data: Observations) -> float:
    """The largest error of a mean or a standard deviation that Monte Carlo noise can make."""
    # In posterior standard deviations, over all parameters, exceeded in 1% of the fits: each of the
    # 2P standard errors times the normal quantile of 0.5% / (2P) (Bonferroni). Bias is not seen
    # here.
    mean, sd = errors_of(answer, lambda z: scalars_of(program, z, data))
    errors = np.concatenate([mean, sd])
    if not np.isfinite(errors).all():
        return float("inf")
    return float(errors.max() * quantile(len(errors)))


def errors_of(
    answer: PosteriorDraws, describe: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Monte Carlo standard errors of means and standard deviations, in standard deviations."""
    mean, sd = standard_errors(describe(answer.z))
    if answer.weighted is None:
        return mean, sd
    z, weights = answer.weighted
    weighted = _of_weighted(describe(z[None])[:, 0], weights)
    # What is lost by choosing is at most what as many independent draws would lose.
    return np.hypot(weighted[0], mean), np.hypot(weighted[1], sd)


def quantile(count: int) -> float:
    """Standard errors within which so many numbers stay together, but in 1% of the fits."""
    return float(scipy.stats.norm.isf(0.5 * FALSE_ALARMS / count))


def draws_needed(tolerance: float, count: int) -> int:
    """Independent draws after which the expected error is below a tolerance, parameters normal."""
    return int(np.ceil((quantile(2 * count) / tolerance) ** 2))


def scalars_of(program: Program, z: np.ndarray, data: Observations) -> np.ndarray:
    """Every number that a model estimates, (scalar, chain, draw)."""
    found = parameters_of(program, z.astype(data.brightness.dtype), data)
    flat = [np.asarray(x, float).reshape(*np.shape(x)[:2], -1) for x in found.values()]
    return np.moveaxis(np.concatenate(flat, axis=-1), -1, 0)


def count_scalars(program: Program, data: Observations) -> int:
    """How many numbers a model estimates."""
    z = jax.ShapeDtypeStruct((program.size,), data.brightness.dtype)
    with TRACING_LOCK:
        found = jax.eval_shape(program.parameters, z, data)
    return sum(int(np.prod(x.shape)) for x in jax.tree.leaves(found))


def _of_weighted(draws: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors of self-normalized weighted draws, in their standard deviations."""
    # Source: Owen (2013), Monte Carlo theory, methods and examples, section 9.2: the delta method.
    apart = draws - (draws @ weights)[:, None]
    variance = apart**2 @ weights
    with np.errstate(all="ignore"):
        mean = np.sqrt(apart**2 @ weights**2 / variance)
        sd = np.sqrt((apart**2 - variance[:, None]) ** 2 @ weights**2) / (2.0 * variance)
    return mean, sd
