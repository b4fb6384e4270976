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
from numpyro.infer import init_to_median
from numpyro.infer.autoguide import AutoLaplaceApproximation

from polar_bayes.errors import FitError
from polar_bayes.inference.modes import Modes, ValueAndGradient
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

    draws: int = 500
    chains: int = 4

    def __post_init__(self) -> None:
        if self.draws < 50 or self.chains < 1:
            raise FitError(
                f"draws is {self.draws} and chains is {self.chains}",
                where="Laplace",
                mend="give at least 50 draws and 1 chain",
            )


def sample(
    program: Program,
    data: Observations,
    potential: ValueAndGradient,
    modes: Modes,
    key: Array,
    settings: Laplace,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Draw from NumPyro's guide at the heaviest mode.

    Args:
        program: The model.
        data: The capture.
        potential: Minus the log density and its gradient, already compiled.
        modes: The peaks.
        key: Random key.
        settings: How many draws.

    Returns:
        Unconstrained draws (chain, draw, size), NaN where the guide has no width; and their
        statistics: the log density `lp` and the `log_weight` of posterior over approximation.
    """
    mode, precision = modes.z[0], np.linalg.inv(modes.covariance[0])
    positions: list[np.ndarray] = []

    def hessian(_: object, location: Array) -> Array:
        order = positions[0]
        return jnp.asarray(precision[np.ix_(order, order)], location.dtype)

    guide = AutoLaplaceApproximation(
        program.model, init_loc_fn=init_to_median(num_samples=1), hessian_fn=hessian
    )
    handlers.seed(guide, key)(data)
    order = _guide_order(guide, program)
    positions.append(order)
    covariance = guide.get_posterior({"auto_loc": jnp.asarray(mode[order])}).covariance_matrix
    covariance = jnp.where(jnp.diagonal(covariance) > 0.0, covariance, jnp.nan)
    factor = jnp.linalg.cholesky(covariance)
    noise = jax.random.normal(key, (settings.chains, settings.draws, program.size))
    drawn = mode[order] + noise @ factor.T
    z = np.asarray(drawn)[..., np.argsort(order)]
    lp = -np.array([potential(draw)[0] for draw in z.reshape(-1, program.size)])
    approximation = -0.5 * np.asarray(jnp.sum(noise**2, axis=-1))
    lp = lp.reshape(z.shape[:2])
    return z, {"lp": lp, "log_weight": lp - approximation}


def _guide_order(guide: AutoLaplaceApproximation, program: Program) -> np.ndarray:
    """For each entry of the guide's vector, its position in the program's.

    The guide strings sites together as the model declares them, the program by name.
    """
    positions = program.unravel(jnp.arange(program.size, dtype=float))
    unpacked = guide._unpack_latent(jnp.arange(program.size, dtype=float))
    order = np.empty(program.size, int)
    for name, ours in positions.items():
        order[np.asarray(unpacked[name], int).ravel()] = np.asarray(ours, int).ravel()
    return order
