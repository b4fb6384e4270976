"""The No-U-Turn sampler, started at the modes, compiled once, and stopped when it is done.

NumPyro's kernel advances a chain by a block of draws at a time. One compiled block serves every
chain; chains run on threads, so both cores work, nobody waits in lock-step, and a progress bar
costs nothing. After each round of blocks the draws are judged: sampling goes on until every
coordinate has mixed, within the limits that the caller sets. The draws do not depend on how many
threads there are.
"""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Array, Float
from numpyro import infer

from polar_bayes.errors import FitError
from polar_bayes.inference.modes import Modes, ValueAndGradient
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

Progress = Callable[[float], None]

LARGEST_R_HAT = 1.008
"""A little below the 1.01 at which a fit is refused."""


@dataclasses.dataclass(frozen=True)
class Nuts:
    """Settings of the sampler.

    Args:
        chains: Independent chains, at least 2.
        warmup: Draws spent on step size and metric, per chain.
        draws: Draws kept at least, per chain.
        most_draws: Draws kept at most, per chain; set it to `draws` for a fixed length.
        effective_draws: Goal for the bulk and tail effective sample size of every coordinate.
        target_acceptance: Higher means smaller steps, range [0.5, 1).
        max_tree_depth: A trajectory has at most 2 ** this steps.
        threads: Chains that run at once.
        block: Draws between two looks at the progress, per chain.

    Raises:
        FitError: A setting is out of range.
    """

    chains: int = 4
    warmup: int = 300
    draws: int = 500
    most_draws: int = 4000
    effective_draws: float = 450.0
    target_acceptance: float = 0.9
    max_tree_depth: int = 8
    threads: int = 2
    block: int = 100

    def __post_init__(self) -> None:
        limits = {
            "chains": 2,
            "warmup": 50,
            "draws": 50,
            "most_draws": self.draws,
            "max_tree_depth": 1,
            "threads": 1,
            "block": 1,
        }
        for name, least in limits.items():
            if getattr(self, name) < least:
                raise FitError(
                    f"{name} is {getattr(self, name)}", where="Nuts", mend=f"give at least {least}"
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


def sample(
    program: Program,
    data: Observations,
    potential: ValueAndGradient,
    modes: Modes,
    key: Array,
    settings: Nuts,
    progress: Progress = lambda _: None,
) -> tuple[np.ndarray, dict[str, np.ndarray], bool]:
    """Draw from the posterior.

    Args:
        program: The model.
        data: The capture.
        potential: Minus the log density and its gradient, already compiled.
        modes: Where chains start: each at a draw from the Laplace approximation, the modes
            chosen by their weights; the heaviest mode gives the metric.
        key: Random key.
        settings: Lengths and limits.
        progress: Called with the fraction of all draws that is done.

    Returns:
        Unconstrained draws (chain, draw, size); statistics, each (chain, draw); and whether the
        goals for mixing were reached before `most_draws`.
    """
    kernel = _Kernel(program, settings)
    key_start, key_chains = jax.random.split(key)
    starts = draw_starts(potential, modes, key_start, settings.chains)
    keys = jax.random.split(key_chains, settings.chains)
    states = [
        kernel.begin(keys[chain], starts[chain], potential, modes.covariance[0], data)
        for chain in range(settings.chains)
    ]
    # Compiled before the threads start: all then share one executable.
    advance = jax.jit(kernel.advance).lower(states[0], data).compile()

    rounds: list[Step] = []
    mixed = False
    warmup_blocks, least, most = (
        -(-draws // settings.block)
        for draws in (settings.warmup, settings.draws, settings.most_draws)
    )
    # Blocks are whole: warm-up ends inside the first kept block only if it does not divide.
    surplus = warmup_blocks * settings.block - settings.warmup

    def advance_all(states: list[infer.hmc.HMCState]) -> tuple[list[infer.hmc.HMCState], Step]:
        advanced = list(pool.map(lambda state: advance(state, data), states))
        steps = [jax.tree.map(np.asarray, step) for _, step in advanced]
        return [state for state, _ in advanced], jax.tree.map(lambda *x: np.stack(x), *steps)

    progress(0.0)
    with ThreadPoolExecutor(settings.threads) as pool:
        for done in range(warmup_blocks + most):
            states, steps = advance_all(states)
            if done == warmup_blocks - 1 and surplus:
                steps = jax.tree.map(lambda x: x[:, -surplus:], steps)
            if done >= warmup_blocks or (done == warmup_blocks - 1 and surplus):
                rounds.append(steps)
            progress(min((done + 1) / (warmup_blocks + least), 1.0))
            if done + 1 >= warmup_blocks + least and (mixed := _mixed(rounds, settings)):
                break
    joined = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *rounds)
    stats = jax.tree.map(lambda x: x[:, : settings.most_draws], joined)._asdict()
    z = stats.pop("z")
    step_size = np.array([float(state.adapt_state.step_size) for state in states])
    stats["step_size"] = np.broadcast_to(step_size[:, None], z.shape[:2])
    stats["reached_max_treedepth"] = stats["n_steps"] >= 2**settings.max_tree_depth - 1
    return z, stats, mixed


def _mixed(rounds: list[Step], settings: Nuts) -> bool:
    """Whether every coordinate has reached the goals; both are invariant to monotone maps."""
    z = np.concatenate([steps.z for steps in rounds], axis=1)
    bulk, tail, r_hat = (
        np.array([measure(coordinate) for coordinate in np.moveaxis(z, -1, 0)])
        for measure in (
            lambda x: array_stats.ess(x, method="bulk"),
            lambda x: array_stats.ess(x, method="tail", prob=(0.05, 0.95)),
            array_stats.rhat,
        )
    )
    enough = min(bulk.min(), tail.min()) >= settings.effective_draws
    return bool(enough and r_hat.max() <= LARGEST_R_HAT)


def draw_starts(
    potential: ValueAndGradient, modes: Modes, key: Array, chains: int
) -> Float[np.ndarray, "chains size"]:
    """Starting points: Laplace draws at modes chosen by weight, kept only where finite.

    Args:
        potential: Minus the log density and its gradient.
        modes: The peaks.
        key: Random key.
        chains: How many.

    Returns:
        Unconstrained vectors; a draw of infinite potential falls back on its mode.
    """
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    starts = []
    for mode in random.choice(len(modes.weight), size=chains, p=modes.weight):
        start = random.multivariate_normal(modes.z[mode], modes.covariance[mode])
        starts.append(start if np.isfinite(potential(start)[0]) else modes.z[mode])
    return np.stack(starts)


class _Kernel:
    """NumPyro's NUTS as two functions of arrays: begin a chain, advance it by a block."""

    def __init__(self, program: Program, settings: Nuts) -> None:
        self.settings = settings
        self.init, self.next = infer.hmc.hmc(
            potential_fn_gen=lambda data: lambda z: program.potential(z, data), algo="NUTS"
        )

    def begin(
        self,
        key: Array,
        start: np.ndarray,
        potential: ValueAndGradient,
        metric: np.ndarray,
        data: Observations,
    ) -> infer.hmc.HMCState:
        value, gradient = potential(start)
        # Value and gradient are given, so that beginning a chain compiles no model.
        given = infer.util.ParamInfo(jnp.asarray(start), jnp.asarray(value), jnp.asarray(gradient))
        return self.init(
            given,
            self.settings.warmup,
            step_size=0.5,
            inverse_mass_matrix=jnp.asarray(metric),
            dense_mass=True,
            target_accept_prob=self.settings.target_acceptance,
            trajectory_length=None,
            max_tree_depth=self.settings.max_tree_depth,
            model_args=(data,),
            rng_key=key,
        )

    def advance(
        self, state: infer.hmc.HMCState, data: Observations
    ) -> tuple[infer.hmc.HMCState, Step]:
        def step(state: infer.hmc.HMCState, _: None) -> tuple[infer.hmc.HMCState, Step]:
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
