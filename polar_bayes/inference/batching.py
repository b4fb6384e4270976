"""Batches of pixels: readings, status codes, and compiled functions of many pixels.

Some arrays differ between pixels, others are shared by all. A batch has a fixed number of pixels,
so every batch of every image runs the same compiled program, which computes only as many of its
pixels as are wanted.
"""

import dataclasses
import enum
import functools
from collections.abc import Callable, Iterator
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, DTypeLike

from polar_bayes.numerics.compile import JitOnce
from polar_bayes.observation.data import Observations
from polar_bayes.physics.geometry import Geometry

IMAGE = ("y", "x")

LANES = 16
"""Pixels of a batch that are computed together: their data fit into the cache of one core."""


@dataclasses.dataclass(frozen=True)
class ObservationBatch:
    """Readings of many pixels: `batched` arrays start with the pixel axis, `static` ones do not."""

    batched: Observations
    static: Observations
    views: np.ndarray

    @classmethod
    def of(cls, arrays: Observations, is_batched: Observations) -> Self:
        """Arrays, and which of them begin with the pixel axis; `valid` does."""
        valid = np.asarray(arrays.valid)
        views = valid.any(axis=tuple(range(1, valid.ndim - 1))).sum(axis=-1)
        return cls(*eqx.partition(arrays, is_batched), views)

    def __len__(self) -> int:
        return len(self.views)

    def take(self, index: np.ndarray) -> Observations:
        """Return the batched arrays of some pixels, in that order."""
        return jax.tree.map(lambda x: x[index], self.batched)

    def subset(self, index: np.ndarray) -> "ObservationBatch":
        """Return a batch of some of the pixels, in that order."""
        return ObservationBatch(self.take(index), self.static, self.views[index])

    def in_precision(self, dtype: DTypeLike) -> "ObservationBatch":
        """Convert the readings to another floating type."""

        def cast(x: np.ndarray) -> np.ndarray:
            return x.astype(dtype) if np.issubdtype(x.dtype, np.floating) else x

        batched, static = (jax.tree.map(cast, part) for part in (self.batched, self.static))
        return ObservationBatch(batched, static, self.views)

    def pixel(self, index: int = 0) -> Observations:
        """Return one pixel as a capture."""
        batched = jax.tree.map(lambda x: jnp.asarray(x[index]), self.batched)
        return eqx.combine(batched, jax.tree.map(jnp.asarray, self.static))


def batch_pixels(
    image: Observations, batched_directions: frozenset[str] = frozenset()
) -> ObservationBatch:
    """Flatten an image, or a block of it, to a batch of pixels."""
    (rows, columns), own_axes = image.shape[:2], image.dims[len(IMAGE) :]
    image = dataclasses.replace(image, dims=own_axes)
    every = jax.tree.map(lambda _: True, image)
    angles: dict[str, Any] = {
        n: x and n in batched_directions for n, x in every.geometry._asdict().items()
    }
    is_batched = dataclasses.replace(
        every,
        geometry=Geometry(**angles),
        full_scale=False,
        intensity_unit=False,
        confidence=every.confidence and "normal_confidence" in batched_directions,
        shared=jax.tree.map(lambda _: False, image.shared),
    )

    def flat(x: Array, of_pixels: bool) -> np.ndarray:
        own = x.shape[len(IMAGE) :]
        if not of_pixels:
            return np.asarray(x).reshape(own)
        return np.broadcast_to(np.asarray(x), (rows, columns, *own)).reshape(rows * columns, *own)

    return ObservationBatch.of(jax.tree.map(flat, image, is_batched), is_batched)


def cut(image: xr.Dataset, pixels: int) -> Iterator[dict[str, slice]]:
    """List the blocks that cover an image, row by row."""
    rows, columns = (image.sizes[dim] for dim in IMAGE)
    wide = min(columns, pixels)
    high = max(1, pixels // wide)
    for y in range(0, rows, high):
        for x in range(0, columns, wide):
            yield {"y": slice(y, min(y + high, rows)), "x": slice(x, min(x + wide, columns))}


# --- Status of each pixel, and the method used ----------------------------------------------------


class Status(enum.IntEnum):
    """Status of a pixel; the last is the value in chunks that were not written.

    A contradicted pixel has a good posterior, and its readings speak against the model.
    """

    GOOD = 0
    MASKED = 1
    TOO_FEW_VIEWS = 2
    NOT_CONVERGED = 3
    NOT_TRUSTED = 4
    CONTRADICTED = 5
    NOT_FITTED = -1


class MethodUsed(enum.IntEnum):
    """Method that determined the numbers of a pixel; `OTHER` is a user's own method."""

    NONE = 0
    LAPLACE = 1
    IMPORTANCE = 2
    ADAPTED = 3
    NUTS = 4
    OTHER = 7


# --- A function of one pixel as a compiled program of a batch -------------------------------------


def batched(function: Callable, *, given: int = 0, lanes: int = LANES) -> JitOnce:
    """Compile a function of one pixel, mapped over a batch."""

    def mapped(over: Callable, *arguments: Any) -> Any:
        return over(functools.partial(function, *arguments[:given]), *arguments[given:])

    return batched_lanes(mapped, given=given, lanes=lanes)


def batched_lanes(function: Callable, *, given: int = 0, lanes: int = LANES) -> JitOnce:
    """Compile a function of `LANES` pixels for a batch.

    Its first argument maps a function of the observations and states of one pixel over them.
    """
    # The compiled program takes: arguments that are the same for all pixels, as many as `given`;
    # the number of pixels that are wanted; the batched and the static readings; and the state of
    # each pixel. Pixels beyond the wanted number only fill the batch and are not computed.

    def run(*arguments: Any) -> Any:
        common, (wanted, own, static, *states) = arguments[:given], arguments[given:]
        grouped = jax.tree.map(lambda x: x.reshape(-1, lanes, *x.shape[1:]), (own, states))

        @jax.jit  # asked for its shape and then in the loop, it is traced once
        def of_lanes(own: Any, states: Any, static: Any, common: tuple) -> Any:
            def over(of_pixel: Callable, *states: Any) -> Any:
                return jax.vmap(lambda pixel, *s: of_pixel(eqx.combine(pixel, static), *s))(
                    own, *states
                )

            return function(over, *common, *states)

        def group(at: Array) -> Any:
            return of_lanes(*jax.tree.map(lambda x: x[at], grouped), static, common)

        def fill(at: Array, found: Any) -> Any:
            return jax.tree.map(lambda whole, part: whole.at[at].set(part), found, group(at))

        count = len(jax.tree.leaves(grouped)[0])
        empty = jax.tree.map(
            lambda x: jnp.zeros((count, *x.shape), x.dtype), jax.eval_shape(group, jnp.int32(0))
        )
        filled = jax.lax.fori_loop(0, -(-wanted // lanes), fill, empty)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), filled)

    return JitOnce(run)
