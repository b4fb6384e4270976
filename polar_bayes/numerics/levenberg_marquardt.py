"""Levenberg-Marquardt: damped steps to a mode, and the normal approximation there.

A damped step minimizes the potential (minus the log posterior density). Functions are of one vector
and mapped over a batch. Cholesky factors of small matrices are written out, because a library
factors a batch of them one call at a time; `benchmarks/pixels.py` has the measurements.

Source:
    Marquardt (1963), J. SIAM 11(2), 431-441.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from polar_bayes.numerics.batches import AnyArray

# --- Cholesky factors of small matrices -----------------------------------------------------------


MAX_UNROLLED = 6
"""Largest matrix whose factor is unrolled, and most coordinates along which Jacobians are computed
one by one. Beyond it compilation takes longer than the program saves."""


def cholesky(matrix: Float[Array | np.ndarray, "size size"]) -> Float[Array, "size size"]:
    """Return the lower factor of a symmetric matrix; NaN if it is not positive definite."""
    size = matrix.shape[0]
    if size > MAX_UNROLLED:
        return jnp.linalg.cholesky(matrix)
    rows: list[list[Array]] = []
    for i in range(size):
        row: list[Array] = []
        for j in range(i + 1):
            left = matrix[i, j] - sum(row[k] * (rows[j] if j < i else row)[k] for k in range(j))
            row.append(left / rows[j][j] if j < i else _root(left))
        rows.append(row)
    return _lower(rows)


def inverse(factor: Float[Array, "size size"]) -> Float[Array, "size size"]:
    """Return the inverse of a lower triangular factor, which is lower triangular."""
    size = factor.shape[0]
    if size > MAX_UNROLLED:
        unit = jnp.eye(size, dtype=factor.dtype)
        return jax.scipy.linalg.solve_triangular(factor, unit, lower=True)
    rows: list[list[Array]] = []
    for i in range(size):
        above = [
            -sum(factor[i, k] * rows[k][j] for k in range(j, i)) / factor[i, i] for j in range(i)
        ]
        rows.append([*above, 1.0 / factor[i, i]])
    return _lower(rows)


def _root(x: Array) -> Array:
    """Return the square root of positive numbers, and NaN rather than infinity for others."""
    return jnp.where(x > 0.0, jnp.sqrt(jnp.where(x > 0.0, x, 1.0)), jnp.nan)


def _lower(rows: list[list[Array]]) -> Array:
    zero = jnp.zeros_like(rows[0][0])
    return jnp.stack([jnp.stack([*row, *[zero] * (len(rows) - len(row))]) for row in rows])


# --- Derivatives of a potential -------------------------------------------------------------------


class Derivatives(NamedTuple):
    """Value, gradient and curvature of the potential, minus the log posterior density."""

    value: Float[AnyArray, ""]
    gradient: Float[AnyArray, " size"]
    curvature: Float[AnyArray, "size size"]


def derivatives(function: Callable, z: Float[Array, " size"]) -> Derivatives:
    """Return value, gradient and Hessian of a function of the unconstrained vector."""

    def first(z: Array) -> tuple[Array, tuple[Array, Array]]:
        value, gradient = jax.value_and_grad(function)(z)
        return gradient, (value, gradient)

    curvature, (value, gradient) = jax.jacfwd(first, has_aux=True)(z)
    return Derivatives(value, gradient, curvature)


# --- Damped steps of one pixel --------------------------------------------------------------------


MAX_STEP = 3.0  # in an unconstrained coordinate: the model changes too much beyond
FIRST_DAMPING = 1e-2
LEAST_DAMPING = 1e-8
DAMPING_UP, DAMPING_DOWN = 10.0, 0.1
ROUNDING = 8.0  # of the potential, in units of its last digit, that count as no change


class LMState(NamedTuple):
    """State of the minimization of one pixel."""

    z: Float[AnyArray, " size"]
    derivatives: Derivatives
    damping: Float[AnyArray, ""]
    decrement: Float[AnyArray, ""]
    steps: Int[AnyArray, ""]
    settled: Bool[AnyArray, ""]
    free: Float[AnyArray, " size"]
    """One for each coordinate; zero for coordinates that are held."""


class NormalApproximation(NamedTuple):
    """A mode, and the normal distribution there; its covariance is `root.T @ root`."""

    z: Float[AnyArray, " size"]
    value: Float[AnyArray, ""]
    root: Float[AnyArray, "size size"]
    decrement: Float[AnyArray, ""]
    condition: Float[AnyArray, ""]

    @property
    def log_evidence(self) -> np.ndarray:
        """Log evidence of the normal approximation of many pixels, up to a constant, (pixel,)."""
        with np.errstate(invalid="ignore"):  # of pixels without a mode
            return np.log(np.diagonal(self.root, axis1=1, axis2=2)).sum(axis=1) - self.value

    def distance(self, z: Float[AnyArray, "pixel size"]) -> np.ndarray:
        """Return distances of vectors from modes in posterior sds, (pixel,); NaN if unknown."""
        root, known = np.swapaxes(self.root, 1, 2), np.isfinite(self.root).all(axis=(1, 2))
        known &= (np.diagonal(root, axis1=1, axis2=2) > 0.0).all(axis=1)
        away = np.full(known.size, np.nan)
        moved = np.linalg.solve(root[known], (z - self.z)[known, :, None])
        away[known] = np.linalg.norm(moved[..., 0], axis=1)
        return away


def init(z: Float[np.ndarray, "pixel size"]) -> LMState:
    """Return states at the starts; the first step only evaluates the derivatives there."""
    count, size = z.shape
    unknown = np.full(count, np.inf, z.dtype)
    identity = np.broadcast_to(np.eye(size, dtype=z.dtype), (count, size, size))
    return LMState(
        z=z,
        derivatives=Derivatives(unknown, np.zeros_like(z), identity),
        damping=np.full(count, FIRST_DAMPING, z.dtype),
        decrement=unknown,
        steps=np.zeros(count, np.int32),
        settled=np.zeros(count, bool),
        free=np.ones_like(z),
    )


def step(derivatives_of: Callable[[Array], Derivatives], goal: float, state: LMState) -> LMState:
    """Take one damped step if it decreases the potential."""
    value, gradient, curvature = state.derivatives
    free = state.free
    gradient = free * gradient
    curvature = free[:, None] * curvature * free + jnp.diag(1.0 - free)
    scale = jnp.maximum(jnp.abs(jnp.diagonal(curvature)), jnp.finfo(value.dtype).tiny)
    root = inverse(cholesky(curvature + state.damping * jnp.diag(scale)))
    whitened = root @ gradient
    decrement = jnp.sqrt(whitened @ whitened)
    move = -(root.T @ whitened)
    move = move * jnp.minimum(1.0, MAX_STEP / jnp.maximum(jnp.max(jnp.abs(move)), MAX_STEP))
    is_possible = jnp.all(jnp.isfinite(move))
    z = state.z + jnp.where(is_possible, move, 0.0)
    proposed = derivatives_of(jnp.asarray(z))
    slack = ROUNDING * jnp.finfo(value.dtype).eps * (1.0 + jnp.abs(value))
    is_finite = jnp.isfinite(proposed.value) & jnp.all(jnp.isfinite(proposed.gradient))
    is_first = ~jnp.isfinite(value)
    accepted = is_possible & is_finite & ((proposed.value <= value + slack) | is_first)
    less = jnp.where(
        is_first, state.damping, jnp.maximum(DAMPING_DOWN * state.damping, LEAST_DAMPING)
    )
    more = DAMPING_UP * jnp.maximum(state.damping, LEAST_DAMPING)
    moved = LMState(
        z=jnp.where(accepted, z, state.z),
        derivatives=jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), proposed, state.derivatives
        ),
        damping=jnp.where(accepted, less, more),
        decrement=jnp.where(is_possible & ~is_first, decrement, jnp.inf),
        steps=state.steps + ~is_first,
        settled=accepted & ~is_first & (decrement < goal) & (state.damping <= FIRST_DAMPING),
        free=free,
    )
    return jax.tree.map(lambda new, old: jnp.where(state.settled, old, new), moved, state)


@jax.jit
@jax.vmap
def finalize(z: Float[Array, " size"], there: Derivatives) -> NormalApproximation:
    """Take the last step with the exact Hessian, and return the normal approximation."""
    value, gradient, curvature = there
    root = inverse(cholesky(curvature))
    whitened = root @ gradient
    covariance = root.T @ root
    condition = jnp.max(jnp.sum(jnp.abs(curvature), 0)) * jnp.max(jnp.sum(jnp.abs(covariance), 0))
    decrement = jnp.sqrt(whitened @ whitened)
    mode = z - root.T @ whitened
    return NormalApproximation(mode, value - 0.5 * decrement**2, root, decrement, condition)
