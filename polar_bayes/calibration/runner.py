"""Blocks of simulations of a calibration: simulated, fitted and ranked, in any process, and stored.

Source:
    Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.calibration.predictive import Arrays, PredictivePit, unranked_reason
from polar_bayes.calibration.scores import PitCrps
from polar_bayes.errors import FitError
from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.compiled_model import CompiledModel, compile_layout
from polar_bayes.inference.problem import observe_request
from polar_bayes.inference.problem_batch import Outcome, empty_outcome, problem_batch
from polar_bayes.inference.program import Program, Values, compile_program
from polar_bayes.inference.request import Request
from polar_bayes.interrupts import on_interrupt, resume_hint
from polar_bayes.maps.blocks import (
    ADDRESS,
    OTHER_OUT,
    VERSIONS,
    Entry,
    Ledger,
    digest,
    digest_files,
    locked_ledger,
    written,
)
from polar_bayes.methods.method import AbstractBatchMethod
from polar_bayes.numerics.compile import TRACING_LOCK, JitOnce, LRUCache
from polar_bayes.numerics.psis import Marginals
from polar_bayes.observation.data import Observations
from polar_bayes.paths import TEMPORARY_PREFIX, replace_file, temporary_folder
from polar_bayes.priors import describe_prior


class Block(NamedTuple):
    """Some simulations and their fits, NaN where a fit has no answer; axis 0 is the simulation."""

    numbers: np.ndarray
    truth: Arrays
    pit: Arrays
    crps: Arrays
    mean: Arrays
    sd: Arrays
    quantiles: Arrays
    outcome: Outcome
    fresh: Arrays
    left_out: Arrays
    left_out_k: Arrays
    entry: Arrays


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationPlan:
    """What is done to every block of one calibration; it can be sent to another process."""

    request: Request
    generative_request: Request | None
    settings: AbstractBatchMethod
    readings: bool
    layout_key: str
    key: str

    @property
    def compiled(self) -> "CompiledPlan":
        """Its programs, which the next calibration of the same model finds in this process."""
        return _COMPILED.of(self.key, lambda: CompiledPlan(self))

    @property
    def block(self) -> int:
        """Simulations of a block."""
        return self.settings.group_size


@dataclasses.dataclass(frozen=True, eq=False)
class CompiledPlan:
    """The programs of a plan, each made at its first use."""

    plan: CalibrationPlan

    @functools.cached_property
    def data(self) -> Observations:
        """The capture whose layout all simulations have."""
        with jax.enable_x64(True):
            return observe_request(self.plan.request)

    @functools.cached_property
    def engine(self) -> CompiledModel:
        """The programs that fit captures."""
        plan = self.plan
        return compile_layout(plan.layout_key, plan.request, lambda: self.data)

    @property
    def program(self) -> Program:
        """The model that is fitted."""
        return self.engine.program

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
        """Why readings cannot be ranked; empty where they can, or where none are to be."""
        if not self.plan.readings:
            return ""
        program, given = self.program, _shapes(self.program, self.data)
        with jax.enable_x64(True), TRACING_LOCK:
            return unranked_reason(program, self.generative_program, self.data, given)


_COMPILED: LRUCache[CompiledPlan] = LRUCache(4)


def fit_block(plan: CalibrationPlan, numbers: np.ndarray) -> Block:
    """Simulate some captures and fit each; this is what a worker is sent."""
    # The result of a simulation depends on its number alone, not on the others of its block.
    compiled, seed, count = plan.compiled, plan.request.seed, len(numbers)
    program, data, shared = compiled.generative_program, compiled.data, compiled.shared
    filled = np.resize(numbers, plan.block)  # so that all blocks run the same program
    is_ranked = plan.readings and not compiled.unranked_reason
    with jax.enable_x64(True):
        key = jax.random.fold_in(jax.random.key(seed), 1)
        drawn = draw_captures(program, data, filled, key, replicate=is_ranked)
    engine = compiled.engine
    truth: Arrays = {name: np.asarray(drawn.truth[name])[:count] for name in shared}
    captures = drawn.captures.subset(np.arange(count))
    marginals, scores = Marginals(count, shared, random=True), PitCrps(truth, numbers, seed)
    ranked = None
    if is_ranked:
        again = {name: np.asarray(values)[:count] for name, values in drawn.replicated.items()}
        ranked = PredictivePit(engine, captures, again, numbers, seed)
    statistics: list[Marginals | PitCrps | PredictivePit] = [marginals, scores]
    statistics += [ranked] if ranked else []
    outcome = empty_outcome(count)
    for found in plan.settings.fit_batch(problem_batch(engine, captures, numbers, seed)):
        outcome.put(found)
        for statistic in statistics if found.draws else ():
            statistic.describe(found.at, found.draws, found.weights)
    return Block(
        numbers=np.asarray(numbers),
        truth=truth,
        pit=scores.pit,
        crps=scores.crps,
        mean=marginals.mean,
        sd=marginals.sd,
        quantiles={name: np.moveaxis(x, 0, 1) for name, x in marginals.quantiles.items()},
        outcome=outcome,
        fresh=ranked.fresh if ranked else {},
        left_out=ranked.left_out if ranked else {},
        left_out_k=ranked.left_out_k if ranked else {},
        entry=ranked.entry if ranked else {},
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


def _shapes(program: Program, data: Observations) -> dict[str, tuple[int, ...]]:
    """Of the parameters of a model, in the order of their names."""
    with jax.enable_x64(True), TRACING_LOCK:
        found = jax.eval_shape(program.parameters, jnp.zeros(program.size), data)
    return {name: found[name].shape for name in sorted(found)}


# --- Captures drawn from a model: parameters from the prior, readings from the links --------------

_SIMULATORS: LRUCache[JitOnce] = LRUCache(4)


class Simulations(NamedTuple):
    """True parameters, captures simulated from them, and replicated readings, where asked for."""

    truth: Values
    captures: ObservationBatch
    replicated: Values


def draw_captures(
    program: Program,
    data: Observations,
    numbers: np.ndarray,
    key: Array,
    *,
    replicate: bool = False,
) -> Simulations:
    """Simulate captures by their numbers, with the layout, stated errors and masks of `data`."""
    cached = program, replicate
    simulate = _SIMULATORS.of(cached, lambda: _simulator(*cached))
    found = simulate(jnp.asarray(numbers, np.uint32), key, data)
    truth, recorded, replicated = jax.tree.map(np.asarray, found)
    return Simulations(truth, _batch(data, recorded), replicated)


def _simulator(program: Program, replicate: bool) -> JitOnce:
    """Compiled: parameters and readings of many captures."""
    # Where intensity is recorded, each capture's own brightness sets its noise, and readings at
    # full scale are saturated.

    def simulate(number: Array, key: Array, data: Observations) -> tuple[Values, tuple, Values]:
        key_truth, key_noise = jax.random.split(jax.random.fold_in(key, number))
        z = program.from_prior(key_truth, data)
        draw = program.describe(key_noise, z, data)
        recorded = _recorded(data, draw.predictive)
        if "intensity" in program.observed:  # the noise of the other readings may follow it
            others = program.describe(key_noise, z, recorded).predictive
            recorded = _recorded(data, {**others, "intensity": draw.predictive["intensity"]})
        key_again = jax.random.fold_in(key_noise, 1)
        again = program.describe(key_again, z, recorded).predictive if replicate else {}
        drawn = recorded.readings, recorded.brightness, recorded.saturated
        return draw.parameters, drawn, again

    return JitOnce(
        lambda numbers, key, data: jax.lax.map(lambda number: simulate(number, key, data), numbers)
    )


def _recorded(data: Observations, readings: Mapping[str, Any]) -> Observations:
    """A capture with other readings; where a view is not valid, those of `data` remain."""
    valid = {n: jnp.where(data.valid, x, data.readings[n]) for n, x in readings.items()}
    capture = dataclasses.replace(data, readings={**data.readings, **valid})
    if "intensity" not in valid:
        return capture
    return dataclasses.replace(
        capture,
        brightness=jnp.clip(valid["intensity"], 0.0, 1.0),
        saturated=data.valid & (valid["intensity"] >= data.full_scale),
    )


def _batch(data: Observations, recorded: tuple) -> ObservationBatch:
    """Captures as a batch: what was drawn and the masks differ, all else is the same."""

    def drawn(capture: Observations) -> tuple:
        return capture.readings, capture.brightness, capture.saturated, capture.valid

    shape = (len(recorded[1]), *data.shape)
    recorded = jax.tree.map(lambda x: np.broadcast_to(x, shape), recorded)
    valid = np.broadcast_to(np.asarray(data.valid), shape)
    plain = jax.tree.map(np.asarray, data)
    is_drawn = eqx.tree_at(
        drawn, jax.tree.map(lambda _: False, plain), jax.tree.map(lambda _: True, drawn(plain))
    )
    own, shared = eqx.partition(eqx.tree_at(drawn, plain, (*recorded, valid)), is_drawn)
    views = valid.reshape(shape[0], -1, shape[-1]).any(axis=1).sum(axis=-1)
    return ObservationBatch(own, shared, views)


# --- Blocks on the disk ---------------------------------------------------------------------------

LEDGER, BLOCK_FILE = "ledger", "[0-9]*-[0-9]*.npz"
LIBRARIES = ("polar_bayes", "jax", "jaxlib", "numpyro", "numpy", "scipy")


@contextlib.contextmanager
def open_store(folder: Path, plan: CalibrationPlan, *, resume: bool) -> Iterator["BlockStore"]:
    """The blocks of a calibration in a folder, which is made, or read where it is resumed."""
    where = str(folder)
    if not resume and folder.exists():
        raise FitError("it is there already", where=where, hint=f"{OTHER_OUT}, or --resume")
    with written(folder, FitError):
        folder.mkdir(exist_ok=resume)
        others = [path for path in folder.iterdir() if not path.match(BLOCK_FILE)]
    names = [path.name for path in others if not path.name.startswith(TEMPORARY_PREFIX)]
    if names and LEDGER not in names:
        raise FitError("it holds no calibration", where=where, hint=OTHER_OUT)
    ledger_of_plan = folder / LEDGER, folder, "calibration", fingerprint_of(plan)
    with (
        locked_ledger(*ledger_of_plan, resume=True) as ledger,
        on_interrupt(lambda: resume_hint(folder)),
    ):
        with written(folder, FitError):
            ledger.read()
            ledger.begin()
        yield BlockStore(folder, ledger)


@dataclasses.dataclass(frozen=True, eq=False)
class BlockStore:
    """A folder of blocks, each in a file that is there whole or not at all."""

    folder: Path
    ledger: Ledger

    def blocks(self) -> list[Block]:
        """The finished blocks; those whose files are lost or damaged are fitted again."""
        paths = {label: self.folder / f"{label}.npz" for label in sorted(self.ledger.entries)}
        return [_read(path) for label, path in paths.items() if self.ledger.holds(label, [path])]

    def add(self, block: Block) -> None:
        """Write a block; arrays are named by their path, such as `pit/roughness`."""
        label = f"{block.numbers.min():08d}-{block.numbers.max():08d}"
        path = self.folder / f"{label}.npz"
        arrays = {
            jax.tree_util.keystr(at, simple=True, separator="/"): np.asarray(x)
            for at, x in jax.tree_util.tree_leaves_with_path(block)
        }
        with written(self.folder, FitError), temporary_folder(self.folder) as unfinished:
            np.savez(unfinished / path.name, allow_pickle=False, **arrays)
            replace_file(unfinished / path.name, path)
            self.ledger.add(label, Entry(digest(block.numbers), digest_files([path])))


def _read(path: Path) -> Block:
    parts: dict[str, Any] = {name: {} for name in Block._fields}
    with np.load(path, allow_pickle=False) as file:
        for key, values in file.items():
            name, _, entry = key.partition("/")
            if entry:
                parts[name][entry] = values
            else:
                parts[name] = values
    return Block(**{**parts, "outcome": Outcome(**parts["outcome"])})


def fingerprint_of(plan: CalibrationPlan) -> dict[str, str]:
    """One text per topic that determines the fits; their number may differ between runs."""
    truth = _topics(plan.generative_request) if plan.generative_request is not None else {}
    data = plan.compiled.data
    return {
        "capture": digest(jax.tree.leaves(data), data.dims, tuple(data.readings)),
        **_topics(plan.request),
        "truth": " ".join(f"{topic}: {text}" for topic, text in truth.items()),
        "method": repr(plan.settings),
        "seed": str(plan.request.seed),
        "readings": str(plan.readings),
        VERSIONS: " ".join(f"{name} {version(name)}" for name in LIBRARIES),
    }


def _topics(request: Request) -> dict[str, str]:
    priors = (
        f"{name}={describe_prior(prior)} {digest(prior)}"
        for name, prior in sorted(request.priors.items())
    )
    links = (f"{name}={link!r}" for name, link in sorted(request.links.items()))
    return {
        "model": f"{request.model_name} {digest(request.model, request.fixed)}",
        "scene": ADDRESS.sub("", repr(request.scene)),
        "priors": ", ".join(priors),
        "links": ADDRESS.sub("", ", ".join(links)),
        "largest_view_zenith": repr(request.largest_view_zenith),
    }
