"""The No-U-Turn sampler (Hoffman and Gelman 2014, JMLR 15, 1593-1623), started at the modes.

NumPyro's kernel advances a chain by a block of draws at a time. One compiled block serves every
chain; chains run on threads, which need not wait for each other within a block. After each round of
blocks R-hat and effective sample sizes are computed: sampling continues until every coordinate has
reached the goals, within the limits of the settings. The draws do not depend on the threads. After
the warm-up all chains go on with one step size and metric, pooled over them.

Where a draw diverged, the steps were too long for a part of the posterior, which the chains may
have left out: they are sampled again with half the step size, which is what a higher target
acceptance leads to (Betancourt 2016, arXiv:1604.00695), and needs no new compilation.
"""

import dataclasses
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, Self, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import infer

from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.initialization import Target
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.problem_batch import BatchDraws, ProblemBatch
from polar_bayes.inference.program import AbstractDensity, Values, first_key, split_key
from polar_bayes.inference.result import Provenance
from polar_bayes.methods.importance import ONE_ROUND, suits_profiles, tail_shares
from polar_bayes.methods.method import AbstractMethod, PosteriorDraws
from polar_bayes.numerics.compile import compiled
from polar_bayes.numerics.mcse import LARGEST_R_HAT, measure
from polar_bayes.progress import Progress

R_HAT_GOAL = 1.0 + 0.8 * (LARGEST_R_HAT - 1.0)
"""R-hat at which chains end: a little below that at which a fit is refused."""


@dataclasses.dataclass(frozen=True)
class Nuts(AbstractMethod):
    """The No-U-Turn sampler.

    Args:
        chains: Independent chains, at least 2.
        warmup: Draws spent on step size and metric, per chain. None: 300; 150 for many patches,
            whose metric is known before.
        draws: Draws kept at least, per chain.
        most_draws: Draws kept at most, per chain; set it to `draws` for a fixed length.
        ess: Goal for the bulk and tail effective sample size of every coordinate.
        target_acceptance: Higher means smaller steps, range [0.5, 1). None: 0.9 for one material,
            0.98 for a few patches, 0.7 for many, whose coordinates are close to normal.
        max_tree_depth: A trajectory has at most 2 ** this steps.
        threads: Chains that run at once.
        block: Draws between two reports of progress, per chain.

    Raises:
        FitError: A setting is out of range.

    Source:
        Hoffman & Gelman (2014), JMLR 15, 1593-1623.
    """

    chains: int = 4
    warmup: int | None = None
    draws: int = 500
    most_draws: int = 8000
    ess: float = 450.0
    target_acceptance: float | None = None
    max_tree_depth: int = 8
    threads: int = 2
    block: int = 100

    def __post_init__(self) -> None:
        limits = {"chains": 2, "warmup": 50, "draws": 50, "most_draws": self.draws}
        self.check_least(**limits, max_tree_depth=1, threads=1, block=1)
        wanted = self.target_acceptance
        if wanted is not None and not 0.5 <= wanted < 1.0:
            self.refuse(f"target_acceptance is {wanted}", "give a number from 0.5 to below 1")

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        key_starts, key_chains = split_key(key)
        target = initialization.target(key_starts, self.chains)
        z, stats, mixed, halvings = sample(
            self._sampler(target, problem),
            target,
            key_chains,
            self,
            lambda done: progress("sampling", done),
        )
        bulk, tail, r_hat = measure(np.moveaxis(z, -1, 0))
        warmup = np.sum(stats["warmup_steps"][:, 0])
        search = float(initialization.metadata.get("gradients", np.nan))
        unvisited = initialization.missed_mode_weight(z)
        return PosteriorDraws(
            method="nuts",
            z=z,
            stats=stats,
            r_hat=float(np.max(r_hat)),
            ess=float(min(np.min(bulk), np.min(tail))),
            gradients=search + float(warmup + np.sum(stats["n_steps"])),
            densities=0.0,
            metadata={
                "modes": {**initialization.metadata, "unvisited": unvisited},
                "goals_reached": mixed,
                "step_size_halvings": halvings,
            },
        )

    @override
    def prepare(self, problem: Problem) -> None:
        target = problem.compiled_model.initializer.prepare_target(problem.data)
        if target is None:
            return
        target = target._replace(starts=np.repeat(target.starts, self.chains, axis=0))
        sampler = self._sampler(target, problem)
        if not sampler.advance.is_begun:
            state = sampler.init(target, first_key(), 0)
            sampler.advance.begin(state, target.given, np.int32(0))

    @override
    def for_comparison(self, problem: Problem, draws: PosteriorDraws) -> tuple[AbstractMethod, ...]:
        # Weighted draws take a tenth of the time, by programs that the cross-check has compiled.
        # Half the effective draws: the ends of an interval then move by a tenth of a sd.
        least = max(self.draws // 2, 50)
        most = max(self.most_draws // 4, least)
        half = 0.5 * self.ess
        chains = dataclasses.replace(self, draws=least, most_draws=most, ess=half)
        return (ONE_ROUND, chains) if suits_profiles(problem.program) else (chains,)

    @override
    def cross_check(self, problem: Problem, parameters: Values, key: Array) -> Provenance:
        return tail_shares(problem, parameters, key)

    def _sampler(self, target: Target, problem: Problem) -> "Sampler":
        """Return the compiled sampler of these settings."""
        return problem.compiled_model.made(_make_sampler, (target.density, self.static(target)))

    def static(self, target: Target) -> "Static":
        """Return what a sampler is compiled for; the target supplies settings left open."""
        warmup, acceptance = self.warmup, self.target_acceptance
        return Static(
            warmup=target.warmup if warmup is None else warmup,
            acceptance=target.acceptance if acceptance is None else acceptance,
            max_tree_depth=self.max_tree_depth,
            block=self.block,
            adapts_metric=target.metric.ndim == 2,  # a diagonal one is exact already
        )

    @override
    def scale_draws(self, factor: float) -> Self:
        scaled = {
            name: int(np.ceil(factor * getattr(self, name))) for name in ("draws", "most_draws")
        }
        return dataclasses.replace(self, ess=factor * self.ess, **scaled)

    @override
    def run_batch(self, batch: ProblemBatch) -> Iterator[BatchDraws]:
        # Several captures are fitted at once, each on a thread of its own.
        return AbstractMethod.run_batch(dataclasses.replace(self, threads=1), batch)


def _make_sampler(_: CompiledModel, settings: tuple[AbstractDensity, "Static"]) -> "Sampler":
    return Sampler(*settings)


# --- Chains -------------------------------------------------------------------------------------


class Step(NamedTuple):
    """One draw with its statistics, or a stack of them."""

    z: Float[Array, " size"]
    diverging: Array
    acceptance_rate: Array
    n_steps: Array
    energy: Array
    lp: Array


def sample(
    sampler: "Sampler",
    target: Target,
    key: Array,
    settings: Nuts,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[np.ndarray, dict[str, np.ndarray], bool, int]:
    """Return draws (chain, draw, size), statistics, whether goals were met, and step halvings."""
    warmup = sampler.static.warmup
    states = [sampler.init(target, key, chain) for chain in range(settings.chains)]
    # Compiled before the threads start: all then share one executable.
    advance = sampler.advance.program(states[0], target.given, np.int32(0))

    rounds: list[Step] = []
    warmup_steps = np.zeros(settings.chains, int)
    wanted, done = warmup + settings.draws, 0

    def advance_all(
        states: list[infer.hmc.HMCState], draws: int = settings.block
    ) -> tuple[list[infer.hmc.HMCState], Step]:
        nonlocal done
        count = np.int32(draws)
        advanced = list(pool.map(lambda state: advance(state, target.given, count), states))
        joined = jax.tree.map(lambda *x: np.stack(x)[:, :draws], *(steps for _, steps in advanced))
        done += draws
        progress(min(done / wanted, 1.0))
        return [state for state, _ in advanced], joined._replace(z=target.transform(joined.z))

    progress(0.0)
    with ThreadPoolExecutor(settings.threads) as pool:
        for begun in range(0, warmup, settings.block):
            states, steps = advance_all(states, min(warmup - begun, settings.block))
            warmup_steps += steps.n_steps.sum(axis=1)
        states = _pooled(states)
        for halvings in range(4):  # at most three times half the step, while chains diverge
            if halvings:
                warmup_steps += _stacked(rounds).n_steps.sum(axis=1)  # they are paid for, too
                states, rounds = [_with_half_the_step(state) for state in states], []
            states = _until_converged(states, rounds, advance_all, settings)
            if not _stacked(rounds).diverging.any():
                break
    stats = jax.tree.map(lambda x: x[:, : settings.most_draws], _stacked(rounds))._asdict()
    z = stats.pop("z")
    step_size = np.array([float(state.adapt_state.step_size) for state in states])
    stats["step_size"] = np.broadcast_to(step_size[:, None], z.shape[:2])
    stats["warmup_steps"] = np.broadcast_to(warmup_steps[:, None], z.shape[:2])
    stats["reached_max_treedepth"] = stats["n_steps"] >= 2**settings.max_tree_depth - 1
    return z, stats, _converged(rounds, settings), halvings


def _until_converged(
    states: list[infer.hmc.HMCState],
    rounds: list[Step],
    advance_all: Callable[[list[infer.hmc.HMCState]], tuple[list[infer.hmc.HMCState], Step]],
    settings: Nuts,
) -> list[infer.hmc.HMCState]:
    """Extend `rounds` by blocks of draws until the goals or the limit are reached.

    A divergence ends it, too, since no further draws make up for it, after as many draws as are
    asked for at least or a multiple of them: what is drawn does not depend on the block.
    """
    least, most = (-(-count // settings.block) for count in (settings.draws, settings.most_draws))
    for done in range(1, most + 1):
        states, steps = advance_all(states)
        rounds.append(steps)
        if done % least == 0 and _stacked(rounds).diverging.any():
            break
        if done >= least and _converged(rounds, settings):
            break
    return states


def _stacked(rounds: list[Step]) -> Step:
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *rounds)


def _pooled(states: list[infer.hmc.HMCState]) -> list[infer.hmc.HMCState]:
    """Return states with the mean of their metrics and the geometric mean of step sizes.

    All draws of the warm-up tell both better than a quarter of them, and no thread waits for the
    chain with the shortest steps.
    """
    own = [state.adapt_state for state in states]
    logs = [np.log(each.step_size) for each in own]
    pooled = {"step_size": np.exp(np.mean(logs)).astype(logs[0].dtype)}
    metric = np.mean([each.inverse_mass_matrix for each in own], axis=0)
    if metric.ndim == 2:
        # NumPyro's root, lower triangular: the metric is its transpose times itself.
        root = np.linalg.cholesky(metric[::-1, ::-1])[::-1, ::-1].T
        pooled["inverse_mass_matrix"], pooled["mass_matrix_sqrt_inv"] = metric, root
        pooled["mass_matrix_sqrt"] = np.linalg.inv(root)
    shared = jax.device_put(pooled)
    return [
        state._replace(adapt_state=each._replace(**shared))
        for state, each in zip(states, own, strict=True)
    ]


def _with_half_the_step(state: infer.hmc.HMCState) -> infer.hmc.HMCState:
    adapted = state.adapt_state
    return state._replace(adapt_state=adapted._replace(step_size=0.5 * adapted.step_size))


def _converged(rounds: list[Step], settings: Nuts) -> bool:
    """Return whether all coordinates meet the goals, which monotone maps do not change."""
    z = np.asarray(_stacked(rounds).z)
    bulk, tail, r_hat = measure(np.moveaxis(z, -1, 0))
    smallest = min(bulk.min(), tail.min())
    return bool(smallest >= settings.ess and r_hat.max() <= R_HAT_GOAL)


class Static(NamedTuple):
    """Settings that are fixed when a sampler is compiled."""

    warmup: int
    acceptance: float
    max_tree_depth: int
    block: int
    adapts_metric: bool


class Sampler:
    """NumPyro's NUTS as two functions of arrays: start a chain, and advance it by a block."""

    def __init__(self, density: AbstractDensity, static: Static) -> None:
        self.static = static
        # From a state, the data and a number of draws to the state after them, and these.
        self.advance = density.once(f"{static}", self._advance)
        self._init, self._next = infer.hmc.hmc(
            potential_fn_gen=lambda given: lambda z: density.potential_jit(z, given), algo="NUTS"
        )
        self._begin = compiled(self._start)

    def init(self, target: Target, key: Array, chain: int) -> infer.hmc.HMCState:
        """Return the initial state of one of the chains that share a key."""
        value, gradient = target.potential(target.starts[chain])
        density = np.asarray(value, target.starts.dtype), np.asarray(gradient)
        return self._begin(target.starts, chain, density, target.metric, target.given, key)

    def _start(
        self,
        starts: Array,
        chain: Array,
        density: tuple[Array, Array],
        metric: Array,
        given: object,
        key: Array,
    ) -> infer.hmc.HMCState:
        # Value and gradient are given, so that starting a chain compiles no model.
        return self._init(
            infer.util.ParamInfo(starts[chain], *density),
            self.static.warmup,
            step_size=0.5,
            inverse_mass_matrix=metric,
            dense_mass=self.static.adapts_metric,
            adapt_mass_matrix=self.static.adapts_metric,
            target_accept_prob=self.static.acceptance,
            trajectory_length=None,
            max_tree_depth=self.static.max_tree_depth,
            model_args=(given,),
            rng_key=jax.random.split(key, len(starts))[chain],
        )

    def _advance(
        self, state: infer.hmc.HMCState, given: object, draws: Array
    ) -> tuple[infer.hmc.HMCState, Step]:
        """Return the state after some draws, and a block of draws padded with zeros."""

        def step(state: infer.hmc.HMCState) -> tuple[infer.hmc.HMCState, Step]:
            state = self._next(state, model_args=(given,))
            return state, Step(
                z=state.z,
                diverging=state.diverging,
                acceptance_rate=state.accept_prob,
                n_steps=state.num_steps,
                energy=state.energy,
                lp=-state.potential_energy,
            )

        def add(
            index: Array, made: tuple[infer.hmc.HMCState, Step]
        ) -> tuple[infer.hmc.HMCState, Step]:
            state, new = step(made[0])
            return state, jax.tree.map(lambda x, value: x.at[index].set(value), made[1], new)

        like = jax.eval_shape(step, state)[1]
        block = jax.tree.map(lambda x: jnp.zeros((self.static.block, *x.shape), x.dtype), like)
        return jax.lax.fori_loop(0, draws, add, (state, block))
