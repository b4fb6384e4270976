"""Pareto-smoothed importance sampling (Vehtari et al. 2024) of many pixels at once.

Also the effective sample sizes, systematic resampling, and the marginals (means, sds, quantiles) of
weighted draws.

Source:
    Vehtari, Simpson, Gelman, Yao & Gabry (2024), JMLR 25(72): the weights and Pareto k; Zhang &
    Stephens (2009), Technometrics 51(3), 316-325: the fit of the tail.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy.special
from jaxtyping import Array, Float

from polar_bayes.numerics.batches import AnyArray

MAX_PARETO_K = 0.7
"""Largest Pareto k of reliable weighted draws, however many there are."""

FINITE_VARIANCE = 0.5
"""Largest Pareto k of weights with a variance. Between it and 0.7 a tail of a posterior was missed
in 3 of 3 seeds."""

FEW_ROUNDS = 3
"""Rounds of adaptation after which weighted draws reach all tails that chains do. Proposals that
adapt for longer can miss the end of a tail, of which Pareto k tells nothing."""


class Smoothed(NamedTuple):
    """Smoothed weights of the draws of every pixel, and Pareto k."""

    weights: Float[np.ndarray, "pixel draw"]
    pareto_k: Float[np.ndarray, " pixel"]


def smooth(log_ratios: Float[np.ndarray, "pixel draw"], relative_ess: float = 1.0) -> Smoothed:
    """Return Pareto-smoothed importance weights of many pixels.

    `relative_ess` is the effective over the actual number of draws: that of chains is not one.
    """
    # Source: Vehtari, Simpson, Gelman, Yao & Gabry (2024), JMLR 25(72).
    count = log_ratios.shape[-1]
    is_large = count * relative_ess > 225
    tail = int(3.0 * (count / relative_ess) ** 0.5) if is_large else count // 5
    known = np.isfinite(log_ratios)
    usable = known.any(axis=-1)
    largest = np.max(log_ratios, axis=-1, where=known, initial=-np.inf, keepdims=True)
    ratios = np.where(known, log_ratios - np.where(np.isfinite(largest), largest, 0.0), -np.inf)
    order = np.argsort(ratios, axis=-1)
    ranked = np.exp(np.take_along_axis(ratios, order, axis=-1).astype(float))
    cutoff = ranked[:, -tail - 1, None]
    excess = ranked[:, -tail:] - cutoff
    flat = excess[:, -1] <= count * np.finfo(log_ratios.dtype).eps
    shape, scale = _fit_tail(np.where(flat[:, None], np.linspace(0.5, 1.0, tail), excess))
    shape = np.where(ranked[:, -tail] > 0.0, shape, np.nan)  # too few draws are possible at all
    steps = (np.arange(tail) + 0.5) / tail
    with np.errstate(all="ignore"):
        smoothed = cutoff + _quantiles(steps, shape[:, None], scale[:, None])
    smooth_enough = (~flat & np.isfinite(shape))[:, None]
    ranked[:, -tail:] = np.where(smooth_enough, np.minimum(smoothed, 1.0), ranked[:, -tail:])
    weights = np.empty_like(ranked)
    np.put_along_axis(weights, order, ranked, axis=-1)
    weights /= np.where(usable, weights.sum(axis=-1), np.nan)[:, None]
    pareto_k = np.where(flat, 0.0, np.where(np.isfinite(shape), shape, np.inf))
    return Smoothed(weights, np.where(usable, pareto_k, np.inf))


def _fit_tail(excess: Float[np.ndarray, "pixel tail"]) -> tuple[np.ndarray, np.ndarray]:
    """Fit generalized Pareto distributions to ascending excesses, row by row."""
    # Source: Zhang & Stephens (2009), Technometrics 51(3), 316-325, with the prior of Vehtari et
    # al.
    count = excess.shape[-1]
    grid = 30 + int(count**0.5)
    quartile = excess[:, int(count / 4.0 + 0.5) - 1, None]
    with np.errstate(all="ignore"):
        b = 1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))
        b = b / (3.0 * quartile) + 1.0 / excess[:, -1:]
        # One point of the grid at a time: an array of (pixel, grid, tail) would not fit the cache.
        k = np.stack([np.mean(np.log1p(-at[:, None] * excess), axis=-1) for at in b.T], axis=-1)
        fit = count * (np.log(-b / k) - k - 1.0)
        weights = scipy.special.softmax(fit, axis=-1)
        weights = np.where(weights >= 10.0 * np.finfo(float).eps, weights, 0.0)
        b = np.sum(b * weights, axis=-1) / np.sum(weights, axis=-1)
        k = np.mean(np.log1p(-b[:, None] * excess), axis=-1)
        scale = -k / b
        shape = (count * k + 10.0 * 0.5) / (count + 10.0)
    lumped = quartile[:, 0] <= excess[:, 0]  # nothing like a tail
    return np.where(lumped, np.nan, shape), scale


def _quantiles(steps: np.ndarray, shape: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return quantiles of a generalized Pareto distribution."""
    spread = np.where(shape == 0.0, -np.log1p(-steps), np.expm1(-shape * np.log1p(-steps)) / shape)
    return scale * spread


def summarize(
    draws: Float[np.ndarray, "pixel draw"],
    weights: Float[np.ndarray, "pixel draw"],
    levels: tuple[float, ...],
    *,
    random: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean, sd and quantiles of weighted draws; quasi-random unless `random`."""
    # Draws without weight may be as far out as infinity, and zero times infinity is NaN.
    low = np.min(draws, axis=-1, keepdims=True, where=weights > 0.0, initial=np.inf)
    high = np.max(draws, axis=-1, keepdims=True, where=weights > 0.0, initial=-np.inf)
    draws = np.clip(draws, low, high)
    mean = np.sum(weights * draws, axis=-1)
    sd = np.sqrt(np.sum(weights * (draws - mean[:, None]) ** 2, axis=-1))
    order = np.argsort(draws, axis=-1)
    ranked = np.take_along_axis(draws, order, axis=-1)
    share = np.take_along_axis(weights, order, axis=-1)
    below = np.cumsum(share, axis=-1) - 0.5 * share
    if random:
        # One more draw of the same distribution lies below the k-th of n with probability k/(n+1):
        # intervals between quasi-random positions, (k-1/2)/n, hold too few.
        # Source: Hyndman & Fan (1996), Am. Stat. 50(4), 361-365, definition 6.
        count = weighted_ess(weights)[:, None]
        below = (count * below + 0.5) / (count + 1.0)
    return mean, sd, np.stack([_interpolate(level, below, ranked) for level in levels])


def _interpolate(level: float, below: np.ndarray, ranked: np.ndarray) -> np.ndarray:
    """Interpolate one quantile of every row."""
    last = ranked.shape[-1] - 1
    right = np.clip(np.sum(below < level, axis=-1), 1, last)[:, None]
    x0, x1 = (np.take_along_axis(ranked, at, axis=-1)[:, 0] for at in (right - 1, right))
    p0, p1 = (np.take_along_axis(below, at, axis=-1)[:, 0] for at in (right - 1, right))
    with np.errstate(divide="ignore", invalid="ignore"):
        between = np.clip((level - p0) / (p1 - p0), 0.0, 1.0)
    return x0 + np.where(p1 > p0, between, 0.0) * (x1 - x0)


def weighted_ess(weights: Float[np.ndarray, "pixel draw"]) -> Float[np.ndarray, " pixel"]:
    """Return the effective sample size of weighted draws (Kish)."""
    return 1.0 / np.sum(weights**2, axis=-1)


# --- Systematic resampling (Kitagawa 1996) --------------------------------------------------------


CHAINS = 4
"""Number of groups of resampled draws, for diagnostics that require chains."""

FEWEST, MOST = 50, 10_000
"""Fewest and most resampled draws of each group."""


def resampled_chains(
    weights: Float[np.ndarray, " draw"], effective: float, random: np.random.Generator
) -> Float[np.ndarray, "chain draw"]:
    """Return indices of draws resampled by weight, in random order."""
    # As many are drawn as the effective sample size: more would look like more than is known.
    each = int(np.clip(effective / CHAINS, FEWEST, MOST))
    index = systematic_resample(weights, CHAINS * each, random.random())
    return random.permutation(index).reshape(CHAINS, each)


def systematic_resample(weights: AnyArray, count: int, first: float | Array = 0.5) -> AnyArray:
    """Return increasing indices of draws, each as often as its weight is worth.

    `first`, of 0 to 1, moves all the levels of cumulative weight at which a draw is taken.

    Source:
        Kitagawa (1996), J. Comput. Graph. Stat. 5(1), 1-25.
    """
    xp = weights.__array_namespace__()  # of JAX within a program
    levels = (xp.arange(count) + first) / count
    return xp.clip(xp.searchsorted(xp.cumsum(weights), levels), 0, len(weights) - 1)


def max_effective_size(count: int) -> float:
    """Return the largest effective sample size after resampling so many draws."""
    resampled = min(count, CHAINS * MOST)
    return count * resampled / (count + resampled) if count else 0.0


def numpy_generator(key: Array) -> np.random.Generator:
    """Return a NumPy random generator seeded by a key of JAX."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))


# --- Marginals of a batch of pixels: what maps show -----------------------------------------------


LEVELS = (0.025, 0.1, 0.25, 0.5, 0.75, 0.9, 0.975)


class Marginals:
    """Marginals of a batch of pixels; NaN for pixels without an answer.

    `scores` are functions of draws, each (pixel, draw), for which the slopes of means are kept.
    """

    def __init__(
        self,
        count: int,
        sizes: Mapping[str, tuple[int, ...]],
        *,
        random: bool = False,
        scores: Sequence[Callable[[Mapping[str, AnyArray]], np.ndarray]] = (),
    ) -> None:
        self._random, self._scores = random, scores

        def empty(*first: int) -> dict[str, np.ndarray]:
            return {name: np.full((*first, count, *own), np.nan) for name, own in sizes.items()}

        self.mean, self.sd = empty(), empty()
        self.quantiles, self.slopes = empty(len(LEVELS)), empty(len(scores))

    def describe(
        self, at: np.ndarray, parameters: Mapping[str, AnyArray], weights: np.ndarray
    ) -> None:
        """Summarize the weighted draws of some pixels."""
        together = 512  # pixels: more do not fit into the cache
        for begin in range(0, at.size, together):
            some = slice(begin, begin + together)
            own = {name: np.asarray(x)[some] for name, x in parameters.items()}
            self._describe(at[some], own, weights[some])

    def _describe(
        self, at: np.ndarray, parameters: dict[str, np.ndarray], weights: np.ndarray
    ) -> None:
        scores = [score(parameters) for score in self._scores]
        centered = [x - np.sum(weights * x, axis=1, keepdims=True) for x in scores]
        gains = [weights * x / np.sum(weights * x**2, axis=1, keepdims=True) for x in centered]
        for name, mean in self.mean.items():
            draws = np.asarray(parameters[name], float)
            for own in np.ndindex(mean.shape[1:]):
                found = summarize(draws[(..., *own)], weights, LEVELS, random=self._random)
                mean[(at, *own)], self.sd[name][(at, *own)] = found[:2]
                self.quantiles[name][(slice(None), at, *own)] = found[2]
                for slope, gain in zip(self.slopes[name], gains, strict=True):
                    slope[(at, *own)] = np.sum(gain * draws[(..., *own)], axis=1)
