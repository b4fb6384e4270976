"""From a start to the peak of one pixel's posterior, a step at a time.

Every function is of one pixel, so that a batch is a map over pixels and nothing else: what a
pixel gets does not depend on who climbs beside it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.pixels.derivatives import AnyArray, Slopes
from polar_bayes.pixels.triangles import cholesky, inverse

LONGEST = 3.0  # of a step, in an unconstrained coordinate: further the model is another one
FIRST_DAMPING = 1e-2
LEAST_DAMPING = 1e-8
FIRMER, LOOSER = 10.0, 0.1
ROUNDING = 8.0  # of the potential, in units of its last digit, that count as no change

Curvature = Callable[[Program, Array, Observations], Slopes]


class Climber(NamedTuple):
    """Where one pixel is."""

    z: Float[AnyArray, " size"]
    slopes: Slopes
    damping: Float[AnyArray, ""]
    decrement: Float[AnyArray, ""]
    steps: Int[AnyArray, ""]
    settled: Bool[AnyArray, ""]


class Peak(NamedTuple):
    """A mode, and the normal distribution that fits there."""

    z: Float[AnyArray, " size"]
    value: Float[AnyArray, ""]
    widths: Float[AnyArray, "size size"]
    decrement: Float[AnyArray, ""]
    condition: Float[AnyArray, ""]


def stand(z: Float[np.ndarray, "pixel size"]) -> Climber:
    """Climbers at their starts; their first step looks around and stays where it is."""
    count, size = z.shape
    far, unit = (
        np.full(count, np.inf, z.dtype),
        np.broadcast_to(np.eye(size, dtype=z.dtype), (count, size, size)),
    )
    return Climber(
        z=z,
        slopes=Slopes(far, np.zeros_like(z), unit),
        damping=np.full(count, FIRST_DAMPING, z.dtype),
        decrement=far,
        steps=np.zeros(count, np.int32),
        settled=np.zeros(count, bool),
    )


def step(
    program: Program, curvature: Curvature, goal: float, climber: Climber, data: Observations
) -> Climber:
    """One damped step, taken only where it leads down."""
    # Source: Marquardt (1963), J. SIAM 11(2), 431-441.
    value, gradient, bend = climber.slopes
    scale = jnp.maximum(jnp.abs(jnp.diagonal(bend)), jnp.finfo(value.dtype).tiny)
    half = inverse(cholesky(bend + climber.damping * jnp.diag(scale)))
    whitened = half @ gradient
    decrement = jnp.sqrt(whitened @ whitened)
    move = -(half.T @ whitened)
    move = move * jnp.minimum(1.0, LONGEST / jnp.maximum(jnp.max(jnp.abs(move)), LONGEST))
    possible = jnp.all(jnp.isfinite(move))
    z = climber.z + jnp.where(possible, move, 0.0)
    tried = curvature(program, jnp.asarray(z), data)
    slack = ROUNDING * jnp.finfo(value.dtype).eps * (1.0 + jnp.abs(value))
    whole = jnp.isfinite(tried.value) & jnp.all(jnp.isfinite(tried.gradient))
    is_first = ~jnp.isfinite(value)
    better = possible & whole & ((tried.value <= value + slack) | is_first)
    looser = jnp.where(
        is_first, climber.damping, jnp.maximum(LOOSER * climber.damping, LEAST_DAMPING)
    )
    firmer = FIRMER * jnp.maximum(climber.damping, LEAST_DAMPING)
    moved = Climber(
        z=jnp.where(better, z, climber.z),
        slopes=jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, climber.slopes),
        damping=jnp.where(better, looser, firmer),
        decrement=jnp.where(possible & ~is_first, decrement, jnp.inf),
        steps=climber.steps + ~is_first,
        settled=better & ~is_first & (decrement < goal) & (climber.damping <= FIRST_DAMPING),
    )
    return jax.tree.map(lambda new, old: jnp.where(climber.settled, old, new), moved, climber)


def crown(z: Float[Array, " size"], slopes: Slopes) -> Peak:
    """The last step, with exact curvature, and what it leaves."""
    value, gradient, bend = slopes
    half = inverse(cholesky(bend))
    whitened = half @ gradient
    covariance = half.T @ half
    condition = jnp.max(jnp.sum(jnp.abs(bend), 0)) * jnp.max(jnp.sum(jnp.abs(covariance), 0))
    decrement = jnp.sqrt(whitened @ whitened)
    return Peak(z - half.T @ whitened, value - 0.5 * decrement**2, half, decrement, condition)
