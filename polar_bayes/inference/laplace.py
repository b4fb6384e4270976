"""The Laplace approximation, and robust nonlinear least squares.

The approximation is a normal distribution at the mode of largest weight (Tierney and Kadane 1986,
J. Am. Stat. Assoc. 81, 82-86). NumPyro's `AutoLaplaceApproximation` supplies the guide, so users
have its methods; the mode comes from `optimize`. Where the Hessian is not positive definite, the
guide silently has zero width, so that a failed fit would look certain: here such draws are NaN.

Least squares fit the readings themselves, each variable in units of its own residual scatter, with
the soft L1 loss, by which residuals beyond about two of these units count less. Most published fits
do the same.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from numpyro import handlers
from numpyro.infer.autoguide import AutoLaplaceApproximation

from polar_bayes.errors import FitError
from polar_bayes.inference.compile import JitOnce
from polar_bayes.inference.optimize import Modes, ValueAndGradient
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations


@dataclasses.dataclass(frozen=True)
class LaplaceSettings:
    """Number of draws, and groups of them; `Laplace` explains each."""

    draws: int = 500
    chains: int = 4

    def __post_init__(self) -> None:
        if self.draws < 50 or self.chains < 1:
            raise FitError(
                f"draws is {self.draws} and chains is {self.chains}",
                where="Laplace",
                hint="give at least 50 draws and 1 chain",
            )


Guide = Callable[[Array, Array, Observations], tuple[Array, Array, Array]]
"""From a mode, its precision and the data to location and Cholesky factor of the guide, and to the
order of its coordinates."""


def sample(
    program: Program,
    guide: Guide,
    data: Observations,
    potential: ValueAndGradient,
    modes: Modes,
    key: Array,
    settings: LaplaceSettings,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Draws (chain, draw, size) from NumPyro's guide at the heaviest mode, and statistics."""
    location, factor, order = guide(
        jnp.asarray(modes.z[0]), jnp.linalg.inv(jnp.asarray(modes.covariance[0])), data
    )
    # The guide reports a failure by a width of exactly zero.
    factor = jnp.where(jnp.diagonal(factor) > 0.0, factor, jnp.nan)
    noise = jax.random.normal(key, (settings.chains, settings.draws, program.size))
    drawn = location + noise @ factor.T
    z = np.asarray(drawn)[..., np.argsort(np.asarray(order))]
    return z, weigh(potential, z, np.asarray(noise))


def weigh(potential: ValueAndGradient, z: np.ndarray, noise: np.ndarray) -> dict[str, np.ndarray]:
    """Log density and log importance weight of draws that are affine in standard normal noise."""
    lp = -np.array([potential(draw)[0] for draw in z.reshape(-1, z.shape[-1])])
    lp = lp.reshape(z.shape[:2])
    return {"lp": lp, "log_weight": lp + 0.5 * np.sum(noise**2, axis=-1)}


def compiled_guide(program: Program) -> Guide:
    """NumPyro's guide around a mode, compiled for captures of the program's layout."""
    return JitOnce(functools.partial(_guide, program))


def _guide(
    program: Program, mode: Array, precision: Array, data: Observations
) -> tuple[Array, Array, Array]:
    """Location and Cholesky factor of NumPyro's guide, and the order of its coordinates."""
    # The guide orders sites as the model declares them, the program by name. The guide's own search
    # for a starting point is not needed, and compilation removes it.
    order = jnp.zeros(program.size, int)
    guide = AutoLaplaceApproximation(
        program.model, hessian_fn=lambda _, location: precision[order][:, order]
    )
    handlers.seed(guide, jax.random.key(0))(data)
    numbers = jnp.arange(program.size, dtype=mode.dtype)
    unpacked = guide._unpack_latent(numbers)
    for name, positions in program.unravel(numbers).items():
        of_guide = unpacked[name].ravel().astype(int)
        order = order.at[of_guide].set(positions.ravel().astype(int))
    posterior = guide.get_posterior({"auto_loc": mode[order]})
    return posterior.loc, posterior.scale_tril, order


# --- Robust least squares, without priors and without noise models --------------------------------


class Estimate(NamedTuple):
    """The best of several fits."""

    z: Float[Array, " size"]
    covariance: Float[Array, "size size"]
    converged: Array
    loss: Float[Array, ""]


def estimate(program: Program, data: Observations, starts: Float[Array, "start size"]) -> Estimate:
    """Levenberg-Marquardt from several starts; the scatter is re-estimated after the first pass."""

    def residuals(z: Array, unit: Array) -> Array:
        parts = program.residuals(z, data)
        return jnp.concatenate([(parts[n] / unit[i]).ravel() for i, n in enumerate(parts)])

    def scatter(z: Array) -> Array:
        parts = program.residuals(z, data).values()
        count = jnp.maximum(jnp.sum(data.valid), 1)
        return jnp.stack([jnp.sqrt(jnp.sum(part**2) / count) + 1e-6 for part in parts])

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
    freedom = jnp.maximum(jnp.sum(data.valid) * len(program.observed) - program.size, 1)
    variance = jnp.sum(soften(z, unit) ** 2) / freedom
    inverse = jnp.where(values > 1e-10 * values[-1], variance / values, jnp.inf)
    unknown = jnp.isinf(inverse)
    covariance = (vectors * jnp.where(unknown, 0.0, inverse)) @ vectors.T
    undetermined = jnp.any((vectors**2 > 1e-6) & unknown, axis=1)
    covariance = covariance + jnp.diag(jnp.where(undetermined, jnp.inf, 0.0))
    return Estimate(z=z, covariance=covariance, converged=converged[best], loss=losses[best])


def to_numpy(estimate: Estimate) -> Estimate:
    """An estimate with NumPy arrays."""
    return jax.tree.map(np.asarray, estimate)


def standard_errors(program: Program, estimate: Estimate) -> dict[str, list[float | None]]:
    """Standard errors of the parameters in their physical range, by the delta method."""
    infinite = np.isinf(np.diagonal(estimate.covariance))
    covariance = np.where(np.isinf(estimate.covariance), 0.0, estimate.covariance)
    errors = {}
    for name, slope in program.slopes(jnp.asarray(estimate.z)).items():
        rows = np.asarray(slope).reshape(-1, program.size)
        sd = np.sqrt(np.einsum("ki,ij,kj->k", rows, covariance, rows))
        undetermined = (rows[:, infinite] != 0.0).any(axis=1)
        errors[name] = [
            None if unknown else float(x) for x, unknown in zip(sd, undetermined, strict=True)
        ]
    return errors
