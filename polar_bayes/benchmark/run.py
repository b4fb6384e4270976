"""Run and measure one method on one capture: once with compilation, then again without.

    python -m polar_bayes.benchmark.run TRIAL RESULT

runs the trial that one file holds and writes its result to the other.
"""

import abc
import dataclasses
import math
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection
from pathlib import Path
from subprocess import PIPE
from typing import ClassVar, NamedTuple, override

import cloudpickle
import jax
import numpy as np
from jaxtyping import Array, Float

from polar_bayes.diagnostics.parameters import scalars
from polar_bayes.errors import FitError, PolarBayesError
from polar_bayes.inference.model_parts import ModelParts
from polar_bayes.inference.problem import Problem, make_problem
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import posterior_of
from polar_bayes.interrupts import on_interrupt
from polar_bayes.methods.method import AbstractMethod, PosteriorDraws
from polar_bayes.numerics.compile import LRUCache
from polar_bayes.numerics.psis import CHAINS, numpy_generator
from polar_bayes.paths import temporary_folder
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.physics.variants import Effect, parts_of, simplify
from polar_bayes.progress import no_progress
from polar_bayes.scenes.effects import choose_effects

try:
    import resource
except ImportError:  # not on Windows, where memory is then not known
    resource = None  # type: ignore[assignment]


class Trial(NamedTuple):
    """A method and the request to which it is applied."""

    request: Request
    method: AbstractMethod


class TrialResult(NamedTuple):
    """Draws of the parameters (parameter, chain, draw), diagnostics, times [s] and memory [MiB]."""

    labels: tuple[str, ...]
    draws: np.ndarray
    posterior: PosteriorDraws
    seconds_first: float
    seconds_again: float
    peak_memory: float
    memory_before: float


def run_trial(trial: Trial) -> TrialResult:
    """Run a trial in this process."""
    before, seed = _memory(), trial.request.seed
    with jax.enable_x64(trial.request.precision == "double"):
        begin = time.perf_counter()
        found, labels, draws = _run(trial, seed)
        first = time.perf_counter() - begin
        peak = _memory()
        begin = time.perf_counter()
        _run(trial, seed + 1)
        again = time.perf_counter() - begin
    bare = dataclasses.replace(
        found, problems=found.doubts, z=np.zeros(0), stats={}, weighted=None, covariance=None
    )
    return TrialResult(labels, draws, bare, first, again, peak, before)


def labeled(
    problem: Problem,
    z: Float[np.ndarray, "chain draw size"],
    without: Collection[str] = (),
) -> tuple[tuple[str, ...], Float[np.ndarray, "parameter chain draw"]]:
    """Return labels, and values (parameter, chain, draw), of all scalar parameters but some."""
    every = scalars(posterior_of(problem.program, problem.constrain(z)))
    found = [each for each in every if each.name not in without]
    return tuple(each.label for each in found), np.stack([each.draws for each in found])


def _run(trial: Trial, seed: int) -> tuple[PosteriorDraws, tuple[str, ...], np.ndarray]:
    """Run the method of a trial; return its draws, and labels and values of the parameters."""
    key_search, key_draws = jax.random.split(jax.random.key(seed))
    problem = make_problem(trial.request, key_search)
    found = trial.method.run(problem, key_draws, no_progress)
    if found.covariance is None:
        return found, *labeled(problem, found.z)
    # Least squares has no scales of noise: their values are those of its start.
    errors = found.metadata["standard_errors"]
    guesses = {name for name, each in errors.items() if None in each} - {*MATERIAL_PARAMETERS}
    found = sample_point(found, key_draws)
    return found, *labeled(problem, found.z, guesses)


def sample_point(found: PosteriorDraws, key: Array, count: int = 1000) -> PosteriorDraws:
    """Draw from the normal distribution given by the standard errors of a point estimate."""
    # What the readings do not determine has no standard error, and is drawn without any width.
    covariance = np.asarray(found.covariance)
    free = np.isinf(np.diagonal(covariance))
    finite = np.where(free[:, None] | free, 0.0, covariance)
    shape = CHAINS, count // CHAINS
    z = numpy_generator(key).multivariate_normal(found.z[0, 0], finite, shape)
    return dataclasses.replace(found, z=z, stats={}, ess=float(count))


def _memory() -> float:
    if resource is None:
        return math.nan
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


# --- A trial in a process of its own: nothing is compiled yet, nothing else takes memory ----------


def run_in_subprocess(trial: Trial) -> TrialResult:
    """Run a trial in a new process, without the compiled programs of earlier ones."""
    with temporary_folder(Path(tempfile.gettempdir())) as folder:
        source, target = folder / "trial", folder / "result"
        source.write_bytes(cloudpickle.dumps(trial))
        command = [sys.executable, "-m", "polar_bayes.benchmark.run", str(source), str(target)]
        with subprocess.Popen(
            command, env=_environment(), stdout=PIPE, stderr=PIPE, text=True
        ) as process:
            with on_interrupt(process.kill):
                try:
                    _, stderr = process.communicate()
                finally:
                    process.kill()  # an exception must not wait for it
        if not target.exists():
            raise FitError(
                f"its process ended with {process.returncode}: {stderr[-300:].strip()}",
                where="accuracy",
                hint="try the same method with polar_bayes.fit, or a smaller capture",
            )
        # Written by the process that this one has just started.
        found = pickle.loads(target.read_bytes())
    if isinstance(found, PolarBayesError):
        raise found
    return found


def _environment() -> dict[str, str]:
    """Return this process's environment variables, without its cache of compiled programs."""
    kept = {name: value for name, value in os.environ.items() if "COMPILATION_CACHE" not in name}
    path = os.pathsep.join(part or os.getcwd() for part in sys.path)
    return kept | {"PYTHONPATH": path, "JAX_ENABLE_COMPILATION_CACHE": "false"}


def _run_file(source: Path, target: Path) -> None:
    """Run a pickled trial and pickle its result; the new process calls this."""
    try:
        found: TrialResult | PolarBayesError = run_trial(pickle.loads(source.read_bytes()))
    except PolarBayesError as error:
        found = error
    target.write_bytes(cloudpickle.dumps(found))


# --- Overrides of the request or method: facets, effects, precision, number of draws --------------


@dataclasses.dataclass(frozen=True)
class AbstractOverride(abc.ABC):
    """A change of one setting other than the method, such as half the facets."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Name of the change in tables, such as `facets / 2`."""

    @abc.abstractmethod
    def apply(self, request: Request, method: AbstractMethod) -> Trial | None:
        """Apply the change to a request and a method.

        Args:
            request: As it was asked.
            method: The method.

        Returns:
            The trial of both, changed; None where this override changes nothing.

        Raises:
            FitError: It cannot be changed for this capture; other errors of the package likewise.
        """


@dataclasses.dataclass(frozen=True)
class _Factor(AbstractOverride):
    """A change that multiplies one number, which `what` names, by a factor."""

    factor: float
    what: ClassVar[str]

    def __post_init__(self) -> None:
        if not self.factor > 0.0:
            raise FitError(
                f"factor is {self.factor}", where=type(self).__name__, hint="give a number above 0"
            )

    @property
    @override
    def name(self) -> str:
        if self.factor >= 1.0:
            return f"{self.what} x {self.factor:g}"
        return f"{self.what} / {1.0 / self.factor:g}"


@dataclasses.dataclass(frozen=True)
class DrawsOverride(_Factor):
    """A multiple of the draws; skipped where a method cannot make about as many.

    Args:
        factor: Above 0.

    Raises:
        FitError: The factor is not above 0.
    """

    what: ClassVar[str] = "draws"

    @override
    def apply(self, request: Request, method: AbstractMethod) -> Trial | None:
        try:
            changed = method.scale_draws(self.factor)
        except FitError:  # as few as the method allows
            return None
        before, after = method.num_draws, None if changed is None else changed.num_draws
        if changed is None or not before or not after:
            return None
        # Numbers are rounded, or have a least: what is called so must be so.
        is_so = abs(after / before / self.factor - 1.0) < 0.1
        return Trial(request, changed) if is_so and changed != method else None


@dataclasses.dataclass(frozen=True)
class PrecisionOverride(AbstractOverride):
    """Single precision in place of double."""

    @property
    @override
    def name(self) -> str:
        return "single precision"

    @override
    def apply(self, request: Request, method: AbstractMethod) -> Trial | None:
        if request.precision == "single":
            return None
        return Trial(dataclasses.replace(request, precision="single"), method)


@dataclasses.dataclass(frozen=True)
class FacetsOverride(_Factor):
    """So many times the facets in each direction.

    Args:
        factor: Above 0.

    Raises:
        FitError: The factor is not above 0.
    """

    what: ClassVar[str] = "facets"

    @override
    def apply(self, request: Request, method: AbstractMethod) -> Trial | None:
        changed = [
            Effect("", key_path, part, self._of(part))
            for key_path, part in parts_of(request.scene)
            if isinstance(part, FacetQuadrature)
        ]
        return _with_scene(simplify(request.scene, changed), request, method)

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
    def apply(self, request: Request, method: AbstractMethod) -> Trial | None:
        scene = _choose(request, self.tolerance)
        if isinstance(scene, PolarBayesError):
            raise scene
        return _with_scene(scene, request, method)


def _with_scene(scene: Scene, request: Request, method: AbstractMethod) -> Trial | None:
    """A trial with another scene; None where it is that of the request."""
    if scene == request.scene:
        return None
    return Trial(dataclasses.replace(request, scene=scene), method)


OVERRIDES: tuple[AbstractOverride, ...] = (
    DrawsOverride(0.25),
    DrawsOverride(4.0),
    FacetsOverride(0.5),
    FacetsOverride(2.0),
    EffectsOverride(),
    PrecisionOverride(),
)
"""The overrides that are applied to every method, one at a time."""

_CHOSEN: LRUCache[Scene | PolarBayesError] = LRUCache(2)
"""Chosen scenes by request: a choice takes minutes, and every method asks for it. Failures are
stored, too, since they would fail again."""


def _choose(request: Request, tolerance: float) -> Scene | PolarBayesError:
    """Return the scene that `polar_bayes.choose_effects` chooses, or the error that it raises."""
    plain = simplify(request.scene, ())
    swapped = (name.rpartition("prior of ") for name in request.swapped)  # by the user
    priors = {name: request.priors[name] for _, found, name in swapped if found}
    limits = tolerance, request.largest_view_zenith, request.seed
    parts = ModelParts(request.model, plain, priors, request.links)
    key = parts.key(request.capture, *limits)

    def choose() -> Scene | PolarBayesError:
        try:
            scene = choose_effects(
                request.capture,
                scene=plain,
                tolerance=tolerance,
                model=request.model,
                priors=priors,
                links=request.links,
                largest_view_zenith=request.largest_view_zenith,
                seed=request.seed,
            )
        except PolarBayesError as error:
            return error
        return simplify(scene, ())

    return _CHOSEN.of(key, choose)


if __name__ == "__main__":
    _run_file(*map(Path, sys.argv[1:]))
