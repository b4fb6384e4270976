"""The No-U-Turn sampler (Hoffman and Gelman 2014, JMLR 15, 1593-1623), started at the modes.

NumPyro's kernel advances a chain by a block of draws at a time. One compiled block serves every
chain; chains run on threads, which need not wait for each other within a block. After each round of
blocks R-hat and effective sample sizes are computed: sampling continues until every coordinate has
reached the goals, within the limits of the settings. The draws do not depend on the threads.
"""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import infer

from polar_bayes.errors import FitError
from polar_bayes.inference.compile import JitOnce, LRUCache
from polar_bayes.inference.mcse import measure
from polar_bayes.inference.optimize import Modes, ValueAndGradient

Progress = Callable[[float], None]

LARGEST_R_HAT = 1.008
"""A little below the 1.01 at which a fit is refused."""

MAX_SAMPLERS = 4
"""Samplers of one density, by their lengths and goals, that stay compiled."""


@dataclasses.dataclass(frozen=True)
class NutsSettings:
    """Numbers of chains and draws, and goals; `Nuts` explains each."""

    chains: int = 4
    warmup: int | None = None
    draws: int = 500
    most_draws: int = 8000
    effective_draws: float = 450.0
    target_acceptance: float | None = None
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
            given = getattr(self, name)
            if given is not None and given < least:
                raise FitError(
                    f"{name} is {getattr(self, name)}", where="Nuts", hint=f"give at least {least}"
                )
        wanted = self.target_acceptance
        if wanted is not None and not 0.5 <= wanted < 1.0:
            raise FitError(
                f"target_acceptance is {self.target_acceptance}",
                where="Nuts",
                hint="give a number from 0.5 to below 1",
            )


class Step(NamedTuple):
    """One draw with its statistics; or a stack of them."""

    z: Float[Array, " size"]
    diverging: Array
    acceptance_rate: Array
    n_steps: Array
    energy: Array
    lp: Array


class Target(NamedTuple):
    """A density with starting points and metric."""

    samplers: "SamplerCache"
    given: Any
    potential: ValueAndGradient
    starts: np.ndarray
    metric: np.ndarray
    transform: Callable[[np.ndarray], np.ndarray] = lambda z: z
    """From draws in the coordinates of the sampler to those of the program, (chain, draw, size)."""
    acceptance: float = 0.9
    warmup: int = 300

    def sampler(self, settings: NutsSettings) -> "_Sampler":
        """The compiled sampler; the target supplies what the settings leave open."""
        warmup, acceptance = settings.warmup, settings.target_acceptance
        return self.samplers.of(
            _Static(
                warmup=self.warmup if warmup is None else warmup,
                acceptance=self.acceptance if acceptance is None else acceptance,
                max_tree_depth=settings.max_tree_depth,
                block=settings.block,
                adapts_metric=self.metric.ndim == 2,  # a diagonal one is exact already
            )
        )


def sample(
    target: Target,
    key: Array,
    settings: NutsSettings,
    progress: Progress = lambda _: None,
) -> tuple[np.ndarray, dict[str, np.ndarray], bool]:
    """Draws (chain, draw, size), statistics by name, and whether the chains reached the goals."""
    sampler = target.sampler(settings)
    warmup = sampler.static.warmup
    keys = jax.random.split(key, settings.chains)
    states = [sampler.init(target, key, at) for key, at in zip(keys, target.starts, strict=True)]
    # Compiled before the threads start: all then share one executable.
    advance = sampler.advance.program(states[0], target.given)

    rounds: list[Step] = []
    warmup_steps = np.zeros(settings.chains, int)
    converged = False
    warmup_blocks, least, most = (
        -(-draws // settings.block) for draws in (warmup, settings.draws, settings.most_draws)
    )

    def advance_all(states: list[infer.hmc.HMCState]) -> tuple[list[infer.hmc.HMCState], Step]:
        advanced = list(pool.map(lambda state: advance(state, target.given), states))
        joined = jax.tree.map(lambda *x: np.stack(x), *(steps for _, steps in advanced))
        return [state for state, _ in advanced], joined._replace(z=target.transform(joined.z))

    progress(0.0)
    with ThreadPoolExecutor(settings.threads) as pool:
        for done in range(warmup_blocks + most):
            states, steps = advance_all(states)
            # A block may hold the end of the warm-up and the first draws.
            before = int(np.clip(warmup - done * settings.block, 0, settings.block))
            warmup_steps += steps.n_steps[:, :before].sum(axis=1)
            if before < settings.block:
                rounds.append(jax.tree.map(lambda x, first=before: x[:, first:], steps))
            progress(min((done + 1) / (warmup_blocks + least), 1.0))
            if done + 1 >= warmup_blocks + least and (converged := _converged(rounds, settings)):
                break
    joined = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *rounds)
    stats = jax.tree.map(lambda x: x[:, : settings.most_draws], joined)._asdict()
    z = stats.pop("z")
    step_size = np.array([float(state.adapt_state.step_size) for state in states])
    stats["step_size"] = np.broadcast_to(step_size[:, None], z.shape[:2])
    stats["warmup_steps"] = np.broadcast_to(warmup_steps[:, None], z.shape[:2])
    stats["reached_max_treedepth"] = stats["n_steps"] >= 2**settings.max_tree_depth - 1
    return z, stats, converged


def expect(target: Target, settings: NutsSettings) -> None:
    """Begin to compile what `sample` will need, in parallel with whatever follows."""
    sampler = target.sampler(settings)
    if not sampler.advance.is_begun:
        state = sampler.init(target, jax.random.key(0), target.starts[0])
        sampler.advance.begin(state, target.given)


def _converged(rounds: list[Step], settings: NutsSettings) -> bool:
    """Whether every coordinate has reached the goals; both are invariant to monotone maps."""
    z = np.concatenate([steps.z for steps in rounds], axis=1)
    bulk, tail, r_hat = measure(np.moveaxis(z, -1, 0))
    smallest = min(bulk.min(), tail.min())
    return bool(smallest >= settings.effective_draws and r_hat.max() <= LARGEST_R_HAT)


def draw_starts(
    potential: ValueAndGradient, modes: Modes, key: Array, chains: int
) -> Float[np.ndarray, "chains size"]:
    """Laplace draws at modes chosen by weight; the mode itself where the draw is not finite."""
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    starts = []
    for mode in random.choice(len(modes.weight), size=chains, p=modes.weight):
        start = random.multivariate_normal(modes.z[mode], modes.covariance[mode])
        starts.append(start if np.isfinite(potential(start)[0]) else modes.z[mode])
    return np.stack(starts)


class _Static(NamedTuple):
    """What is fixed when a sampler is compiled."""

    warmup: int
    acceptance: float
    max_tree_depth: int
    block: int
    adapts_metric: bool


class SamplerCache:
    """The compiled samplers of one density."""

    def __init__(self, density: Callable[[Array, Any], Array]) -> None:
        self._density = density
        self._samplers: LRUCache[_Sampler] = LRUCache(MAX_SAMPLERS)

    def of(self, static: _Static) -> "_Sampler":
        """The sampler of such lengths and goals."""
        return self._samplers.of(static, lambda: _Sampler(self._density, static))


class _Sampler:
    """NumPyro's NUTS as two functions of arrays: start a chain, advance it by a block."""

    def __init__(self, density: Callable[[Array, Any], Array], static: _Static) -> None:
        self.static = static
        # From a state and the data to the state after a block and its steps.
        self.advance = JitOnce(self._advance)
        self._init, self._next = infer.hmc.hmc(
            potential_fn_gen=lambda given: lambda z: density(z, given), algo="NUTS"
        )

    def init(self, target: Target, key: Array, start: np.ndarray) -> infer.hmc.HMCState:
        value, gradient = target.potential(start)
        # Value and gradient are given, so that starting a chain compiles no model.
        given = infer.util.ParamInfo(jnp.asarray(start), jnp.asarray(value), jnp.asarray(gradient))
        return self._init(
            given,
            self.static.warmup,
            step_size=0.5,
            inverse_mass_matrix=jnp.asarray(target.metric),
            dense_mass=self.static.adapts_metric,
            adapt_mass_matrix=self.static.adapts_metric,
            target_accept_prob=self.static.acceptance,
            trajectory_length=None,
            max_tree_depth=self.static.max_tree_depth,
            model_args=(target.given,),
            rng_key=key,
        )

    def _advance(self, state: infer.hmc.HMCState, given: Any) -> tuple[infer.hmc.HMCState, Step]:
        def step(state: infer.hmc.HMCState, _: None) -> tuple[infer.hmc.HMCState, Step]:
            state = self._next(state, model_args=(given,))
            return state, Step(
                z=state.z,
                diverging=state.diverging,
                acceptance_rate=state.accept_prob,
                n_steps=state.num_steps,
                energy=state.energy,
                lp=-state.potential_energy,
            )

        return jax.lax.scan(step, state, None, length=self.static.block)
