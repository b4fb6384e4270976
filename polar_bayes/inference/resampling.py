"""Draws weighed by the posterior, and draws chosen among them by weight."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from polar_bayes.inference.compile import TRACING_LOCK, JitOnce
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

PIECE = 1024
"""Draws that are looked at in one call: one compiled program serves any number."""

SIDE_BY_SIDE = 64

CHAINS = 4
"""Groups of the chosen draws, for diagnostics that ask for chains."""

FEWEST, MOST = 50, 10_000
"""Chosen draws of each group."""


def log_densities(program: Program, z: np.ndarray, data: Observations) -> np.ndarray:
    """Log posterior density of many unconstrained vectors, up to a constant."""
    look, count, parts = _looker(program), len(z), []
    for begin in range(0, count, PIECE):
        index = np.minimum(np.arange(begin, begin + PIECE), count - 1)
        parts.append(np.asarray(look(jnp.asarray(z[index]), data), float))
    found = np.concatenate(parts)[:count]
    return np.where(np.isnan(found), -np.inf, found)


def choose(
    weights: Float[np.ndarray, " draw"], effective: float, random: np.random.Generator
) -> np.ndarray:
    """Which draws stand for all, each as often as it weighs."""
    # As many are chosen as the weighted ones are worth. More would look like more than is known.
    # Source: Kitagawa (1996), J. Comput. Graph. Stat. 5(1), 1-25: systematic resampling.
    each = int(np.clip(effective / CHAINS, FEWEST, MOST))
    places = (np.arange(CHAINS * each) + random.random()) / (CHAINS * each)
    index = np.searchsorted(np.cumsum(weights), places)
    chosen = np.clip(index, 0, len(weights) - 1)
    return random.permutation(chosen).reshape(CHAINS, each)


def max_effective_size(count: int) -> float:
    """How many independent draws the chosen ones stand for at best, all weights being equal."""
    chosen = min(count, CHAINS * MOST)
    return count * chosen / (count + chosen) if count else 0.0


def generator(key: Array) -> np.random.Generator:
    """NumPy's random numbers from a key of JAX."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))


@functools.lru_cache(maxsize=8)
def _looker(program: Program) -> Callable[[Array, Observations], Array]:
    def look(z: Array, data: Observations) -> Array:
        return jax.lax.map(lambda z: -program.potential_jit(z, data), z, batch_size=SIDE_BY_SIDE)

    with TRACING_LOCK:
        return JitOnce(look)
