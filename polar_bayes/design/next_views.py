"""The public verb: where to look next, so that the posterior narrows most."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Array
from numpyro import distributions as dist

from polar_bayes.design.candidates import (
    Chosen,
    Rig,
    Views,
    choose,
    default_candidates,
    directions_of,
    join,
    links_of_new,
)
from polar_bayes.design.criteria import AbstractCriterion, DOptimal
from polar_bayes.design.fisher import (
    distributions,
    information_of_each,
    prior_precision,
    sound_precision,
)
from polar_bayes.design.identify import provenance
from polar_bayes.design.setup import (
    PRIOR_DRAWS,
    Question,
    draws_at,
    draws_of,
    embed,
    find_peaks,
    flat_parameters,
    label_parameters,
    pose,
)
from polar_bayes.errors import FitError
from polar_bayes.inference.compile import compiled
from polar_bayes.inference.optimize import from_prior
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.observation.data import ANGLES, Observations, observe
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.progress import Progress, with_progress

APART = ("wavelength", "reading")
WIDTH = 2.0 * 1.959963984540054
"""Width of a 95% interval, in standard deviations of a normal distribution."""


class Design(NamedTuple):
    """All that a choice needs, averaged over draws of what the material may be."""

    base: np.ndarray
    each: np.ndarray
    slopes: np.ndarray
    view: np.ndarray
    wavelength: np.ndarray
    reading: np.ndarray

    def variances(self, information: np.ndarray) -> np.ndarray:
        """Expected covariance of the parameters, (draw, option, parameter, parameter)."""
        slopes = self.slopes[:, None]
        return slopes @ np.linalg.inv(information) @ np.swapaxes(slopes, -1, -2)


@with_progress
def next_views(
    capture: xr.Dataset,
    candidates: xr.Dataset | None = None,
    *,
    count: int = 3,
    criterion: AbstractCriterion | None = None,
    rig: Rig | None = None,
    readings: Sequence[str] | Mapping[str, AbstractLink] | None = None,
    apart: Sequence[str] = (),
    result: xr.DataTree | None = None,
    draws: int = 16,
    model: str | Callable = "per_material",
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> xr.Dataset:
    r"""Views that would add most to what a capture tells, and what to expect of them.

    The information of the capture, of the prior and of every candidate is known for any value of
    the parameters; the criterion of the covariance $(P + F + \sum F_{picked})^{-1}$ is averaged
    over draws of the posterior, so that the choice does not hang on one value. Candidates are
    picked greedily, then exchanged until no exchange of one helps.

    Args:
        capture: The views that were measured; as for `polar_bayes.fit`.
        candidates: Views that could be: view_zenith and view_azimuth (degree) by `view`,
            light_zenith and light_azimuth unless the capture has one light, and a coordinate
            `wavelength` where only some of the capture's are measured. By default every 2.5
            degrees in the capture's own azimuths. Stated errors (`q_error`) are taken from here,
            else the capture's median.
        count: How many to pick, at least 1.
        criterion: `DOptimal()` (by default), `AOptimal()`, `SingleParameter(name)`, or your own.
        rig: What the set-up can do.
        readings: Variables that new views record, such as ("q", "u") where the capture has only q;
            or a mapping to their links. By default those of the capture.
        apart: "wavelength", "reading" or both, where one view at one wavelength, or in one
            variable, is a candidate of its own. By default a candidate is a view with all.
        result: A fit of this capture and model, whose draws then stand for the posterior; by
            default a normal approximation at the mode is drawn from.
        draws: Over how many the criterion is averaged.
        model: A name or a callable.
        scene: A name, a `Scene` or None.
        priors: Overrides.
        links: One link, a mapping or None.
        largest_view_zenith: Unit degree, or None for the set-up's own; candidates keep to it too.
        seed: Of draws and starts.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        By `pick`, the most useful first: `candidate` (its number), the four angles, and
        `wavelength` and `reading` where they were apart. By `step` (0: as it is; then after each
        pick): `criterion`, and by `parameter` of the material `expected_sd` (root of the variance
        averaged over the draws) and `interval_width` of the 95% interval, in its own unit.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: Candidates, readings or a rig that cannot be used, or no mode was found.

    Source:
        Fedorov (1972), Theory of Optimal Experiments; Chaloner & Verdinelli (1995), Statistical
        Science 10, 273-304, for the average over the posterior.
    """
    if isinstance(count, bool) or not isinstance(count, int) or count < 1 or draws < 1:
        raise FitError(
            f"count is {count} and draws is {draws}",
            where="next_views",
            hint="give whole numbers of at least 1",
        )
    criterion, rig = criterion or DOptimal(), rig or Rig()
    if set(apart) - set(APART):
        raise FitError(
            f"apart is {tuple(apart)}",
            where="next_views",
            hint=f"give some of {', '.join(APART)}",
        )
    with jax.enable_x64(True):
        question = pose(capture, model, scene, priors, links, largest_view_zenith, seed)
        request = question.request
        new = links_of_new(question, readings)
        if candidates is None:
            candidates = default_candidates(request.capture, request.largest_view_zenith)
        views = join(request.capture, candidates, [*request.links, *new])
        wide = _widen(question, views, new, model, priors)
        places = embed(question.program, wide.program)
        if result is None:
            z = draws_at(find_peaks(question, progress), draws, seed)
        else:
            z = draws_of(question, result, draws)
        labels = label_parameters(wide)
        rows = [i for i, one in enumerate(labels.scalars) if one.name in MATERIAL_PARAMETERS]
        rows = rows or list(range(len(labels.scalars)))
        design = _design(question, wide, views, z, places, tuple(new), tuple(apart))
    design = design._replace(slopes=design.slopes[:, np.array(labels.rows)[rows]])
    unit = labels.prior_sd[rows]
    names = [labels.names[row] for row in rows]

    def loss(information: np.ndarray) -> np.ndarray:
        covariance = design.variances(information) / np.outer(unit, unit)
        return np.mean(criterion.loss(covariance, names), axis=0)

    within = views.directions[:, 0] <= request.largest_view_zenith
    allowed = rig.allows(views.directions, directions_of(request.capture)) & within
    useful = np.einsum("kvii->v", design.each) > 0.0  # a wavelength that is not measured adds none
    clashes = rig.clashes(views.directions)[np.ix_(design.view, design.view)]
    clashes &= _one_exposure(design, rig.repeatable)
    chosen = choose(loss, design.base, design.each, allowed[design.view] & useful, clashes, count)
    return _assemble(request.capture, views, design, chosen, names, (criterion, rig, wide))


def _widen(
    question: Question,
    views: Views,
    new: Mapping[str, AbstractLink],
    model: str | Callable,
    priors: Mapping[str, dist.Distribution] | None,
) -> Question:
    """The model on measured views and candidates together."""
    request = question.request
    links = {**request.links, **new}
    limit = request.largest_view_zenith
    wide = resolve(
        views.capture, model, request.scene, priors, links, limit, request.seed, "double"
    )
    data = observe(wide.capture, largest_view_zenith=limit)
    recorded = jnp.broadcast_to(question.data.brightness, question.data.shape)
    rest = jnp.full((*data.shape[:-1], data.shape[-1] - views.measured), jnp.median(recorded))
    data = dataclasses.replace(data, brightness=jnp.concatenate([recorded, rest], axis=-1))
    program = compile_program(wide.bind(wide.scene), data)
    unheard = [name for name in new if name not in program.observed]
    if unheard:
        raise FitError(
            f"the model does not observe {unheard[0]}",
            where="next_views: readings",
            hint=f"give some of {', '.join(program.observed)}",
        )
    prior = question.prior
    if program.size != question.program.size:
        key = jax.random.key(request.seed)
        prior = from_prior(program, key, PRIOR_DRAWS, data)
    return Question(wide, data, program, prior)


def _design(
    question: Question,
    wide: Question,
    views: Views,
    draws: np.ndarray,
    places: np.ndarray,
    new: tuple[str, ...],
    apart: tuple[str, ...],
) -> Design:
    """The information of every candidate at every draw, from one compiled program."""
    program, count = wide.program, len(draws)
    z = wide.prior[np.arange(count) % len(wide.prior)].copy()  # what only new readings bring in
    z[:, places] = draws
    center = np.median(wide.prior, axis=0)
    center[places] = np.median(draws, axis=0)
    kept = 2 if "wavelength" in apart else 1
    if kept == 2 and [name for name, _ in wide.data.dims][-2:] != ["wavelength", "view"]:
        raise FitError(
            "the capture has no wavelengths to choose from",
            where="next_views: apart",
            hint="leave wavelength out",
        )
    is_predicted = "intensity" in question.program.observed

    def told(z: Array, data: Observations) -> tuple[dict[str, Array], Array]:
        if is_predicted:  # a bright view is read more sharply; what was recorded stays
            data = _with_prediction(wide, z, data, views.measured)
        slopes = jax.jacfwd(lambda z: flat_parameters(program, z, data))(z)
        return information_of_each(program, z, data, kept), slopes

    run = compiled(lambda z, data: jax.lax.map(lambda one: told(one, data), z))
    found, slopes = jax.tree.map(np.asarray, run(jnp.asarray(z), wide.data))
    curvature = np.asarray(
        compiled(lambda z, data: prior_precision(program, z, data))(center, wide.data)
    )
    size, many = program.size, wide.data.shape[-1]
    by_view = {n: x.reshape(count, -1, many, size, size) for n, x in found.items()}
    base = sum(
        by_view[n][:, :, : views.measured].sum(axis=(1, 2)) for n in question.program.observed
    )
    base = base + sound_precision(curvature, wide.prior)
    added = np.stack([by_view[name][:, :, views.measured :] for name in new], axis=1)
    if "reading" not in apart:
        added = added.sum(axis=1, keepdims=True)
    numbers = np.indices(added.shape[1:4]).reshape(3, -1)
    return Design(
        base=base,
        each=added.reshape(count, -1, size, size),
        slopes=slopes,
        view=numbers[2],
        wavelength=numbers[1] if kept == 2 else np.full(numbers.shape[1], -1),
        reading=np.array(new)[numbers[0]] if "reading" in apart else np.full(numbers.shape[1], ""),
    )


def _with_prediction(wide: Question, z: Array, data: Observations, measured: int) -> Observations:
    """The same capture with candidates as bright as the model predicts them."""
    sensor = distributions(wide.program, z, data)["intensity"]
    seen = jnp.clip(jnp.broadcast_to(sensor.mean, data.shape), 0.0, 1.0)
    brightness = jnp.where(jnp.arange(data.shape[-1]) < measured, data.brightness, seen)
    return dataclasses.replace(data, brightness=jax.lax.stop_gradient(brightness))


def _one_exposure(design: Design, repeatable: bool) -> np.ndarray:
    """Where the limits between two views hold: not between wavelengths and readings of one."""
    same_view = design.view[:, None] == design.view[None, :]
    same = (
        same_view
        & (design.wavelength[:, None] == design.wavelength[None, :])
        & (design.reading[:, None] == design.reading[None, :])
    )
    return ~same_view | (same & (not repeatable))


def _assemble(
    capture: xr.Dataset,
    views: Views,
    design: Design,
    chosen: Chosen,
    names: list[str],
    about: tuple[AbstractCriterion, Rig, Question],
) -> xr.Dataset:
    criterion, rig, wide = about
    picks = np.array(chosen.picks)
    known = design.base[:, None] + np.concatenate(
        [np.zeros_like(design.each[:, :1]), np.cumsum(design.each[:, picks], axis=1)], axis=1
    )
    variance = np.diagonal(design.variances(known), axis1=-2, axis2=-1).mean(axis=0)
    at = design.view[picks]
    found = xr.Dataset(
        {
            "candidate": ("pick", at),
            "criterion": ("step", chosen.losses),
            "expected_sd": (("step", "parameter"), np.sqrt(variance)),
            "interval_width": (("step", "parameter"), WIDTH * np.sqrt(variance)),
        },
        coords={"parameter": names, "step": np.arange(len(picks) + 1)},
    )
    for column, name in enumerate(ANGLES):
        found[name] = ("pick", views.directions[at, column], {"units": "degree"})
    if (design.wavelength >= 0).any():
        wavelengths = capture["wavelength"].to_numpy()[design.wavelength[picks]]
        found["wavelength"] = ("pick", wavelengths, {"units": "nm"})
    if (design.reading != "").any():
        found["reading"] = ("pick", design.reading[picks])
    told: dict[str, Any] = provenance(wide.request)
    told |= {"criterion": repr(criterion), "rig": repr(rig), "exchanges": chosen.exchanges}
    found.attrs[PROVENANCE] = json.dumps(told, sort_keys=True)
    return found


# --- Where to look next and what it is worth, as a table and in words -----------------------------


HARDLY = 0.9
"""Width after over width before from which views hardly help."""


def next_views_table(found: xr.Dataset) -> pd.DataFrame:
    """Width of the expected 95% interval of every parameter, before and after each view.

    Args:
        found: What `polar_bayes.next_views` returns.

    Returns:
        One row for each parameter, in its unit; columns "now", "after 1", "after 2" and so on.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    table = found["interval_width"].transpose("parameter", "step").to_pandas()
    table.columns = ["now", *(f"after {step}" for step in table.columns[1:])]
    return table


def next_views_sentences(found: xr.Dataset) -> list[str]:
    """Where to look, and by how much the intervals narrow.

    Args:
        found: What `polar_bayes.next_views` returns.

    Returns:
        The views in their order; each parameter's interval before and after; then the parameters
        that they hardly help, where there are any.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    widths = found["interval_width"].transpose("step", "parameter")
    before, after = widths.isel(step=0).to_numpy(), widths.isel(step=-1).to_numpy()
    names = found["parameter"].to_numpy()
    helped = after < HARDLY * before
    said = [f"Look next at {'; then at '.join(_views_in_words(found))}."]
    said += [
        f"The 95% interval of {name} is expected to narrow from {old:.3g} to {new:.3g}."
        for name, old, new in zip(names[helped], before[helped], after[helped], strict=True)
    ]
    if not helped.all():
        said.append(f"These views hardly help {', '.join(names[~helped])}.")
    return said


def _views_in_words(found: xr.Dataset) -> list[str]:
    light = any(np.ptp(found[f"light_{angle}"].to_numpy()) for angle in ("zenith", "azimuth"))
    rows: list[Mapping[str, Any]] = [
        {str(n): found[n].to_numpy()[pick] for n in found.data_vars if found[n].dims == ("pick",)}
        for pick in range(found.sizes["pick"])
    ]
    return [_view_in_words(row, light) for row in rows]


def _view_in_words(row: Mapping[str, Any], light: bool) -> str:
    words = f"zenith {row['view_zenith']:g}, azimuth {row['view_azimuth']:g}"
    if light:
        words += f" (light at {row['light_zenith']:g}, {row['light_azimuth']:g})"
    if "wavelength" in row:
        words += f", {row['wavelength']:g} nm"
    if "reading" in row:
        words += f", {row['reading']}"
    return words


def _check(found: xr.Dataset) -> None:
    if not isinstance(found, xr.Dataset) or "interval_width" not in found:
        raise FitError(
            "it names no views",
            where="next_views",
            hint="give what polar_bayes.next_views returns",
        )
