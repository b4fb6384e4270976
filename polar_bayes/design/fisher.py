r"""What all readings of a capture tell of a model's coordinates, and what its prior does.

$$ F(z) = \sum_{readings} J^T I(\phi) J, \quad J = \partial\phi / \partial z $$

with $\phi$ the parameters of each reading's distribution. Noise and instrument parameters are among
the coordinates, so what they take away from the material is counted.

$$ I(\phi) = E[\nabla_\phi \log p(x|\phi) \, \nabla_\phi \log p(x|\phi)^T] $$

Each distribution that a link can give has its entry here: what its parameters are, and their
information. The information about anything that these depend on follows by the chain rule.

$$ F_{paper} = \sum_i \kappa_i S_i S_i^T, \quad S_i = \partial\rho_i / \partial z $$

A Beta reading of mean $\mu$ tells more. Its exact information about the mean is
$\kappa^2[\psi_1(\mu\kappa) + \psi_1((1-\mu)\kappa)]$, which is about $\kappa/(\mu(1-\mu))$: four
times the paper's at $\mu = 1/2$ and without bound towards 0 and 1.
"""

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jax.scipy.special import polygamma
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro import handlers

from polar_bayes.errors import FitError
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.observation.distributions import MeanConcentrationBeta, SensorStudentT

# --- Fisher information of one reading about the parameters of its own distribution ---------------


NODES = 400
"""Equally likely readings over which the information of a sensor with stops is averaged."""


class Told(NamedTuple):
    """A distribution's parameters, and what one reading tells of them."""

    parameters: tuple[Float[Array, "..."], ...]
    information: Float[Array, "... parameter parameter"]


def information(distribution: dist.Distribution) -> Told:
    """Fisher information of one reading about the parameters of its distribution."""
    # Source: Lehmann & Casella (1998), Theory of Point Estimation, section 2.5.
    shape = distribution.batch_shape
    distribution = bare(distribution)
    for family, told in _FAMILIES.items():
        if type(distribution) is family:
            found = told(distribution)
            size = len(found.parameters)
            return Told(
                tuple(jnp.broadcast_to(x, shape) for x in found.parameters),
                jnp.broadcast_to(found.information, (*shape, size, size)),
            )
    raise FitError(
        f"the Fisher information of {type(distribution).__name__} is not known",
        where="identify",
        hint=f"use a link that gives one of {', '.join(f.__name__ for f in _FAMILIES)}",
    )


def bare(distribution: dist.Distribution) -> dist.Distribution:
    """A distribution without the masks and expansions around it."""
    while isinstance(distribution, _WRAPPED):
        distribution = distribution.base_dist
    return distribution


def _matrix(rows: list[list[Array]]) -> Array:
    return jnp.stack([jnp.stack(jnp.broadcast_arrays(*row), axis=-1) for row in rows], axis=-2)


def _normal(normal: dist.Normal) -> Told:
    nothing, precision = jnp.zeros_like(normal.scale), normal.scale**-2.0
    return Told(
        (normal.loc, normal.scale), _matrix([[precision, nothing], [nothing, 2.0 * precision]])
    )


def _student(student: dist.StudentT) -> Told:
    """Location and scale; degrees of freedom are given. Lange et al. (1989), JASA 84, 881-896."""
    freedom, nothing, precision = student.df, jnp.zeros_like(student.scale), student.scale**-2.0
    location = (freedom + 1.0) / (freedom + 3.0) * precision
    scale = 2.0 * freedom / (freedom + 3.0) * precision
    return Told((student.loc, student.scale), _matrix([[location, nothing], [nothing, scale]]))


def _sensor(sensor: SensorStudentT) -> Told:
    """Location and scale, averaged over readings; those at a stop tell only that they stopped."""
    freedom, stop = sensor.degrees_of_freedom, sensor.full_scale
    nodes = scipy.stats.t(freedom).ppf((np.arange(NODES) + 0.5) / NODES)

    def score(node: Array, location: Array, scale: Array, stop: Array) -> Array:
        value = jnp.clip(location + scale * node, 0.0, stop)
        is_saturated = location + scale * node >= stop

        def log_prob(at: Array) -> Array:
            return SensorStudentT(freedom, at[0], at[1], is_saturated, stop).log_prob(value)

        slope = jax.grad(log_prob)(jnp.stack([location, scale]))
        return jnp.outer(slope, slope)

    told = functools.reduce(
        lambda function, _: jax.vmap(function), range(sensor.location.ndim), _averaged(score, nodes)
    )
    parts = jnp.broadcast_arrays(sensor.location, sensor.scale, stop)
    return Told((sensor.location, sensor.scale), told(*parts))


def _averaged(function: Callable, nodes: np.ndarray) -> Callable:
    return lambda *given: jnp.mean(jax.vmap(lambda node: function(node, *given))(nodes), axis=0)


def _beta(beta: MeanConcentrationBeta) -> Told:
    r"""Mean and concentration: for the mean $\kappa^2[\psi_1(\mu\kappa)+\psi_1((1-\mu)\kappa)]$."""
    mean, concentration = beta.mean_value, beta.concentration
    first, second, whole = (
        polygamma(1, x) for x in (mean * concentration, (1.0 - mean) * concentration, concentration)
    )
    of_mean = concentration**2 * (first + second)
    across = concentration * (mean * first - (1.0 - mean) * second)
    of_concentration = mean**2 * first + (1.0 - mean) ** 2 * second - whole
    return Told((mean, concentration), _matrix([[of_mean, across], [across, of_concentration]]))


def _transformed(transformed: dist.TransformedDistribution) -> Told:
    """A fixed change of the reading changes no information: that of the base distribution."""
    return information(transformed.base_dist)


_WRAPPED = (dist.MaskedDistribution, dist.ExpandedDistribution, dist.Independent)
_FAMILIES: dict[type, Callable] = {
    dist.Normal: _normal,
    dist.StudentT: _student,
    SensorStudentT: _sensor,
    MeanConcentrationBeta: _beta,
    dist.TransformedDistribution: _transformed,
}


# --- What all readings of a capture tell of a model's coordinates, and what its prior does --------


class Seen(NamedTuple):
    """What the readings of one variable see of the coordinates; 0 where they are not valid."""

    slope: Array
    information: Array
    concentration: Array | None


def look(program: Program, z: Float[Array, " size"], data: Observations) -> dict[str, Seen]:
    """Derivatives and information of every reading, with the optics told once."""

    def told(z: Array) -> tuple[dict[str, Array], dict[str, tuple]]:
        fixed = distributions(program, z, data)
        found = {name: information(each) for name, each in fixed.items()}
        parameters = {name: jnp.stack(one.parameters, axis=-1) for name, one in found.items()}
        is_beta = {n: isinstance(bare(each), MeanConcentrationBeta) for n, each in fixed.items()}
        return parameters, {
            name: (one.information, one.parameters[1] if is_beta[name] else None)
            for name, one in found.items()
        }

    slopes, beside = jax.jacfwd(told, has_aux=True)(z)
    valid = data.valid[..., None, None]
    return {
        name: Seen(jnp.where(valid, slopes[name], 0.0), jnp.where(valid, each, 0.0), concentration)
        for name, (each, concentration) in beside.items()
    }


def expected_information(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Float[Array, "size size"]:
    """Fisher information of a capture's layout about the unconstrained coordinates."""
    return sum_information(look(program, z, data))


def sum_information(seen: Mapping[str, Seen]) -> Float[Array, "size size"]:
    """Fisher information of all readings about the unconstrained coordinates."""
    parts = [
        jnp.einsum("...ki,...kl,...lj->ij", each.slope, each.information, each.slope)
        for each in seen.values()
    ]
    return jnp.sum(jnp.stack(parts), axis=0)


def information_of_each(
    program: Program, z: Float[Array, " size"], data: Observations, kept: int
) -> dict[str, Float[Array, "reading size size"]]:
    """The same for every variable and view, or every variable, wavelength and view."""
    apart = int(np.prod(data.shape[len(data.shape) - kept :]))

    def of_each(slope: Array, each: Array) -> Array:
        slope, each = (x.reshape(-1, apart, *x.shape[-2:]) for x in (slope, each))
        return jnp.einsum("nvki,nvkl,nvlj->vij", slope, each, slope)

    return {
        name: of_each(each.slope, each.information) for name, each in look(program, z, data).items()
    }


def distributions(
    program: Program, z: Float[Array, " size"], data: Observations
) -> dict[str, dist.Distribution]:
    """How the readings of every observed variable scatter at a point."""
    fixed = handlers.substitute(program.model, data=program.constrain(z))
    trace = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(data)
    return {name: trace[name]["fn"] for name in program.observed}


def prior_precision(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Float[Array, "size size"]:
    """Curvature of minus the log prior of the unconstrained coordinates."""
    return jax.hessian(lambda z: program.prior_potential(z, data))(z)


def sound_precision(
    curvature: Float[np.ndarray, "size size"], draws: Float[np.ndarray, "draw size"]
) -> Float[np.ndarray, "size size"]:
    """The curvature of a prior, or the inverse covariance of its draws where it is no precision."""
    # Far in the tail of a bounded prior, and in the funnel of a population, the curvature has a
    # direction in which the density bends the other way.
    try:
        np.linalg.cholesky(curvature)
        return 0.5 * (curvature + curvature.T)
    except np.linalg.LinAlgError:
        spread = np.var(draws, axis=0) + 1e-12
        few = len(draws) < 10 * draws.shape[1]
        return (
            np.diag(1.0 / spread)
            if few
            else np.linalg.inv(np.cov(draws.T) + 1e-12 * np.diag(spread))
        )


# --- The information of the paper: every degree of polarization counts with its concentration -----


def paper_information(
    program: Program, z: Float[Array, " size"], data: Observations
) -> tuple[Float[Array, "size size"], Float[Array, "size size"]]:
    """The paper's sum over the readings with Beta noise, and the exact one about their means."""
    # The noise counts as known in both: only the means move.
    # Source: The paper, on identifiability: the sum of kappa S S' over views.
    return sum_as_paper(look(program, z, data), program.size)


def sum_as_paper(
    seen: Mapping[str, Seen], size: int
) -> tuple[Float[Array, "size size"], Float[Array, "size size"]]:
    """The same from what the readings see."""
    paper: list[Array] = []
    exact: list[Array] = []
    for each in seen.values():
        if each.concentration is not None:
            mean = each.slope[..., 0, :]
            weights = (each.concentration, each.information[..., 0, 0])
            for found, weight in zip((paper, exact), weights, strict=True):
                found.append(jnp.einsum("...i,...,...j->ij", mean, weight, mean))
    if not paper:
        nothing = jnp.full((size, size), jnp.nan)
        return nothing, nothing
    return jnp.sum(jnp.stack(paper), axis=0), jnp.sum(jnp.stack(exact), axis=0)


def sd_with(
    information: Float[np.ndarray, "size size"],
    prior: Float[np.ndarray, "size size"],
    slopes: Float[np.ndarray, "parameter size"],
) -> Float[np.ndarray, " parameter"]:
    """Standard deviations of parameters, expected from an information matrix and a prior."""
    covariance = np.linalg.inv(information + prior)
    return np.sqrt(np.einsum("pi,ij,pj->p", slopes, covariance, slopes))
