r"""What all readings of a capture tell of a model's coordinates, and what its prior does.

$$ F(z) = \sum_{readings} J^T I(\phi) J, \quad J = \partial\phi / \partial z $$

with $\phi$ the parameters of each reading's distribution. Noise and instrument parameters are among
the coordinates, so what they take away from the material is counted.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro import handlers
from numpyro.infer.util import potential_energy

from polar_bayes.identifiability.information import information
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations


def expected_information(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Float[Array, "size size"]:
    """Fisher information of a capture's layout about the unconstrained coordinates.

    Args:
        program: The model.
        z: Where.
        data: Directions, masks and brightness count; the readings do not.

    Returns:
        The matrix, without the prior.

    Raises:
        FitError: A link gives a distribution of which nothing is known.
    """

    def told(z: Array) -> dict:
        fixed = handlers.substitute(program.model, data=program.constrain(z))
        trace = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(data)
        return {name: information(trace[name]["fn"]) for name in program.observed}

    def parameters(z: Array) -> dict[str, Array]:
        return {name: jnp.stack(one.parameters, axis=-1) for name, one in told(z).items()}

    slopes, here = jax.jacfwd(parameters)(z), told(z)
    found = jnp.zeros((program.size, program.size), z.dtype)
    for name in program.observed:
        each = jnp.where(data.valid[..., None, None], here[name].information, 0.0)
        slope = jnp.where(data.valid[..., None, None], slopes[name], 0.0)
        found = found + jnp.einsum("...ki,...kl,...lj->ij", slope, each, slope)
    return found


def prior_precision(
    program: Program, z: Float[Array, " size"], data: Observations
) -> Float[Array, "size size"]:
    """Curvature of minus the log prior of the unconstrained coordinates.

    Args:
        program: The model.
        z: Where.
        data: Any capture of the layout.

    Returns:
        The matrix.

    Raises:
        Nothing.
    """
    alone = handlers.block(program.model, hide=list(program.observed))
    return jax.hessian(lambda z: potential_energy(alone, (data,), {}, program.unravel(z)))(z)
