"""Functions of a fixed number of rows, applied to any number of rows."""

from collections.abc import Callable, Iterator

import jax
import numpy as np
from jaxtyping import Array

AnyArray = Array | np.ndarray


def take_rows[T](values: T, which: np.ndarray | slice) -> T:
    """Select pixels of arrays that all begin with the pixel axis."""
    return jax.tree.map(lambda x: np.asarray(x)[which], values)


def put_rows[T](values: T, which: np.ndarray | slice, new: T) -> None:
    """Replace pixels of arrays that all begin with the pixel axis, in place."""
    for whole, part in zip(jax.tree.leaves(values), jax.tree.leaves(new), strict=True):
        whole[which] = part


def batches(count: int, size: int) -> Iterator[np.ndarray]:
    """Yield indices of batches of one size; the last batch repeats the last pixel."""
    for begin in range(0, count, size):
        yield np.minimum(np.arange(begin, begin + size), count - 1)


def map_batches[T](
    function: Callable[[np.ndarray], T], count: int, size: int, over: Callable = map
) -> T:
    """Apply a function of the indices of one batch, and join results along the pixel axis."""
    # Each part is put in its place as it comes: two copies of all results may not fit into memory.
    joined: T | None = None
    parts = over(lambda index: jax.tree.map(np.asarray, function(index)), batches(count, size))
    for begin, part in zip(range(0, count, size), parts, strict=True):
        if joined is None:
            joined = jax.tree.map(lambda x: np.empty((count, *x.shape[1:]), x.dtype), part)
        end = min(begin + size, count)
        put_rows(joined, slice(begin, end), take_rows(part, slice(end - begin)))
    assert joined is not None, "no rows"
    return joined


def map_elements(function: Callable, values: np.ndarray, size: int) -> np.ndarray:
    """Apply an elementwise function to an array of any shape, `size` elements at a time."""
    flat = np.ravel(values)
    if not flat.size:
        return np.zeros(np.shape(values))
    return map_batches(lambda at: function(flat[at]), flat.size, size).reshape(np.shape(values))
