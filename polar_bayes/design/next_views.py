"""Optimal design of further views: those that narrow the posterior most.

Fedorov exchange (Fedorov 1972, Theory of Optimal Experiments) on a criterion of the expected
covariance, averaged over draws of the posterior (Chaloner & Verdinelli 1995).
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Array
from numpyro import distributions as dist

from polar_bayes.design.candidates import (
    CandidateViews,
    Constraints,
    candidate_links,
    join_candidates,
    view_directions,
)
from polar_bayes.design.fisher import (
    STEP,
    information_by_view,
    positive_definite,
    prior_precision,
    reading_information,
)
from polar_bayes.design.optimal_design import (
    AbstractCriterion,
    DOptimal,
    Selection,
    fedorov_exchange,
)
from polar_bayes.design.setup import (
    DesignProblem,
    coordinate_indices,
    make_design_problem,
    parameter_vector,
    posterior_draws,
    provenance_attrs,
)
from polar_bayes.diagnostics.budget import known_to_half
from polar_bayes.errors import FitError
from polar_bayes.inference.compiled_model import compile_model
from polar_bayes.inference.problem import observe_request
from polar_bayes.inference.program import PRIOR_DRAWS, from_prior
from polar_bayes.inference.request import resolve
from polar_bayes.inference.result import capture_of, provenance_of
from polar_bayes.numerics.optimize import finite_sd
from polar_bayes.observation.data import ANGLES, Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.progress import Progress, with_progress
from polar_bayes.scenes.scene_file import arguments_of
from polar_bayes.setups import Setup


class Design(NamedTuple):
    """Information of the capture with its prior, and of every candidate, at posterior draws.

    `jacobian` (draw, parameter, size) is that of the parameters by the coordinates; the last three
    say which view, wavelength and reading each candidate is, -1 and "" where it has them all.
    """

    base: np.ndarray
    each: np.ndarray
    jacobian: np.ndarray
    view: np.ndarray
    wavelength: np.ndarray
    reading: np.ndarray

    def covariance(self, information: np.ndarray) -> np.ndarray:
        """Return the expected covariance, (draw, option, parameter, parameter)."""
        jacobian = self.jacobian[:, None]
        return jacobian @ np.linalg.inv(information) @ np.swapaxes(jacobian, -1, -2)

    def halved(self, slopes: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return expected sds, (quantity, parameter), where each quantity alone has half its u.

        The slopes are those of the quantities by the coordinates, (draw, quantity, size).
        """
        # Half the standard uncertainty is four times the precision.
        scaled = math.sqrt(3.0) * slopes / u[:, None]
        covariance = self.covariance(self.base[:, None] + scaled[..., None] * scaled[..., None, :])
        return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1).mean(axis=0))

    def conflicts(self, between_views: np.ndarray, repeatable: bool) -> np.ndarray:
        """Return which candidates exclude each other; readings of one view do not."""
        same_view = self.view[:, None] == self.view
        same = (
            same_view
            & (self.wavelength[:, None] == self.wavelength)
            & (self.reading[:, None] == self.reading)
        )
        limited = ~same_view | (same & (not repeatable))
        return between_views[np.ix_(self.view, self.view)] & limited


@with_progress
def next_views(
    capture: xr.Dataset | xr.DataTree,
    candidates: xr.Dataset | None = None,
    *,
    count: int = 3,
    criterion: AbstractCriterion | None = None,
    constraints: Constraints | None = None,
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
    r"""Select views that would narrow the posterior most, and predict the widths.

    The criterion of the covariance $(P + F + \sum F_{picked})^{-1}$, of the information of prior,
    capture and candidates, is averaged over draws of the posterior. Candidates are picked greedily,
    then exchanged until no exchange of one helps.

    Args:
        capture: The views that were measured; as for `polar_bayes.fit`. Or a fit, which tells its
            capture, scene, links, priors and draws where they are not given.
        candidates: Views that could be: view_zenith and view_azimuth (degree) by `view`,
            light_zenith and light_azimuth unless the capture has one light, and a coordinate
            `wavelength` where only some of the capture's are measured. By default every 2.5
            degrees in the capture's own azimuths. Stated errors (`q_error`) are taken from here,
            else the capture's median.
        count: How many to pick, at least 1.
        criterion: `DOptimal()` (by default), `AOptimal()`, `SingleParameter(name)`, or your own.
        constraints: Views that the set-up can take.
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
        `wavelength` and `reading` where they were apart. By `step` (0: the capture alone; then
        after each pick): `criterion`, and by `parameter` of the material `expected_sd` (root of
        the variance averaged over the draws) and `interval_width` of the 95% interval. By
        `quantity` of the set-up, if any: `uncertainty`, and by `parameter` `halved_width`, that of
        the 95% interval of the capture alone if this quantity were known twice as well.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: Candidates, readings or constraints that cannot be used, or no mode was found.

    Source:
        Fedorov (1972); Chaloner & Verdinelli (1995), Statistical Science 10, 273-304.
    """
    _check_choice(count, draws, apart)
    if isinstance(capture, xr.DataTree):
        asked = _asked_of(capture, model, scene, priors, links, largest_view_zenith)
        model, scene, priors, links, largest_view_zenith = asked
        result, capture = result or capture, capture_of(capture)
    request = resolve(capture, model, scene, priors, links, largest_view_zenith, seed, "double")
    with jax.enable_x64(True):
        problem = make_design_problem(request)
        new = candidate_links(problem, readings)
        views = join_candidates(request, candidates, [*request.links, *new])
        extended = _extended(problem, views, new, model, priors)
        drawn = posterior_draws(problem, result, draws, progress)
        design = _design(problem, extended, views, drawn, tuple(new), tuple(apart))
        return _selected(extended, views, design, criterion, constraints, count)


def _asked_of(fit: xr.DataTree, model: str | Callable, *others: object) -> tuple:
    """Return the model of a fit, and its arguments where the caller gives no others."""
    stated = arguments_of(fit)
    names = ("scene", "priors", "links", "largest_view_zenith")
    given = dict(zip(names, others, strict=True))
    kept = (stated.get(name) if given[name] is None else given[name] for name in names)
    return stated.get("model", model), *kept


def _check_choice(count: object, draws: int, apart: Sequence[str]) -> None:
    if isinstance(count, bool) or not isinstance(count, int) or count < 1 or draws < 1:
        what, hint = f"count is {count} and draws is {draws}", "give whole numbers of at least 1"
        raise FitError(what, where="next_views", hint=hint)
    if set(apart) - {"wavelength", "reading"}:
        hint = "give some of wavelength, reading"
        raise FitError(f"apart is {tuple(apart)}", where="next_views", hint=hint)


def _selected(
    extended: DesignProblem,
    views: CandidateViews,
    design: Design,
    criterion: AbstractCriterion | None,
    constraints: Constraints | None,
    count: int,
) -> xr.Dataset:
    """Select candidates that lower the criterion most, and predict their effect."""
    criterion, constraints = criterion or DOptimal(), constraints or Constraints()
    request, scalars = extended.request, extended.scalars
    rows = [i for i, one in enumerate(scalars) if one.name in MATERIAL_PARAMETERS]
    rows = rows or list(range(len(scalars)))
    names, unit = [scalars[row].label for row in rows], extended.prior_sd[rows]
    places = dict(zip(extended.names, extended.rows, strict=True))
    stated = request.standard_uncertainties(extended.program.supports)
    known = {name: u for name, u in stated.items() if name in places}
    slopes = design.jacobian[:, [places[name] for name in known]]
    design = design._replace(jacobian=design.jacobian[:, [places[name] for name in names]])

    def loss(information: np.ndarray) -> np.ndarray:
        covariance = design.covariance(information) / np.outer(unit, unit)
        return np.mean(criterion.loss(covariance, names), axis=0)

    measured = view_directions(request.capture)[: views.measured]
    allowed = constraints.allows(views.directions, measured)
    allowed &= views.directions[:, 0] <= request.largest_view_zenith
    useful = np.einsum("kvii->v", design.each) > 0.0  # a wavelength that is not measured adds none
    conflicts = design.conflicts(constraints.conflicts(views.directions), constraints.repeatable)
    options = allowed[design.view] & useful
    selection = fedorov_exchange(loss, design.base, design.each, options, conflicts, count)
    zenith = views.directions[design.view[options], 0]
    asked = {
        "criterion": repr(criterion),
        "constraints": repr(constraints),
        "limits": [float(zenith.min()), float(zenith.max()), constraints.from_light],
    }
    provenance = provenance_attrs(request, **asked, exchanges=selection.exchanges)
    found = _assemble(views, design, selection, names)
    if known:
        u = np.array(list(known.values()))
        found["uncertainty"] = ("quantity", u)
        found["halved_width"] = (("quantity", "parameter"), _width(design.halved(slopes, u)))
        found = found.assign_coords(quantity=list(known))
    return found.assign_attrs(provenance)


def _extended(
    problem: DesignProblem,
    views: CandidateViews,
    new: Mapping[str, AbstractLink],
    model: str | Callable,
    priors: Mapping[str, dist.Distribution] | None,
) -> DesignProblem:
    """Return the model on measured views and candidates together."""
    links = {**problem.request.links, **new}
    limit, seed = problem.request.largest_view_zenith, problem.request.seed
    # The scene has the input quantities of its set-up already, however the capture was read.
    scene = Setup(problem.request.scene, links)
    priors = {**problem.request.priors, **(priors or {})}
    request = resolve(views.capture, model, scene, priors, links, limit, seed, "double")
    data = observe_request(request)
    recorded = np.broadcast_to(problem.data.brightness, problem.data.shape)
    recorded = recorded[..., : views.measured]
    rest = np.full((*data.shape[:-1], data.shape[-1] - views.measured), np.median(recorded))
    brightness, count = np.concatenate([recorded, rest], axis=-1), np.int32(views.measured)
    data = dataclasses.replace(data, **jax.device_put({"brightness": brightness, "views": count}))
    compiled_model = compile_model(request, data)
    data, program, prior = compiled_model.free(data), compiled_model.program, problem.prior
    for name in (name for name in new if name not in program.observed):
        hint = f"give some of {', '.join(program.observed)}"
        what = f"the model does not observe {name}"
        raise FitError(what, where="next_views: readings", hint=hint)
    if program.size != problem.program.size:
        prior = from_prior(program, jax.random.key(seed), PRIOR_DRAWS, data)
    return DesignProblem(request, data, compiled_model, prior)


def _design(
    problem: DesignProblem,
    extended: DesignProblem,
    views: CandidateViews,
    draws: np.ndarray,
    new: tuple[str, ...],
    apart: tuple[str, ...],
) -> Design:
    """Compute the information of every candidate at every draw by one compiled program."""
    program, data, count = extended.program, extended.data, len(draws)
    indices = coordinate_indices(problem.program, program)
    z = extended.prior[np.arange(count) % len(extended.prior)].copy()  # for parameters of the new
    z[:, indices] = draws
    center = np.median(extended.prior, axis=0)
    center[indices] = np.median(draws, axis=0)
    by_wavelength = "wavelength" in apart
    if by_wavelength and [name for name, _ in data.dims][-2:] != ["wavelength", "view"]:
        what, hint = "the capture has no wavelengths to choose from", "leave wavelength out"
        raise FitError(what, where="next_views: apart", hint=hint)
    axes = data.shape[-2:] if by_wavelength else data.shape[-1:]
    is_predicted = "intensity" in problem.program.observed

    def evaluate(z: Array, step: Array, data: Observations) -> tuple[dict[str, Array], Array]:
        if is_predicted:
            data = _with_predicted_brightness(extended, z, data)
        jacobian = jax.jacfwd(lambda z: parameter_vector(program, z, data))(z)
        return information_by_view(reading_information(program, z, data, step), axes), jacobian

    def run(z: Array, center: Array, step: Array, data: Observations) -> tuple[tuple, Array]:
        of_draws = jax.lax.map(lambda one: evaluate(one, step, data), z)
        return of_draws, prior_precision(program, center, data)

    # By what its trace depends on beside the model.
    name = f"information by {axes}, brightness {is_predicted}"
    found = program.once(name, run)(z, center, STEP * finite_sd(extended.prior), data)
    (information, jacobian), hessian = jax.tree.map(np.asarray, found)
    size, many = program.size, data.shape[-1]
    by_view = {n: x.reshape(count, -1, many, size, size) for n, x in information.items()}
    base = positive_definite(hessian, extended.prior) + sum(
        by_view[n][:, :, : views.measured].sum(axis=(1, 2)) for n in problem.program.observed
    )
    added = np.stack([by_view[name][:, :, views.measured :] for name in new], axis=1)
    if "reading" not in apart:
        added = added.sum(axis=1, keepdims=True)
    reading, wavelength, view = np.indices(added.shape[1:4]).reshape(3, -1)
    return Design(
        base=base,
        each=added.reshape(count, -1, size, size),
        jacobian=jacobian,
        view=view,
        wavelength=wavelength if by_wavelength else np.full(view.size, -1),
        reading=np.array(new)[reading] if "reading" in apart else np.full(view.size, ""),
    )


def _with_predicted_brightness(
    extended: DesignProblem, z: Array, data: Observations
) -> Observations:
    """Give candidates the predicted brightness, which sets their noise."""
    sensor = extended.program.trace(z, data)["intensity"]["fn"]
    predicted = jnp.clip(jnp.broadcast_to(sensor.mean, data.shape), 0.0, 1.0)
    brightness = jnp.where(data.is_measured, data.brightness, predicted)
    return dataclasses.replace(data, brightness=jax.lax.stop_gradient(brightness))


def _width(sd: np.ndarray) -> np.ndarray:
    """Return the width of a normal distribution's 95% interval."""
    return 2.0 * 1.959963984540054 * sd


def _assemble(
    views: CandidateViews, design: Design, selection: Selection, names: list[str]
) -> xr.Dataset:
    picks = np.array(selection.picks)
    added = np.cumsum(design.each[:, picks], axis=1)
    information = design.base[:, None] + np.insert(added, 0, 0.0, axis=1)
    variance = np.diagonal(design.covariance(information), axis1=-2, axis2=-1).mean(axis=0)
    at = design.view[picks]
    found = xr.Dataset(
        {
            "candidate": ("pick", at),
            "criterion": ("step", selection.losses),
            "expected_sd": (("step", "parameter"), np.sqrt(variance)),
            "interval_width": (("step", "parameter"), _width(np.sqrt(variance))),
        },
        coords={"parameter": names, "step": np.arange(len(picks) + 1)},
    )
    for column, name in enumerate(ANGLES):
        found[name] = ("pick", views.directions[at, column], {"units": "degree"})
    if (design.wavelength >= 0).any():
        wavelengths = views.capture["wavelength"].to_numpy()[design.wavelength[picks]]
        found["wavelength"] = ("pick", wavelengths, {"units": "nm"})
    if (design.reading != "").any():
        found["reading"] = ("pick", design.reading[picks])
    return found


# --- Table and sentences --------------------------------------------------------------------------


def next_views_table(found: xr.Dataset) -> pd.DataFrame:
    """Return expected 95% widths of every parameter before and after each view."""
    table = found["interval_width"].transpose("parameter", "step").to_pandas()
    table.columns = ["now", *(f"after {step}" for step in table.columns[1:])]
    return table


SMALL_GAIN = 0.1
"""Share by which further views narrow an interval, below which they hardly help."""


def next_views_sentences(found: xr.Dataset) -> list[str]:
    """State which views to take next, and by how much which intervals narrow."""
    widths = found["interval_width"].transpose("step", "parameter")
    before, after = widths.isel(step=0).to_numpy(), widths.isel(step=-1).to_numpy()
    names = found["parameter"].to_numpy()
    helped = after < (1.0 - SMALL_GAIN) * before
    sentences = [f"Look next at {'; then at '.join(_view_texts(found))}."]
    sentences += [
        f"The 95% interval of {name} is expected to narrow from {old:.3g} to {new:.3g}."
        for name, old, new in zip(names[helped], before[helped], after[helped], strict=True)
    ]
    if not helped.all():
        sentences.append(f"These views hardly help {', '.join(names[~helped])}.")
    return [*sentences, *quantity_sentences(found), *limits_sentences(found)]


def quantity_sentences(found: xr.Dataset) -> list[str]:
    """State which quantity of the set-up to know better, where that helps, beside the views."""
    if "halved_width" not in found:
        return []
    widths = found["interval_width"].transpose("step", "parameter").to_numpy()
    halved = found["halved_width"].transpose("quantity", "parameter").to_numpy()
    quantities, u = found["quantity"].to_numpy(), found["uncertainty"].to_numpy()
    best = np.argmin(halved, axis=0)
    sentences = []
    for at, name in enumerate(found["parameter"].to_numpy()):
        gain, of_views = 1.0 - np.array([halved[best[at], at], widths[-1, at]]) / widths[0, at]
        if gain >= SMALL_GAIN:
            better = known_to_half(str(quantities[best[at]]), float(u[best[at]]))
            sentences.append(
                f"Without further views, the {better} narrows the 95% interval of {name} by "
                f"{gain:.0%} (these views: {of_views:.0%})."
            )
    return sentences


def limits_sentences(found: xr.Dataset) -> list[str]:
    """State the limits within which views were chosen, and how to narrow them."""
    if "limits" not in (about := provenance_of(found)):
        return []
    low, high, apart = about["limits"]
    near = f"at least {apart:g} degrees from the light" if apart else "however near to the light"
    return [
        f"Candidates had zeniths from {low:g} to {high:g} degrees, {near}; where light and viewer "
        "would collide, state their smallest angle by "
        "constraints=pb.design.Constraints(from_light=30), or polar-bayes identify --from-light 30."
    ]


def _view_texts(found: xr.Dataset) -> list[str]:
    """Format views as `zenith 10, azimuth 180`, with the light if it moves."""
    light_moves = any(np.ptp(found[f"light_{angle}"].to_numpy()) for angle in ("zenith", "azimuth"))
    texts = []
    for pick in range(found.sizes["pick"]):
        row = found.isel(pick=pick)
        text = f"zenith {row['view_zenith'].item():g}, azimuth {row['view_azimuth'].item():g}"
        if light_moves:
            text += f" (light at {row['light_zenith'].item():g}, {row['light_azimuth'].item():g})"
        if "wavelength" in row:
            text += f", {row['wavelength'].item():g} nm"
        if "reading" in row:
            text += f", {row['reading'].item()}"
        texts.append(text)
    return texts
