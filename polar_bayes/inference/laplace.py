"""The Laplace approximation: a normal distribution at the heaviest mode.

NumPyro's `AutoLaplaceApproximation` supplies the guide, so users keep its methods; the mode
comes from our own climbs. Its one trap is mended here: where the Hessian is not positive
definite it silently returns zero width, and a fit that failed would look perfectly certain.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpyro import handlers
from numpyro.infer.autoguide import AutoLaplaceApproximation

from polar_bayes.cards import Carded
from polar_bayes.errors import FitError
from polar_bayes.inference.modes import Modes, ValueAndGradient
from polar_bayes.inference.program import Program
from polar_bayes.inference.tracing import TracedOnce
from polar_bayes.observation.data import Observations


@dataclasses.dataclass(frozen=True)
class Laplace(Carded):
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


Guide = Callable[[Array, Array, Observations], tuple[Array, Array, Array]]
"""Of a mode, its precision and the data: location and Cholesky factor of the guide, and order."""


def sample(
    program: Program,
    guide: Guide,
    data: Observations,
    potential: ValueAndGradient,
    modes: Modes,
    key: Array,
    settings: Laplace,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Draw from NumPyro's guide at the heaviest mode."""
    location, factor, order = guide(
        jnp.asarray(modes.z[0]), jnp.linalg.inv(jnp.asarray(modes.covariance[0])), data
    )
    # The guide's own sign of failure is a width of exactly zero.
    factor = jnp.where(jnp.diagonal(factor) > 0.0, factor, jnp.nan)
    noise = jax.random.normal(key, (settings.chains, settings.draws, program.size))
    drawn = location + noise @ factor.T
    z = np.asarray(drawn)[..., np.argsort(np.asarray(order))]
    lp = -np.array([potential(draw)[0] for draw in z.reshape(-1, program.size)])
    approximation = -0.5 * np.asarray(jnp.sum(noise**2, axis=-1))
    lp = lp.reshape(z.shape[:2])
    return z, {"lp": lp, "log_weight": lp - approximation}


def compiled_guide(program: Program) -> Guide:
    """NumPyro's guide around a mode, compiled for captures of the program's layout."""
    return TracedOnce(functools.partial(_guide, program))


def _guide(
    program: Program, mode: Array, precision: Array, data: Observations
) -> tuple[Array, Array, Array]:
    """Location and Cholesky factor of NumPyro's guide, and the order of its coordinates."""
    # The guide strings sites together as the model declares them, the program by name. Inside one
    # compiled function the guide's search for a start of its own, which is not needed, drops out.
    order = jnp.zeros(program.size, int)
    guide = AutoLaplaceApproximation(
        program.model, hessian_fn=lambda _, location: precision[order][:, order]
    )
    handlers.seed(guide, jax.random.key(0))(data)
    numbers = jnp.arange(program.size, dtype=mode.dtype)
    unpacked = guide._unpack_latent(numbers)
    for name, ours in program.unravel(numbers).items():
        theirs = unpacked[name].ravel().astype(int)
        order = order.at[theirs].set(ours.ravel().astype(int))
    posterior = guide.get_posterior({"auto_loc": mode[order]})
    return posterior.loc, posterior.scale_tril, order
