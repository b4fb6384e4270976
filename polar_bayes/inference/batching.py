"""The pixels of an image in a row: what is each one's own, and what all of them share.

A batch has a fixed number of pixels, so that every batch of every image runs the same program, and
only as many of them are computed as are wanted.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.compile import JitOnce
from polar_bayes.observation.data import Observations
from polar_bayes.physics.geometry import Geometry

IMAGE = ("y", "x")


@dataclasses.dataclass(frozen=True)
class Stack:
    """Readings of many pixels."""

    own: Observations
    shared: Observations
    views: np.ndarray

    def __len__(self) -> int:
        return len(self.views)

    def take(self, index: np.ndarray) -> Observations:
        """The own arrays of some pixels, in that order."""
        return jax.tree.map(lambda x: x[index], self.own)

    def subset(self, index: np.ndarray) -> "Stack":
        """Some of the pixels, in that order."""
        return Stack(self.take(index), self.shared, self.views[index])

    def in_precision(self, dtype: Any) -> "Stack":
        """The same readings in another floating type."""
        own, shared = (jax.tree.map(lambda x: _cast(x, dtype), t) for t in (self.own, self.shared))
        return Stack(own, shared, self.views)

    def pixel(self, index: int = 0) -> Observations:
        """One pixel as a capture of its own."""
        own = jax.tree.map(lambda x: jnp.asarray(x[index]), self.own)
        return together(own, jax.tree.map(jnp.asarray, self.shared))


def stack(image: Observations, own_directions: frozenset[str] = frozenset()) -> Stack:
    """Put the pixels of an image, or of a block of it, in a row."""
    rows, columns = image.shape[:2]

    def row(x: Array) -> np.ndarray:
        whole = np.broadcast_to(np.asarray(x), (rows, columns, *x.shape[2:]))
        return whole.reshape(rows * columns, *x.shape[2:])

    def common(x: Array) -> np.ndarray:
        return np.asarray(x).reshape(x.shape[2:])

    def parts(take: Callable, is_own: bool) -> Observations:
        """Own or shared arrays; None stands where the other part has them."""
        angles: dict[str, Any] = {
            name: take(x) if x is not None and (name in own_directions) == is_own else None
            for name, x in image.geometry._asdict().items()
        }
        trust = image.confidence
        has_trust = trust is not None and ("normal_confidence" in own_directions) == is_own
        readings: dict[str, Any] = {
            n: take(x) if is_own else None for n, x in image.readings.items()
        }
        errors: dict[str, Any] = {n: take(x) if is_own else None for n, x in image.errors.items()}
        units: dict[str, Any] = {
            name: None if is_own else np.asarray(getattr(image, name))
            for name in ("full_scale", "intensity_unit")
        }
        masks: dict[str, Any] = {
            name: take(getattr(image, name)) if is_own else None
            for name in ("brightness", "valid", "saturated")
        }
        return Observations(
            geometry=Geometry(**angles),
            readings=readings,
            errors=errors,
            dims=tuple(axis for axis in image.dims if axis[0] not in IMAGE),
            confidence=take(trust) if has_trust else None,
            **units,
            **masks,
        )

    valid = np.broadcast_to(np.asarray(image.valid), image.shape)
    views = np.any(valid, axis=tuple(range(2, valid.ndim - 1))).sum(axis=-1).ravel()
    return Stack(parts(row, True), parts(common, False), views)


def together(own: Observations, shared: Observations) -> Observations:
    """One pixel's own arrays and the shared ones as one capture."""
    return eqx.combine(own, shared)


def _cast(x: np.ndarray, dtype: Any) -> np.ndarray:
    return x.astype(dtype) if np.issubdtype(x.dtype, np.floating) else x


# --- A function of one pixel as a compiled program of a batch -------------------------------------


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

    return JitOnce(run)
