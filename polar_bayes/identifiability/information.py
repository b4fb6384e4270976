r"""Fisher information of one reading about the parameters of its own distribution.

$$ I(\phi) = E[\nabla_\phi \log p(x|\phi) \, \nabla_\phi \log p(x|\phi)^T] $$

Each distribution that a link can give has its entry here: what its parameters are, and their
information. The information about anything that these depend on follows by the chain rule.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jax.scipy.special import polygamma
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.observation.distributions import MeanConcentrationBeta, SensorStudentT

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
        mend=f"use a link that gives one of {', '.join(f.__name__ for f in _FAMILIES)}",
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
