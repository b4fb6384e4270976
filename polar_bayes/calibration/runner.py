"""Some simulations of a calibration: numbers in, ranks and marginals out, in any process.

Any model that can be fitted can be calibrated so, whatever its axes. Fits come one after another
on each thread, and all of them run the same compiled programs.
"""

import dataclasses
import functools
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.calibration.predictive import Arrays, PredictivePit, unranked_reason
from polar_bayes.calibration.scores import PitCrps
from polar_bayes.calibration.simulations import draw_captures, redraw_readings
from polar_bayes.diagnostics.convergence import LARGEST_R_HAT, SMALLEST_ESS
from polar_bayes.errors import FitError
from polar_bayes.inference.batch_fit import PixelMethod, candidates_of, fit_stack
from polar_bayes.inference.batch_nuts import PixelNuts
from polar_bayes.inference.batch_programs import ENGINE_LOCK, BatchEngine, EngineSpec, make_engine
from polar_bayes.inference.batch_result import Approach, Describe, Outcome, Status, no_outcome
from polar_bayes.inference.batching import Stack
from polar_bayes.inference.compile import TRACING_LOCK
from polar_bayes.inference.initialization import AbstractInitializer, Drawn
from polar_bayes.inference.laplace import Laplace
from polar_bayes.inference.mcse import measure
from polar_bayes.inference.nuts import Nuts
from polar_bayes.inference.problem import CompiledModel, compile_model
from polar_bayes.inference.program import Program, Values, compile_program, parameters_of
from polar_bayes.inference.psis import Marginals, smooth
from polar_bayes.inference.request import Request
from polar_bayes.observation.data import READINGS, Observations, observe
from polar_bayes.physics.instrument import Discrepancy
from polar_bayes.progress import no_progress

# --- Simulations fitted by what `polar_bayes.fit` runs: modes first, then chains or the guide ther


SequentialMethod = Nuts | Laplace
CHAINS_BLOCK = 4
"""Simulations of a block: few, since each may take half a minute."""


def needs_mcmc(request: Request) -> bool:
    """Whether the posteriors of a capture are out of reach of weighted draws."""
    read = [request.capture[name].sizes for name in READINGS if name in request.capture]
    several = any(dim != "view" and length > 1 for sizes in read for dim, length in sizes.items())
    return several or request.scene.has(Discrepancy)


def fit_sequentially(
    compiled_model: CompiledModel,
    settings: SequentialMethod,
    captures: Stack,
    numbers: np.ndarray,
    seed: int,
    describe: Describe,
) -> Outcome:
    """Fit every capture of a row as `polar_bayes.fit` does, one after another."""
    # The draws of chains are correlated, and ranks want independent ones. So each chain is thinned
    # to every k-th draw, k the number of draws over their effective sample size (of the bulk, the
    # least of all parameters), rounded up. The verdict of `polar_bayes.verdict` becomes the status:
    # good, or not trusted where R-hat is above 1.01, an effective sample size below 400, a draw
    # diverged or is no number, the goals were not reached before `most_draws`, or the mode of a
    # normal approximation is not settled. Such fits are ranked all the same.
    found, base = no_outcome(len(captures)), jax.random.fold_in(jax.random.key(seed), 3)
    with jax.enable_x64(True), TRACING_LOCK:  # two threads that begin at once share what they make
        initializer = compiled_model.initializer
    for at, number in enumerate(numbers):
        with jax.enable_x64(True):  # a thread does not inherit it
            data, key = captures.pixel(at), jax.random.fold_in(base, int(number))
            told = _fit_one(initializer, compiled_model.program, settings, data, key)
        if told is None:
            continue
        drawn, parameters = told
        measured = _measure(settings, drawn, parameters)
        for name, value in measured.items():
            getattr(found, name)[at] = value
        few = _thin(parameters, measured["effective_draws"])
        count = len(next(iter(few.values())))
        weights = np.full((1, count), 1.0 / count)
        describe(np.array([at]), {name: x[None] for name, x in few.items()}, weights)
    return found


def _fit_one(
    initializer: AbstractInitializer,
    program: Program,
    settings: SequentialMethod,
    data: Observations,
    key: Array,
) -> tuple[Drawn, Values] | None:
    """Draws of one capture and their parameters; None where there are none."""
    key_starts, key_draws = jax.random.split(key)
    if isinstance(settings, Nuts):
        settings = dataclasses.replace(settings, threads=1)
    try:
        initialization = initializer.find(data, key_starts, no_progress)
        drawn = initialization.draw(key_draws, settings, no_progress)
    except (FitError, np.linalg.LinAlgError):  # no peak, or no width around it
        return None
    parameters = parameters_of(program, drawn.z, data)
    return (drawn, parameters) if _whole(parameters).any() else None


def _measure(settings: SequentialMethod, drawn: Drawn, parameters: Values) -> dict[str, float]:
    """What a fit is worth, by the names of `Outcome`."""
    fine = _whole(parameters)
    good, worth, pareto_k = not drawn.problems and bool(fine.all()), float(fine.sum()), np.nan
    if isinstance(settings, Nuts):
        bulk, tail, r_hat = measure(_scalars(parameters))
        mixed = min(bulk.min(), tail.min()) >= SMALLEST_ESS and r_hat.max() <= LARGEST_R_HAT
        good = good and bool(mixed and drawn.goals_reached and not drawn.stats["diverging"].any())
        worth = float(np.nan_to_num(bulk.min(), nan=1.0))
    else:
        pareto_k = float(smooth(drawn.stats["log_weight"].reshape(1, -1))[1][0])
    return {
        "effective_draws": worth,
        "pareto_k": pareto_k,
        "approach": Approach.NUTS if isinstance(settings, Nuts) else Approach.LAPLACE,
        "status": Status.GOOD if good else Status.NOT_TRUSTED,
    }


def _thin(parameters: Values, effective: float) -> dict[str, np.ndarray]:
    """Nearly independent draws, those that are numbers, in a row: by name, (draw, ...)."""
    fine = _whole(parameters)
    step = int(np.ceil(fine.size / np.clip(effective, 1.0, fine.size)))
    few = np.zeros_like(fine)
    few[:, ::step] = True
    if not (few & fine).any():
        few[:] = True
    return {name: np.asarray(x)[few & fine] for name, x in parameters.items()}


def _whole(parameters: Values) -> np.ndarray:
    """Which draws are numbers, (chain, draw)."""
    finite = [np.isfinite(np.asarray(x)) for x in parameters.values()]
    return np.all([x.all(axis=tuple(range(2, x.ndim))) for x in finite], axis=0)


def _scalars(parameters: Values) -> np.ndarray:
    """Every number that a fit estimates, (scalar, chain, draw)."""
    flat = [np.asarray(x).reshape(*np.shape(x)[:2], -1) for x in parameters.values()]
    return np.moveaxis(np.concatenate(flat, axis=-1), -1, 0)


# --- Some simulations of a calibration: numbers in, ranks and marginals out, in any process -------


Method = PixelMethod | SequentialMethod
BLOCK = 64
"""Simulations of a block: what one thread or worker fits at a time, and what a crash can lose."""

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
    def data(self) -> Observations:
        """The capture whose layout all simulations have."""
        return _data_of(self)

    @property
    def engine(self) -> BatchEngine:
        """The compiled programs, which the next calibration of the same model finds."""
        candidates = candidates_of(self.settings)
        recipe = EngineSpec(self.request, lambda: self.data, candidates, self.recipe_key)
        with ENGINE_LOCK:
            return make_engine(recipe)

    @property
    def compiled_model(self) -> CompiledModel:
        """The same for fits one by one, which `polar_bayes.fit` finds."""
        return _prepared_of(self)

    @property
    def program(self) -> Program:
        """The model that is fitted."""
        if isinstance(self.settings, SequentialMethod):
            return self.compiled_model.program
        return self.engine.program

    @property
    def rough(self) -> Program:
        """The same in single precision."""
        if isinstance(self.settings, SequentialMethod):
            return _rough_of(self)
        return self.engine.rough

    @property
    def block(self) -> int:
        """Simulations of a block."""
        return CHAINS_BLOCK if isinstance(self.settings, SequentialMethod) else BLOCK

    @property
    def generative_program(self) -> Program:
        """The model by which captures are simulated."""
        return _generative_program_of(self)

    @property
    def shared(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters that are both simulated and fitted, by name."""
        return _shared_by(self)

    @property
    def unranked_reason(self) -> str:
        """Why readings cannot be ranked; empty where they can, or nobody asks."""
        return _unranked_reason_of(self) if self.readings else ""

    def __eq__(self, other: object) -> bool:
        """The same blocks."""
        return isinstance(other, Plan) and self.key == other.key

    def __hash__(self) -> int:
        """Of the key."""
        return hash(self.key)


def fit_block(plan: Plan, numbers: np.ndarray) -> Block:
    """Simulate some captures and fit each; this is what a worker is sent."""
    # What becomes of a simulation depends on its number alone, not on those beside it.
    seed, shared = plan.request.seed, plan.shared
    filled = np.resize(numbers, plan.block)  # so that all blocks run the same program
    wanted = np.arange(len(numbers))
    is_ranked = plan.readings and not plan.unranked_reason
    with jax.enable_x64(True):
        key = jax.random.fold_in(jax.random.key(seed), 1)
        drawn = draw_captures(plan.generative_program, plan.data, filled, key)
        fresh = (
            redraw_readings(plan.generative_program, plan.data, drawn, filled, key)
            if is_ranked
            else {}
        )
    truth = {name: np.asarray(drawn.truth[name])[wanted] for name in shared}
    captures = drawn.captures.subset(wanted)
    marginals, standing = Marginals(len(numbers), shared), PitCrps(truth, numbers, seed)
    ranked = None
    if is_ranked:
        again = {name: np.asarray(values)[wanted] for name, values in fresh.items()}
        ranked = PredictivePit(plan.rough, captures, again, numbers, seed)
    apart = _apart(plan.settings)

    def describe(at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        few = {name: np.asarray(x)[:, ::apart] for name, x in parameters.items()}
        share = weights[:, ::apart] / weights[:, ::apart].sum(axis=-1, keepdims=True)
        for taker in (marginals, standing, ranked):
            if taker is not None:
                taker.describe(at, few, share)

    outcome = _fit(plan, captures, numbers, describe)
    return Block(
        numbers=np.asarray(numbers),
        truth=truth,
        pit=standing.pit,
        crps=standing.crps,
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


def _fit(plan: Plan, captures: Stack, numbers: np.ndarray, describe: Describe) -> Outcome:
    """Fits of captures by what the settings say."""
    settings, seed = plan.settings, plan.request.seed
    if isinstance(settings, SequentialMethod):
        return fit_sequentially(plan.compiled_model, settings, captures, numbers, seed, describe)
    return fit_stack(plan.engine, settings, captures, numbers, seed, describe)


def _apart(settings: Method) -> int:
    if isinstance(settings, PixelNuts):
        return max(1, settings.chains * settings.draws // RANKED)
    return 1


@functools.lru_cache(maxsize=4)
def _data_of(plan: Plan) -> Observations:
    limit = plan.request.largest_view_zenith
    with jax.enable_x64(True):
        return observe(plan.request.capture, largest_view_zenith=limit)


@functools.lru_cache(maxsize=4)
def _prepared_of(plan: Plan) -> CompiledModel:
    with jax.enable_x64(True):
        return compile_model(plan.request, plan.request.scene, plan.data)


@functools.lru_cache(maxsize=4)
def _rough_of(plan: Plan) -> Program:
    single = dataclasses.replace(plan.request, precision="single")
    with jax.enable_x64(False), TRACING_LOCK:
        return compile_program(single.bind(single.scene), plan.data.in_single_precision())


@functools.lru_cache(maxsize=4)
def _generative_program_of(plan: Plan) -> Program:
    request = plan.generative_request
    if request is None:
        return plan.program
    with jax.enable_x64(True), TRACING_LOCK:
        return compile_program(request.bind(request.scene), plan.data)


@functools.lru_cache(maxsize=4)
def _shared_by(plan: Plan) -> dict[str, tuple[int, ...]]:
    fitted, simulated = (
        _shapes(program, plan.data) for program in (plan.program, plan.generative_program)
    )
    return {name: shape for name, shape in simulated.items() if fitted.get(name) == shape}


@functools.lru_cache(maxsize=4)
def _unranked_reason_of(plan: Plan) -> str:
    given, program, generative_program = (
        _shapes(plan.program, plan.data),
        plan.program,
        plan.generative_program,
    )
    with jax.enable_x64(True), TRACING_LOCK:
        return unranked_reason(program, generative_program, plan.data, given)


def _shapes(program: Program, data: Observations) -> dict[str, tuple[int, ...]]:
    """Of the parameters of a model, in the order of their names."""
    with jax.enable_x64(True), TRACING_LOCK:
        found = jax.eval_shape(program.parameters, jnp.zeros(program.size), data)
    return {name: found[name].shape for name in sorted(found)}
