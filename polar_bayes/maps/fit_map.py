"""Maps of an image: every pixel fitted by itself."""

import dataclasses
import json
from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.errors import CaptureError, FitError
from polar_bayes.inference.batch_engine import engine_key
from polar_bayes.inference.batch_laplace import PixelLaplace
from polar_bayes.inference.batch_method import AbstractPixelMethod
from polar_bayes.inference.batching import IMAGE, MIN_VIEWS, Status, cut, empty_outcome
from polar_bayes.inference.psis import Marginals
from polar_bayes.inference.request import resolve
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.maps.blocks import (
    NUMBER,
    Plan,
    as_completed,
    fit_block,
    maps_of,
    mask_missing,
    workers,
)
from polar_bayes.observation.data import ANGLES
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import describe_prior
from polar_bayes.progress import Counter, with_counter

BLOCK = 4096
"""Pixels of a block: enough to fill many batches, few enough for many blocks in memory."""


@with_counter("pixels")
def fit_pixels(
    capture: xr.Dataset,
    *,
    model: str | Callable = "per_material",
    method: AbstractPixelMethod | None = None,
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    precision: str = "double",
    progress: Counter | None = None,
) -> xr.Dataset:
    """Fit every pixel of an image by itself.

    Each pixel is the fit that `polar_bayes.fit` makes of it, by the normal approximation at its
    mode unless `method` says otherwise: the same model, priors and links. Noise parameters are
    each pixel's own unless the model holds them (`numpyro.handlers.condition`). A map has the
    marginals of each pixel and nothing joint: to ask for the mean of a region, fit the region.

    Args:
        capture: A capture with dims y and x. In chunks (Dask), it is read block by block, and the
            maps come in the same chunks, computed when they are asked for.
        model: See `polar_bayes.fit`; the other arguments too.
        method: By default `PixelLaplace()`. `PixelSMC()` explores all modes of a pixel, at many
            times the cost; `PixelNuts()` runs chains in each.
        scene: A name in `SETUPS` or a `Scene`.
        priors: Distributions that replace or extend `polar_bayes.priors.PRIORS`.
        links: One link for the polarization, or a mapping from variable to link.
        largest_view_zenith: Views beyond it are set aside. Unit degree.
        seed: The same seed gives the same maps, however the image is cut.
        precision: "double" or "single".
        progress: Called with the pixels that are done, and all.

    Returns:
        For each parameter its mean `<name>`, `<name>_sd` and `<name>_quantile`, each (y, x, ...);
        `pareto_k`, `effective_draws`, `condition`, `steps`, `approach` (the method by which the
        numbers were found) and `status` of each pixel. NaN where a pixel has no answer; the
        attribute `polar_bayes` holds the provenance.

    Raises:
        CaptureError: The capture is no image, or does not hold what a fit needs.
        SceneError: No such scene.
        FitError: A model, prior, link or setting cannot be used.
    """
    plan = plan_map(
        capture, model, method, scene, priors, links, largest_view_zenith, seed, precision
    )
    if capture.chunks:
        numbered = with_pixel_numbers(capture)
        maps = xr.map_blocks(fit_block, numbered, args=[plan], template=blank(capture, plan))
    else:
        maps = _at_once(capture, plan, progress)
    maps["status"].encoding["fill_value"] = int(Status.NOT_FITTED)  # of chunks in a Zarr store
    return maps


def plan_map(
    capture: xr.Dataset,
    model: str | Callable,
    method: AbstractPixelMethod | None,
    scene: str | Scene | None,
    priors: Mapping[str, dist.Distribution] | None,
    links: AbstractLink | Mapping[str, AbstractLink] | None,
    largest_view_zenith: float | None,
    seed: int,
    precision: str,
) -> Plan:
    """Check the request of a map on one of its pixels."""
    settings = PixelLaplace() if method is None else method
    if not isinstance(settings, AbstractPixelMethod):
        raise FitError(
            f"{method!r} is no method for pixels",
            where="fit_pixels: method",
            hint="give settings such as PixelLaplace(draws=512) or PixelSMC()",
        )
    missing = [dim for dim in IMAGE if dim not in capture.dims]
    if missing:
        raise CaptureError(
            f"it has no axis {' or '.join(missing)}",
            where=str(capture.attrs.get("name", "capture")),
            hint="give an image with dims y and x, or use polar_bayes.fit",
        )
    pixel, limit = _fullest_pixel(capture), largest_view_zenith
    request = resolve(pixel, model, scene, priors, links, limit, seed, precision)
    own = frozenset(
        name
        for name in (*ANGLES, "normal_confidence")
        if name in capture and set(IMAGE) & set(capture[name].dims)
    )
    unit = _intensity_unit(capture)
    return Plan(
        request, settings, unit, own, engine_key(request, settings, sorted(own), unit is None)
    )


def with_pixel_numbers(
    block: xr.Dataset, region: Mapping[str, slice] | None = None, columns: int = 0
) -> xr.Dataset:
    """A block, by default a whole image, with the index of each pixel in the image, row by row."""
    if region is None:
        region, columns = {dim: slice(0, block.sizes[dim]) for dim in IMAGE}, block.sizes["x"]
    y, x = (xr.Variable((d,), np.arange(region[d].start, region[d].stop)) for d in IMAGE)
    if block.chunks:
        y, x = y.chunk(y=block.chunks["y"]), x.chunk(x=block.chunks["x"])
    return block.assign({NUMBER: y * columns + x})


def blank(capture: xr.Dataset, plan: Plan) -> xr.Dataset:
    """Maps of the image without values: names, axes, types and attributes."""
    corner = capture.isel({dim: slice(1) for dim in IMAGE})
    nothing = empty_outcome(1, Status.NOT_FITTED)
    tiny = maps_of(Marginals(1, plan.sizes), nothing, corner, plan.engine.parameter_axes)
    one = tiny.isel({dim: 0 for dim in IMAGE}, drop=True)
    whole = one.expand_dims({dim: capture.sizes[dim] for dim in IMAGE})
    whole = whole.assign_coords({dim: capture[dim] for dim in IMAGE if dim in capture.coords})
    whole = xr.Dataset(
        {n: v.transpose(*tiny[n].dims) for n, v in whole.items()},
        attrs={PROVENANCE: provenance_json(plan)},
    )
    chunks = {dim: capture.chunks[dim] for dim in IMAGE if dim in capture.chunks}
    return whole.chunk(chunks) if chunks else whole


def _at_once(capture: xr.Dataset, plan: Plan, progress: Counter | None) -> xr.Dataset:
    """Blocks on threads, put together in memory."""
    maps = blank(capture, plan).copy(deep=True)
    every, done = capture.sizes["y"] * capture.sizes["x"], 0
    with workers(None) as (pool, count):
        tasks = ((region,) for region in cut(capture, BLOCK))

        def fit(region: dict[str, slice]) -> xr.Dataset:
            block = with_pixel_numbers(capture.isel(region), region, capture.sizes["x"])
            return fit_block(block, plan)

        blocks = as_completed(pool, count, fit, tasks)
        for (region,), block in blocks:
            for name, values in block.items():
                maps[name][region] = values
            done += block.sizes["y"] * block.sizes["x"]
            if progress is not None:
                progress(done, every)
    return maps


def _fullest_pixel(capture: xr.Dataset) -> xr.Dataset:
    """The first pixel that has as many valid views as any in its rows; read row by row."""
    rows = capture.sizes["y"]
    best, most = None, 0
    for y in range(rows):
        row = mask_missing(capture.isel(y=y).load())
        views = row["valid"].any([d for d in row["valid"].dims if d not in ("x", "view")])
        counts = views.sum("view")
        found, x = int(counts.max()), int(counts.argmax("x")) if "x" in counts.dims else 0
        if found > most:
            best, most = row.isel(x=x), found
        if most == capture.sizes["view"]:
            break
    if best is None or most < MIN_VIEWS:
        raise CaptureError(
            f"no pixel has {MIN_VIEWS} valid views",
            where=str(capture.attrs.get("name", "capture")),
            hint="check `valid` and the readings: NaN counts as missing",
        )
    return best


def _intensity_unit(capture: xr.Dataset) -> float | None:
    """The largest intensity of the whole image, where it states no saturation level."""
    if "intensity" not in capture or "saturation_level" in capture["intensity"].attrs:
        return None
    readings = mask_missing(capture)
    largest = float(readings["intensity"].where(readings["valid"]).max())
    return largest if largest > 0.0 else 1.0


def provenance_json(plan: Plan) -> str:
    """Provenance of maps, as JSON."""
    request = plan.request
    provenance = {
        "method": "pixels",
        "fitted_by": type(plan.settings).__name__,
        "settings": dataclasses.asdict(plan.settings),
        "model": request.model_name,
        "scene": request.scene_name,
        "scene_parts": repr(request.scene),
        "priors": {name: describe_prior(prior) for name, prior in request.priors.items()},
        "fixed": request.fixed,
        "links": {name: repr(link) for name, link in request.links.items()},
        "swapped": list(request.swapped),
        "largest_view_zenith": request.largest_view_zenith,
        "seed": request.seed,
        "precision": request.precision,
        "intensity_unit": plan.intensity_unit,
    }
    return json.dumps(provenance, sort_keys=True)
