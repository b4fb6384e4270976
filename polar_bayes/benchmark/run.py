"""One method on one capture, run and measured: first with everything to compile, then again.

    python -m polar_bayes.benchmark.run TRIAL MEASURED

runs what one file holds and writes what came of it to the other.
"""

import abc
import dataclasses
import functools
import math
import os
import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from subprocess import PIPE
from typing import override

import cloudpickle
import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.diagnostics.parameters import scalars
from polar_bayes.effects.choose import choose_effects
from polar_bayes.effects.variants import Effect, parameter_ranks, simplify
from polar_bayes.errors import FitError, PolarBayesError
from polar_bayes.inference.compile import LRUCache
from polar_bayes.inference.method import PosteriorDraws
from polar_bayes.inference.problem import Problem, compile_model
from polar_bayes.inference.program import Program, parameters_of
from polar_bayes.inference.request import Method, Request
from polar_bayes.inference.result import posterior_of
from polar_bayes.inference.run_method import answer, draws_of, with_draws
from polar_bayes.interrupts import on_interrupt
from polar_bayes.observation.data import Observations, observe
from polar_bayes.paths import unfinished_folder
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import no_progress

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
    answer: PosteriorDraws
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


def problem_of(request: Request, key: Array) -> Problem:
    """The capture of a request, ready to be fitted."""
    data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
    if request.precision == "single":
        data = data.in_single_precision()
    compiled_model = compile_model(request, request.scene, data)
    return Problem(request, compiled_model, data, key, no_progress)


def labeled(
    program: Program, z: np.ndarray, data: Observations
) -> tuple[tuple[str, ...], np.ndarray]:
    """Parameters of draws: their labels, and (parameter, chain, draw)."""
    drawn = parameters_of(program, z.astype(data.brightness.dtype), data)
    found = scalars(posterior_of(program, drawn))
    return tuple(each.label for each in found), np.stack([each.draws for each in found])


def _run(trial: Trial, seed: int) -> tuple[PosteriorDraws, Program, Observations]:
    problem = problem_of(trial.request, jax.random.key(seed))
    return answer(trial.method, problem), problem.program, problem.data


def _memory() -> float:
    if resource is None:
        return math.nan
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MEBIBYTE


# --- A trial in a process of its own: nothing is compiled yet, nothing else takes memory ----------


LAST_WORDS = 300
"""Characters of what a process that broke down has said."""


def run_fresh(trial: Trial) -> Measured:
    """Run a trial in a new process, with compiled programs of earlier ones out of reach."""
    with unfinished_folder(Path(tempfile.gettempdir())) as folder:
        given, made = folder / "trial", folder / "measured"
        given.write_bytes(cloudpickle.dumps(trial))
        words = [sys.executable, "-m", "polar_bayes.benchmark.run", str(given), str(made)]
        with subprocess.Popen(
            words, env=_environment(), stdout=PIPE, stderr=PIPE, text=True
        ) as process:
            with on_interrupt(process.kill):
                try:
                    _, said = process.communicate()
                finally:
                    process.kill()  # an exception must not wait for it
        if not made.exists():
            raise FitError(
                f"its process ended with {process.returncode}: {said[-LAST_WORDS:].strip()}",
                where="accuracy",
                hint="try the same method with polar_bayes.fit, or a smaller capture",
            )
        # Written by the process that this one has just started.
        found = pickle.loads(made.read_bytes())
    if isinstance(found, PolarBayesError):
        raise found
    return found


def _environment() -> dict[str, str]:
    """That of this process, without its store of compiled programs."""
    kept = {name: value for name, value in os.environ.items() if "COMPILATION_CACHE" not in name}
    path = os.pathsep.join(part or os.getcwd() for part in sys.path)
    return kept | {"PYTHONPATH": path, "JAX_ENABLE_COMPILATION_CACHE": "false"}


def _work(given: Path, made: Path) -> None:
    trial = pickle.loads(given.read_bytes())
    try:
        found: Measured | PolarBayesError = run_trial(trial)
    except PolarBayesError as error:
        found = error
    made.write_bytes(cloudpickle.dumps(found))


# --- Overrides of the request or method: facets, effects, precision, number of draws --------------


Overridden = tuple[Request, Method]

NEARLY = 0.1
"""Relative difference between the draws that an override is called by and those that there are."""


@dataclasses.dataclass(frozen=True)
class AbstractOverride(abc.ABC):
    """One setting that is not the method, changed one way."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What it is called beside the method: `facets / 2`."""

    @abc.abstractmethod
    def apply(self, request: Request, method: Method) -> Overridden | None:
        """What is fitted then.

        Args:
            request: As it was asked.
            method: The method.

        Returns:
            Both, changed; None where this override changes nothing.

        Raises:
            FitError: It cannot be changed for this capture; other errors of the package likewise.
        """


@dataclasses.dataclass(frozen=True)
class DrawsOverride(AbstractOverride):
    """So many times the draws; left out where a method cannot have about as many.

    Args:
        factor: Above 0.

    Raises:
        FitError: The factor is not above 0.
    """

    factor: float

    def __post_init__(self) -> None:
        if not self.factor > 0.0:
            raise FitError(
                f"factor is {self.factor}", where="DrawsOverride", hint="give a number above 0"
            )

    @property
    @override
    def name(self) -> str:
        return _times("draws", self.factor)

    @override
    def apply(self, request: Request, method: Method) -> Overridden | None:
        try:
            changed = with_draws(method, self.factor)
        except FitError:  # as few as the method allows
            return None
        before, after = draws_of(method), None if changed is None else draws_of(changed)
        if changed is None or not before or not after:
            return None
        # Numbers are rounded, or have a least: what is called so must be so.
        is_so = abs(after / before / self.factor - 1.0) < NEARLY
        return (request, changed) if is_so and changed != method else None


@dataclasses.dataclass(frozen=True)
class PrecisionOverride(AbstractOverride):
    """Single precision in place of double."""

    @property
    @override
    def name(self) -> str:
        return "single precision"

    @override
    def apply(self, request: Request, method: Method) -> Overridden | None:
        if request.precision == "single":
            return None
        return dataclasses.replace(request, precision="single"), method


@dataclasses.dataclass(frozen=True)
class FacetsOverride(AbstractOverride):
    """So many times the facets in each direction.

    Args:
        factor: Above 0.

    Raises:
        FitError: The factor is not above 0.
    """

    factor: float

    def __post_init__(self) -> None:
        if not self.factor > 0.0:
            raise FitError(
                f"factor is {self.factor}", where="FacetsOverride", hint="give a number above 0"
            )

    @property
    @override
    def name(self) -> str:
        return _times("facets", self.factor)

    @override
    def apply(self, request: Request, method: Method) -> Overridden | None:
        changed = [
            Effect("", key_path, part, self._of(part))
            for key_path, part in parameter_ranks(request.scene)
            if isinstance(part, FacetQuadrature)
        ]
        scene = simplify(request.scene, changed)
        return None if scene == request.scene else (_with_scene(request, scene), method)

    def _of(self, rule: FacetQuadrature) -> FacetQuadrature:
        along, across = (
            min(64, max(1, round(self.factor * nodes))) for nodes in (rule.along, rule.across)
        )
        return FacetQuadrature(along=along, across=across)


@dataclasses.dataclass(frozen=True)
class EffectsOverride(AbstractOverride):
    """Only the effects that `polar_bayes.choose_effects` keeps.

    Args:
        tolerance: Of the choice, posterior standard deviations, > 0.
    """

    tolerance: float = 0.1

    @property
    @override
    def name(self) -> str:
        return "chosen effects"

    @override
    def apply(self, request: Request, method: Method) -> Overridden | None:
        choose = functools.partial(_chosen, request, self.tolerance)
        _, scene = _CHOSEN.of((id(request), self.tolerance), choose)
        if isinstance(scene, PolarBayesError):
            raise scene
        return None if scene == request.scene else (_with_scene(request, scene), method)


OVERRIDES: tuple[AbstractOverride, ...] = (
    DrawsOverride(0.25),
    DrawsOverride(4.0),
    FacetsOverride(0.5),
    FacetsOverride(2.0),
    EffectsOverride(),
    PrecisionOverride(),
)
"""What every method is crossed with, one at a time."""

PRIOR = "prior of "
"""How a request says that a prior is the user's own."""

_CHOSEN: LRUCache[tuple[Request, Scene | PolarBayesError]] = LRUCache(2)
"""Choices take minutes and serve every method; each is stored with its request. One that failed
would fail again."""


def _chosen(request: Request, tolerance: float) -> tuple[Request, Scene | PolarBayesError]:
    plain = simplify(request.scene, ())
    own = [name.removeprefix(PRIOR) for name in request.swapped if name.startswith(PRIOR)]
    try:
        scene = choose_effects(
            request.capture,
            scene=plain,
            tolerance=tolerance,
            model=request.model,
            priors={name: request.priors[name] for name in own},
            links=request.links,
            largest_view_zenith=request.largest_view_zenith,
            seed=request.seed,
        )
    except PolarBayesError as error:
        return request, error
    return request, simplify(scene, ())


def _with_scene(request: Request, scene: Scene) -> Request:
    return dataclasses.replace(request, scene=scene)


def _times(what: str, factor: float) -> str:
    return f"{what} x {factor:g}" if factor >= 1.0 else f"{what} / {1.0 / factor:g}"


if __name__ == "__main__":
    _work(*map(Path, sys.argv[1:]))
