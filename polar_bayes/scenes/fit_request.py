"""The steps of one fit: from a capture and a scene to an ArviZ DataTree."""

import dataclasses
import inspect
import json
import math
import platform
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from types import FunctionType

import jax
import numpy as np
import xarray as xr
from jaxtyping import Array
from numpyro import distributions as dist
from numpyro.primitives import Messenger

from polar_bayes import methods
from polar_bayes.capture.plausibility import cautions, indices_by_eye
from polar_bayes.capture.schema import count
from polar_bayes.errors import FitError
from polar_bayes.inference.prior_probability import has_probabilities, probability_below
from polar_bayes.inference.problem import Problem, make_problem
from polar_bayes.inference.program import BLOCK, PRIOR_DRAWS, THREADS, Values, from_prior
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import Provenance, assemble
from polar_bayes.methods.method import AbstractMethod, find_method
from polar_bayes.numerics.compile import check_memory, compiled
from polar_bayes.priors import support_bounds
from polar_bayes.progress import Progress
from polar_bayes.scenes.neighbors import STOPPED, fit_comparisons, removed_terms, try_alternatives

DIAGNOSTICS = ("r_hat", "pareto_k", "ess")
"""Diagnostics that methods state of their draws and results store; None if not stated."""

Keep = Callable[[xr.DataTree], None]
"""Function of a fit that is called before comparisons with the fit are made."""


def fit_request(
    request: Request,
    method: AbstractMethod,
    progress: Progress,
    start_time: float,
    *,
    with_comparisons: bool = True,
    keep: Keep | None = None,
) -> xr.DataTree:
    """Fit a request in the current precision."""
    keys = compiled(_keys)(np.uint32(request.seed))
    key_search, key_draws, key_check, key_comparisons, key_posterior, key_prior = keys
    problem = make_problem(request, key_search, start_time)
    _check_room(problem, PRIOR_DRAWS)
    method.prepare(problem)
    problem.prepare_predictions()
    prepared = time.perf_counter()
    draws = method.run(problem, key_draws, progress)
    ended = {"": start_time}  # when each stage had ended, compilation included
    if problem.search_seconds:
        ended["modes"] = prepared + problem.search_seconds
    ended["draws"] = time.perf_counter()
    _check_room(problem, draws.z[..., 0].size + PRIOR_DRAWS)
    posterior = problem.predict(key_posterior, draws.z)
    prior_z = from_prior(problem.program, key_prior, PRIOR_DRAWS, problem.data)
    prior = problem.predict(key_prior, prior_z[None])
    ended["prediction"] = time.perf_counter()
    checked = method.cross_check(problem, posterior.parameters, key_check)
    ended["cross-check"] = time.perf_counter()
    is_point = draws.covariance is not None

    stated = {name: getattr(draws, name) for name in DIAGNOSTICS}
    known = {
        **_provenance(request, method, problem),
        "prior_probability": _prior_probability(request, posterior.parameters),
        "problems": draws.problems,
        "method": draws.method,
        **{name: value if math.isfinite(value) else None for name, value in stated.items()},
        **draws.metadata,
        **checked,
    }

    def result(
        comparisons: Mapping[str, xr.Dataset], failed: dict[str, str], alternatives: Provenance
    ) -> xr.DataTree:
        spent = np.diff(list(ended.values())).round(3).tolist()
        seconds = dict(zip(list(ended)[1:], spent, strict=True))
        provenance = {**known, "timings": seconds, **alternatives}
        provenance |= {"comparisons_failed": failed} if failed else {}
        ledger = request.scene.ledger  # how the scene was chosen
        tables = {"effects": ledger} if isinstance(ledger, xr.Dataset) else {}
        given = problem.program, request.capture, problem.data, posterior, prior, draws.stats
        return assemble(*given, {**comparisons, **tables}, provenance)

    if not with_comparisons or is_point:  # a point has no interval to compare
        return result({}, {}, {})
    removed, deadline = removed_terms(request), method.deadline(problem)
    if keep is not None:
        stopped = {"alternatives_failed": STOPPED}
        keep(result({}, dict.fromkeys(removed, STOPPED), stopped))
    methods = method.for_comparison(problem, draws)
    given = request, problem, methods, deadline, key_comparisons, progress
    comparisons, failed = fit_comparisons(removed, *given)
    ended["comparisons"] = time.perf_counter()
    if STOPPED in failed.values():
        return result(comparisons, failed, {"alternatives_failed": STOPPED})
    alternatives = try_alternatives(
        request, problem, posterior.parameters, key_check, progress, deadline=deadline
    )
    ended["alternatives"] = time.perf_counter()
    return result(comparisons, failed, alternatives)


def _keys(seed: Array) -> tuple[Array, ...]:
    """Split a key for search, draws, check, comparisons and both predictions."""
    key, comparisons, posterior, prior = jax.random.split(jax.random.key(seed), 4)
    return (*jax.random.split(key), jax.random.fold_in(key, 1), comparisons, posterior, prior)


def choose_method(
    method: str | AbstractMethod, tolerance: float | None, seconds: float | None
) -> AbstractMethod:
    """Return the settings of the caller's method, given by name or as a value."""
    limits = {"tolerance": tolerance, "seconds": seconds}
    given = {name: value for name, value in limits.items() if value is not None}
    if given and method != "auto":
        raise FitError(
            f"{' and '.join(given)} needs method='auto'",
            where=f"fit: method={method!r}",
            hint="leave it out, or give method='auto'",
        )
    if given:
        return methods.Auto(tolerance, seconds)
    return find_method(method, "fit", one=True)


def _check_room(problem: Problem, draws: int) -> None:
    """Refuse predictions of more draws than fit into memory."""
    data = problem.data
    readings = len(problem.program.observed) * problem.dtype.itemsize * math.prod(data.shape)
    # Noise-free readings, predicted ones and the density of each; in blocks, then all of them.
    check_memory((draws + THREADS * BLOCK) * 3 * readings)


def _model_settings(model: Callable) -> Provenance:
    """Return the fields of a model that is a dataclass, in types of JSON."""
    if not dataclasses.is_dataclass(model) or isinstance(model, type):
        return {}
    return json.loads(json.dumps(dataclasses.asdict(model), default=repr))


def _model_source(model: Callable) -> str:
    """Return the source of the user's model, so that a result shows what was fitted."""
    while isinstance(model, Messenger):
        model = model.fn
    code = model if isinstance(model, FunctionType) else type(model)
    if (code.__module__ or "").startswith("polar_bayes."):  # None: of exec() in a bare namespace
        return ""
    try:
        return inspect.getsource(code)
    except (OSError, TypeError):
        return ""


def _finite_bounds(prior: dist.Distribution) -> list[float | None]:
    """Return the bounds of the support of a prior; None for infinite ones."""
    return [bound if math.isfinite(bound) else None for bound in support_bounds(prior)]


def _prior_probability(request: Request, posterior: Values) -> dict[str, list[float]]:
    """Return prior probabilities below posterior medians, for priors that have them."""
    found = {}
    for name, prior in request.priors.items():
        if name in posterior and name not in request.fixed:
            median = np.median(np.asarray(posterior[name], float), axis=(0, 1))
            if has_probabilities(prior):
                found[name] = probability_below(prior, median).ravel().tolist()
    return found


def _indices_by_eye(request: Request) -> dict[str, list[float]]:
    """Return the index by eye of each material; empty where coats or light move the peak."""
    source = getattr(request.scene.surface, "illumination", None)
    if request.scene.coat is not None or getattr(source, "polarization", None) is not None:
        return {}
    found = indices_by_eye(request.capture)
    return {name: list(index) for name, index in found.items() if index is not None}


def _provenance(request: Request, method: AbstractMethod, problem: Problem) -> Provenance:
    """Return everything that is needed to repeat the fit."""
    data = jax.device_get(problem.data)
    at_boundary = {
        name: int(np.sum((np.asarray(link.reading(x)) != x) & data.fitted(name)))
        for name, link in request.links.items()
        for x in [data.readings[name]]
    }
    packages = ("polar_bayes", "jax", "numpyro", "arviz", "optimistix", "numpy", "xarray")
    used = {"used": int(np.sum(data.valid)), "at_margin": at_boundary}
    return {
        "settings": dataclasses.asdict(method),
        "method_parts": repr(method),
        **request.describe(),
        "model_settings": _model_settings(request.model),
        "model_source": _model_source(request.model),
        "capture_cautions": list(cautions(request.capture)),
        "indices_by_eye": _indices_by_eye(request),
        "known": request.standard_uncertainties(problem.program.supports),
        "bounds": {name: _finite_bounds(prior) for name, prior in request.priors.items()},
        "declared": request.declared,
        "fixed": request.fixed,
        "swapped": list(request.swapped),
        "largest_view_zenith": request.largest_view_zenith,
        "precision": request.precision,
        "chain_method": "threads",
        "versions": {name: version(name) for name in packages},
        "machine": {"processor": platform.machine(), "python": platform.python_version()},
        "counts": {**count(request.capture), **used},
        "capture": {
            str(key): value if isinstance(value, str | int | float) else str(value)
            for key, value in request.capture.attrs.items()
        },
    }
