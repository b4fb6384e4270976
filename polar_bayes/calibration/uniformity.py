"""Are these numbers uniform on (0, 1)? A test that looks at the whole distribution at once."""

import functools
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float

NULLS = 9999
"""Uniform samples to which one is compared: p-values are exact multiples of a ten-thousandth."""

MOST_POINTS = 200
"""At which the empirical distribution is looked at."""

SEED = 20


class Uniformity(NamedTuple):
    """What the test says."""

    p_value: float
    mean: float
    spread: float


def uniformity(sample: Float[np.ndarray, " size"]) -> Uniformity:
    """Test a sample against the uniform distribution."""
    # The statistic is the largest surprise of the empirical distribution at any of many points,
    # each judged by its own binomial distribution: what simultaneous bands of ECDF plots are made
    # of. Its distribution is found by simulation, so the rate of false alarms at a level is that
    # level.
    # Source: Saeilynoja, Buerkner & Vehtari (2022), Stat. Comput. 32, 32.
    observed = _surprise(sample[None])[0]
    null = null_statistics(len(sample))
    p_value = (1 + np.searchsorted(null, observed, side="right")) / (1 + NULLS)
    return Uniformity(float(p_value), float(sample.mean()), float(sample.std() * 12.0**0.5))


def _surprise(samples: Float[np.ndarray, "sample size"]) -> Float[np.ndarray, " sample"]:
    """Smallest two-sided binomial p-value of each empirical distribution."""
    count = samples.shape[-1]
    points = min(count, MOST_POINTS)
    cell = np.minimum((samples * points).astype(int), points - 1)
    held = np.zeros((len(samples), points), int)
    np.add.at(held, (np.arange(len(samples))[:, None], cell), 1)
    below = np.cumsum(held, axis=-1)[:, :-1]
    return two_sided(count, points)[below, np.arange(points - 1)].min(axis=-1)


@functools.lru_cache(maxsize=4)
def two_sided(count: int, points: int) -> Float[np.ndarray, "outcome point"]:
    """Two-sided p-values of every count below every point."""
    share = np.arange(1, points) / points
    outcome = np.arange(count + 1)[:, None]
    low = scipy.stats.binom.cdf(outcome, count, share)
    high = scipy.stats.binom.sf(outcome - 1, count, share)
    return np.minimum(1.0, 2.0 * np.minimum(low, high))


@functools.lru_cache(maxsize=4)
def null_statistics(count: int) -> Float[np.ndarray, " null"]:
    """Statistics of uniform samples, in ascending order."""
    random = np.random.default_rng(SEED)
    found = [
        _surprise(random.random((part, count)))
        for part in np.diff(np.linspace(0, NULLS, 11).astype(int))
    ]
    return np.sort(np.concatenate(found))
