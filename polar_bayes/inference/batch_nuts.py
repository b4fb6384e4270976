"""NUTS for the pixels whose posterior is not nearly normal: many short fits in one program."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro import infer

from polar_bayes.errors import FitError
from polar_bayes.inference.program import Program
from polar_bayes.inference.smc import PixelTempering
from polar_bayes.observation.data import Observations
from polar_bayes.repr_html import HTMLRepr

MOST_DOUBLINGS = 8


@dataclasses.dataclass(frozen=True)
class PixelNuts(HTMLRepr):
    """NUTS in each of many pixels, with a metric that is known before.

    Args:
        chains: Of each pixel, >= 2.
        warmup: Draws that find the step size, >= 10.
        draws: Kept draws of each chain, >= 50.
        target_acceptance: Between 0.5 and 1.
        largest_r_hat: Above it a pixel counts as not converged; between 1 and 100.
        start: None: chains begin around the mode, with the metric of the normal approximation; they
            see one mode and no other. Or they begin at tempered draws, with the metric of these,
            which see all; where chains do not mix, the tempered draws stay.

    Raises:
        FitError: A setting is outside its range.
    """

    chains: int = 2
    warmup: int = 150
    draws: int = 400
    target_acceptance: float = 0.9
    largest_r_hat: float = 1.05
    start: PixelTempering | None = None

    def __post_init__(self) -> None:
        for name, least in (("chains", 2), ("warmup", 10), ("draws", 50)):
            if getattr(self, name) < least:
                raise FitError(
                    f"{name} is {getattr(self, name)}",
                    where="PixelNuts",
                    hint=f"give {least} or more",
                )
        for name, low, high in (("target_acceptance", 0.5, 1.0), ("largest_r_hat", 1.0, 100.0)):
            if not low < getattr(self, name) < high:
                raise FitError(
                    f"{name} is {getattr(self, name)}",
                    where="PixelNuts",
                    hint=f"give a number between {low:g} and {high:g}",
                )


def chains(
    program: Program,
    settings: PixelNuts,
    data: Observations,
    starts: Float[Array, "chain size"],
    half: Float[Array, "size size"],
    key: Array,
) -> Float[Array, "chain draw size"]:
    """Chains in one pixel."""
    # Source: Hoffman & Gelman (2014), JMLR 15, 1593-1623.
    begin, advance = infer.hmc.hmc(
        potential_fn_gen=lambda data: lambda z: program.potential(z, data), algo="NUTS"
    )

    def chain(given: tuple[Array, Array]) -> Array:
        first, key = given
        value, gradient = jax.value_and_grad(program.potential)(first, data)
        state = begin(
            infer.util.ParamInfo(first, value, gradient),
            settings.warmup,
            step_size=0.5,
            inverse_mass_matrix=half.T @ half,
            dense_mass=True,
            adapt_mass_matrix=False,
            target_accept_prob=settings.target_acceptance,
            trajectory_length=None,
            max_tree_depth=MOST_DOUBLINGS,
            model_args=(data,),
            rng_key=jax.random.split(key)[1],
        )

        def move(state: Any, _: None) -> tuple[Any, Array]:
            state = advance(state, model_args=(data,))
            return state, state.z

        return jax.lax.scan(move, state, None, length=settings.warmup + settings.draws)[1]

    keys = jax.random.split(key, settings.chains)
    return jax.lax.map(chain, (starts, keys))[:, settings.warmup :]


def around_mode(
    program: Program,
    settings: PixelNuts,
    data: Observations,
    mode: Float[Array, " size"],
    half: Float[Array, "size size"],
    key: Array,
) -> Float[Array, "chain size"]:
    """Draws of the normal approximation, for chains to begin at."""

    def draw(key: Array) -> Array:
        noise = jax.random.normal(jax.random.split(key)[0], mode.shape, mode.dtype)
        found = mode + noise @ half
        return jnp.where(jnp.isfinite(program.potential(found, data)), found, mode)

    return jax.vmap(draw)(jax.random.split(key, settings.chains))
