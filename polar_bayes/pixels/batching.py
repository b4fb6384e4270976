"""A function of one pixel as a compiled program of a batch.

A batch has a fixed number of pixels, so that every batch of every image runs the same program, and
only as many of them are computed as are wanted.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.tracing import TracedOnce
from polar_bayes.pixels.stack import together

CLIMBING = 16
"""Pixels of a batch that climb side by side: what they need stays in a core's own cache."""


def batches(count: int, size: int) -> Iterator[np.ndarray]:
    """Indices of batches of one size; the last is filled up with the last pixel."""
    for begin in range(0, count, size):
        yield np.minimum(np.arange(begin, begin + size), count - 1)


def batched(function: Callable, *, given: int = 0, side_by_side: int = CLIMBING) -> Callable:
    """A function of one pixel, mapped over a batch, compiled."""
    # Its first arguments, as many as `given`, are the same for all pixels; so is how many pixels of
    # the batch are wanted, which comes before the batch. The others fill it up, and cost nothing.

    def run(*arguments: Any) -> Any:
        common, (wanted, own, shared, *states) = arguments[:given], arguments[given:]
        grouped = jax.tree.map(lambda x: x.reshape(-1, side_by_side, *x.shape[1:]), (own, states))

        def group(at: Array) -> Any:
            def of_pixel(mine: Any, state: Any) -> Any:
                return function(*common, together(mine, shared), *state)

            return jax.vmap(of_pixel)(*jax.tree.map(lambda x: x[at], grouped))

        def fill(at: Array, found: Any) -> Any:
            return jax.tree.map(lambda whole, part: whole.at[at].set(part), found, group(at))

        count = len(jax.tree.leaves(grouped)[0])
        empty = jax.tree.map(
            lambda x: jnp.zeros((count, *x.shape), x.dtype), jax.eval_shape(group, jnp.int32(0))
        )
        filled = jax.lax.fori_loop(0, -(-wanted // side_by_side), fill, empty)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), filled)

    return TracedOnce(run)
