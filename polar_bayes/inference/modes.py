"""Where the posterior has its peaks, how wide and how heavy each is.

Several local modes exist in these posteriors (a large roughness can imitate a low fraction), and
one start finds only one of them. So every fit first climbs from many prior draws, keeps the
distinct peaks, and weighs each by its Laplace evidence. Chains and approximations start there.
"""

import dataclasses
import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations


class Status(enum.IntEnum):
    """What became of one climb."""

    OK = 0
    NOT_CONVERGED = 1
    NOT_A_MAXIMUM = 2


class Climb(NamedTuple):
    """One local optimum of the log posterior density.

    Args:
        z: Where it ended, unconstrained.
        potential: Minus the log density there.
        decrement: Newton decrement: how far, in posterior sds, the true peak may still be.
        covariance: Inverse Hessian; NaN where the Hessian is not positive definite.
        log_evidence: Laplace's approximation; minus infinity unless the status is OK.
        status: A `Status`.
    """

    z: Float[Array, " size"]
    potential: Float[Array, ""]
    decrement: Float[Array, ""]
    covariance: Float[Array, "size size"]
    log_evidence: Float[Array, ""]
    status: Array


@dataclasses.dataclass(frozen=True)
class Modes:
    """Distinct peaks, heaviest first.

    Args:
        z: (mode, size).
        covariance: (mode, size, size).
        weight: Share of the Laplace evidence, (mode,); sums to 1.
        decrement: Newton decrement of each, (mode,).
        starts: How many climbs were made.
        failures: How many of them ended elsewhere than at a peak.
    """

    z: np.ndarray
    covariance: np.ndarray
    weight: np.ndarray
    decrement: np.ndarray
    starts: int
    failures: int


def climb(program: Program, start: Float[Array, " size"], data: Observations) -> Climb:
    """Follow the log density uphill from one start, then polish with Newton steps.

    Args:
        program: The model.
        start: Unconstrained vector.
        data: The capture.

    Returns:
        The optimum with its curvature and an honest status; never a zero covariance.
    """

    def potential(z: Array, _: None = None) -> Array:
        value = program.potential(z, data)
        return jnp.where(jnp.isfinite(value), value, 1e10)

    solver = optx.BFGS(rtol=1e-6, atol=1e-6)
    found = optx.minimise(potential, solver, start, max_steps=300, throw=False)

    def newton(_: int, z: Array) -> Array:
        gradient, hessian = jax.grad(potential)(z), jax.hessian(potential)(z)
        step = jnp.linalg.solve(hessian + 1e-9 * jnp.eye(program.size), gradient)
        closer = z - step
        return jnp.where(potential(closer) <= potential(z), closer, z)

    z = jax.lax.fori_loop(0, 3, newton, found.value)
    gradient, hessian = jax.grad(potential)(z), jax.hessian(potential)(z)
    factor = jnp.linalg.cholesky(hessian)
    is_maximum = jnp.all(jnp.isfinite(factor))
    safe = jnp.where(is_maximum, factor, jnp.eye(program.size))
    scaled = jax.scipy.linalg.solve_triangular(safe, gradient, lower=True)
    inverse = jax.scipy.linalg.cho_solve((safe, True), jnp.eye(program.size))
    decrement = jnp.where(is_maximum, jnp.linalg.norm(scaled), jnp.inf)
    converged = decrement < 1e-2
    status = jnp.where(
        ~is_maximum, Status.NOT_A_MAXIMUM, jnp.where(converged, Status.OK, Status.NOT_CONVERGED)
    )
    log_evidence = (
        -potential(z)
        + 0.5 * program.size * jnp.log(2.0 * jnp.pi)
        - jnp.sum(jnp.log(jnp.diagonal(safe)))
    )
    return Climb(
        z=z,
        potential=potential(z),
        decrement=decrement,
        covariance=jnp.where(is_maximum, inverse, jnp.nan),
        log_evidence=jnp.where(status == Status.OK, log_evidence, -jnp.inf),
        status=status,
    )


def distinct(climbs: Climb, *, starts: int) -> Modes | None:
    """Keep one climb per peak.

    Two climbs are the same peak when they lie within 0.1 posterior standard deviations of each
    other, in the curvature of the heavier.

    Args:
        climbs: A batch of climbs.
        starts: How many there are.

    Returns:
        The peaks, or None when no climb reached one.
    """
    order = np.argsort(-np.asarray(climbs.log_evidence), kind="stable")
    status, evidence = np.asarray(climbs.status), np.asarray(climbs.log_evidence)
    z, covariance = np.asarray(climbs.z), np.asarray(climbs.covariance)
    kept: list[int] = []
    for index in order:
        if status[index] != Status.OK:
            continue
        if all(_distance(z[index] - z[k], covariance[k]) > 0.1 for k in kept):
            kept.append(int(index))
    if not kept:
        return None
    weight = np.exp(evidence[kept] - evidence[kept[0]])
    return Modes(
        z=z[kept],
        covariance=covariance[kept],
        weight=weight / weight.sum(),
        decrement=np.asarray(climbs.decrement)[kept],
        starts=starts,
        failures=int(np.sum(status != Status.OK)),
    )


def _distance(step: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))
