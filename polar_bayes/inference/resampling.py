"""Systematic resampling of weighted draws (Kitagawa 1996)."""

import jax
import numpy as np
from jaxtyping import Array, Float

CHAINS = 4
"""Groups of resampled draws, for diagnostics that ask for chains."""

FEWEST, MOST = 50, 10_000
"""Resampled draws of each group."""


def systematic_resample(
    weights: Float[np.ndarray, " draw"], effective: float, random: np.random.Generator
) -> Float[np.ndarray, "chain draw"]:
    """Indices of draws, each as often as it weighs, in random order."""
    # As many are drawn as the effective sample size: more would look like more than is known.
    # Source: Kitagawa (1996), J. Comput. Graph. Stat. 5(1), 1-25.
    each = int(np.clip(effective / CHAINS, FEWEST, MOST))
    levels = (np.arange(CHAINS * each) + random.random()) / (CHAINS * each)
    index = np.clip(np.searchsorted(np.cumsum(weights), levels), 0, len(weights) - 1)
    return random.permutation(index).reshape(CHAINS, each)


def max_effective_size(count: int) -> float:
    """Effective sample size after resampling so many draws of equal weight."""
    resampled = min(count, CHAINS * MOST)
    return count * resampled / (count + resampled) if count else 0.0


def numpy_generator(key: Array) -> np.random.Generator:
    """NumPy's random numbers from a key of JAX."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))
