"""The public verb: draw from the prior, simulate, fit again, and see where the truth stands."""

import contextlib
import json
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from dask.base import tokenize
from numpyro import distributions as dist

from polar_bayes.calibration.runner import (
    Block,
    Method,
    Plan,
    cut,
    fit_block,
    join,
    needs_mcmc,
)
from polar_bayes.calibration.store import BlockStore, fingerprint_of
from polar_bayes.errors import FitError
from polar_bayes.inference.batch_engine import engine_key
from polar_bayes.inference.batch_laplace import PixelLaplace
from polar_bayes.inference.batch_nuts import PixelNuts
from polar_bayes.inference.batch_result import MethodUsed, Status
from polar_bayes.inference.mode_methods import Nuts
from polar_bayes.inference.program import Program, Values
from polar_bayes.inference.psis import LEVELS, MAX_PARETO_K
from polar_bayes.inference.request import Request, resolve
from polar_bayes.inference.result import PROVENANCE, dims_of, shape_of
from polar_bayes.inference.smc import PixelSMC
from polar_bayes.interrupts import on_interrupt
from polar_bayes.maps.blocks import as_completed, workers
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.paths import as_path
from polar_bayes.physics.part import notation
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import describe_prior
from polar_bayes.progress import Counter, no_progress, with_counter

# --- A finished calibration as a tree: labels come back here --------------------------------------


def assemble(
    program: Program,
    request: Request,
    data: Observations,
    found: Block,
    about: Mapping[str, Any],
) -> xr.DataTree:
    """Put a calibration into one tree."""
    dims = dims_of(program)
    lengths = dict(data.dims)
    captured = request.capture
    axes = {
        dim: captured[dim].to_numpy() if dim in captured.coords else np.arange(lengths[dim])
        for name in found.truth
        for dim in dims[name]
        if dim in lengths
    }
    axes["simulation"] = found.numbers

    def labeled(values: Values, ending: str = "") -> dict[str, xr.DataArray]:
        first = ("quantile",) if ending == "_quantile" else ()
        return {
            f"{name}{ending}": xr.DataArray(
                np.reshape(x, (*np.shape(x)[: len(first) + 1], *shape_of(program, name))),
                dims=(*first, "simulation", *dims[name]),
                attrs={"symbol": notation(name)[0], "units": notation(name)[2]},
            )
            for name, x in values.items()
        }

    flags = {"status": Status, "approach": MethodUsed}
    fits = {
        name: (
            "simulation",
            x,
            {"flag_meanings": " ".join(each.name.lower() for each in flags[name])}
            if name in flags
            else {},
        )
        for name, x in found.outcome._asdict().items()
    }
    quantiles = {name: np.moveaxis(x, 1, 0) for name, x in found.quantiles.items()}
    whole = {
        **labeled(found.mean),
        **labeled(found.sd, "_sd"),
        **labeled(quantiles, "_quantile"),
        **labeled(found.crps, "_crps"),
    }
    simulation = {"simulation": found.numbers}
    groups = {
        "prior_sbc": xr.Dataset(labeled(found.pit), axes),
        "truth": xr.Dataset(labeled(found.truth), axes),
        "marginals": xr.Dataset(whole, {**axes, "quantile": list(LEVELS)}),
        "fits": xr.Dataset(fits, simulation),
    }
    if found.place:
        groups["predictive_pit"] = xr.Dataset(_of_readings(found.fresh), simulation)
        groups["loo_pit"] = xr.Dataset(_of_readings(found.left_out), simulation)
        groups["readings"] = xr.Dataset(_chosen(found, data), simulation)
    tree = xr.DataTree.from_dict(groups)
    tree.attrs[PROVENANCE] = json.dumps(about, sort_keys=True)
    return tree


def _of_readings(values: Values) -> dict[str, tuple]:
    return {
        name: ("simulation", x, {"symbol": notation(name)[0], "units": "1"})
        for name, x in values.items()
    }


def _chosen(found: Block, data: Observations) -> dict[str, tuple]:
    """Which entries were looked at, and how far leaving them out can be trusted."""
    said = f"Pareto k of the weights without it; above {MAX_PARETO_K} they say little"
    chosen: dict[str, tuple] = {}
    for name, place in found.place.items():
        chosen[f"{name}_pareto_k"] = ("simulation", found.left_out_k[name], {"long_name": said})
        index = np.unravel_index(np.maximum(place, 0), data.shape)
        for (dim, _), at in zip(data.dims, index, strict=True):
            words = {"long_name": f"number of its {dim}, -1 where none is valid"}
            chosen[f"{name}_{dim}"] = ("simulation", np.where(place < 0, -1, at), words)
    return chosen


# --- The public verb: draw from the prior, simulate, fit again, and see where the truth stands ----


METHODS: dict[str, Method] = {
    "laplace": PixelLaplace(weighted=False),
    "importance": PixelLaplace(draws=512),
    "tempered": PixelSMC(),
    "nuts": PixelNuts(start=PixelSMC()),
}
FEWEST = 20


@with_counter("fits")
def calibrate(
    capture: xr.Dataset,
    *,
    simulations: int = 1000,
    model: str | Callable = "per_material",
    method: str | Method | None = None,
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    truth: Mapping[str, Any] | None = None,
    seed: int = 0,
    readings: bool = True,
    store: str | os.PathLike[str] | None = None,
    resume: bool = False,
    scheduler: str | None = None,
    progress: Counter | None = None,
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
        method: "tempered" (draws led from the prior to the posterior, which sees every mode: the
            default for one material in one color), "nuts" (chains that begin at such draws), or
            what begins at one mode: "importance" (the normal approximation, its draws weighed by
            the posterior, corrected as in maps), "laplace" (the same unweighed). Where the capture
            has patches, materials or wavelengths, or the scene a discrepancy, the default is
            "nuts", and these chains are those of `polar_bayes.fit`. Or settings, those of
            `polar_bayes.fit` (`Nuts`, `Laplace`) too.
        scene: A name, a `Scene` or None.
        priors: Overrides.
        links: One link, a mapping or None.
        largest_view_zenith: Unit degree, or None for the set-up's own.
        truth: Arguments (model, scene, priors, links) by which captures are simulated where they
            differ from those that are fitted: a check that is broken on purpose.
        seed: Of everything that is drawn.
        readings: True ranks readings among what the fits predict, too: in every simulation one of
            each recorded variable that is read afresh, and one that is left out of the fit.
        store: A folder in which finished blocks of fits are kept, so that a calibration that was
            broken off can go on; by default they are kept in memory alone. It stays.
        resume: Go on with what is in the store: the same question, and as many simulations or
            more, or fewer. The result is that of a calibration that was not broken off.
        scheduler: Address of a `dask.distributed` scheduler whose workers fit the blocks; by
            default threads of this process.
        progress: Called with the fits that are done, and all.

    Returns:
        A tree with the groups `prior_sbc` (probability integral transforms, which
        `arviz_plots.plot_ecdf_pit(tree, sample_dims=["simulation"])` shows), `truth`, `marginals`
        (mean, sd, quantiles and ranked score of every fit) and `fits` (status, approach, pareto_k,
        effective_draws, condition, steps). A fit that failed is NaN, and counted in `status`. Where
        readings are ranked, `predictive_pit` (of fresh readings), `loo_pit` (of those left out)
        and `readings` (which ones, and Pareto k) lie beside them; where they cannot be, the
        attribute `polar_bayes` says why.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: Something asked for cannot be used, the store is there already (or, to resume,
            was begun with another question), or it cannot be written.
    """
    if resume and store is None:
        raise FitError(
            "there is no store to go on with", where="calibrate: resume", hint="give store="
        )
    if simulations < FEWEST:
        raise FitError(
            f"simulations is {simulations}", where="calibrate", hint=f"give {FEWEST} or more"
        )
    asked = {"model": model, "scene": scene, "priors": priors, "links": links}
    strange = set(truth or {}) - set(asked)
    if strange:
        raise FitError(
            f"{', '.join(sorted(strange))} cannot differ",
            where="calibrate: truth",
            hint=f"give some of {', '.join(asked)}",
        )
    request, told = (
        _resolved(capture, {**asked, **differing}, largest_view_zenith, seed)
        for differing in ({}, truth or {})
    )
    settings = _settings(method, request)
    clock = time.perf_counter()
    plan = planned(request, told if truth else None, settings, readings)
    if not plan.shared:
        raise FitError(
            "it has no parameter in common with what is fitted",
            where="calibrate: truth",
            hint="give models whose parameters have the same names and shapes",
        )
    kept = None if store is None else BlockStore(as_path(store, "store"), fingerprint_of(plan))
    found = kept.begin(resume=resume) if kept is not None else []
    missing = _missing(found, simulations)
    show = progress or no_progress
    with on_interrupt(kept.resume_hint) if kept is not None else contextlib.nullcontext():
        found += _fit_all(plan, missing, simulations, kept, scheduler, show)
    about = _provenance(request, settings, truth, simulations)
    about["seconds"] = round(time.perf_counter() - clock, 3)
    if missing.size < simulations:
        about["fits found in the store"] = simulations - missing.size
    if readings:
        about["readings_told"] = plan.unranked_reason or "ranked"
    return assemble(plan.program, request, plan.data, join(found, simulations), about)


def _settings(method: str | Method | None, request: Request) -> Method:
    if isinstance(method, Method):
        return method
    if needs_mcmc(request) and method in (None, "nuts"):
        return Nuts()
    if method is None:
        return METHODS["tempered"]
    if method not in METHODS:
        raise FitError(
            "no such method",
            where=f"method={method!r}",
            hint=f"give one of {', '.join(METHODS)}, or settings such as PixelNuts(draws=1000)",
        )
    return METHODS[method]


def _named(settings: Method) -> str:
    names = (name for name, each in METHODS.items() if each == settings)
    return next(names, type(settings).__name__)


def _resolved(
    capture: xr.Dataset, asked: Mapping[str, Any], limit: float | None, seed: int
) -> Request:
    model, scene, priors, links = (asked[name] for name in ("model", "scene", "priors", "links"))
    return resolve(capture, model, scene, priors, links, limit, seed, "double")


def planned(request: Request, told: Request | None, settings: Method, readings: bool) -> Plan:
    """What is done to every block."""
    limit = request.largest_view_zenith
    recipe_key = engine_key(request, limit)
    told_key = "" if told is None else engine_key(told)
    key = tokenize(recipe_key, told_key, repr(settings), readings, tokenize(request.capture))
    return Plan(request, told, settings, readings, recipe_key, key)


def _missing(found: list[Block], simulations: int) -> np.ndarray:
    """Numbers of the simulations that are still to be fitted."""
    there = [block.numbers for block in found]
    return np.setdiff1d(np.arange(simulations), np.concatenate([*there, []])).astype(int)


def _fit_all(
    plan: Plan,
    missing: np.ndarray,
    every: int,
    kept: BlockStore | None,
    scheduler: str | None,
    progress: Counter,
) -> list[Block]:
    """Blocks of fits on threads or workers; who fits what changes nothing."""
    found: list[Block] = []
    if not missing.size:
        return found
    done = every - missing.size
    with workers(scheduler) as (executor, count):
        tasks = ((plan, numbers) for numbers in cut(missing, plan.block))
        for _, block in as_completed(executor, count, fit_block, tasks):
            if kept is not None:
                kept.add(block)
            found.append(block)
            done += len(block.numbers)
            progress(done, every)
    return found


def _provenance(
    request: Request,
    settings: Method,
    truth: Mapping[str, Any] | None,
    simulations: int,
) -> dict[str, Any]:
    return {
        "calibration": simulations,
        "model": request.model_name,
        "method": _named(settings),
        "settings": repr(settings),
        "scene": request.scene_name,
        "scene_parts": repr(request.scene),
        "priors": {name: describe_prior(prior) for name, prior in request.priors.items()},
        "links": {name: repr(link) for name, link in request.links.items()},
        "truth": {name: repr(value) for name, value in (truth or {}).items()},
        "seed": request.seed,
        "capture": str(request.capture.attrs.get("name", "capture")),
    }
