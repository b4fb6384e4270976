"""The one public verb of inference: a capture in, an ArviZ DataTree out."""

import dataclasses
import platform
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import xarray as xr
from jaxtyping import Array

from polar_bayes.capture.schema import count
from polar_bayes.errors import FitError
from polar_bayes.inference import laplace, nuts, point
from polar_bayes.inference.modes import Modes, climb, distinct
from polar_bayes.inference.program import Draw, Program, compile_program
from polar_bayes.inference.result import assemble, posterior_of
from polar_bayes.inference.request import Method, Request, resolve
from polar_bayes.observation.data import Observations, observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.discrepancy import Discrepancy
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import describe_prior

STARTS = 16
PRIOR_DRAWS = 500


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
    progress: Callable[[str, float], None] | None = None,
) -> xr.DataTree:
    """Fit one capture.

    Args:
        capture: A Dataset of the capture schema; validated here.
        model: A name in `MODELS` or a callable `model(data, scene, priors, links)`.
        method: "nuts", "laplace", "point", or settings such as `Nuts(draws=2000)`.
        scene: A name in `SETUPS` or a `Scene`; by default the set-up that the capture names in
            its attribute `setup`, else "paper".
        priors: Distributions that replace or extend `polar_bayes.priors.PRIORS`.
        links: One link for the polarization, or a mapping from variable to link.
        largest_view_zenith: Views beyond it are set aside and counted. Unit degree.
        seed: The same seed gives the same result on the same machine.
        precision: "double" or "single".
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        A DataTree with the groups posterior, sample_stats, log_likelihood, log_prior,
        posterior_predictive, noise_free, prior, prior_predictive, observed_data and
        constant_data; `polar_bayes.diagnostics.convergence.verdict` says whether it converged.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        SceneError: No such scene.
        FitError: A model, method, prior or link cannot be used.
    """
    request = resolve(
        capture, model, method, scene, priors, links, largest_view_zenith, seed, precision
    )
    with jax.enable_x64(precision == "double"):
        return _run(request, progress or (lambda stage, fraction: None))


def _run(request: Request, progress: Callable[[str, float], None]) -> xr.DataTree:
    clock = _Clock()
    data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
    if request.precision == "single":
        data = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, data)
    keys = iter(jax.random.split(jax.random.key(request.seed), 8))
    program = compile_program(request.bind(request.scene), data)
    progress("searching for modes", 0.0)
    starts = _prior_starts(program, data, next(keys))
    problems: list[str] = []
    extra: dict[str, Any] = {}

    if isinstance(request.method, point.Point):
        posterior_z, stats, problems, extra = _fit_point(program, data, starts, request.method)
        clock.lap("point")
    else:
        modes = _search(program, data, starts)
        progress("searching for modes", 1.0)
        clock.lap("modes")
        extra["modes"] = _describe_modes(modes)
        posterior_z, stats = _draw(program, data, modes, next(keys), request.method, progress)
        clock.lap("draws")

    progress("predicting", 0.0)
    describe = _per_draw(program)
    key_describe, key_prior = next(keys), next(keys)
    posterior = describe(key_describe, posterior_z, data)
    prior = _prior(program, key_prior, data)
    clock.lap("prediction")
    progress("predicting", 1.0)

    tree_extra: dict[str, xr.Dataset] = {}
    if _has_discrepancy(request.scene) and not isinstance(request.method, point.Point):
        plain = request.scene.without(Discrepancy)
        progress("fitting without discrepancy", 0.0)
        tree_extra["without_discrepancy"] = _fit_plain(request, plain, data, next(keys))
        clock.lap("without_discrepancy")
        progress("fitting without discrepancy", 1.0)

    provenance = _provenance(request, data, clock, problems, extra)
    tree = assemble(program, request.capture, data, posterior, prior, stats, provenance)
    for name, dataset in tree_extra.items():
        tree[name] = xr.DataTree(dataset)
    return tree


class _Clock:
    """Seconds spent in each stage, compilation included."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.laps[stage] = now - self._last
        self._last = now


def _prior_starts(program: Program, data: Observations, key: Array) -> Array:
    draw = jax.jit(lambda keys, data: jax.lax.map(lambda k: program.from_prior(k, data), keys))
    return draw(jax.random.split(key, STARTS), data)


def _search(program: Program, data: Observations, starts: Array) -> Modes:
    search = jax.jit(lambda starts, data: jax.lax.map(lambda z: climb(program, z, data), starts))
    modes = distinct(search(starts, data), starts=len(starts))
    if modes is None:
        raise FitError(
            f"none of {len(starts)} starts reached a peak of the posterior",
            where="fit",
            mend="check the capture against the prior predictive, or give narrower priors",
        )
    return modes


def _describe_modes(modes: Modes) -> dict[str, Any]:
    return {
        "starts": modes.starts,
        "failures": modes.failures,
        "weights": [round(float(weight), 6) for weight in modes.weight[:8]],
        "newton_decrement": float(modes.decrement[0]),
    }


def _draw(
    program: Program,
    data: Observations,
    modes: Modes,
    key: Array,
    method: Method,
    progress: Callable[[str, float], None],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Unconstrained draws (chain, draw, size) and their statistics."""
    if isinstance(method, laplace.Laplace):
        z = laplace.sample(program, data, modes, key, method)
        densities = jax.jit(lambda z, data: jax.lax.map(lambda x: -program.potential(x, data), z))(
            jnp.asarray(z.reshape(-1, program.size)), data
        )
        return z, {"lp": np.asarray(densities).reshape(z.shape[:2])}
    assert isinstance(method, nuts.Nuts)
    total = method.chains * -(-(method.warmup + method.draws) // method.block) * method.block
    done = 0

    def advance(draws: int) -> None:
        nonlocal done
        done += draws
        progress("sampling", done / total)

    progress("sampling", 0.0)
    chains = nuts.sample(program, data, modes, key, method, advance)
    stats = dict(chains.stats)
    stats["step_size"] = np.broadcast_to(chains.step_size[:, None], chains.z.shape[:2])
    return chains.z, stats


def _per_draw(program: Program) -> Callable[[Array, np.ndarray, Observations], Draw]:
    """Describe every draw, one at a time inside one compiled loop."""
    compiled = jax.jit(
        lambda keys, z, data: jax.lax.map(lambda kz: program.describe(*kz, data), (keys, z))
    )

    def describe(key: Array, z: np.ndarray, data: Observations) -> Draw:
        flat = jnp.asarray(z.reshape(-1, program.size))
        draws = compiled(jax.random.split(key, len(flat)), flat, data)
        return jax.tree.map(lambda x: np.asarray(x).reshape(*z.shape[:2], *x.shape[1:]), draws)

    return describe


def _prior(program: Program, key: Array, data: Observations) -> Draw:
    draws = jax.jit(lambda keys, data: jax.lax.map(lambda k: program.prior_draw(k, data), keys))(
        jax.random.split(key, PRIOR_DRAWS), data
    )
    return jax.tree.map(lambda x: np.asarray(x)[None], draws)


def _fit_point(
    program: Program, data: Observations, starts: Array, method: point.Point
) -> tuple[np.ndarray, dict[str, np.ndarray], list[str], dict[str, Any]]:
    solve = jax.jit(lambda starts, data: point.estimate(program, data, starts))
    found = point.to_numpy(solve(starts[: method.starts], data))
    problems = [] if found.converged else ["least squares did not meet its tolerance"]
    jacobian = jax.jacfwd(program.constrain)(jnp.asarray(found.z))
    variance = np.where(np.isinf(np.diagonal(found.covariance)), 0.0, 1.0)
    safe = np.where(np.isinf(found.covariance), 0.0, found.covariance)
    sds = {}
    for name, slope in jacobian.items():
        slope = np.asarray(slope)
        sd = np.sqrt(np.einsum("...i,ij,...j->...", slope, safe, slope))
        moved = np.any((np.abs(slope) > 0.0) & (variance == 0.0), axis=-1)
        sds[name] = np.where(moved, np.inf, sd).ravel().tolist()
    stats = {"loss": np.asarray(found.loss)[None, None]}
    text = {name: [s if np.isfinite(s) else None for s in sd] for name, sd in sds.items()}
    return found.z[None, None], stats, problems, {"standard_errors": text}


def _has_discrepancy(scene: Scene) -> bool:
    terms = () if scene.instrument is None else scene.instrument.terms
    return any(isinstance(term, Discrepancy) for term in terms)


def _fit_plain(request: Request, scene: Scene, data: Observations, key: Array) -> xr.Dataset:
    """The same fit without the discrepancy, to stand beside it in the report."""
    program = compile_program(request.bind(scene), data)
    key_starts, key_draws, key_describe = jax.random.split(key, 3)
    modes = _search(program, data, _prior_starts(program, data, key_starts))
    z, _ = _draw(program, data, modes, key_draws, request.method, lambda stage, fraction: None)
    return posterior_of(program, _per_draw(program)(key_describe, z, data), data)


def _provenance(
    request: Request,
    data: Observations,
    clock: _Clock,
    problems: list[str],
    extra: Mapping[str, Any],
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
        "scene": request.scene_name,
        "scene_parts": repr(request.scene),
        "priors": {name: describe_prior(prior) for name, prior in request.priors.items()},
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
        "problems": problems,
        "capture": {
            str(key): value if isinstance(value, str | int | float) else str(value)
            for key, value in request.capture.attrs.items()
        },
        **extra,
    }
