"""Blocks of simulations of a calibration: simulate, fit, rank and store them, in any process.

Source:
    Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from polar_bayes.calibration.predictive import Arrays, PredictivePit, unranked_reason
from polar_bayes.calibration.scores import PitCrps
from polar_bayes.capture.files import read_netcdf, write_netcdf
from polar_bayes.errors import FitError, OutputError, PolarBayesError
from polar_bayes.inference.batching import MethodUsed, ObservationBatch, Status
from polar_bayes.inference.compiled_model import CompiledModel, compile_layout
from polar_bayes.inference.problem import observe_request
from polar_bayes.inference.problem_batch import Outcome, problem_batch
from polar_bayes.inference.program import Program, Values, compile_program
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import dims_of, shape_of
from polar_bayes.maps.blocks import (
    OTHER_OUT,
    RESUME,
    VERSIONS,
    Journal,
    digest,
    open_journal,
    request_topics,
    written,
)
from polar_bayes.methods.method import AbstractBatchMethod
from polar_bayes.numerics.compile import TRACING_LOCK, JitOnce, LRUCache
from polar_bayes.numerics.psis import LEVELS, MAX_PARETO_K, Marginals
from polar_bayes.observation.data import Observations
from polar_bayes.paths import TEMPORARY_PREFIX, replace_file, temporary_folder
from polar_bayes.physics.part import notation


@dataclasses.dataclass(frozen=True, eq=False)
class CalibrationPlan:
    """Everything that defines the fits of a calibration; it can be sent to another process."""

    request: Request
    generative_request: Request | None
    settings: AbstractBatchMethod
    readings: bool
    layout_key: str
    key: str

    @property
    def compiled(self) -> "CompiledPlan":
        """Compiled programs; the next calibration of the same model reuses them."""
        return _COMPILED.of(self.key, lambda: CompiledPlan(self))

    @property
    def block(self) -> int:
        """Number of simulations of a block."""
        return self.settings.group_size


@dataclasses.dataclass(frozen=True, eq=False)
class CompiledPlan:
    """The compiled programs of a plan, each made at its first use."""

    plan: CalibrationPlan

    @functools.cached_property
    def data(self) -> Observations:
        """The capture whose layout all simulations have."""
        with jax.enable_x64(True):
            return observe_request(self.plan.request)

    @functools.cached_property
    def engine(self) -> CompiledModel:
        """The compiled model that fits captures."""
        plan = self.plan
        return compile_layout(plan.layout_key, plan.request, lambda: self.data)

    @functools.cached_property
    def generative_program(self) -> Program:
        """The model from which captures are simulated, as functions of one vector."""
        request = self.plan.generative_request
        if request is None:
            return self.engine.program
        with jax.enable_x64(True), TRACING_LOCK:
            return compile_program(request.bind(), self.data)

    @functools.cached_property
    def shared(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters that are both simulated and fitted, by name."""
        fitted = _shapes(self.engine.program, self.data)
        simulated = _shapes(self.generative_program, self.data)
        return {name: shape for name, shape in simulated.items() if fitted.get(name) == shape}

    @functools.cached_property
    def unranked_reason(self) -> str:
        """Reason why readings cannot be ranked; empty where they can or need not be."""
        if not self.plan.readings:
            return ""
        program, given = self.engine.program, _shapes(self.engine.program, self.data)
        with jax.enable_x64(True), TRACING_LOCK:
            return unranked_reason(program, self.generative_program, self.data, given)


_COMPILED: LRUCache[CompiledPlan] = LRUCache(4)


def fit_block(plan: CalibrationPlan, numbers: np.ndarray) -> xr.DataTree:
    """Simulate and fit some captures, as workers do; NaN where a fit has no answer."""
    # The result of a simulation depends on its number alone, not on the others of its block.
    compiled, seed, count = plan.compiled, plan.request.seed, len(numbers)
    program, data, shared = compiled.generative_program, compiled.data, compiled.shared
    filled = np.resize(numbers, plan.block)  # so that all blocks run the same program
    is_ranked = plan.readings and not compiled.unranked_reason
    with jax.enable_x64(True):
        key = jax.random.fold_in(jax.random.key(seed), 1)
        drawn = draw_captures(program, data, filled, key, replicate=is_ranked)
    truth: Arrays = {name: np.asarray(drawn.truth[name])[:count] for name in shared}
    captures = drawn.captures.subset(np.arange(count))
    batch = problem_batch(compiled.engine, captures, numbers, seed)
    marginals, scores = Marginals(count, shared, random=True), PitCrps(truth, numbers, seed)
    ranked = None
    if is_ranked:
        again = {name: np.asarray(values)[:count] for name, values in drawn.replicated.items()}
        ranked = PredictivePit(batch, again, numbers)
    statistics: list[Marginals | PitCrps | PredictivePit] = [marginals, scores]
    statistics += [ranked] if ranked else []
    outcome = Outcome(count)
    for found in plan.settings.fit_batch(batch):
        outcome.put(found)
        for statistic in statistics if found.draws else ():
            statistic.describe(found.at, found.draws, found.weights)
    groups = _label_groups(compiled, numbers, truth, scores, marginals)
    fits: dict[str, tuple] = {name: ("simulation", x) for name, x in vars(outcome).items()}
    for name, flags in {"status": Status, "method": MethodUsed}.items():
        meanings = " ".join(flag.name.lower() for flag in flags)
        fits[name] = (*fits[name], {"flag_meanings": meanings})
    groups["fits"] = xr.Dataset(fits, {"simulation": numbers})
    if ranked:
        groups |= _label_readings(ranked, data, numbers)
    return xr.DataTree.from_dict(groups)


def _label_groups(
    compiled: "CompiledPlan",
    numbers: np.ndarray,
    truth: Arrays,
    scores: PitCrps,
    marginals: Marginals,
) -> dict[str, xr.Dataset]:
    """What is known of the parameters of some simulations, with names, axes and units."""
    program, captured = compiled.engine.program, compiled.plan.request.capture
    dims, lengths = dims_of(program), dict(compiled.data.dims)
    axes = {
        dim: captured[dim].to_numpy() if dim in captured.coords else np.arange(lengths[dim])
        for name in truth
        for dim in dims[name]
        if dim in lengths
    }
    axes["simulation"] = numbers

    def labeled(values: Values, suffix: str = "", first: tuple[str, ...] = ()) -> dict[str, tuple]:
        found = {}
        for name, x in values.items():
            symbol, _, unit = notation(name)
            shape = (*np.shape(x)[: len(first) + 1], *shape_of(program, name))
            attributes = {"symbol": symbol, "units": unit}
            axes_of_name = (*first, "simulation", *dims[name])
            found[f"{name}{suffix}"] = axes_of_name, np.reshape(x, shape), attributes
        return found

    own = {
        **labeled(marginals.mean),
        **labeled(marginals.sd, "_sd"),
        **labeled(marginals.quantiles, "_quantile", ("quantile",)),
        **labeled(scores.crps, "_crps"),
    }
    return {
        "prior_sbc": xr.Dataset(labeled(scores.pit), axes),
        "truth": xr.Dataset(labeled(truth), axes),
        "marginals": xr.Dataset(own, {**axes, "quantile": list(LEVELS)}),
    }


def _label_readings(
    ranked: PredictivePit, data: Observations, numbers: np.ndarray
) -> dict[str, xr.Dataset]:
    """Label PIT values of readings, their indices, and Pareto k of leaving each one out."""
    k_name = f"Pareto k of the weights without it; above {MAX_PARETO_K} they are unreliable"
    chosen: dict[str, tuple] = {}
    for name, entry in ranked.entry.items():
        k = ranked.left_out_k[name]
        chosen[f"{name}_pareto_k"] = ("simulation", k, {"long_name": k_name})
        index = np.unravel_index(np.maximum(entry, 0), data.shape)
        for (dim, _), at in zip(data.dims, index, strict=True):
            attributes = {"long_name": f"number of its {dim}, -1 where none is valid"}
            chosen[f"{name}_{dim}"] = ("simulation", np.where(entry < 0, -1, at), attributes)

    def pit(values: Arrays) -> dict[str, tuple]:
        return {
            name: ("simulation", x, {"symbol": notation(name)[0], "units": "1"})
            for name, x in values.items()
        }

    groups = {"predictive_pit": pit(ranked.fresh), "loo_pit": pit(ranked.left_out)}
    groups["readings"] = chosen
    return {name: xr.Dataset(own, {"simulation": numbers}) for name, own in groups.items()}


def join(blocks: Sequence[xr.DataTree], count: int) -> xr.DataTree:
    """Combine blocks into one, ordered by simulation, up to a number of simulations."""
    groups = {}
    for name in blocks[0].children:
        whole = xr.concat(
            [block[name].to_dataset() for block in blocks],
            "simulation",
            data_vars="minimal",
            coords="minimal",
            compat="override",
            join="exact",
        )
        ordered = whole.sortby("simulation").drop_duplicates("simulation")
        groups[name] = ordered.sel(simulation=slice(0, count - 1))
    return xr.DataTree.from_dict(groups)


def numbers_of(block: xr.DataTree) -> np.ndarray:
    """Return the numbers of the simulations of a block."""
    return block["fits"]["simulation"].to_numpy()


def cut(numbers: np.ndarray, size: int) -> list[np.ndarray]:
    """Split ascending simulation numbers into one array per block."""
    ends = np.flatnonzero(np.diff(numbers // size)) + 1
    return [part for part in np.split(numbers, ends) if part.size]


def _shapes(program: Program, data: Observations) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a model's parameters by name, in alphabetical order."""
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
    """Compile the simulation of many captures: parameters from the prior, and readings."""
    # Where intensity is recorded, each capture's own brightness sets its noise, and readings at
    # full scale are saturated.

    def simulate(number: Array, key: Array, data: Observations) -> tuple[Values, dict, Values]:
        key_truth, key_noise = jax.random.split(jax.random.fold_in(key, number))
        z = program.from_prior(key_truth, data)
        draw = program.describe(key_noise, z, data)
        recorded = _recorded(data, draw.predictive)
        if "intensity" in program.observed:  # the noise of the other readings may follow it
            others = program.describe(key_noise, z, recorded).predictive
            recorded = _recorded(data, {**others, "intensity": draw.predictive["intensity"]})
        key_again = jax.random.fold_in(key_noise, 1)
        again = program.describe(key_again, z, recorded).predictive if replicate else {}
        drawn = {name: getattr(recorded, name) for name in ("readings", "brightness", "saturated")}
        return draw.parameters, drawn, again

    return JitOnce(
        lambda numbers, key, data: jax.lax.map(lambda number: simulate(number, key, data), numbers)
    )


def _recorded(data: Observations, readings: Mapping[str, Any]) -> Observations:
    """Replace the readings of a capture; views that are not valid keep the readings of `data`."""
    valid = {n: jnp.where(data.valid, x, data.readings[n]) for n, x in readings.items()}
    capture = dataclasses.replace(data, readings={**data.readings, **valid})
    if "intensity" not in valid:
        return capture
    return dataclasses.replace(
        capture,
        brightness=jnp.clip(valid["intensity"], 0.0, 1.0),
        saturated=data.valid & (valid["intensity"] >= data.full_scale),
    )


def _batch(data: Observations, recorded: Mapping[str, Any]) -> ObservationBatch:
    """Captures as a batch: what was drawn and the masks differ, all else is the same."""
    own = {**recorded, "valid": data.valid}
    shape = (len(recorded["brightness"]), *data.shape)
    wide = jax.tree.map(lambda x: np.broadcast_to(x, shape), own)
    arrays = dataclasses.replace(jax.tree.map(np.asarray, data), **wide)
    nothing, drawn = jax.tree.map(lambda _: False, data), jax.tree.map(lambda _: True, own)
    return ObservationBatch.of(arrays, dataclasses.replace(nothing, **drawn))


# --- Blocks on the disk ---------------------------------------------------------------------------

JOURNAL, BLOCK_FILE = "journal", "[0-9]*-[0-9]*.nc"
LIBRARIES = ("polar_bayes", "jax", "jaxlib", "numpyro", "numpy", "scipy")


@contextlib.contextmanager
def open_store(folder: Path, plan: CalibrationPlan, resume: bool) -> Iterator["BlockStore"]:
    """Create the folder of a calibration's blocks, or open it to resume."""
    where = str(folder)
    if not resume and folder.exists():
        raise OutputError("it is there already", where=where, hint=RESUME)
    with written(folder):
        folder.mkdir(exist_ok=resume)
        others = [path for path in folder.iterdir() if not path.match(BLOCK_FILE)]
    names = [path.name for path in others if not path.name.startswith(TEMPORARY_PREFIX)]
    if names and JOURNAL not in names:
        what = "it holds no calibration that this version can resume"
        raise OutputError(what, where=where, hint=OTHER_OUT)
    journal_of_plan = folder / JOURNAL, folder, "calibration", topics_of(plan)
    with open_journal(*journal_of_plan, resume=True) as journal:
        with written(folder):
            journal.read()
            journal.begin()
        yield BlockStore(folder, journal)


@dataclasses.dataclass(frozen=True, eq=False)
class BlockStore:
    """A folder of blocks, each of which is one file that is written atomically."""

    folder: Path
    journal: Journal

    def blocks(self) -> list[xr.DataTree]:
        """Read the finished blocks; those with lost or damaged files are fitted again."""
        found = []
        for path in sorted(self.folder.glob(BLOCK_FILE)):
            broken = FitError("it cannot be read", where=str(path), hint=RESUME)
            if path.stem in self.journal.done:
                with contextlib.suppress(PolarBayesError):
                    found.append(read_netcdf(xr.DataTree, path, broken))
        return found

    def add(self, block: xr.DataTree) -> None:
        """Write a block to a file named by the numbers of its first and last simulation."""
        numbers = numbers_of(block)
        path = self.folder / f"{numbers.min():08d}-{numbers.max():08d}.nc"
        with written(self.folder), temporary_folder(self.folder) as unfinished:
            write_netcdf(block, unfinished / path.name)
            replace_file(unfinished / path.name, path)
            self.journal.add(path.stem)


def topics_of(plan: CalibrationPlan) -> dict[str, str]:
    """Return a text per topic that determines the fits, without the number of simulations."""
    truth = request_topics(plan.generative_request) if plan.generative_request is not None else {}
    data = plan.compiled.data
    return {
        "capture": digest(jax.tree.leaves(data), data.dims, tuple(data.readings)),
        **request_topics(plan.request),
        "truth": " ".join(f"{topic}: {text}" for topic, text in truth.items()),
        "method": repr(plan.settings),
        "seed": str(plan.request.seed),
        "readings": str(plan.readings),
        VERSIONS: " ".join(f"{name} {version(name)}" for name in LIBRARIES),
    }
