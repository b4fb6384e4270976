"""Draws of another density by another sampler, which the posteriors of models are held against."""

from collections.abc import Callable, Mapping

import emcee
import numpy as np
from arviz_stats.base import array_stats


def ensemble_draws(
    density: Callable, center: np.ndarray, width: np.ndarray, walkers: int, steps: int
) -> tuple[np.ndarray, float]:
    """Chain (step, walker, coordinate), and how many of its draws are independent."""
    start = center + width * np.random.default_rng(8).normal(size=(walkers, len(center)))
    np.random.seed(9)  # noqa: NPY002 - the sampler takes its state from here
    # Not its snooker move, whose factor is half of what it should be: draws come out too narrow.
    moves = [(emcee.moves.StretchMove(), 0.5), (emcee.moves.DEMove(), 0.5)]
    sampler = emcee.EnsembleSampler(walkers, len(center), density, vectorize=True, moves=moves)
    sampler.run_mcmc(start, steps, progress=False)
    chain = sampler.get_chain(discard=1000)
    independent = chain[..., 0].size / float(np.max(sampler.get_autocorr_time(discard=1000)))
    assert independent > 1000.0
    return chain, independent


def assert_same_draws(
    ours: Mapping[str, np.ndarray], theirs: Mapping[str, np.ndarray], independent: float
) -> None:
    """Means and standard deviations: a comparison fails by chance in 6e-5 of cases.

    Args:
        ours: Draws (chain, draw) of every quantity.
        theirs: Draws of an ensemble sampler.
        independent: How many of these are independent.
    """
    assert set(ours) == set(theirs)
    for name, draws in ours.items():
        other = theirs[name].ravel()
        error = np.hypot(array_stats.mcse(draws, method="mean"), other.std() / independent**0.5)
        assert abs(draws.mean() - other.mean()) < 4.0 * error, name
        kurtosis = np.mean(((other - other.mean()) / other.std()) ** 4)
        spread_error = other.std() * np.sqrt((kurtosis - 1.0) / (4.0 * independent))
        error = np.hypot(array_stats.mcse(draws, method="sd"), spread_error)
        assert abs(draws.std() - other.std()) < 4.0 * error, name
