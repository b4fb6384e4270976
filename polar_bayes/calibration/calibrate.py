"""The public verb: draw from the prior, simulate, fit again, and see where the truth stands."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.calibration.result import assemble
from polar_bayes.calibration.simulations import Simulations, draw_captures
from polar_bayes.calibration.standing import Standing
from polar_bayes.errors import FitError
from polar_bayes.inference.program import Program, Values, compile_program
from polar_bayes.inference.request import Request, resolve
from polar_bayes.observation.data import Observations, observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.pixels.engine import Engine
from polar_bayes.pixels.executors import as_completed, workers
from polar_bayes.pixels.fitting import PixelLaplace, fit_stack
from polar_bayes.pixels.making import Recipe, key_of, make_engine
from polar_bayes.pixels.marginals import Marginals
from polar_bayes.pixels.outcome import Outcome
from polar_bayes.pixels.sampling import PixelNuts
from polar_bayes.pixels.tempering import PixelTempering
from polar_bayes.pixels.tracing import TRACING
from polar_bayes.priors import describe_prior

Method = PixelLaplace | PixelNuts | PixelTempering
METHODS: dict[str, Method] = {
    "laplace": PixelLaplace(weighted=False),
    "importance": PixelLaplace(draws=512),
    "tempered": PixelTempering(),
    "nuts": PixelNuts(start=PixelTempering()),
}
CANDIDATES = 32
BLOCK = 128
"""Simulations that one thread fits at a time."""

RANKED = 128
"""About so many draws of a chain are ranked: far enough apart to be nearly independent."""

FEWEST = 20


def calibrate(
    capture: xr.Dataset,
    *,
    simulations: int = 1000,
    model: str | Callable = "per_material",
    method: str | Method = "tempered",
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    truth: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> xr.DataTree:
    """Simulation-based calibration: do the intervals of this fit hold?

    Parameters are drawn from the prior and captures from the likelihood, each is fitted, and the
    truth is ranked among the draws. Where model, prior and sampler are right the ranks are uniform
    and intervals hold as often as they say.

    Args:
        capture: Only its layout is used: directions, wavelengths, which variables were read, stated
            errors and masks.
        simulations: How many, at least 20.
        model: As for `polar_bayes.fit`; scene, priors, links and largest_view_zenith too.
        method: "laplace" (the normal approximation at the mode), "importance" (its draws weighed by
            the posterior, corrected as in maps), "tempered" (draws led from the prior to the
            posterior, which sees every mode), "nuts" (chains in every fit), or settings.
        scene: A name, a `Scene` or None.
        priors: Overrides.
        links: One link, a mapping or None.
        largest_view_zenith: Unit degree, or None for the set-up's own.
        truth: Arguments (model, scene, priors, links) by which captures are simulated where they
            differ from those that are fitted: a check that is broken on purpose.
        seed: Of everything that is drawn.
        progress: Called with the fits that are done, and all.

    Returns:
        A tree with the groups `prior_sbc` (probability integral transforms, which
        `arviz_plots.plot_ecdf_pit(tree, sample_dims=["simulation"])` shows), `truth`, `marginals`
        (mean, sd, quantiles and ranked score of every fit) and `fits` (status, approach, pareto_k,
        effective_draws, condition, steps). A fit that failed is NaN, and counted in `status`.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: Something asked for cannot be used.
    """
    if simulations < FEWEST:
        raise FitError(
            f"simulations is {simulations}", where="calibrate", mend=f"give {FEWEST} or more"
        )
    settings = _settings(method)
    asked = {"model": model, "scene": scene, "priors": priors, "links": links}
    strange = set(truth or {}) - set(asked)
    if strange:
        raise FitError(
            f"{', '.join(sorted(strange))} cannot differ",
            where="calibrate: truth",
            mend=f"give some of {', '.join(asked)}",
        )
    request, told = (
        _resolved(capture, {**asked, **differing}, largest_view_zenith, seed)
        for differing in ({}, truth or {})
    )
    clock = time.perf_counter()
    with jax.enable_x64(True):
        data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
        engine = _engine_of(request, settings, data)
        teller = compile_program(told.bind(told.scene), data) if truth else engine.program
        key = jax.random.fold_in(jax.random.key(seed), 1)
        drawn = draw_captures(teller, data, simulations, key)
    shared = _in_common(engine.program, data, drawn)
    marginals = Marginals(simulations, {name: x.shape[1:] for name, x in shared.items()})
    standing = Standing(shared, seed)
    outcomes = _fit_all(engine, settings, drawn, seed, (marginals, standing), progress or _silent)
    about = _provenance(request, settings, method, truth, simulations)
    about["seconds"] = round(time.perf_counter() - clock, 3)
    return assemble(engine.program, request, data, shared, marginals, standing, outcomes, about)


def _settings(method: str | Method) -> Method:
    if isinstance(method, Method):
        return method
    if method not in METHODS:
        raise FitError(
            "no such method",
            where=f"method={method!r}",
            mend=f"give one of {', '.join(METHODS)}, or settings such as PixelNuts(draws=1000)",
        )
    return METHODS[method]


def _resolved(
    capture: xr.Dataset, asked: Mapping[str, Any], limit: float | None, seed: int
) -> Request:
    model, scene, priors, links = (asked[name] for name in ("model", "scene", "priors", "links"))
    return resolve(capture, model, "laplace", scene, priors, links, limit, seed, "double")


def _engine_of(request: Request, settings: Method, data: Observations) -> Engine:
    """The programs, which the next calibration of the same model finds compiled."""
    candidates = settings.candidates if isinstance(settings, PixelLaplace) else CANDIDATES
    key = key_of(request, candidates, request.largest_view_zenith)
    with TRACING:
        return make_engine(Recipe(request, lambda: data, candidates, key))


def _in_common(program: Program, data: Observations, drawn: Simulations) -> Values:
    """Truths of the parameters that are fitted."""
    with jax.enable_x64(True):
        fitted = jax.eval_shape(program.parameters, jnp.zeros(program.size), data)
    shared = {
        name: np.asarray(truth)
        for name, truth in drawn.truth.items()
        if name in fitted and truth.shape[1:] == fitted[name].shape
    }
    if not shared:
        raise FitError(
            "it has no parameter in common with what is fitted",
            where="calibrate: truth",
            mend="give models whose parameters have the same names and shapes",
        )
    return shared


def _fit_all(
    engine: Engine,
    settings: Method,
    drawn: Simulations,
    seed: int,
    takers: tuple[Marginals, Standing],
    progress: Callable[[int, int], None],
) -> Outcome:
    """Blocks of fits on threads; who fits what changes nothing."""
    count = len(drawn.captures)
    apart = 1
    if isinstance(settings, PixelNuts):
        apart = max(1, settings.chains * settings.draws // RANKED)

    def fit(begin: int) -> Outcome:
        index = np.arange(begin, min(begin + BLOCK, count))

        def describe(at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
            few = {name: np.asarray(x)[:, ::apart] for name, x in parameters.items()}
            share = weights[:, ::apart] / weights[:, ::apart].sum(axis=-1, keepdims=True)
            for taker in takers:
                taker.describe(index[at], few, share)

        return fit_stack(engine, settings, drawn.captures.subset(index), index, seed, describe)

    found: dict[int, Outcome] = {}
    with workers(None) as (pool, threads):
        tasks = ((begin,) for begin in range(0, count, BLOCK))
        for (begin,), outcome in as_completed(pool, threads, fit, tasks):
            found[begin] = outcome
            progress(sum(len(each.status) for each in found.values()), count)
    ordered = (found[begin] for begin in sorted(found))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *ordered)


def _silent(done: int, every: int) -> None:
    """No progress to show."""


def _provenance(
    request: Request,
    settings: Method,
    method: str | Method,
    truth: Mapping[str, Any] | None,
    simulations: int,
) -> dict[str, Any]:
    return {
        "calibration": simulations,
        "model": request.model_name,
        "method": method if isinstance(method, str) else type(method).__name__,
        "settings": repr(settings),
        "scene": request.scene_name,
        "scene_parts": repr(request.scene),
        "priors": {name: describe_prior(prior) for name, prior in request.priors.items()},
        "links": {name: repr(link) for name, link in request.links.items()},
        "truth": {name: repr(value) for name, value in (truth or {}).items()},
        "seed": request.seed,
        "capture": str(request.capture.attrs.get("name", "capture")),
    }
