"""The No-U-Turn sampler, started at the modes and compiled once for all chains.

NumPyro's kernel advances a chain by a block of draws at a time. One compiled block serves every
chain; chains run on threads, so both cores work, nobody waits in lock-step, and a progress bar
costs nothing. The draws do not depend on how many threads there are.
"""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.infer.hmc import hmc

from polar_bayes.errors import FitError
from polar_bayes.inference.modes import Modes
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

Progress = Callable[[int], None]


@dataclasses.dataclass(frozen=True)
class Nuts:
    """Settings of the sampler.

    Args:
        chains: Independent chains, at least 2.
        warmup: Draws spent on step size and metric, per chain.
        draws: Draws kept, per chain.
        target_acceptance: Higher means smaller steps, range (0, 1).
        max_tree_depth: A trajectory has at most 2 ** this steps.
        threads: Chains that run at once.
        block: Draws between two steps of the progress bar.

    Raises:
        FitError: A setting is out of range.
    """

    chains: int = 4
    warmup: int = 500
    draws: int = 1000
    target_acceptance: float = 0.9
    max_tree_depth: int = 8
    threads: int = 2
    block: int = 100

    def __post_init__(self) -> None:
        limits = {"chains": 2, "warmup": 50, "draws": 50, "threads": 1, "block": 1}
        for name, least in limits.items():
            if getattr(self, name) < least:
                raise FitError(
                    f"{name} is {getattr(self, name)}",
                    where="Nuts",
                    mend=f"give at least {least}",
                )
        if not 0.5 <= self.target_acceptance < 1.0:
            raise FitError(
                f"target_acceptance is {self.target_acceptance}",
                where="Nuts",
                mend="give a number from 0.5 to below 1",
            )


class Step(NamedTuple):
    """What is kept of one draw."""

    z: Float[Array, " size"]
    diverging: Array
    acceptance_rate: Array
    n_steps: Array
    energy: Array
    lp: Array


@dataclasses.dataclass(frozen=True)
class Chains:
    """All draws: arrays of shape (chain, draw, ...)."""

    z: np.ndarray
    stats: dict[str, np.ndarray]
    step_size: np.ndarray


def sample(
    program: Program,
    data: Observations,
    modes: Modes,
    key: Array,
    settings: Nuts,
    progress: Progress = lambda _: None,
) -> Chains:
    """Draw from the posterior.

    Args:
        program: The model.
        data: The capture.
        modes: Where chains start: each at a draw from the Laplace approximation, the modes
            chosen by their weights; the heaviest mode gives the metric.
        key: Random key.
        settings: Lengths and limits.
        progress: Called with the number of draws done since the last call.

    Returns:
        The draws and the sampler's own statistics.
    """
    kernel = _Kernel(program, settings)
    key_start, key_chains = jax.random.split(key)
    starts = draw_starts(program, data, modes, key_start, settings.chains)
    keys = jax.random.split(key_chains, settings.chains)
    metric = jnp.asarray(modes.covariance[0])
    # Compiled before the threads start: both then share one executable.
    begin = jax.jit(kernel.begin).lower(keys[0], starts[0], metric, data).compile()
    first = begin(keys[0], starts[0], metric, data)
    advance = jax.jit(kernel.advance).lower(first, data).compile()

    def run(chain: int) -> tuple[Step, Array]:
        state = begin(keys[chain], starts[chain], metric, data)
        kept = []
        blocks = -(-(settings.warmup + settings.draws) // settings.block)
        for _ in range(blocks):
            state, steps = advance(state, data)
            kept.append(jax.tree.map(np.asarray, steps))
            progress(settings.block)
        joined = jax.tree.map(lambda *parts: np.concatenate(parts), *kept)
        window = slice(settings.warmup, settings.warmup + settings.draws)
        return jax.tree.map(lambda x: x[window], joined), state.adapt_state.step_size

    with ThreadPoolExecutor(settings.threads) as pool:
        finished = list(pool.map(run, range(settings.chains)))
    steps = jax.tree.map(lambda *chains: np.stack(chains), *(steps for steps, _ in finished))
    stats = steps._asdict()
    stats["reached_max_treedepth"] = stats["n_steps"] >= 2**settings.max_tree_depth - 1
    return Chains(
        z=stats.pop("z"),
        stats=stats,
        step_size=np.asarray([float(step_size) for _, step_size in finished]),
    )


def draw_starts(
    program: Program, data: Observations, modes: Modes, key: Array, chains: int
) -> Float[Array, "chains size"]:
    """Starting points: Laplace draws at modes chosen by weight, kept only where finite.

    Args:
        program: The model.
        data: The capture.
        modes: The peaks.
        key: Random key.
        chains: How many.

    Returns:
        Unconstrained vectors; a draw of infinite potential falls back on its mode.
    """
    key_mode, key_step = jax.random.split(key)
    chosen = jax.random.choice(key_mode, len(modes.weight), (chains,), p=jnp.asarray(modes.weight))
    centers = jnp.asarray(modes.z)[chosen]
    factors = jnp.linalg.cholesky(jnp.asarray(modes.covariance))[chosen]
    noise = jax.random.normal(key_step, centers.shape, centers.dtype)
    starts = centers + jnp.einsum("cij,cj->ci", factors, noise)
    potentials = jax.jit(lambda z, d: jax.lax.map(lambda x: program.potential(x, d), z))
    finite = jnp.isfinite(potentials(starts, data))
    return jnp.where(finite[:, None], starts, centers)


class _Kernel:
    """NumPyro's NUTS as two functions of arrays: begin a chain, advance it by a block."""

    def __init__(self, program: Program, settings: Nuts) -> None:
        self.settings = settings
        self.init, self.next = hmc(
            potential_fn_gen=lambda data: lambda z: program.potential(z, data), algo="NUTS"
        )

    def begin(self, key: Array, start: Array, metric: Array, data: Observations):  # noqa: ANN201
        return self.init(
            start,
            self.settings.warmup,
            step_size=0.5,
            inverse_mass_matrix=metric,
            dense_mass=True,
            target_accept_prob=self.settings.target_acceptance,
            trajectory_length=None,
            max_tree_depth=self.settings.max_tree_depth,
            model_args=(data,),
            rng_key=key,
        )

    def advance(self, state, data: Observations):  # noqa: ANN001, ANN201
        def step(state, _):  # noqa: ANN001, ANN202
            state = self.next(state, model_args=(data,))
            return state, Step(
                z=state.z,
                diverging=state.diverging,
                acceptance_rate=state.accept_prob,
                n_steps=state.num_steps,
                energy=state.energy,
                lp=-state.potential_energy,
            )

        return jax.lax.scan(step, state, None, length=self.settings.block)
