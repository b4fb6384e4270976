"""Simulation-based calibration (Talts et al. 2018): draw from the prior, simulate, fit, rank."""

import contextlib
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from dask.base import tokenize
from numpyro import distributions as dist

from polar_bayes.calibration.runner import (
    BlockStore,
    CalibrationPlan,
    cut,
    fit_block,
    join,
    numbers_of,
    open_store,
)
from polar_bayes.errors import FitError
from polar_bayes.inference.batching import Status
from polar_bayes.inference.compiled_model import layout_key
from polar_bayes.inference.request import Request, resolve
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.maps.blocks import as_completed, workers
from polar_bayes.methods.method import AbstractBatchMethod, find_method, make_method, name_of
from polar_bayes.methods.registry import FIT_DEFAULT
from polar_bayes.observation.links import AbstractLink
from polar_bayes.paths import as_path
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Counter, no_progress, notice, with_counter

MIN_SIMULATIONS = 20


@with_counter("fits")
def calibrate(
    capture: xr.Dataset,
    *,
    simulations: int = 1000,
    model: str | Callable = "per_material",
    method: str | AbstractBatchMethod | None = None,
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
    """Test by simulation whether the intervals of a fit have their nominal coverage.

    Parameters are drawn from the prior and captures from the likelihood, each is fitted, and the
    truth is ranked among the draws. Where model, prior and sampler are right the ranks are uniform
    and intervals have their nominal coverage.

    Args:
        capture: Only its layout is used: directions, wavelengths, which variables were read, stated
            errors and masks.
        simulations: How many, at least 20.
        model: As for `polar_bayes.fit`; scene, priors, links and largest_view_zenith too.
        method: As for `polar_bayes.fit`, by default the one that it takes: a name is one algorithm,
            so what is tested here is what a fit does. "auto" fits many side by side by importance
            sampling, and the others by chains; "nuts" runs chains for each simulation, which takes
            seconds each. Or the settings of a method of `pb.methods`, such as those of a map; least
            squares make no draws.
        scene: A name, a `Scene` or None.
        priors: Overrides.
        links: One link, a mapping or None.
        largest_view_zenith: Unit degree, or None for the set-up's own.
        truth: Arguments (model, scene, priors, links) of the data-generating model where they
            differ from those of the fitted model: a misspecification on purpose.
        seed: Seed of all random numbers.
        readings: True ranks readings among the predictions of the fits, too: in every simulation
            one replicated reading of each recorded variable, and one that is left out of the fit.
        store: A folder for finished blocks of fits, so that an interrupted calibration can be
            resumed; by default they are in memory only. The folder is not deleted.
        resume: Resume from the store: the same request, with any number of simulations. The result
            is that of a calibration without interruption.
        scheduler: Address of a `dask.distributed` scheduler whose workers fit the blocks; by
            default threads of this process.
        progress: Called with the fits that are done, and all.

    Returns:
        A tree with the groups `prior_sbc` (probability integral transforms, which
        `arviz_plots.plot_ecdf_pit(tree, sample_dims=["simulation"])` shows), `truth`, `marginals`
        (mean, sd, quantiles and ranked score of every fit) and `fits` (status, method, pareto_k,
        ess, condition, steps). A fit that failed is NaN, and counted in `status`. Where
        readings are ranked, there are also `predictive_pit` (of replicated readings), `loo_pit` (of
        those left out) and `readings` (which ones, and Pareto k); where they cannot be, the
        attribute `polar_bayes` states the reason.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: An argument cannot be used, or the store to resume was begun with another request.
        OutputError: The store exists already, cannot be written, or is none to resume; or another
            process is writing it.
    """
    start = time.perf_counter()
    _check_size(simulations, store, resume)
    asked = {"model": model, "scene": scene, "priors": priors, "links": links}
    limits = {"largest_view_zenith": largest_view_zenith, "seed": seed, "precision": "double"}
    requests = _requests(capture, asked, truth or {}, limits)
    settings = find_method(FIT_DEFAULT if method is None else method, "calibrate", many=True)
    plan = make_plan(*requests, settings, readings)
    forecast, folder = Forecast(plan), None if store is None else as_path(store, "store")
    with contextlib.nullcontext() if folder is None else open_store(folder, plan, resume) as blocks:
        tree, found = _fit_all(plan, simulations, blocks, scheduler, progress, forecast)
    stated = _provenance(plan, truth or {}, simulations, forecast.sentence, found)
    stated["seconds"] = round(time.perf_counter() - start, 3)
    tree.attrs[PROVENANCE] = json.dumps(stated, sort_keys=True)
    return tree


def _check_size(simulations: int, store: object, resume: bool) -> None:
    """Raise FitError for too few simulations, or where there is nothing to resume."""
    if resume and store is None:
        what = "there is no store to go on with"
        raise FitError(what, where="calibrate: resume", hint="give store=")
    if simulations < MIN_SIMULATIONS:
        hint = f"give {MIN_SIMULATIONS} or more"
        raise FitError(f"simulations is {simulations}", where="calibrate", hint=hint)


def _requests(
    capture: xr.Dataset, asked: dict[str, Any], truth: Mapping[str, Any], limits: dict[str, Any]
) -> tuple[Request, Request | None]:
    """Return the request of the fits, and that of the simulated data where it differs."""
    if unknown := set(truth) - set(asked):
        what = f"{', '.join(sorted(unknown))} cannot differ"
        raise FitError(what, where="calibrate: truth", hint=f"give some of {', '.join(asked)}")
    fitted = resolve(capture, **asked, **limits)
    return fitted, resolve(capture, **{**asked, **truth}, **limits) if truth else None


def _provenance(
    plan: CalibrationPlan, truth: Mapping[str, Any], simulations: int, forecast: str, found: int
) -> dict[str, Any]:
    """Describe how a calibration was made, in what JSON can hold."""
    optional = {
        "forecast": forecast,
        "fits found in the store": found,
        "why_not_ranked": plan.compiled.unranked_reason,
    }
    return {
        **plan.request.describe(),
        "calibration": simulations,
        "method": name_of(plan.settings),
        "settings": repr(plan.settings),
        "truth": {name: repr(value) for name, value in truth.items()},
        "capture": str(plan.request.capture.attrs.get("name", "capture")),
        **{name: value for name, value in optional.items() if value},
    }


def make_plan(
    request: Request,
    generative_request: Request | None,
    settings: AbstractBatchMethod,
    readings: bool,
) -> CalibrationPlan:
    """Check and combine the requests; without a generative one, the fitted model simulates."""
    own_key = layout_key(request, request.largest_view_zenith)
    generative_key = "" if generative_request is None else layout_key(generative_request)
    key = tokenize(own_key, generative_key, repr(settings), readings, tokenize(request.capture))
    plan = CalibrationPlan(request, generative_request, settings, readings, own_key, key)
    if not plan.compiled.shared:
        what = "the data-generating model and the fitted model share no parameter"
        hint = "give models whose parameters have the same names and shapes"
        raise FitError(what, where="calibrate: truth", hint=hint)
    return plan


def _fit_all(
    plan: CalibrationPlan,
    simulations: int,
    store: BlockStore | None,
    scheduler: str | None,
    progress: Counter | None,
    forecast: "Forecast",
) -> tuple[xr.DataTree, int]:
    """Fit all simulations; return the calibration, and how many fits were in the store."""
    blocks = [] if store is None else store.blocks()
    stored = np.concatenate([*map(numbers_of, blocks), []])
    missing = np.setdiff1d(np.arange(simulations), stored).astype(int)
    found = done = simulations - missing.size
    # The result does not depend on which thread or worker fits what, and when.
    with workers(scheduler if missing.size else None) as (executor, count):
        tasks = ((plan, numbers) for numbers in cut(missing, plan.block))
        for _, block in as_completed(executor, count, fit_block, tasks):
            if store is not None:
                store.add(block)
            blocks.append(block)
            done += len(numbers_of(block))
            (progress or no_progress)(done, simulations)
            forecast.see(block, simulations - done)
    return join(blocks, simulations), found


@dataclasses.dataclass
class Forecast:
    """Forecast of the remaining time, and of a faster method's results on the same simulations.

    It is made after `pilot` fits, where those that are left take `long` seconds or more.
    """

    plan: CalibrationPlan
    sentence: str = ""
    pilot: int = 8
    long: float = 300.0
    faster: str = "importance"
    _seen: list[xr.DataTree] = dataclasses.field(default_factory=list)
    _begin: float = 0.0

    def see(self, block: xr.DataTree, left: int) -> None:
        """Take in a finished block, and announce the forecast once enough blocks are finished."""
        self._seen.append(block)
        if len(self._seen) == 1:  # its programs are compiled
            self._begin = time.perf_counter()
        count = sum(len(numbers_of(each)) for each in self._seen[1:])
        if self.sentence or count < self.pilot:
            return
        seconds = left * (time.perf_counter() - self._begin) / count
        name = name_of(self.plan.settings)
        if seconds >= self.long:
            self.sentence = f"{left} more fits by {name} take about {seconds / 60.0:.0f} min"
            self.sentence += "" if name == self.faster else self._faster(left)
            notice(self.sentence)

    def _faster(self, left: int) -> str:
        """Fit the same simulations by the faster method, and describe its time and results."""
        plan = dataclasses.replace(self.plan, settings=make_method(self.faster), readings=False)
        own = join(self._seen, sys.maxsize)
        parts = cut(numbers_of(own), plan.block)
        fit_block(plan, parts[0])  # compiles its programs
        begin = time.perf_counter()
        other = join([fit_block(plan, part) for part in parts], sys.maxsize)
        minutes = left * (time.perf_counter() - begin) / sum(map(len, parts)) / 60.0
        both = np.all([each["fits"]["status"] == Status.GOOD for each in (own, other)], axis=0)
        one, two = (each["marginals"].to_dataset().isel(simulation=both) for each in (own, other))
        moved = [(abs(two[name] - one[name]) / one[f"{name}_sd"]).values for name in own["truth"]]
        largest = max((np.max(each, initial=0.0) for each in moved), default=0.0)
        return (
            f", by {self.faster} about {max(minutes, 0.1):.1f} min; both trust {both.sum()} of "
            f"{len(both)}, whose means differ by at most {largest:.2g} sd"
        )
