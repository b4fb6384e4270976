"""Blocks of simulations of a calibration: simulated, fitted and ranked, in any process.

Source:
    Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788.
"""

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.calibration.predictive import Arrays, PredictivePit, unranked_reason
from polar_bayes.calibration.scores import PitCrps
from polar_bayes.calibration.simulations import draw_captures, redraw_readings
from polar_bayes.inference.batch_engine import BatchEngine, make_engine
from polar_bayes.inference.batch_method import AbstractPixelMethod
from polar_bayes.inference.batch_nuts import PixelNuts
from polar_bayes.inference.batching import Describe, ObservationBatch, Outcome
from polar_bayes.inference.compile import TRACING_LOCK, LRUCache
from polar_bayes.inference.method import AbstractMethod
from polar_bayes.inference.problem import CompiledModel, compile_model
from polar_bayes.inference.program import Program, Values, compile_program
from polar_bayes.inference.psis import Marginals
from polar_bayes.inference.request import Request
from polar_bayes.observation.data import READINGS, Observations, observe
from polar_bayes.physics.instrument import Discrepancy

Method = AbstractPixelMethod | AbstractMethod
CHAINS_BLOCK = 4
"""Simulations of a block where they are fitted one after another: each may take half a minute."""

BLOCK = 64
"""Simulations of a block elsewhere: what one thread or worker fits, and what a crash can lose."""

RANKED = 128
"""About so many draws of a chain are ranked: far enough apart to be nearly independent."""


class Block(NamedTuple):
    """Some simulations and their fits, NaN where a fit has no answer; axis 0 is the simulation."""

    numbers: np.ndarray
    truth: Arrays
    pit: Arrays
    crps: Arrays
    mean: Arrays
    sd: Arrays
    quantiles: Arrays
    fresh: Arrays
    left_out: Arrays
    left_out_k: Arrays
    entry: Arrays
    outcome: Outcome


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """What is done to every block of one calibration; it can be sent to another process."""

    request: Request
    generative_request: Request | None
    settings: Method
    readings: bool
    recipe_key: str
    key: str

    @property
    def compiled(self) -> "CompiledPlan":
        """Its programs, which the next calibration of the same model finds in this process."""
        return _COMPILED.of(self.key, lambda: CompiledPlan(self))

    @property
    def block(self) -> int:
        """Simulations of a block."""
        return CHAINS_BLOCK if self.is_sequential else BLOCK

    @property
    def is_sequential(self) -> bool:
        """Whether one capture is fitted after another."""
        return isinstance(self.settings, AbstractMethod)

    @property
    def data(self) -> Observations:
        """The capture whose layout all simulations have."""
        return self.compiled.data

    @property
    def program(self) -> Program:
        """The model that is fitted."""
        return self.compiled.program

    @property
    def shared(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters that are both simulated and fitted, by name."""
        return self.compiled.shared

    @property
    def unranked_reason(self) -> str:
        """Why readings cannot be ranked; empty where they can, or nobody asks."""
        return self.compiled.unranked_reason if self.readings else ""


@dataclasses.dataclass(frozen=True, eq=False)
class CompiledPlan:
    """The programs of a plan, each made at its first use."""

    plan: Plan

    @functools.cached_property
    def data(self) -> Observations:
        """The capture whose layout all simulations have."""
        request = self.plan.request
        with jax.enable_x64(True):
            return observe(request.capture, largest_view_zenith=request.largest_view_zenith)

    @functools.cached_property
    def model(self) -> CompiledModel:
        """The programs that fit one capture after another."""
        with jax.enable_x64(True):
            return compile_model(self.plan.request, self.data)

    @functools.cached_property
    def batch_engine(self) -> BatchEngine:
        """The programs that fit many captures side by side."""
        plan = self.plan
        return make_engine(plan.recipe_key, plan.request, lambda: self.data)

    @property
    def program(self) -> Program:
        """The model that is fitted."""
        return self.model.program if self.plan.is_sequential else self.batch_engine.program

    @property
    def single(self) -> Program:
        """The same in single precision."""
        return self.model.single if self.plan.is_sequential else self.batch_engine.single_program

    @functools.cached_property
    def generative_program(self) -> Program:
        """The model by which captures are simulated."""
        request = self.plan.generative_request
        if request is None:
            return self.program
        with jax.enable_x64(True), TRACING_LOCK:
            return compile_program(request.bind(request.scene), self.data)

    @functools.cached_property
    def shared(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters that are both simulated and fitted, by name."""
        fitted = _shapes(self.program, self.data)
        simulated = _shapes(self.generative_program, self.data)
        return {name: shape for name, shape in simulated.items() if fitted.get(name) == shape}

    @functools.cached_property
    def unranked_reason(self) -> str:
        """Why readings cannot be ranked; empty where they can."""
        program, given = self.program, _shapes(self.program, self.data)
        with jax.enable_x64(True), TRACING_LOCK:
            return unranked_reason(program, self.generative_program, self.data, given)


_COMPILED: LRUCache[CompiledPlan] = LRUCache(4)


def needs_mcmc(request: Request) -> bool:
    """Whether the posteriors of a capture are out of reach of weighted draws."""
    read = [request.capture[name].sizes for name in READINGS if name in request.capture]
    several = any(dim != "view" and length > 1 for sizes in read for dim, length in sizes.items())
    return several or request.scene.has(Discrepancy)


def fit_block(plan: Plan, numbers: np.ndarray) -> Block:
    """Simulate some captures and fit each; this is what a worker is sent."""
    # What becomes of a simulation depends on its number alone, not on the others of its block.
    seed, shared, program = plan.request.seed, plan.shared, plan.compiled.generative_program
    filled = np.resize(numbers, plan.block)  # so that all blocks run the same program
    wanted = np.arange(len(numbers))
    is_ranked = plan.readings and not plan.unranked_reason
    with jax.enable_x64(True):
        key = jax.random.fold_in(jax.random.key(seed), 1)
        drawn = draw_captures(program, plan.data, filled, key)
        fresh = redraw_readings(program, plan.data, drawn, filled, key) if is_ranked else {}
    truth = {name: np.asarray(drawn.truth[name])[wanted] for name in shared}
    captures = drawn.captures.subset(wanted)
    marginals, scores = Marginals(len(numbers), shared), PitCrps(truth, numbers, seed)
    ranked = None
    if is_ranked:
        again = {name: np.asarray(values)[wanted] for name, values in fresh.items()}
        ranked = PredictivePit(plan.compiled.single, captures, again, numbers, seed)
    step = _thinning(plan.settings)

    def describe(at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        thinned = {name: np.asarray(x)[:, ::step] for name, x in parameters.items()}
        share = weights[:, ::step] / weights[:, ::step].sum(axis=-1, keepdims=True)
        for statistic in (marginals, scores, ranked):
            if statistic is not None:
                statistic.describe(at, thinned, share)

    outcome = _fit(plan, captures, numbers, describe)
    return Block(
        numbers=np.asarray(numbers),
        truth=truth,
        pit=scores.pit,
        crps=scores.crps,
        mean=marginals.mean,
        sd=marginals.sd,
        quantiles={name: np.moveaxis(x, 0, 1) for name, x in marginals.quantiles.items()},
        fresh=ranked.fresh if ranked else {},
        left_out=ranked.left_out if ranked else {},
        left_out_k=ranked.left_out_k if ranked else {},
        entry=ranked.entry if ranked else {},
        outcome=outcome,
    )


def join(blocks: Iterable[Block], count: int) -> Block:
    """The first simulations of a calibration as one block, in order."""
    whole = jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)
    numbers, first = np.unique(whole.numbers, return_index=True)
    return jax.tree.map(lambda x: x[first[numbers < count]], whole)


def cut(numbers: np.ndarray, size: int) -> list[np.ndarray]:
    """Numbers of simulations in ascending order, a part for each block."""
    ends = np.flatnonzero(np.diff(numbers // size)) + 1
    return [part for part in np.split(numbers, ends) if part.size]


def _fit(
    plan: Plan, captures: ObservationBatch, numbers: np.ndarray, describe: Describe
) -> Outcome:
    """Fits of captures by what the settings say."""
    engine: Any = plan.compiled.model if plan.is_sequential else plan.compiled.batch_engine
    return plan.settings.run_batch(engine, captures, numbers, plan.request.seed, describe)


def _thinning(settings: Method) -> int:
    """Every how many draws of a chain one is ranked."""
    if isinstance(settings, PixelNuts):
        return max(1, settings.chains * settings.draws // RANKED)
    return 1


def _shapes(program: Program, data: Observations) -> dict[str, tuple[int, ...]]:
    """Of the parameters of a model, in the order of their names."""
    with jax.enable_x64(True), TRACING_LOCK:
        found = jax.eval_shape(program.parameters, jnp.zeros(program.size), data)
    return {name: found[name].shape for name in sorted(found)}
