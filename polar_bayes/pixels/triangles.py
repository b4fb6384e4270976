"""Cholesky factors of very small matrices, written out.

A library factors a batch of 4 by 4 matrices one call at a time; written out, the arithmetic of a
thousand pixels runs side by side. `tests/benchmarks/pixels.py` has the ratio.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def cholesky(matrix: Float[Array | np.ndarray, "size size"]) -> Float[Array, "size size"]:
    """Lower factor of a symmetric matrix."""
    size = matrix.shape[0]
    rows: list[list[Array]] = []
    for i in range(size):
        row: list[Array] = []
        for j in range(i + 1):
            left = matrix[i, j] - sum(row[k] * (rows[j] if j < i else row)[k] for k in range(j))
            row.append(left / rows[j][j] if j < i else _root(left))
        rows.append(row)
    return _lower(rows)


def inverse(factor: Float[Array, "size size"]) -> Float[Array, "size size"]:
    """Inverse of a lower factor, lower again."""
    size = factor.shape[0]
    rows: list[list[Array]] = []
    for i in range(size):
        above = [
            -sum(factor[i, k] * rows[k][j] for k in range(j, i)) / factor[i, i] for j in range(i)
        ]
        rows.append([*above, 1.0 / factor[i, i]])
    return _lower(rows)


def _root(x: Array) -> Array:
    """Square root of what is above zero; NaN, not infinity one division later, of the rest."""
    return jnp.where(x > 0.0, jnp.sqrt(jnp.where(x > 0.0, x, 1.0)), jnp.nan)


def _lower(rows: list[list[Array]]) -> Array:
    zero = jnp.zeros_like(rows[0][0])
    return jnp.stack([jnp.stack([*row, *[zero] * (len(rows) - len(row))]) for row in rows])
