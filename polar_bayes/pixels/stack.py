"""The pixels of an image in a row: what is each one's own, and what all of them share."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

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
