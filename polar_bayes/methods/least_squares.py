"""Robust nonlinear least squares, without priors and without noise models.

The readings themselves are fitted, each variable in units of its own residual scatter, with the
soft L1 loss, by which residuals beyond about two of these units count less. Most published fits do
the same.
"""

import dataclasses
from typing import NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.program import Program, from_prior
from polar_bayes.methods.method import AbstractMethod, PosteriorDraws
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress


@dataclasses.dataclass(frozen=True)
class Point(AbstractMethod):
    """Robust least squares: the deterministic baseline, without priors and without noise models.

    Args:
        starts: Prior draws from which it descends; the best end is kept.

    Raises:
        FitError: Fewer than one start.
    """

    starts: int = 16

    def __post_init__(self) -> None:
        self.check_least(starts=1)

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        starts = from_prior(problem.program, problem.key, self.starts, problem.data)
        program, solve = problem.program, problem.compiled_model.made(_solver, None)
        found = solve(jnp.asarray(starts), problem.data)
        return PosteriorDraws(
            method="point",
            z=np.asarray(found.z)[None, None],
            stats={"loss": np.asarray(found.loss)[None, None]},
            problems=[] if found.converged else ["least squares did not meet its tolerance"],
            covariance=np.asarray(found.covariance),
            metadata={"standard_errors": standard_errors(program, found, problem.data)},
        )


def _solver(compiled_model: CompiledModel, _: None) -> JitOnce:
    program = compiled_model.program
    return JitOnce(lambda starts, data: estimate(program, data, starts))


class Estimate(NamedTuple):
    """The best of several fits, with what the covariance needs."""

    z: Float[Array, " size"]
    covariance: Float[Array, "size size"]
    converged: Array
    loss: Float[Array, ""]


def estimate(program: Program, data: Observations, starts: Float[Array, "start size"]) -> Estimate:
    """Run Levenberg-Marquardt from several starts, and re-estimate the scatter after one pass."""
    counts = jnp.stack([jnp.sum(data.fitted(name)) for name in program.observed])

    def residuals(z: Array, unit: Array) -> Array:
        parts = program.residuals(z, data)
        return jnp.concatenate([(parts[n] / unit[i]).ravel() for i, n in enumerate(parts)])

    def scatter(z: Array) -> Array:
        squares = [jnp.sum(part**2) for part in program.residuals(z, data).values()]
        return jnp.sqrt(jnp.stack(squares) / jnp.maximum(counts, 1)) + 1e-6

    def soften(z: Array, unit: Array) -> Array:
        # (sqrt(1 + r^2) - 1) = soft L1; its signed square root keeps the derivative at 0.
        r = residuals(z, unit)
        return r * jnp.sqrt(2.0 / (1.0 + jnp.sqrt(1.0 + r**2)))

    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)

    def descend(start: Array) -> tuple[Array, Array, Array]:
        unit = jnp.ones(len(program.observed)) * 0.05
        rough = optx.least_squares(soften, solver, start, unit, max_steps=100, throw=False)
        unit = scatter(rough.value)
        fine = optx.least_squares(soften, solver, rough.value, unit, max_steps=200, throw=False)
        loss = jnp.sum(jnp.stack([jnp.log(scatter(fine.value))]))
        converged = fine.result == optx.RESULTS.successful
        return fine.value, jnp.where(jnp.isfinite(loss), loss, jnp.inf), converged

    ends, losses, converged = jax.lax.map(descend, starts)
    best = jnp.argmin(jnp.where(converged, losses, losses + 1e6))
    z = ends[best]
    unit = scatter(z)
    jacobian = jax.jacfwd(lambda x: soften(x, unit))(z)
    values, vectors = jnp.linalg.eigh(jacobian.T @ jacobian)
    freedom = jnp.maximum(jnp.sum(counts) - program.size, 1)
    variance = jnp.sum(soften(z, unit) ** 2) / freedom
    inverse = jnp.where(values > 1e-10 * values[-1], variance / values, jnp.inf)
    unknown = jnp.isinf(inverse)
    covariance = (vectors * jnp.where(unknown, 0.0, inverse)) @ vectors.T
    undetermined = jnp.any((vectors**2 > 1e-6) & unknown, axis=1)
    covariance = covariance + jnp.diag(jnp.where(undetermined, jnp.inf, 0.0))
    return Estimate(z=z, covariance=covariance, converged=converged[best], loss=losses[best])


def standard_errors(
    program: Program, estimate: Estimate, data: Observations
) -> dict[str, list[float | None]]:
    """Return standard errors of parameters in their physical range, by the delta method."""
    infinite = np.isinf(np.diagonal(estimate.covariance))
    covariance = np.where(np.isinf(estimate.covariance), 0.0, estimate.covariance)
    errors = {}
    for name, slope in program.slopes(jnp.asarray(estimate.z), data).items():
        rows = np.asarray(slope).reshape(-1, program.size)
        sd = np.sqrt(np.einsum("ki,ij,kj->k", rows, covariance, rows))
        undetermined = (rows[:, infinite] != 0.0).any(axis=1)
        errors[name] = [
            None if unknown else float(x) for x, unknown in zip(sd, undetermined, strict=True)
        ]
    return errors
