"""One block of an image: readings in, maps out, in any process."""

import contextlib
import dataclasses
import enum
import importlib
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, ThreadPoolExecutor, wait
from typing import Any

import jax
import numpy as np
import xarray as xr

from polar_bayes.capture.schema import validate
from polar_bayes.errors import FitError
from polar_bayes.inference.batch_engine import BatchEngine, make_engine
from polar_bayes.inference.batch_method import AbstractPixelMethod
from polar_bayes.inference.batching import (
    IMAGE,
    MethodUsed,
    Outcome,
    Status,
    batch_pixels,
    empty_outcome,
)
from polar_bayes.inference.psis import LEVELS, Marginals
from polar_bayes.inference.request import Request
from polar_bayes.observation.data import READINGS, Observations, observe
from polar_bayes.physics.part import notation

ParameterAxes = dict[str, tuple[tuple[str, ...], tuple[int, ...]]]

DIAGNOSTICS = {
    "pareto_k": "Pareto k of the importance weights",
    "effective_draws": "effective sample size of the draws",
    "condition": "condition number of the curvature at the mode",
    "steps": "steps to the mode",
    "approach": "method by which the numbers were found",
    "status": "status of the pixel",
}

FLAGS: dict[str, type[enum.IntEnum]] = {"approach": MethodUsed, "status": Status}

NUMBER = "pixel_number"
"""Variable of a block: index of each pixel in the whole image, row by row."""


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A checked request of a map, which can be sent to another process."""

    request: Request
    settings: AbstractPixelMethod
    intensity_unit: float | None
    own_directions: frozenset[str]
    key: str

    def observe(self, capture: xr.Dataset) -> Observations:
        """A block, or one pixel, as arrays."""
        return observe(
            capture,
            largest_view_zenith=self.request.largest_view_zenith,
            intensity_unit=self.intensity_unit,
        )

    @property
    def engine(self) -> BatchEngine:
        """The compiled programs, made at first use in each process."""

        def pixel() -> Observations:
            with jax.enable_x64(True):
                return self.observe(self.request.capture)

        return make_engine(self.key, self.request, pixel)

    @property
    def sizes(self) -> dict[str, tuple[int, ...]]:
        """Lengths of the axes of every parameter within a pixel."""
        return {name: own for name, (_, own) in self.engine.parameter_axes.items()}

    def __eq__(self, other: object) -> bool:
        """The same programs, not the same readings."""
        return isinstance(other, Plan) and self.key == other.key

    def __hash__(self) -> int:
        """Of the key."""
        return hash(self.key)


def fit_block(block: xr.Dataset, plan: Plan) -> xr.Dataset:
    """Fit every pixel of a block."""
    numbers = block[NUMBER].transpose(*IMAGE).to_numpy().ravel()
    found, axes = Marginals(numbers.size, plan.sizes), plan.engine.parameter_axes
    with jax.enable_x64(True):
        readings = mask_missing(block.drop_vars(NUMBER))
        if not readings["valid"].any():  # a corner of a picture; as a capture it would be refused
            return maps_of(found, empty_outcome(numbers.size, Status.MASKED), block, axes)
        pixels = batch_pixels(plan.observe(validate(readings)), plan.own_directions)
    seed = plan.request.seed
    outcome = plan.settings.run_batch(plan.engine, pixels, numbers, seed, found.describe)
    return maps_of(found, outcome, block, axes)


def mask_missing(capture: xr.Dataset) -> xr.Dataset:
    """A capture whose missing readings are marked as such."""
    valid = capture.get("valid", xr.DataArray(True)).astype(bool)
    for name in READINGS:
        if name in capture:
            valid = valid & capture[name].notnull()
    return capture.assign(valid=valid)


def maps_of(
    found: Marginals, outcome: Outcome, block: xr.Dataset, axes: ParameterAxes
) -> xr.Dataset:
    """The marginals of a block as labeled maps."""
    shape = tuple(block.sizes[dim] for dim in IMAGE)
    variables: dict[str, Any] = {}
    for name, (own, sizes) in axes.items():
        symbol, meaning, unit = notation(name)
        for ending, statistic, values, first in (
            ("", "mean of", found.mean[name], ()),
            ("_sd", "standard deviation of", found.sd[name], ()),
            ("_quantile", "quantiles of", found.quantiles[name], ("quantile",)),
        ):
            whole = values.reshape(*values.shape[: len(first)], *shape, *sizes)
            labels = {"units": unit, "long_name": f"{statistic} {meaning}", "symbol": symbol}
            variables[f"{name}{ending}"] = ((*first, *IMAGE, *own), np.float32(whole), labels)
    for name, meaning in DIAGNOSTICS.items():
        attrs: dict[str, Any] = {"units": "1", "long_name": meaning}
        if name in FLAGS:
            flags = list(FLAGS[name])
            attrs = {
                "long_name": meaning,
                "flag_values": [int(each) for each in flags],
                "flag_meanings": " ".join(each.name.lower() for each in flags),
            }
        variables[name] = (IMAGE, getattr(outcome, name).reshape(shape), attrs)
    coords = {dim: block.coords[dim] for dim in (*IMAGE, "wavelength") if dim in block.coords}
    return xr.Dataset(variables, coords={**coords, "quantile": list(LEVELS)})


# --- Threads of this process, or workers of a cluster ---------------------------------------------


AHEAD = 2
"""Blocks that wait for each that is being fitted: none idles, and memory stays small."""


@contextlib.contextmanager
def workers(scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """Something that runs functions, and how many at a time."""
    if scheduler is None:
        threads = os.cpu_count() or 1
        pool = ThreadPoolExecutor(threads)
        try:
            yield pool, threads
        except BaseException:  # an interrupt must not wait for blocks that take minutes
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()
        return
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        raise FitError(
            "the library for clusters is not installed",
            where=f"scheduler={scheduler}",
            hint="pip install 'polar_bayes[cluster]', or leave the scheduler out",
        ) from error
    try:
        client = distributed.Client(scheduler, timeout="5s")
    except (OSError, ValueError) as error:
        raise FitError(
            "no scheduler answers there",
            where=f"scheduler={scheduler}",
            hint="give the address that `dask scheduler` prints, such as tcp://10.0.0.1:8786",
        ) from error
    with client:
        yield client.get_executor(), max(1, len(client.scheduler_info()["workers"]))


def as_completed(
    executor: Executor, count: int, function: Callable, tasks: Iterable[tuple]
) -> Iterator[tuple[tuple, Any]]:
    """Results as they come, with few tasks on their way at any time."""
    waiting, left = {}, iter(tasks)
    try:
        while True:
            for task in left:
                waiting[executor.submit(function, *task)] = task
                if len(waiting) >= AHEAD * count:
                    break
            if not waiting:
                return
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield waiting.pop(future), future.result()
    finally:
        for future in waiting:
            future.cancel()
