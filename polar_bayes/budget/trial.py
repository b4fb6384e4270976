"""One method on one capture, run and measured: first with everything to compile, then again."""

import dataclasses
import math
import sys
import time

import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.diagnostics.parameters import scalars
from polar_bayes.inference.bench import Bench
from polar_bayes.inference.draws import parameters_of
from polar_bayes.inference.method import Answer
from polar_bayes.inference.prepared import prepare
from polar_bayes.inference.program import Program
from polar_bayes.inference.request import Method, Request
from polar_bayes.inference.result import posterior_of
from polar_bayes.ladder.builtin import answer
from polar_bayes.observation.data import Observations, observe
from polar_bayes.progress import silent

try:
    import resource
except ImportError:  # not on Windows, where memory is then not known
    resource = None  # type: ignore[assignment]

MEBIBYTE = 2**20


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """What is run."""

    request: Request
    method: Method
    seed: int


@dataclasses.dataclass(frozen=True, eq=False)
class Measured:
    """What came of it."""

    labels: tuple[str, ...]
    draws: np.ndarray
    answer: Answer
    seconds_first: float
    seconds_again: float
    peak_memory: float
    memory_before: float


def run_trial(trial: Trial) -> Measured:
    """Run a trial in this process."""
    before = _memory()
    with jax.enable_x64(trial.request.precision == "double"):
        begin = time.perf_counter()
        found, program, data = _run(trial, trial.seed)
        labels, draws = labeled(program, found.z, data)
        first = time.perf_counter() - begin
        peak = _memory()
        begin = time.perf_counter()
        again, program, data = _run(trial, trial.seed + 1)
        labeled(program, again.z, data)
        seconds = time.perf_counter() - begin
    bare = dataclasses.replace(found, z=np.zeros(0), stats={}, weighted=None)
    return Measured(labels, draws, bare, first, seconds, peak, before)


def bench_of(request: Request, key: Array) -> Bench:
    """The capture of a request, ready to be fitted."""
    data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
    if request.precision == "single":
        data = data.in_single_precision()
    prepared = prepare(request, request.scene, data)
    return Bench(request, prepared, data, key, silent)


def labeled(
    program: Program, z: np.ndarray, data: Observations
) -> tuple[tuple[str, ...], np.ndarray]:
    """Parameters of draws: their labels, and (parameter, chain, draw)."""
    drawn = parameters_of(program, z.astype(data.brightness.dtype), data)
    found = scalars(posterior_of(program, drawn))
    return tuple(each.label for each in found), np.stack([each.draws for each in found])


def _run(trial: Trial, seed: int) -> tuple[Answer, Program, Observations]:
    bench = bench_of(trial.request, jax.random.key(seed))
    return answer(trial.method, bench), bench.program, bench.data


def _memory() -> float:
    if resource is None:
        return math.nan
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MEBIBYTE
