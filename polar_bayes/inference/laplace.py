"""The Laplace approximation: a normal distribution at the heaviest mode.

NumPyro's `AutoLaplaceApproximation` supplies the guide, so users keep its methods; the mode
comes from our own climbs. Its one trap is mended here: where the Hessian is not positive
definite it silently returns zero width, and a fit that failed would look perfectly certain.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpyro import handlers
from numpyro.infer.autoguide import AutoLaplaceApproximation

from polar_bayes.errors import FitError
from polar_bayes.inference.modes import Modes
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations


@dataclasses.dataclass(frozen=True)
class Laplace:
    """Settings of the approximation.

    Args:
        draws: Draws from the fitted normal distribution, in `chains` groups for ArviZ.
        chains: Groups; the draws are independent, so they only serve diagnostics.

    Raises:
        FitError: Fewer than 50 draws or than 1 chain.
    """

    draws: int = 1000
    chains: int = 4

    def __post_init__(self) -> None:
        if self.draws < 50 or self.chains < 1:
            raise FitError(
                f"draws is {self.draws} and chains is {self.chains}",
                where="Laplace",
                mend="give at least 50 draws and 1 chain",
            )


def sample(
    program: Program, data: Observations, modes: Modes, key: Array, settings: Laplace
) -> np.ndarray:
    """Draw from NumPyro's guide at the heaviest mode.

    Args:
        program: The model.
        data: The capture.
        modes: The peaks.
        key: Random key.
        settings: How many draws.

    Returns:
        Unconstrained vectors (chain, draw, size); NaN where the guide has no width.
    """
    guide = AutoLaplaceApproximation(program.model)
    handlers.seed(guide, key)(data)
    # The guide orders its vector by site as the model declares them, ours by name.
    order = _guide_order(guide, program)
    location = jnp.asarray(modes.z[0])[order]
    covariance = guide.get_posterior({"auto_loc": location}).covariance_matrix
    covariance = jnp.where(jnp.diagonal(covariance) > 0.0, covariance, jnp.nan)
    factor = jnp.linalg.cholesky(covariance)
    noise = jax.random.normal(key, (settings.chains, settings.draws, program.size))
    drawn = location + noise @ factor.T
    return np.asarray(drawn)[..., np.argsort(order)]


def _guide_order(guide: AutoLaplaceApproximation, program: Program) -> np.ndarray:
    """For each entry of the guide's vector, its position in the program's."""
    positions = program.unravel(jnp.arange(program.size, dtype=float))
    unpacked = guide._unpack_latent(jnp.arange(program.size, dtype=float))
    order = np.empty(program.size, int)
    for name, ours in positions.items():
        order[np.asarray(unpacked[name], int).ravel()] = np.asarray(ours, int).ravel()
    return order
