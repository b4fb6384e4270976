"""Simulation-based calibration: PIT and CRPS of the truth; tests of ranks, coverage and spread.

Source: Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788 (ranks); Gneiting &
Raftery (2007), JASA 102, 359-378 (CRPS); Saeilynoja, Buerkner & Vehtari (2022), Stat. Comput. 32,
32 (simultaneous bands of the empirical distribution).
"""

import functools
import math
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy.special
import scipy.stats
from jaxtyping import Float

from polar_bayes.inference.program import Values
from polar_bayes.numerics.psis import weighted_ess


class PitCrps:
    """PIT and CRPS of every parameter, filled in fit by fit; NaN where a fit has failed."""

    def __init__(self, truth: Values, numbers: np.ndarray, seed: int) -> None:
        self._truth = {name: np.asarray(truth[name], float) for name in sorted(truth)}
        generators = [np.random.default_rng([seed, number]) for number in numbers]
        self._uniform = {
            name: np.array([each.random(x.shape[1:]) for each in generators])
            for name, x in self._truth.items()
        }
        self.pit = {name: np.full(x.shape, np.nan) for name, x in self._truth.items()}
        self.crps = {name: np.full(x.shape, np.nan) for name, x in self._truth.items()}

    def describe(self, at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        """Fill in the fits at some positions from their weighted draws."""
        for name, truth in self._truth.items():
            draws = np.asarray(parameters[name], float)
            for entry in np.ndindex(truth.shape[1:]):
                index = (at, *entry)
                sample = draws[(..., *entry)], weights, truth[index]
                self.pit[name][index] = randomized_pit(*sample, self._uniform[name][index])
                self.crps[name][index] = crps(*sample)


def randomized_pit(
    draws: Float[np.ndarray, "fit draw"],
    weights: Float[np.ndarray, "fit draw"],
    value: Float[np.ndarray, " fit"],
    uniform: Float[np.ndarray, " fit"],
    count: int | None = None,
) -> Float[np.ndarray, " fit"]:
    """Return the weighted share of draws below each value, randomized over ties and gaps."""
    # The gap is as wide as between `count` draws of equal weight, by default as many as the weights
    # are worth: where a value is one more draw of the same distribution, this has the variance of a
    # uniform number, however few they are.
    below = np.sum(weights * (draws < value[:, None]), axis=-1)
    tied = np.sum(weights * (draws == value[:, None]), axis=-1)
    number = weighted_ess(weights) if count is None else count
    return (number * (below + uniform * tied) + uniform) / (number + 1)


def crps(
    draws: Float[np.ndarray, "fit draw"],
    weights: Float[np.ndarray, "fit draw"],
    value: Float[np.ndarray, " fit"],
) -> Float[np.ndarray, " fit"]:
    """Continuous ranked probability score of each fit, E|X - value| - E|X - X'| / 2."""
    order = np.argsort(draws, axis=-1)
    ranked = np.take_along_axis(draws, order, axis=-1)
    share = np.take_along_axis(weights, order, axis=-1)
    spread = np.sum(share * ranked * (2.0 * np.cumsum(share, axis=-1) - share - 1.0), axis=-1)
    return np.sum(share * np.abs(ranked - value[:, None]), axis=-1) - spread


# --- Test of uniformity, with the band of the empirical distribution that belongs to it -----------

NULL_SAMPLES = 9999
"""Uniform samples that give the null distribution: p-values are multiples of a ten-thousandth."""

MAX_POINTS = 200
"""Largest number of points at which the empirical distribution is evaluated."""

SEED = 20


class Uniformity(NamedTuple):
    """Result of a test of uniformity, with mean and relative spread (1 if uniform)."""

    p_value: float
    mean: float
    spread: float


def uniformity(sample: Float[np.ndarray, " size"]) -> Uniformity:
    """Test a sample against the uniform distribution; NaN for fewer than two values."""
    # The statistic is the smallest of the two-sided binomial p-values of the empirical distribution
    # at many points. Its null distribution is simulated, so that the rate of false alarms is the
    # level, and a curve leaves `ecdf_band` exactly where the test fails at that level.
    if sample.size < 2:
        return Uniformity(math.nan, math.nan, math.nan)
    null = null_statistics(len(sample))
    rank = 1 + np.searchsorted(null, _smallest_p_value(sample[None])[0], side="right")
    spread = sample.std() * 12.0**0.5
    return Uniformity(float(rank / (1 + NULL_SAMPLES)), float(sample.mean()), float(spread))


def _smallest_p_value(samples: Float[np.ndarray, "sample size"]) -> Float[np.ndarray, " sample"]:
    count = samples.shape[-1]
    points = min(count, MAX_POINTS)
    cell = np.clip(samples * points, 0, points - 1).astype(int)  # an edited file may hold others
    histogram = np.zeros((len(samples), points), int)
    np.add.at(histogram, (np.arange(len(samples))[:, None], cell), 1)
    below = np.cumsum(histogram, axis=-1)[:, :-1]
    return binomial_p_values(count, points)[below, np.arange(points - 1)].min(axis=-1)


@functools.lru_cache(maxsize=4)
def binomial_p_values(count: int, points: int) -> Float[np.ndarray, "outcome point"]:
    """Two-sided p-values of every number of values below every point."""
    share = np.arange(1, points) / points
    outcome = np.arange(count + 1)[:, None]
    low = scipy.stats.binom.cdf(outcome, count, share)
    high = scipy.stats.binom.sf(outcome - 1, count, share)
    return np.minimum(1.0, 2.0 * np.minimum(low, high))


@functools.lru_cache(maxsize=4)
def null_statistics(count: int) -> Float[np.ndarray, " null"]:
    """Return ascending statistics of uniform samples of this size."""
    random = np.random.default_rng(SEED)
    sizes = np.diff(np.linspace(0, NULL_SAMPLES, 11).astype(int))  # in parts, to save memory
    return np.sort(np.concatenate([_smallest_p_value(random.random((n, count))) for n in sizes]))


class EcdfBand(NamedTuple):
    """Simultaneous band of the empirical distribution of a uniform sample, minus the uniform."""

    at: Float[np.ndarray, " point"]
    lower: Float[np.ndarray, " point"]
    upper: Float[np.ndarray, " point"]


def ecdf_band(count: int, level: float) -> EcdfBand:
    """Return the band that a curve leaves exactly if `uniformity` has a p-value below `level`."""
    table = binomial_p_values(count, min(count, MAX_POINTS))
    # A p-value is (1 + null statistics up to the observed one) / (1 + NULL_SAMPLES): below the
    # level are the observed statistics that are smaller than the null statistic of this rank.
    rank = max(math.ceil(round(level * (1 + NULL_SAMPLES), 6)) - 2, 0)
    inside = table >= null_statistics(count)[rank]
    at = np.arange(1, table.shape[1] + 1) / (table.shape[1] + 1)
    lowest = inside.argmax(axis=0) / count
    highest = 1.0 - inside[::-1].argmax(axis=0) / count
    return EcdfBand(
        np.concatenate([[0.0], at, [1.0]]), np.pad(lowest - at, 1), np.pad(highest - at, 1)
    )


def histogram_band(count: int, bins: int, level: float = 0.05) -> tuple[float, float]:
    """Return densities that bound all bars of a uniform sample's histogram (Bonferroni)."""
    tail = level / (2 * bins)
    low, high = scipy.stats.binom.ppf([tail, 1.0 - tail], count, 1.0 / bins)
    return float(low) * bins / count, float(high) * bins / count


# --- Coverage and spread --------------------------------------------------------------------------


def coverage_p_value(held: int, count: int, share: float) -> float:
    """Two-sided exact binomial test of the coverage of intervals; NaN without intervals."""
    return float(scipy.stats.binomtest(held, count, share).pvalue) if count else math.nan


def spread_of_scores(pit: Float[np.ndarray, " size"]) -> tuple[float, float]:
    """p-value and standard deviation of normal scores of PIT values; NaN for fewer than two.

    Of right posteriors it is 1: it is the scatter of the truths over the posterior's width.
    """
    # A normal score is (truth - mean) / sd where the posterior is normal. Of any other posterior it
    # is standard normal all the same, so the test is exact, and no tail of a posterior upsets it.
    if pit.size < 2:
        return math.nan, math.nan
    scores = scipy.special.ndtri(np.clip(pit, 1e-12, 1.0 - 1e-12))
    freedom = len(scores) - 1
    chi_square = freedom * float(np.var(scores, ddof=1))
    tails = scipy.stats.chi2.cdf(chi_square, freedom), scipy.stats.chi2.sf(chi_square, freedom)
    return min(1.0, 2.0 * float(min(tails))), math.sqrt(chi_square / freedom)


# --- Several p-values as one test -----------------------------------------------------------------

FALSE_ALARMS = 0.05
"""Largest probability that a correct model, prior, link and method fail a joint test."""


TESTS = ("p_value", "p_held_50", "p_held_80", "p_held_95", "p_spread")
"""Columns of p-values: uniformity of ranks, coverage of intervals, and spread."""


def p_values(table: pd.DataFrame) -> pd.DataFrame:
    """Return all p-values of a table: five per parameter, one per reading."""
    return table[[test for test in TESTS if test in table]]


def significance_level(table: pd.DataFrame) -> float:
    """Return the level of each single test: the false-alarm rate over the number of tests."""
    return FALSE_ALARMS / p_values(table).size


def is_calibrated(table: pd.DataFrame) -> bool:
    """Return whether all tests pass jointly, at most 5% of which are false alarms.

    Args:
        table: Of `calibration_table`, or of `calibration_readings`, which are judged by their ranks
            alone.

    Returns:
        False where the smallest p-value is below 5% over the number of tests (Bonferroni), or a row
        has none, with fewer than two fits that have an answer.
    """
    return bool((p_values(table) >= significance_level(table)).all(axis=None))
