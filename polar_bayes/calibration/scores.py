"""Where the truth stands among the draws of its posterior."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy.stats
from jaxtyping import Float

from polar_bayes.inference.program import Values


class PitCrps:
    """Probability integral transforms and scores, filled in as fits come: NaN without an answer."""

    # Source: Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788; Gneiting &
    # Raftery (2007), JASA 102, 359-378, eq. 21.

    def __init__(self, truth: Values, numbers: np.ndarray, seed: int) -> None:
        self._truth = {name: np.asarray(truth[name], float) for name in sorted(truth)}
        random = [np.random.default_rng([seed, number]) for number in numbers]
        self._chance = {
            name: np.array([each.random(x.shape[1:]) for each in random])
            for name, x in self._truth.items()
        }
        self.pit = {name: np.full(x.shape, np.nan) for name, x in self._truth.items()}
        self.crps = {name: np.full(x.shape, np.nan) for name, x in self._truth.items()}

    def describe(self, at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        """Take down some fits."""
        for name, truth in self._truth.items():
            draws = np.asarray(parameters[name], float)
            for own in np.ndindex(truth.shape[1:]):
                place = (at, *own)
                told = draws[(..., *own)], weights, truth[place]
                self.pit[name][place] = share_below(*told, self._chance[name][place])
                self.crps[name][place] = ranked_score(*told)


def share_below(
    draws: Float[np.ndarray, "fit draw"],
    weights: Float[np.ndarray, "fit draw"],
    truth: Float[np.ndarray, " fit"],
    chance: Float[np.ndarray, " fit"],
) -> Float[np.ndarray, " fit"]:
    """Share of each posterior below the truth, spread evenly over the gap in which it falls."""
    below = np.sum(weights * (draws < truth[:, None]), axis=-1)
    tied = np.sum(weights * (draws == truth[:, None]), axis=-1)
    count = draws.shape[-1]
    return (count * (below + chance * tied) + chance) / (count + 1)


def ranked_score(
    draws: Float[np.ndarray, "fit draw"],
    weights: Float[np.ndarray, "fit draw"],
    truth: Float[np.ndarray, " fit"],
) -> Float[np.ndarray, " fit"]:
    """E|X - truth| - E|X - X'| / 2 of every fit."""
    order = np.argsort(draws, axis=-1)
    ranked = np.take_along_axis(draws, order, axis=-1)
    share = np.take_along_axis(weights, order, axis=-1)
    spread = np.sum(share * ranked * (2.0 * np.cumsum(share, axis=-1) - share - 1.0), axis=-1)
    return np.sum(share * np.abs(ranked - truth[:, None]), axis=-1) - spread


# --- Are these numbers uniform on (0, 1)? A test that looks at the whole distribution at once -----


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


# --- How far the ranks of a right method stray: bands of ECDFs, and of histograms -----------------


class EcdfBand(NamedTuple):
    """Empirical distributions of uniform samples, minus the uniform one."""

    at: Float[np.ndarray, " point"]
    lower: Float[np.ndarray, " point"]
    upper: Float[np.ndarray, " point"]


def ecdf_band(count: int, level: float) -> EcdfBand:
    """The band that a curve leaves exactly where `uniformity` has a p-value below the level."""
    # Source: Saeilynoja, Buerkner & Vehtari (2022), Stat. Comput. 32, 32.
    table = two_sided(count, min(count, MOST_POINTS))
    # A p-value is (1 + null samples at least as surprising) / (1 + NULLS): below the level are
    # those that surprise more than the null sample of this rank.
    rank = max(math.ceil(round(level * (1 + NULLS), 6)) - 2, 0)
    inside = table >= null_statistics(count)[rank]
    at = np.arange(1, table.shape[1] + 1) / (table.shape[1] + 1)
    lowest = inside.argmax(axis=0) / count
    highest = 1.0 - inside[::-1].argmax(axis=0) / count
    ends = [0.0]
    return EcdfBand(
        np.concatenate([ends, at, [1.0]]),
        np.concatenate([ends, lowest - at, ends]),
        np.concatenate([ends, highest - at, ends]),
    )


def histogram_band(count: int, bins: int, level: float = 0.05) -> tuple[float, float]:
    """How high the bars of a uniform histogram are."""
    tail = level / (2 * bins)
    low, high = scipy.stats.binom.ppf([tail, 1.0 - tail], count, 1.0 / bins)
    return float(low) * bins / count, float(high) * bins / count


# --- One test of several p-values together, and the sentences of those that stray -----------------


FALSE_ALARMS = 0.05
"""How often a right model, prior, link and method fail a joint test, at most."""


def limit_of(table: pd.DataFrame) -> float:
    """The p-value below which a row strays: the false-alarm rate over the number of rows."""
    return FALSE_ALARMS / len(table)


def is_calibrated(table: pd.DataFrame) -> bool:
    """Whether ranks pass the joint test, at a rate of false alarms of at most 5%.

    Args:
        table: Of `calibration_table`, or of `calibration_readings`.

    Returns:
        False where the smallest p-value is below 5% over the number of rows (Bonferroni), or a row
        has none, with fewer than two answers.

    Raises:
        Nothing.
    """
    return bool((table["p_value"] >= limit_of(table)).all())


def which_stray(table: pd.DataFrame, how: Callable[[pd.Series], str]) -> list[str]:
    """A sentence for each row whose ranks stray."""
    limit, said = limit_of(table), []
    for label, row in table.iterrows():
        if not row["p_value"] >= limit:  # none at all strays too
            chance = f" (p = {row['p_value']:.2g})" if row["answered"] > 1 else ""
            said.append(f"{label}: {how(row)}{chance}.")
    return said
