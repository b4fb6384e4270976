"""NUTS for the pixels whose posterior is not nearly normal: many short fits in one program."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro import infer

from polar_bayes.errors import FitError
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

MOST_DOUBLINGS = 8


@dataclasses.dataclass(frozen=True)
class PixelNuts:
    """NUTS in each of many pixels, with the metric of the normal approximation.

    Args:
        chains: Of each pixel, >= 2.
        warmup: Draws that find the step size, >= 10.
        draws: Kept draws of each chain, >= 50.
        target_acceptance: Between 0.5 and 1.
        largest_r_hat: Above it a pixel counts as not converged; between 1 and 100.

    Raises:
        FitError: A setting is outside its range.
    """

    chains: int = 2
    warmup: int = 150
    draws: int = 400
    target_acceptance: float = 0.9
    largest_r_hat: float = 1.05

    def __post_init__(self) -> None:
        for name, least in (("chains", 2), ("warmup", 10), ("draws", 50)):
            if getattr(self, name) < least:
                raise FitError(
                    f"{name} is {getattr(self, name)}",
                    where="PixelNuts",
                    mend=f"give {least} or more",
                )
        for name, low, high in (("target_acceptance", 0.5, 1.0), ("largest_r_hat", 1.0, 100.0)):
            if not low < getattr(self, name) < high:
                raise FitError(
                    f"{name} is {getattr(self, name)}",
                    where="PixelNuts",
                    mend=f"give a number between {low:g} and {high:g}",
                )


def chains(
    program: Program,
    settings: PixelNuts,
    data: Observations,
    z: Float[Array, " size"],
    half: Float[Array, "size size"],
    key: Array,
) -> Float[Array, "chain draw size"]:
    """Chains in one pixel, each from a draw of the normal approximation.

    Args:
        program: The model of one pixel.
        settings: Lengths and goals.
        data: The pixel's readings.
        z: The mode.
        half: Widths there; `z + half.T @ e` are draws.
        key: Random key.

    Returns:
        Unconstrained draws after the warm-up.

    Raises:
        Nothing.

    Source:
        Hoffman & Gelman (2014), JMLR 15, 1593-1623.
    """
    start, advance = infer.hmc.hmc(
        potential_fn_gen=lambda data: lambda z: program.potential(z, data), algo="NUTS"
    )

    def chain(key: Array) -> Array:
        key_start, key_chain = jax.random.split(key)
        first = z + jax.random.normal(key_start, z.shape, z.dtype) @ half
        first = jnp.where(jnp.isfinite(program.potential(first, data)), first, z)
        value, gradient = jax.value_and_grad(program.potential)(first, data)
        state = start(
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
            rng_key=key_chain,
        )

        def move(state: Any, _: None) -> tuple[Any, Array]:
            state = advance(state, model_args=(data,))
            return state, state.z

        return jax.lax.scan(move, state, None, length=settings.warmup + settings.draws)[1]

    return jax.lax.map(chain, jax.random.split(key, settings.chains))[:, settings.warmup :]
