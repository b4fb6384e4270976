r"""What all readings of a capture tell of a model's coordinates, and what its prior does.

$$ F(z) = \sum_{readings} J^T I(\phi) J, \quad J = \partial\phi / \partial z $$

with $\phi$ the parameters of each reading's distribution. Noise and instrument parameters are among
the coordinates, so what they take away from the material is counted.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro import handlers

from polar_bayes.identifiability.information import bare, information
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.observation.distributions import MeanConcentrationBeta


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
