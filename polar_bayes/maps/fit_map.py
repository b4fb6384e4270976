"""Maps of an image: fits of every pixel."""

import dataclasses
import enum
import functools
import json
import operator
from collections.abc import Callable, Mapping, Sequence

import dask.array as da
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError, FitError
from polar_bayes.inference.batching import (
    IMAGE,
    MethodUsed,
    Status,
    batch_pixels,
    cut,
)
from polar_bayes.inference.compiled_model import CompiledModel, compile_layout, layout_key
from polar_bayes.inference.problem_batch import Outcome, ProblemBatch, problem_batch
from polar_bayes.inference.request import MIN_VIEWS, Request, resolve
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.maps.blocks import as_completed, workers
from polar_bayes.maps.criticism import PROBLEMS, Criticism, PixelCriticism
from polar_bayes.maps.lazy import DISAGREEMENT, UNKNOWN
from polar_bayes.maps.propagation import Carried, Propagation, carried
from polar_bayes.maps.shared import PIXELS as SHARED_PIXELS
from polar_bayes.maps.shared import (
    SharedParameter,
    as_priors,
    estimate_shared,
    moved_by_setup,
    of_priors,
)
from polar_bayes.methods.corrected_laplace import CorrectedLaplace
from polar_bayes.methods.method import AbstractBatchMethod, find_method, name_of
from polar_bayes.methods.registry import MAP_DEFAULT
from polar_bayes.numerics.psis import LEVELS, Marginals
from polar_bayes.observation.data import ANGLES, READINGS, Observations, observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.part import notation
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.progress import Counter, no_progress, with_counter

BLOCK = 4096
"""Pixels of a block: enough for full batches, few enough to hold many blocks in memory."""


DIAGNOSTICS = {
    "pareto_k": "Pareto k of the importance weights",
    "ess": "effective sample size of the draws",
    "condition": "condition number of the curvature at the mode",
    "steps": "steps to the mode",
    "method": "method by which the numbers were found",
    "status": "status of the pixel",
}

FILL_VALUES = {"status": int(Status.NOT_FITTED), "criticism": UNKNOWN}
"""Values of chunks in a Zarr store that are not written, by variable."""

NUMBER = "pixel_number"
"""Variable of a block that holds the index of each pixel in the image, row by row."""


@with_counter("pixels")
def fit_pixels(
    capture: xr.Dataset,
    *,
    model: str | Callable = "per_material",
    method: str | AbstractBatchMethod | None = None,
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    precision: str = "double",
    shared: str | Sequence[str] | None = None,
    known: Mapping[str, float] | None = None,
    progress: Counter | None = None,
) -> xr.Dataset:
    """Fit every pixel of an image separately.

    Each pixel is the fit that `polar_bayes.fit` makes of it, by the Laplace approximation at its
    mode, corrected, unless `method` says otherwise: the same model, priors and links. Parameters in
    `shared` are one unknown of the whole image: their posterior, estimated from 512 pixels drawn at
    random, is the prior of every pixel. Errors of the set-up, such as that of a lamp's direction,
    move all pixels alike, to first order. A map has the marginals of each pixel, from which
    `maps.region_means` tells means and contrasts of regions.

    Args:
        capture: A capture with dims y and x. In chunks (Dask), it is read block by block, and the
            maps come in the same chunks, computed when they are asked for.
        model: See `polar_bayes.fit`; the other arguments too.
        method: "corrected-laplace" by default. "importance" explores all modes of every pixel, at
            many times the cost; "laplace" checks nothing; other methods of `polar_bayes.fit` fit
            one pixel after another. Or settings, such as `pb.methods.CorrectedLaplace(draws=512)`.
        scene: A name in `SETUPS` or a `Scene`.
        priors: Distributions that replace or extend `polar_bayes.priors.PRIORS`.
        links: One link for the polarization, or a mapping from variable to link.
        largest_view_zenith: Views beyond it are set aside. Unit degree.
        seed: The same seed gives the same maps, however the image is cut.
        precision: "double" or "single".
        shared: Parameters of the noise or instrument, such as `("stokes_scale", "dolp_gain")` or
            `("light_zenith_offset",)`, that have one value in all of the image; `()` for none. By
            default those of the set-up (`Setup.shared`) in images of at least 512 pixels, as long
            as pixels agree about them; `maps.shared_cautions` tells where they do not.
        known: Standard uncertainties of input quantities of the set-up, see `polar_bayes.fit`.
        progress: Called with the pixels that are done, and all.

    Returns:
        For each parameter its mean `<name>`, `<name>_sd` and `<name>_quantile`, each (y, x, ...);
        what is shared has no map, and is told by `maps.shared_parameters`; `<name>_slope` is the
        change of the mean with one sd of each shared parameter and input quantity;
        `pareto_k`, `ess`, `condition`, `steps`, `method` (the method by which the
        numbers were found) and `status` of each pixel; `criticism`, the checks in which its
        readings speak against the model (`maps.count_criticism`). NaN where a pixel has no answer;
        the attribute `polar_bayes` holds the provenance.

    Raises:
        CaptureError: The capture is no image, or does not hold what a fit needs.
        SceneError: No such scene.
        FitError: A model, prior, link or setting cannot be used.
    """
    asked = plan_map(
        capture,
        model,
        method,
        scene,
        priors,
        links,
        largest_view_zenith,
        seed,
        precision,
        shared,
        known,
    )
    plan = estimate_plan(asked, capture)
    if capture.chunks:
        numbered = with_pixel_numbers(capture)
        maps = xr.map_blocks(fit_block, numbered, args=[plan], template=blank(capture, plan))
    else:
        maps = _in_memory(capture, plan, progress or no_progress)
    for name, value in FILL_VALUES.items():
        maps[name].encoding["fill_value"] = value
    return maps


@dataclasses.dataclass(frozen=True)
class MapPlan:
    """A validated request of a map, which can be sent to another process."""

    key: str  # that of the compiled programs; plans with the same key are equal
    request: Request = dataclasses.field(compare=False)
    settings: AbstractBatchMethod
    intensity_unit: float | None = dataclasses.field(compare=False)
    own_directions: frozenset[str] = dataclasses.field(compare=False)
    shared: tuple[SharedParameter, ...] = ()
    carried: tuple[Carried, ...] = ()
    shares_by_default: bool = dataclasses.field(default=False, compare=False)
    otherwise: "MapPlan | None" = dataclasses.field(default=None, compare=False)
    """What holds where pixels do not agree about what they share by default."""
    found: Mapping[str, object] = dataclasses.field(default_factory=dict, compare=False)

    def sharing(self, names: Sequence[str], request: Request) -> "MapPlan":
        """Return the plan of a request in which these parameters are shared by all pixels."""
        key, shared = self._key(request, names), tuple(of_priors(names, request.priors))
        plan = dataclasses.replace(self, key=key, request=request, shared=shared)
        # A model of the user's own need not know of them.
        sites = plan.with_setup.program.positions if request.carried else {}
        acting = tuple(each for each in carried(request.carried) if each.name in sites)
        return dataclasses.replace(plan, carried=acting)

    def _key(self, request: Request, shared: Sequence[str]) -> str:
        own, no_unit = sorted(self.own_directions), self.intensity_unit is None
        return layout_key(request, own, no_unit, tuple(shared))

    def observe(self, capture: xr.Dataset) -> Observations:
        """Return a block, or one pixel, as arrays."""
        limit, unit = self.request.largest_view_zenith, self.intensity_unit
        links = self.request.links
        data = observe(capture, largest_view_zenith=limit, intensity_unit=unit, described=links)
        priors = jax.tree.map(jnp.asarray, as_priors(self.shared))
        return dataclasses.replace(data, shared=priors)

    def marginals(self, count: int) -> Marginals:
        """Return empty marginals of a number of pixels."""
        priors = self.request.priors
        scores = [functools.partial(each.scores, priors[each.name]) for each in self.shared]
        errors = [operator.itemgetter(each.name) for each in self.carried]
        return Marginals(count, self.sizes, scores=[*scores, *errors])

    def batch(self, image: xr.Dataset, numbers: np.ndarray | None = None) -> ProblemBatch:
        """The pixels of an image, or of a block, row by row; `numbers` are theirs in the whole."""
        with jax.enable_x64(True):
            pixels = batch_pixels(self.observe(validate(image)), self.own_directions)
        every = np.arange(len(pixels)) if numbers is None else numbers
        return problem_batch(self.engine, pixels, every, self.request.seed)

    def propagation(self, batch: ProblemBatch) -> Propagation:
        """What errors of the set-up do to pixels."""
        moves = ((each, each.by_setup.values()) for each in self.shared if each.by_setup)
        slopes = {each.name: [-x / each.sd**2 for x in own] for each, own in moves}
        return Propagation(batch, self.with_setup, self.carried, slopes)

    @property
    def with_setup(self) -> CompiledModel:
        """The model of a pixel whose set-up has errors, around zero."""
        # Each has a normal prior: the coordinate of what only adds has no value at zero.
        normal = {name: dist.Normal(0.0, 1.0) for name in self.request.carried}
        priors = {**self.request.priors, **normal}
        asked = dataclasses.replace(
            self.request, scene=self.request.scene_with_setup, priors=priors
        )
        key = self._key(asked, [each.name for each in self.shared])
        return compile_layout(key, asked, self._pixel)

    @property
    def engine(self) -> CompiledModel:
        """The compiled model, made at first use in each process."""
        return compile_layout(self.key, self.request, self._pixel)

    def _pixel(self) -> Observations:
        with jax.enable_x64(True):
            return self.observe(self.request.capture)

    @property
    def axes(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...]]]:
        """Names and lengths of the axes of each mapped parameter within a pixel."""
        shared = {each.name for each in self.shared}
        found = self.engine.parameter_axes
        return {name: axes for name, axes in found.items() if name not in shared}

    @property
    def sizes(self) -> dict[str, tuple[int, ...]]:
        """Lengths of the axes of each mapped parameter within a pixel."""
        return {name: own for name, (_, own) in self.axes.items()}


def plan_map(
    capture: xr.Dataset,
    model: str | Callable,
    method: str | AbstractBatchMethod | None,
    scene: str | Scene | None,
    priors: Mapping[str, dist.Distribution] | None,
    links: AbstractLink | Mapping[str, AbstractLink] | None,
    largest_view_zenith: float | None,
    seed: int,
    precision: str,
    shared: str | Sequence[str] | None = None,
    known: Mapping[str, float] | None = None,
) -> MapPlan:
    """Check the request of a map on one of its pixels."""
    settings = find_method(MAP_DEFAULT if method is None else method, "fit_pixels", many=True)
    missing = [dim for dim in IMAGE if dim not in capture.dims]
    if missing:
        what = f"it has no axis {' or '.join(missing)}"
        hint = "give an image with dims y and x, or use polar_bayes.fit"
        raise CaptureError(what, where=str(capture.attrs.get("name", "capture")), hint=hint)
    pixel, limit = _fullest_pixel(capture), largest_view_zenith
    asked = pixel, model, scene, priors, links, limit, seed, precision
    names = (shared,) if isinstance(shared, str) else tuple(shared or ())
    request = resolve(*asked, known=known, shared=names)
    _check_shared(names, request)
    stated = (name for name in (*ANGLES, "normal_confidence") if name in capture)
    of_pixels = frozenset(name for name in stated if set(IMAGE) & set(capture[name].dims))
    unit, is_usual = _intensity_unit(capture), shared is None
    plan = MapPlan("", request, settings, unit, of_pixels, shares_by_default=is_usual)
    plan = plan.sharing(names, request)
    is_large = capture.sizes["y"] * capture.sizes["x"] >= SHARED_PIXELS
    quantities = [each.name for each in plan.carried]
    # Parts of the instrument first, about which pixels agree more often than about the set-up.
    for own in (request.priors, quantities) if is_usual and is_large else ():
        if more := [name for name in request.shared if name in own]:
            names = *names, *more
            wider = plan.sharing(names, resolve(*asked, known=known, shared=names))
            plan = dataclasses.replace(wider, otherwise=plan)
    return plan


def estimate_plan(plan: MapPlan, capture: xr.Dataset) -> MapPlan:
    """Complete the plan from a sample of pixels: shared parameters, and number of starts.

    It takes as long as hundreds of fits, and must be done once for one image.
    """
    if plan.shared:
        plan = _with_shared(plan, _random_pixels(capture, plan.request.seed, SHARED_PIXELS))
    return dataclasses.replace(_with_settings(plan, capture), otherwise=None)


def _check_shared(names: Sequence[str], request: Request) -> None:
    """Refuse shared parameters that are vectors, unknown, or part of the material."""
    for name in names:
        every = *request.priors, *request.carried
        known = [each for each in every if each not in MATERIAL_PARAMETERS]
        if name not in known or request.priors[name].event_shape:
            what, hint = "an image cannot share it", f"give names among {', '.join(known)}"
            raise FitError(what, where=f"fit_pixels: shared={name!r}", hint=hint)


def _with_shared(plan: MapPlan, pixels: xr.Dataset) -> MapPlan:
    """Add the posterior of shared parameters, estimated from pixels drawn at random."""
    batch, priors = plan.batch(pixels), plan.request.priors
    method = plan.settings if isinstance(plan.settings, CorrectedLaplace) else CorrectedLaplace()
    try:
        found = estimate_shared(batch, method, priors, plan.shared)
    except FitError as error:
        if plan.otherwise is None:
            raise
        return _sharing_less(plan, plan.otherwise, pixels, error.what)
    most = max(each.disagreement for each in found)
    if plan.otherwise and most > DISAGREEMENT:
        reason = f"pixels do not agree (information matrix test {most:.1f})"
        return _sharing_less(plan, plan.otherwise, pixels, reason)
    plan = dataclasses.replace(plan, shared=tuple(found))
    if not plan.carried:
        return plan
    batch = plan.batch(pixels)
    moved = moved_by_setup(batch, method, priors, found, plan.propagation(batch))
    return dataclasses.replace(plan, shared=tuple(moved))


def _sharing_less(plan: MapPlan, less: MapPlan, pixels: xr.Dataset, reason: str) -> MapPlan:
    """Return the plan that shares fewer parameters, with the reason."""
    kept = [each.name for each in less.shared]
    names = [name for name in plan.request.shared if name not in kept]
    less = dataclasses.replace(less, found={"not_shared": {"names": names, "reason": reason}})
    return _with_shared(less, pixels) if less.shared else less


def _with_settings(plan: MapPlan, capture: xr.Dataset) -> MapPlan:
    """Return the plan with method settings that suit the image."""

    def sample(count: int) -> ProblemBatch:
        return plan.batch(_random_pixels(capture, plan.request.seed, count))

    size = capture.sizes["y"] * capture.sizes["x"]
    settings, found = plan.settings.for_image(size, sample, is_shared=bool(plan.shared))
    return dataclasses.replace(plan, settings=settings, found={**plan.found, **found})


def _random_pixels(capture: xr.Dataset, seed: int, count: int) -> xr.Dataset:
    """Draw pixels that have enough views, as an image of one row."""
    rows, columns = (capture.sizes[dim] for dim in IMAGE)
    order = np.random.default_rng(seed).permutation(rows * columns)
    found: list[xr.Dataset] = []
    for begin in range(0, order.size, 2 * count):
        y, x = np.unravel_index(order[begin : begin + 2 * count], (rows, columns))
        place = {"y": xr.DataArray(y, dims="x_"), "x": xr.DataArray(x, dims="x_")}
        some = capture.drop_vars(IMAGE, errors="ignore").isel(place)
        some = mask_missing(some.load().rename(x_="x"))
        some = some.map(lambda v: v.expand_dims("y") if "x" in v.dims else v, keep_attrs=True)
        enough = np.flatnonzero(_count_views(some).transpose(*IMAGE).to_numpy()[0] >= MIN_VIEWS)
        found.append(some.isel(x=enough))
        if sum(each.sizes["x"] for each in found) >= count:
            break
    joined = xr.concat(found, "x", data_vars="minimal", coords="minimal", compat="override")
    return joined.isel(x=slice(count))


def _fullest_pixel(capture: xr.Dataset) -> xr.Dataset:
    """Return the first pixel with the most valid views of the image; rows are read one by one."""
    best, most = None, 0
    for y in range(capture.sizes["y"]):
        row = mask_missing(capture.isel(y=y).load())
        counts = _count_views(row)
        found, x = int(counts.max()), int(counts.argmax("x")) if "x" in counts.dims else 0
        if found > most:
            best, most = row.isel(x=x), found
        if most == capture.sizes["view"]:
            break
    if best is None or most < MIN_VIEWS:
        what = f"no pixel has {MIN_VIEWS} valid views"
        hint = "check `valid` and the readings: NaN counts as missing"
        raise CaptureError(what, where=str(capture.attrs.get("name", "capture")), hint=hint)
    return best


def _count_views(readings: xr.Dataset) -> xr.DataArray:
    """Count the views of each pixel with any valid reading."""
    valid = readings["valid"]
    return valid.any([d for d in valid.dims if d not in (*IMAGE, "view")]).sum("view")


def _intensity_unit(capture: xr.Dataset) -> float | None:
    """Return the largest intensity of the image; None if a saturation level is stated."""
    if "intensity" not in capture or "saturation_level" in capture["intensity"].attrs:
        return None
    readings = mask_missing(capture)
    largest = float(readings["intensity"].where(readings["valid"]).max())
    return largest if largest > 0.0 else 1.0


def provenance_json(plan: MapPlan) -> str:
    """Return the provenance of maps as JSON."""
    request = plan.request
    own, shared = plan.engine.program.supports, [each.name for each in plan.shared]
    provenance = {
        **request.describe(),
        "method": name_of(plan.settings),
        "settings": dataclasses.asdict(plan.settings),
        "fixed": request.fixed,
        "swapped": list(request.swapped),
        "largest_view_zenith": request.largest_view_zenith,
        "precision": request.precision,
        "intensity_unit": plan.intensity_unit,
        "shared": {each.name: _described(each, plan) for each in plan.shared},
        "shared_by_default": plan.shares_by_default,
        "carried": {each.name: each.sd for each in plan.carried},
        "of_each_pixel": [n for n in request.standard_uncertainties(own) if n not in shared],
        **plan.found,
    }
    return json.dumps(provenance, sort_keys=True)


def _described(parameter: SharedParameter, plan: MapPlan) -> dict[str, object]:
    """Describe a shared parameter in types of JSON."""
    prior = plan.request.priors[parameter.name]
    with jax.enable_x64(True):
        quantiles = parameter.quantiles(prior, LEVELS, plan.carried)
    return {
        "quantiles": dict(zip(map(str, LEVELS), quantiles.tolist(), strict=True)),
        "pixels": parameter.pixels,
        "disagreement": parameter.disagreement,
    }


# --- Blocks of an image ---------------------------------------------------------------------------


def with_pixel_numbers(image: xr.Dataset, region: Mapping[str, slice] | None = None) -> xr.Dataset:
    """Add the index of each pixel, row by row, to a block or image."""
    region = region or {dim: slice(None) for dim in IMAGE}
    block = image.isel(region)
    y, x = (xr.Variable((dim,), np.arange(image.sizes[dim])[region[dim]]) for dim in IMAGE)
    if block.chunks:
        y, x = y.chunk(y=block.chunks["y"]), x.chunk(x=block.chunks["x"])
    return block.assign({NUMBER: y * image.sizes["x"] + x})


def blank(capture: xr.Dataset, plan: MapPlan) -> xr.Dataset:
    """Return lazy maps without values: names, axes, types and attributes (Dask)."""
    corner = capture.isel({dim: slice(1) for dim in IMAGE})
    nothing, unknown = Outcome(1, Status.NOT_FITTED), np.full(1, UNKNOWN, np.int8)
    tiny = maps_of(plan.marginals(1), nothing, unknown, corner, plan)
    tiny = tiny.drop_vars(IMAGE, errors="ignore")
    sizes = dict(tiny.sizes) | {dim: capture.sizes[dim] for dim in IMAGE}
    coords = {dim: capture[dim] for dim in IMAGE if dim in capture.coords}
    whole = tiny.coords.to_dataset().assign_coords(coords)
    for name, variable in tiny.items():
        shape = [sizes[dim] for dim in variable.dims]
        values = da.broadcast_to(da.from_array(variable.to_numpy()), shape)
        whole[name] = (variable.dims, values, variable.attrs)
    whole.attrs[PROVENANCE] = provenance_json(plan)
    for name, (mean, sd) in plan.engine.prior_moments.items():
        if name in plan.axes:
            whole[name].attrs |= {"prior_mean": mean.tolist(), "prior_sd": sd.tolist()}
    chunks = {dim: capture.chunks[dim] for dim in IMAGE if dim in capture.chunks}
    return whole.chunk(chunks) if chunks else whole


def _in_memory(capture: xr.Dataset, plan: MapPlan, progress: Counter) -> xr.Dataset:
    """Fit blocks on threads, and combine the maps in memory."""
    maps = blank(capture, plan).compute().copy(deep=True)  # repeated values are read-only
    every, done = capture.sizes["y"] * capture.sizes["x"], 0
    with workers(None) as (pool, count):
        tasks = ((region,) for region in cut(capture, BLOCK))

        def fit(region: dict[str, slice]) -> xr.Dataset:
            return fit_block(with_pixel_numbers(capture, region), plan)

        for (region,), block in as_completed(pool, count, fit, tasks):
            for name, values in block.items():
                maps[name][region] = values
            done += block.sizes["y"] * block.sizes["x"]
            progress(done, every)
    return maps


def fit_block(block: xr.Dataset, plan: MapPlan) -> xr.Dataset:
    """Fit every pixel of a block."""
    numbers = block[NUMBER].transpose(*IMAGE).to_numpy().ravel()
    found = plan.marginals(numbers.size)
    readings = mask_missing(block.drop_vars(NUMBER))
    if not readings["valid"].any():  # a corner of a picture; as a capture it would be refused
        nothing = Outcome(numbers.size, Status.MASKED)
        return maps_of(found, nothing, np.zeros(numbers.size, np.int8), block, plan)
    batch = plan.batch(readings, numbers)
    criticism = PixelCriticism(batch, found)
    outcome = Outcome(len(batch))
    criticism.begin_compiling()
    propagation = plan.propagation(batch) if plan.carried else None
    if propagation:
        propagation.begin_compiling()
    for part in plan.settings.fit_batch(batch):
        if propagation:
            part = propagation.move(part)
        outcome.put(part)
        draws = {name: np.asarray(x) for name, x in part.draws.items()}
        if draws:
            for name, size in plan.sizes.items():  # plates may leave axes of length one behind
                draws[name] = draws[name].reshape(*part.weights.shape, *size)
            found.describe(part.at, draws, part.weights)
        criticism.describe(part, draws)
    flags = criticism.judge(outcome.status)
    outcome.status[(flags & PROBLEMS) != 0] = Status.CONTRADICTED
    return maps_of(found, outcome, flags, block, plan)


def mask_missing(capture: xr.Dataset) -> xr.Dataset:
    """Mark missing readings of a capture as not valid."""
    valid = capture.get("valid", xr.DataArray(True)).astype(bool)
    for name in READINGS:
        if name in capture:
            valid = valid & capture[name].notnull()
    return capture.assign(valid=valid)


def maps_of(
    found: Marginals, outcome: Outcome, criticism: np.ndarray, block: xr.Dataset, plan: MapPlan
) -> xr.Dataset:
    """Return the marginals and flags of a block as labeled maps."""
    shape = tuple(block.sizes[dim] for dim in IMAGE)
    variables: dict[str, tuple] = {}
    for name, (own, sizes) in plan.axes.items():
        symbol, meaning, unit = notation(name)
        statistics = [
            ("", "mean of", found.mean[name], ()),
            ("_sd", "standard deviation of", found.sd[name], ()),
            ("_quantile", "quantiles of", found.quantiles[name], ("quantile",)),
        ]
        if plan.shared or plan.carried:
            what = "change with one sd of what is shared of"
            statistics.append(("_slope", what, found.slopes[name], ("shared",)))
        for ending, statistic, values, first in statistics:
            whole = values.reshape(*values.shape[: len(first)], *shape, *sizes)
            labels = {"units": unit, "long_name": f"{statistic} {meaning}", "symbol": symbol}
            variables[f"{name}{ending}"] = ((*first, *IMAGE, *own), np.float32(whole), labels)
    kinds: dict[str, type[enum.IntEnum]] = {"method": MethodUsed, "status": Status}
    for name, meaning in DIAGNOSTICS.items():
        attrs: dict[str, object] = {"units": "1", "long_name": meaning}
        if name in kinds:
            attrs = _flag_attrs(meaning, "flag_values", kinds[name])
        variables[name] = (IMAGE, getattr(outcome, name).reshape(shape), attrs)
    checks = "checks in which the readings speak against the model"
    attrs = _flag_attrs(checks, "flag_masks", Criticism)
    variables["criticism"] = (IMAGE, criticism.reshape(shape), attrs)
    coords = {dim: block.coords[dim] for dim in (*IMAGE, "wavelength") if dim in block.coords}
    found_maps = xr.Dataset(variables, coords={**coords, "quantile": list(LEVELS)})
    names = [*(each.name for each in plan.shared), *(each.name for each in plan.carried)]
    return found_maps.assign_coords(shared=names) if names else found_maps


def _flag_attrs(meaning: str, key: str, kind: type[enum.IntEnum]) -> dict[str, object]:
    names = " ".join(each.name.lower() for each in kind)
    return {"long_name": meaning, key: [int(each) for each in kind], "flag_meanings": names}
