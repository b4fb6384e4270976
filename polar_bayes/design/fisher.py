r"""Fisher information of readings about the unconstrained coordinates of a model.

$$ F(z) = \sum_{readings} J^T I(\phi) J, \quad J = \partial\phi / \partial z $$

with $\phi$ the parameters of each reading's distribution and $I$ its information about them,

$$ I(\phi) = E[\nabla_\phi \log p(x|\phi) \, \nabla_\phi \log p(x|\phi)^T] $$

(Lehmann & Casella 1998, Theory of Point Estimation, sections 2.5 and 2.6). Noise and instrument
parameters are among the coordinates, so $F$ counts what they take away from the material.

The paper counts each degree of polarization with its concentration,

$$ F_{paper} = \sum_i \kappa_i S_i S_i^T, \quad S_i = \partial\rho_i / \partial z $$

The exact information of a Beta reading about its mean is
$\kappa^2[\psi_1(\mu\kappa) + \psi_1((1-\mu)\kappa)]$, which is about $\kappa/(\mu(1-\mu))$: four
times the paper's at $\mu = 1/2$ and without bound towards 0 and 1.
"""

import functools
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
import scipy.stats
from jax.scipy.special import polygamma
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.observation.distributions import MeanConcentrationBeta, SensorStudentT
from polar_bayes.priors import unwrapped

# --- Fisher information of one reading about the parameters of its own distribution ---------------


NODES = 400
"""Number of equally likely readings that average the information of a saturating sensor."""

FAR_FROM_MARGIN, MARGIN_NODES = 4.0, 128
"""Sds between the mean of a Beta distribution and the margin from which no reading lies there
(1e-5); number of readings that average the information elsewhere."""


FisherInformation = tuple[tuple[Array, ...], Array]
"""The parameters of a distribution, and the information of one reading about them."""


def information(distribution: dist.Distribution) -> FisherInformation:
    """Return the Fisher information of one reading about its distribution's parameters."""
    shape = distribution.batch_shape
    parameters, matrix = _information(unwrapped(distribution))
    parameters = tuple(jnp.broadcast_to(x, shape) for x in parameters)
    return parameters, jnp.broadcast_to(matrix, (*shape, *matrix.shape[-2:]))


@functools.singledispatch
def _information(distribution: dist.Distribution) -> FisherInformation:
    """The same by the kind of distribution, broadcast only as far as its parameters are."""
    known = (kind.__name__ for kind in _information.registry if kind is not object)
    what = f"the Fisher information of {type(distribution).__name__} is not known"
    hint = f"use a link that gives one of {', '.join(known)}"
    raise FitError(what, where="identify", hint=hint)


def _symmetric(first: Array, across: Array, second: Array) -> Array:
    """Return the 2 x 2 matrix [[first, across], [across, second]]."""
    entries = jnp.broadcast_arrays(first, across, across, second)
    return jnp.stack(entries, axis=-1).reshape(*entries[0].shape, 2, 2)


@_information.register
def _(normal: dist.Normal) -> FisherInformation:
    precision = normal.scale**-2.0
    matrix = _symmetric(precision, jnp.zeros_like(precision), 2.0 * precision)
    return (normal.loc, normal.scale), matrix


@_information.register
def _(student: dist.StudentT) -> FisherInformation:
    """Information on location and scale of Student's t: Lange et al. (1989), JASA 84, 881-896."""
    freedom, precision = student.df, student.scale**-2.0
    location = (freedom + 1.0) / (freedom + 3.0) * precision
    scale = 2.0 * freedom / (freedom + 3.0) * precision
    matrix = _symmetric(location, jnp.zeros_like(precision), scale)
    return (student.loc, student.scale), matrix


@_information.register
def _(sensor: SensorStudentT) -> FisherInformation:
    """Information on location and scale: the mean outer product of scores at noise quantiles."""
    freedom = sensor.degrees_of_freedom
    nodes = scipy.stats.t(freedom).ppf((np.arange(NODES) + 0.5) / NODES)

    def outer_score(node: Array, location: Array, scale: Array, stop: Array) -> Array:
        value = jnp.clip(location + scale * node, 0.0, stop)
        is_saturated = location + scale * node >= stop

        def log_prob(at: Array) -> Array:
            return SensorStudentT(freedom, at[0], at[1], is_saturated, stop).log_prob(value)

        score = jax.grad(log_prob)(jnp.stack([location, scale]))
        return jnp.outer(score, score)

    def mean_outer_score(*reading: Array) -> Array:
        return jnp.mean(jax.vmap(lambda node: outer_score(node, *reading))(nodes), axis=0)

    of_all = jnp.vectorize(mean_outer_score, signature="(),(),()->(p,p)")
    matrix = of_all(sensor.location, sensor.scale, sensor.full_scale)
    return (sensor.location, sensor.scale), matrix


@_information.register
def _(beta: MeanConcentrationBeta) -> FisherInformation:
    r"""Information on mean and concentration.

    The information on the mean is $\kappa^2[\psi_1(\mu\kappa)+\psi_1((1-\mu)\kappa)]$.
    """
    mean, concentration = beta.mean_value, beta.concentration
    first, second, whole = (
        polygamma(1, x) for x in (mean * concentration, (1.0 - mean) * concentration, concentration)
    )
    of_mean = concentration**2 * (first + second)
    across = concentration * (mean * first - (1.0 - mean) * second)
    of_concentration = mean**2 * first + (1.0 - mean) ** 2 * second - whole
    matrix = _symmetric(of_mean, across, of_concentration)
    if beta.margin:
        nearest = concentration * jnp.minimum(mean, 1.0 - mean)
        is_far = nearest - concentration * beta.margin > FAR_FROM_MARGIN * jnp.sqrt(nearest)
        censored = jnp.vectorize(
            functools.partial(_censored_beta, margin=beta.margin), signature="(),()->(p,p)"
        )(mean, concentration)
        matrix = jnp.where(is_far[..., None, None], matrix, censored)
    return (mean, concentration), matrix


@_information.register
def _(transformed: dist.TransformedDistribution) -> FisherInformation:
    return information(transformed.base_dist)  # a fixed change of variables leaves it as it is


def _censored_beta(mean: Array, concentration: Array, margin: float) -> Array:
    """Mean outer product of scores: by quadrature between the margins, and at both ends."""
    end = math.log(margin) - math.log1p(-margin)
    nodes, weights = np.polynomial.legendre.leggauss(MARGIN_NODES)
    inside = scipy.special.expit(end * nodes)
    reading = jnp.asarray(np.concatenate([inside, [margin, 1.0 - margin]]), mean.dtype)
    volume = np.concatenate([-end * weights * inside * (1.0 - inside), [1.0, 1.0]])

    def log_prob(at: Array, value: Array) -> Array:
        return MeanConcentrationBeta(at[0], at[1], margin).log_prob(value)

    def term(value: Array, volume: Array) -> Array:
        log_density, score = jax.value_and_grad(log_prob)(jnp.stack([mean, concentration]), value)
        return volume * jnp.exp(log_density) * jnp.outer(score, score)

    return jnp.sum(jax.vmap(term)(reading, jnp.asarray(volume, mean.dtype)), axis=0)


# --- Fisher information of a capture about the unconstrained coordinates of a model ---------------


STEP = 1e-4
"""Step of central differences in prior sds, which leaves about seven digits of a slope."""


class ReadingInformation(NamedTuple):
    """Factors of the Fisher information of one variable; 0 where readings are not valid."""

    jacobian: Float[Array, "... parameter size"]
    information: Float[Array, "... parameter parameter"]
    concentration: Float[Array, "..."] | None


def reading_information(
    program: Program,
    z: Float[Array, " size"],
    data: Observations,
    step: Float[Array, " size"] | None = None,
) -> dict[str, ReadingInformation]:
    """Return Jacobians and information matrices of all readings, by variable.

    With a step of each coordinate, slopes are central differences: only values are compiled.
    """

    def noise(z: Array) -> tuple[dict[str, Array], dict[str, dist.Distribution]]:
        trace = program.trace(z, data)
        found = {name: trace[name]["fn"] for name in program.observed}
        return {n: jnp.stack(information(each)[0], axis=-1) for n, each in found.items()}, found

    # Slopes and distributions come from one pass, so the optics run once; the information that is
    # not read there is not compiled.
    if step is None:
        jacobians, distributions = jax.jacfwd(noise, has_aux=True)(z)
    else:
        jacobians, distributions = _central_differences(noise, z, step)
    readings = {}
    for name, distribution in distributions.items():
        of_noise, matrix = information(distribution)
        is_beta = isinstance(unwrapped(distribution), MeanConcentrationBeta)
        is_fitted = data.fitted(name)[..., None, None]
        readings[name] = ReadingInformation(
            jnp.where(is_fitted, jacobians[name], 0.0),
            jnp.where(is_fitted, matrix, 0.0),
            of_noise[1] if is_beta else None,
        )
    return readings


def _central_differences[Slopes, Aux](
    function: Callable[[Array], tuple[Slopes, Aux]], z: Array, step: Array
) -> tuple[Slopes, Aux]:
    """Return Jacobians of the first part of a function's value, and the second part."""
    shift = jnp.diag(step)
    values, aux = jax.lax.map(function, jnp.concatenate([z[None], z + shift, z - shift]))

    def slopes(rows: Array) -> Array:
        ahead, behind = jnp.split(rows[1:], 2)
        return jnp.moveaxis(ahead - behind, 0, -1) / (2.0 * step)

    return jax.tree.map(slopes, values), jax.tree.map(lambda rows: rows[0], aux)


def total_information(readings: Mapping[str, ReadingInformation]) -> Float[Array, "size size"]:
    """Return the Fisher information of all readings about the unconstrained coordinates."""
    total = functools.partial(jnp.einsum, "...ki,...kl,...lj->ij")
    parts = [total(each.jacobian, each.information, each.jacobian) for each in readings.values()]
    return jnp.sum(jnp.stack(parts), axis=0)


def information_by_view(
    readings: Mapping[str, ReadingInformation], axes: tuple[int, ...]
) -> dict[str, Float[Array, "reading size size"]]:
    """Return the information by variable and view (and wavelength), on the last axes."""
    views = int(np.prod(axes))

    def by_view(jacobian: Array, matrix: Array) -> Array:
        jacobian, matrix = (x.reshape(-1, views, *x.shape[-2:]) for x in (jacobian, matrix))
        return jnp.einsum("nvki,nvkl,nvlj->vij", jacobian, matrix, jacobian)

    return {name: by_view(each.jacobian, each.information) for name, each in readings.items()}


def paper_information(
    readings: Mapping[str, ReadingInformation], size: int
) -> tuple[Float[Array, "size size"], Float[Array, "size size"]]:
    """Return the paper's sum over readings with Beta noise, and the exact information."""
    # The noise counts as known in both: only the means move.
    # Source: The paper, on identifiability: the sum of kappa S S' over views.
    of_beta = [each for each in readings.values() if each.concentration is not None]
    if not of_beta:
        unknown = jnp.full((size, size), jnp.nan)
        return unknown, unknown

    def weighted_sum(weights: list[Array]) -> Array:
        means = [each.jacobian[..., 0, :] for each in of_beta]
        pairs = zip(means, weights, strict=True)
        parts = [jnp.einsum("...i,...,...j->ij", mean, weight, mean) for mean, weight in pairs]
        return jnp.sum(jnp.stack(parts), axis=0)

    return (
        weighted_sum([jnp.asarray(each.concentration) for each in of_beta]),
        weighted_sum([each.information[..., 0, 0] for each in of_beta]),
    )


# --- The precision of the prior -------------------------------------------------------------------


def prior_precision(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Float[Array, "size size"]:
    """Return the Hessian of minus the log prior of the unconstrained coordinates."""
    return jax.hessian(lambda z: program.prior_potential(z, data))(z)


def positive_definite(
    hessian: Float[np.ndarray, "size size"], draws: Float[np.ndarray, "draw size"]
) -> Float[np.ndarray, "size size"]:
    """Return a prior's Hessian, or the inverse covariance of its draws if it is indefinite."""
    # Far in the tail of a bounded prior, and in the funnel of a population, the log density is not
    # concave in every direction.
    try:
        np.linalg.cholesky(hessian)
        return 0.5 * (hessian + hessian.T)
    except np.linalg.LinAlgError:
        variance = np.var(draws, axis=0) + 1e-12
        if len(draws) < 10 * draws.shape[1]:  # too few draws for a full covariance
            return np.diag(1.0 / variance)
        return np.linalg.inv(np.cov(draws.T) + 1e-12 * np.diag(variance))
