"""The one public verb of inference: a capture in, an ArviZ DataTree out."""

import dataclasses
import inspect
import json
import math
import platform
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from types import FunctionType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from numpyro import distributions as dist
from numpyro.primitives import Messenger

from polar_bayes.capture.schema import count
from polar_bayes.errors import FitError
from polar_bayes.inference import laplace
from polar_bayes.inference.compile import OutOfTimeError, check_memory, run_until
from polar_bayes.inference.initialization import STARTS
from polar_bayes.inference.method import AbstractMethod
from polar_bayes.inference.nuts import Nuts
from polar_bayes.inference.optimize import from_prior
from polar_bayes.inference.problem import CompiledModel, Problem, compile_model
from polar_bayes.inference.program import Draw, Program, parameters_of
from polar_bayes.inference.request import MODELS, Method, Request, resolve
from polar_bayes.inference.result import assemble, posterior_of
from polar_bayes.observation.data import Observations, observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.instrument import Discrepancy
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import describe_prior, support_bounds
from polar_bayes.progress import Progress, no_progress

PRIOR_DRAWS = 500
BLOCK = 500
KEYS = 1 << 15
THREADS = 2
OF_DRAWS = ("r_hat", "k_hat", "effective_draws")
"""What a method says of its own draws, kept with the result; None where it says nothing."""


def fit(
    capture: xr.Dataset,
    *,
    model: str | Callable = "per_material",
    method: str | Method = "nuts",
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    precision: str = "double",
    progress: Progress | None = None,
) -> xr.DataTree:
    """Fit one capture."""
    begun = time.perf_counter()
    request = resolve(
        capture, model, method, scene, priors, links, largest_view_zenith, seed, precision
    )
    with jax.enable_x64(precision == "double"):
        return _run(request, progress or no_progress, begun)


class _Fitted(NamedTuple):
    """One model, fitted: draws, their statistics, and what there is to say about them."""

    program: Program
    z: np.ndarray
    stats: dict[str, np.ndarray]
    problems: list[str]
    extra: dict[str, Any]
    beside: Method | None = None
    deadline: float = math.inf


def _run(request: Request, progress: Progress, begun: float) -> xr.DataTree:
    clock = _Clock(begun)
    data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
    if request.precision == "single":
        data = data.in_single_precision()
    key_main, key_plain, key_posterior, key_prior = jax.random.split(
        jax.random.key(request.seed), 4
    )
    compiled_model = compile_model(request, request.scene, data)
    _check_room(compiled_model.program, data, PRIOR_DRAWS)
    _expect(compiled_model, data, request.method)
    _expect_draws(compiled_model.program, data)
    fitted = _fit_scene(request, compiled_model, data, key_main, progress, clock)
    _check_room(fitted.program, data, fitted.z[..., 0].size + PRIOR_DRAWS)
    describe = _per_draw(fitted.program)
    posterior = describe(key_posterior, fitted.z, data)
    prior_z = from_prior(fitted.program, key_prior, PRIOR_DRAWS, data)
    prior = describe(key_prior, prior_z[None], data)
    clock.lap("prediction")

    beside, comparisons_failed = _fit_beside(request, fitted, data, key_plain, progress)
    if isinstance(request.scene.ledger, xr.Dataset):
        beside["effects"] = request.scene.ledger  # how the scene was chosen stays with the result
    if comparisons_failed:
        fitted.extra["comparisons_failed"] = comparisons_failed
    clock.lap("beside")

    provenance = _provenance(request, data, clock, fitted)
    return assemble(
        fitted.program, request.capture, data, posterior, prior, fitted.stats, beside, provenance
    )


def _fit_scene(
    request: Request,
    compiled_model: CompiledModel,
    data: Observations,
    key: Array,
    progress: Progress,
    clock: "_Clock",
) -> _Fitted:
    """Search for modes from prior draws, then do what the method asks."""
    key_starts, key_draws = jax.random.split(key)
    program = compiled_model.program
    if isinstance(request.method, AbstractMethod):
        answer = request.method.draw(
            Problem(request, compiled_model, data, key, progress, clock.begun)
        )
        clock.lap("draws")
        own = {name: getattr(answer, name) for name in OF_DRAWS}
        finite = {name: x if math.isfinite(x) else None for name, x in own.items()}
        said = {"method": answer.kind} | finite | answer.said
        return _Fitted(
            program,
            answer.z,
            answer.stats,
            answer.problems,
            said,
            answer.beside,
            answer.deadline,
        )
    if isinstance(request.method, laplace.Point):
        starts = from_prior(program, key_starts, STARTS, data)
        fitted = _fit_point(compiled_model, data, starts, request.method)
        clock.lap("least squares")
        return fitted
    initialization = compiled_model.initializer.find(data, key_starts, progress)
    clock.lap("modes")
    drawn = initialization.draw(key_draws, request.method, progress)
    clock.lap("draws")
    extra: dict[str, Any] = {"modes": initialization.said}
    if drawn.goals_reached is not None:
        extra["goals_reached"] = drawn.goals_reached
    return _Fitted(program, drawn.z, drawn.stats, drawn.problems, extra)


class _Clock:
    """Seconds spent in each stage, compilation included."""

    def __init__(self, begun: float) -> None:
        self.laps: dict[str, float] = {}
        self.begun = begun
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = now - self._last
        self._last = now


def _expect(compiled_model: CompiledModel, data: Observations, method: Method) -> None:
    """Begin to compile the sampler, beside the search."""
    if isinstance(method, Nuts):
        compiled_model.initializer.expect(data, method)


def _expect_draws(program: Program, data: Observations) -> None:
    """Begin to compile what will describe them, beside the search and the sampler."""
    keys = jax.random.key_data(jax.random.key(0))
    program.described.begin(
        jax.ShapeDtypeStruct((BLOCK, *keys.shape), keys.dtype),
        jax.ShapeDtypeStruct((BLOCK, program.size), data.brightness.dtype),
        data,
    )


def _check_room(program: Program, data: Observations, draws: int) -> None:
    """Refuse what is described of so many draws where the memory cannot hold it."""
    readings = len(program.observed) * data.brightness.dtype.itemsize * math.prod(data.shape)
    # Noise-free readings, predicted ones and the density of each; in blocks, then all of them.
    check_memory((draws + THREADS * BLOCK) * 3 * readings)


def _per_draw(program: Program) -> Callable[[Array, np.ndarray, Observations], Draw]:
    """Describe every draw, a block at a time inside one compiled loop of fixed length."""

    def describe(key: Array, z: np.ndarray, data: Observations) -> Draw:
        dtype = data.brightness.dtype
        flat = z.reshape(-1, program.size).astype(dtype)
        # A key depends on its place alone, so a round number of them serves draws of any number.
        every = jax.random.split(key, KEYS * -(-len(flat) // KEYS))
        keys = np.asarray(jax.random.key_data(every))

        # Posterior and prior have different lengths; blocks of one length compile once, and run on
        # threads as the chains do.
        def run(start: int) -> Draw:
            index = np.minimum(np.arange(start, start + BLOCK), len(flat) - 1)
            with jax.enable_x64(dtype == jnp.float64):  # a thread does not inherit it
                of_block, drawn = jnp.asarray(keys[index]), jnp.asarray(flat[index])
                return jax.tree.map(np.asarray, program.described(of_block, drawn, data))

        first = run(0)  # compiled before the threads start
        joined = jax.tree.map(lambda x: np.empty((len(flat), *x.shape[1:]), x.dtype), first)

        def fill(start: int, block: Draw) -> None:
            for whole, part in zip(jax.tree.leaves(joined), jax.tree.leaves(block), strict=True):
                whole[start : start + BLOCK] = part[: len(flat) - start]

        fill(0, first)
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(lambda start: fill(start, run(start)), range(BLOCK, len(flat), BLOCK)))
        return jax.tree.map(lambda x: x.reshape(*z.shape[:2], *x.shape[1:]), joined)

    return describe


def _fit_point(
    compiled_model: CompiledModel, data: Observations, starts: np.ndarray, method: laplace.Point
) -> _Fitted:
    program = compiled_model.program
    found = laplace.to_numpy(
        compiled_model.least_squares(jnp.asarray(starts[: method.starts]), data)
    )
    errors = laplace.standard_errors(program, found)
    problems = [] if found.converged else ["least squares did not meet its tolerance"]
    stats = {"loss": np.asarray(found.loss)[None, None]}
    return _Fitted(
        program, np.asarray(found.z)[None, None], stats, problems, {"standard_errors": errors}
    )


def _fit_beside(
    request: Request, fitted: _Fitted, data: Observations, key: Array, progress: Progress
) -> tuple[dict[str, xr.Dataset], dict[str, str]]:
    """Posteriors of the same fit without what makes its intervals honest, and which ones failed."""
    method = fitted.beside or request.method
    if isinstance(method, laplace.Point) or not request.scene.has(Discrepancy):
        return {}, {}
    scenes = {
        "without_discrepancy": request.scene.without(Discrepancy),
        "without_instrument": dataclasses.replace(request.scene, instrument=None),
    }
    requests = {
        name: dataclasses.replace(request, scene=scene, method=method)
        for name, scene in scenes.items()
    }
    beside: dict[str, xr.Dataset] = {}
    failed: dict[str, str] = {}

    def compare(progress: Progress) -> None:
        every: dict[str, CompiledModel] = {}
        for name, asked in requests.items():
            try:
                every[name] = compile_model(asked, asked.scene, data)
                _expect(every[name], data, method)
            except FitError as error:  # a failed comparison must not cost the user the fit
                failed[name] = str(error)
        for number, (name, compiled_model) in enumerate(every.items()):
            at = number / len(every)
            progress("comparing", at)
            try:
                beside[name] = _compare(
                    requests[name],
                    compiled_model,
                    data,
                    key,
                    lambda *_, at=at: progress("comparing", at),
                )
            except FitError as error:
                failed[name] = str(error)

    late = ""
    try:
        run_until(fitted.deadline, progress, compare)
    except OutOfTimeError as error:
        late = str(error)
    progress("comparing", 1.0)
    done = dict(beside)  # an abandoned thread may still write to its own
    return done, {name: late for name in requests if late and name not in done} | failed


def _compare(
    request: Request,
    compiled_model: CompiledModel,
    data: Observations,
    key: Array,
    progress: Progress,
) -> xr.Dataset:
    """The posterior of another scene."""
    found = _fit_scene(request, compiled_model, data, key, progress, _Clock(time.perf_counter()))
    return posterior_of(found.program, parameters_of(found.program, found.z, data))


def _settings_of(model: Callable) -> dict[str, Any]:
    """The fields of a model that is a value, in what JSON can hold."""
    if not dataclasses.is_dataclass(model) or isinstance(model, type):
        return {}
    return json.loads(json.dumps(dataclasses.asdict(model), default=repr))


def _bounds_of(prior: dist.Distribution) -> list[float | None]:
    """Where a prior ends; None, which JSON can hold, where it does not."""
    return [bound if math.isfinite(bound) else None for bound in support_bounds(prior)]


def _source_of(request: Request) -> str:
    """The text of a model of the user's own, so that a result says what was fitted."""
    model = request.model
    while isinstance(model, Messenger):
        model = model.fn
    ours = [story if isinstance(story, FunctionType) else type(story) for story in MODELS.values()]
    if model in ours or type(model) in ours:
        return ""
    try:
        return inspect.getsource(model if isinstance(model, FunctionType) else type(model))
    except (OSError, TypeError):
        return ""


def _provenance(
    request: Request, data: Observations, clock: _Clock, fitted: _Fitted
) -> dict[str, Any]:
    counts = count(request.capture)
    used = int(np.sum(data.valid))
    at_boundary = {
        name: int(np.sum((np.asarray(link.reading(x)) != np.asarray(x)) & np.asarray(data.valid)))
        for name, link in request.links.items()
        for x in [data.readings[name]]
    }
    packages = ("polar_bayes", "jax", "numpyro", "arviz", "optimistix", "numpy", "xarray")
    return {
        "method": request.method_name,
        "settings": dataclasses.asdict(request.method),
        "model": request.model_name,
        "model_settings": _settings_of(request.model),
        "model_source": _source_of(request),
        "scene": request.scene_name,
        "scene_parts": repr(request.scene),
        "priors": {name: describe_prior(prior) for name, prior in request.priors.items()},
        "bounds": {name: _bounds_of(prior) for name, prior in request.priors.items()},
        "declared": request.declared,
        "fixed": request.fixed,
        "links": {name: repr(link) for name, link in request.links.items()},
        "swapped": list(request.swapped),
        "largest_view_zenith": request.largest_view_zenith,
        "seed": request.seed,
        "precision": request.precision,
        "chain_method": "threads",
        "versions": {name: version(name) for name in packages},
        "machine": {"processor": platform.machine(), "python": platform.python_version()},
        "timings": {stage: round(seconds, 3) for stage, seconds in clock.laps.items()},
        "counts": {**counts, "used": used, "at_margin": at_boundary},
        "problems": fitted.problems,
        "capture": {
            str(key): value if isinstance(value, str | int | float) else str(value)
            for key, value in request.capture.attrs.items()
        },
        **fitted.extra,
    }
