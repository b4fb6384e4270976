"""Candidate views: constraints of the set-up, and one capture that holds all candidates."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from polar_bayes.capture.schema import dims_text
from polar_bayes.design.setup import DesignProblem
from polar_bayes.errors import FitError
from polar_bayes.inference.request import Request
from polar_bayes.observation.data import ANGLES, READINGS
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.geometry import unit_vectors
from polar_bayes.setups import SETUPS

# --- Constraints of the set-up --------------------------------------------------------------------


Directions = Float[np.ndarray, "view 4"]
"""View zenith, view azimuth, light zenith and light azimuth, unit degree."""


@dataclasses.dataclass(frozen=True)
class Constraints:
    """Constraints on the views that a set-up can take.

    Args:
        view_zenith: Least and largest, unit degree, range [0, 90].
        light_zenith: The same for the light.
        from_light: Smallest angle between viewer and light, which would hide each other. Unit
            degree.
        minimum_separation: Smallest angle between two views under one light: between two new ones
            and, unless repeatable, between a new one and one that was measured. Unit degree.
        repeatable: True where a view may be taken again: one that was measured, or a new one
            more than once.

    Raises:
        FitError: A limit is outside of its range.
    """

    view_zenith: tuple[float, float] = (0.0, 90.0)
    light_zenith: tuple[float, float] = (0.0, 90.0)
    from_light: float = 0.0
    minimum_separation: float = 0.0
    repeatable: bool = False
    # Directions within so many degrees are one.
    same_direction: ClassVar[float] = 1e-4

    def __post_init__(self) -> None:
        for name in ("view_zenith", "light_zenith"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 90.0:
                hint = "give two rising angles from 0 to 90 degrees"
                raise FitError(f"{name} is ({low:g}, {high:g})", where="Constraints", hint=hint)
        for name in ("from_light", "minimum_separation"):
            if not 0.0 <= (angle := getattr(self, name)) <= 180.0:
                hint = "give degrees from 0 to 180"
                raise FitError(f"{name} is {angle:g}", where="Constraints", hint=hint)

    def allows(self, candidates: Directions, measured: Directions) -> Bool[np.ndarray, " view"]:
        """Return True for candidates that can be taken, given the views that were measured."""
        allowed = _angle(candidates[:, :2], candidates[:, 2:]) >= self.from_light
        for column, (low, high) in ((0, self.view_zenith), (2, self.light_zenith)):
            allowed &= (candidates[:, column] >= low) & (candidates[:, column] <= high)
        if not self.repeatable:
            allowed &= ~self._too_near(candidates, measured).any(axis=1)
        return allowed

    def conflicts(self, candidates: Directions) -> Bool[np.ndarray, "view view"]:
        """Return which pairs of candidates exclude each other; a view itself, if unrepeatable."""
        near = self._too_near(candidates, candidates)
        if self.repeatable:
            near &= _distance(candidates, candidates) > self.same_direction
        return near

    def _too_near(self, some: Directions, others: Directions) -> Bool[np.ndarray, "some other"]:
        return _distance(some, others) < max(self.minimum_separation, self.same_direction)


def _distance(some: Directions, others: Directions) -> Float[np.ndarray, "some other"]:
    """Return the larger of the angles between two viewers and between two lights."""
    viewers = _angle(some[:, None, :2], others[None, :, :2])
    return np.maximum(viewers, _angle(some[:, None, 2:], others[None, :, 2:]))


def _angle(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the angle in degrees between directions (zenith, azimuth)."""
    apart = unit_vectors(some) - unit_vectors(others)
    half = 0.5 * np.linalg.norm(apart, axis=-1)  # an arc cosine loses small angles
    return np.degrees(2.0 * np.arcsin(np.minimum(half, 1.0)))


# --- Links of the readings of new views -----------------------------------------------------------


def candidate_links(
    problem: DesignProblem, readings: Sequence[str] | Mapping[str, AbstractLink] | None
) -> dict[str, AbstractLink]:
    """Return the link of every variable that new views record."""
    request, observed = problem.request, problem.program.observed
    if readings is None:
        return {name: link for name, link in request.links.items() if name in observed}
    if isinstance(readings, str):
        readings = (readings,)
    given = dict(readings) if isinstance(readings, Mapping) else dict.fromkeys(readings)
    found = {name: _link_of(request, name, link) for name, link in given.items()}
    where = "next_views: readings"
    if not found:
        hint = f"give some of {', '.join(READINGS)}"
        raise FitError("new views record nothing", where=where, hint=hint)
    if "dop" in found and {"q", "u"} & set(found):
        what = "the degree of polarization is made of q and u, and would count twice"
        raise FitError(what, where=where, hint="leave out dop, or q and u")
    return found


def _link_of(request: Request, name: str, given: AbstractLink | None) -> AbstractLink:
    """Return the link that was given, or that of the capture, a related variable or the set-up."""
    where = f"next_views: readings: {name!r}"
    if name not in READINGS:
        hint = f"give some of {', '.join(READINGS)}"
        raise FitError("there is no such reading", where=where, hint=hint)
    setups = (request.scene_name, str(request.capture.attrs.get("setup")))
    setup = next((SETUPS[key] for key in setups if key in SETUPS), None)
    known = dict(setup.links) if setup is not None else {}
    known |= {n: link for link in request.links.values() for n in link.observables}
    link = given or request.links.get(name) or known.get(name)
    if link is None or name not in link.observables:
        hint = f"give its link: readings={{{name!r}: ...}}"
        raise FitError(f"the noise of {name} is not known", where=where, hint=hint)
    if link != request.links.get(name, link):
        what = f"new readings of {name} have another link than those that were measured"
        hint = f"leave out its link, which is {request.links[name]!r}"
        raise FitError(what, where=where, hint=hint)
    return link


# --- One capture of measured and candidate views --------------------------------------------------


PLACEHOLDERS = {"dop": 0.5, "q": 0.0, "u": 0.0, "intensity": 0.0}
"""Readings of views that were not taken; the expected information is independent of them."""


class CandidateViews(NamedTuple):
    """One capture of the measured views, followed by the candidates."""

    capture: xr.Dataset
    measured: int
    directions: Directions


def view_directions(views: xr.Dataset) -> Directions:
    """Return the four angles of every view; those of the first patch if patches differ."""
    columns = []
    for name in ANGLES:
        angle = views[name]
        angle = angle.isel({dim: 0 for dim in angle.dims if dim != "view"})
        columns.append(np.broadcast_to(angle.to_numpy(), views.sizes["view"]))
    return np.stack(columns, axis=-1).astype(float)


def _default_candidates(capture: xr.Dataset, limit: float) -> xr.Dataset:
    """List views every 2.5 degrees in the capture's azimuths and under its lights."""
    measured = view_directions(capture)
    zeniths = np.arange(2.5, min(limit, 87.5) + 1e-9, 2.5)
    # Where the light's zenith mirrors the viewer's in every view, as on a goniometer, it does so
    # in the candidates.
    if np.allclose(measured[:, 0], measured[:, 2]) and np.ptp(measured[:, 0]) > 0.0:
        rows = [(z, a, z, b) for a, b in np.unique(measured[:, [1, 3]], axis=0) for z in zeniths]
    else:
        rows = [(z, *rest) for rest in np.unique(measured[:, 1:], axis=0) for z in zeniths]
    angles = np.array(rows, float).T
    return xr.Dataset({name: ("view", angle) for name, angle in zip(ANGLES, angles, strict=True)})


def join_candidates(
    request: Request, candidates: xr.Dataset | None, readings: Sequence[str]
) -> CandidateViews:
    """Append candidates to the views of a capture."""
    capture = request.capture
    if candidates is None:
        candidates = _default_candidates(capture, request.largest_view_zenith)
    candidates = _checked(capture, candidates)
    wavelengths = _measured_wavelengths(capture, candidates)
    old = _with_readings(capture, candidates, readings)
    new = old.isel(view=np.zeros(candidates.sizes["view"], int)).copy(deep=True)
    for name in ANGLES:
        new[name] = _filled(new[name], xr.DataArray(candidates[name].to_numpy(), dims="view"))
    has_wavelengths = "wavelength" in new["valid"].dims
    valid = xr.DataArray(wavelengths, dims="wavelength") if has_wavelengths else True
    new["valid"] = _filled(new["valid"], valid)
    if "saturated" in new:
        new["saturated"] = xr.zeros_like(new["saturated"])
    for name in (n for n in READINGS if n in new):
        new[name] = xr.full_like(new[name], PLACEHOLDERS[name])
    for name in (*(f"{reading}_error" for reading in READINGS), "normal_confidence"):
        if name in old and "view" in old[name].dims:
            errors = old[name].median("view")
            if name in candidates:
                errors = candidates[name].drop_vars(candidates[name].coords)
            new[name] = _filled(new[name], errors)
    joined = xr.concat(
        [old, new], dim="view", data_vars="minimal", coords="minimal", compat="override"
    )
    return CandidateViews(joined, capture.sizes["view"], view_directions(candidates))


def _filled(variable: xr.DataArray, values: xr.DataArray | bool) -> xr.DataArray:
    """Broadcast values to the dims of a variable, in their order."""
    return (xr.zeros_like(variable) + values).transpose(*variable.dims)


def _with_readings(
    capture: xr.Dataset, candidates: xr.Dataset, readings: Sequence[str]
) -> xr.Dataset:
    """Add every variable that the model or the candidates have to the capture."""
    labels = ["view"] if "view" in capture.coords else []
    old = capture.drop_vars([n for n in capture if str(n).startswith("true_")] + labels)
    signal = next(old[name] for name in READINGS if name in old)
    old["valid"] = old.get("valid", xr.ones_like(signal, dtype=bool))
    for name in (n for n in readings if n not in old):
        old[name] = xr.full_like(signal, PLACEHOLDERS[name]).assign_attrs(units="1")
        if name == "intensity":
            old[name].attrs = {"saturation_level": 1.0}
    for name in (f"{n}_error" for n in readings):
        if name in candidates and name not in old:
            old[name] = xr.ones_like(signal).assign_attrs(units="1")
    return old


def _checked(capture: xr.Dataset, candidates: xr.Dataset) -> xr.Dataset:
    """Return angles, errors and wavelengths of the candidates, with the capture's single light."""
    where = "next_views: candidates"
    if not isinstance(candidates, xr.Dataset) or "view" not in candidates.dims:
        hint = "give an xarray.Dataset with view_zenith and view_azimuth over a dim view"
        raise FitError("they are no views", where=where, hint=hint)
    errors = (f"{name}_error" for name in READINGS)
    used = [n for n in (*ANGLES, "wavelength", *errors) if n in candidates.variables]
    candidates = candidates[used]
    for name in ANGLES:
        if name not in candidates:
            same = np.unique(capture[name].to_numpy())
            if not name.startswith("light") or same.size > 1:
                hint = f"add {name} in degree, with dim view"
                raise FitError("it is missing", where=f"{where}: {name}", hint=hint)
            candidates[name] = ("view", np.full(candidates.sizes["view"], same[0]))
        if candidates[name].dims != ("view",):
            what = f"its dims are {dims_text(candidates[name].dims)}"
            raise FitError(what, where=f"{where}: {name}", hint="give it the one dim view")
        angle = candidates[name].to_numpy()
        inside = np.isfinite(angle)
        if name.endswith("zenith"):
            inside &= (angle >= 0.0) & (angle < 90.0)
        if not inside.all():
            at = int(np.argmin(inside))
            what = f"{angle[at]:g} is no direction"
            hint = "give degrees; a zenith is from 0 to below 90"
            raise FitError(what, where=f"{where}: {name}[view={at}]", hint=hint)
    return candidates


def _measured_wavelengths(
    capture: xr.Dataset, candidates: xr.Dataset
) -> Bool[np.ndarray, " wavelength"]:
    """Return which of the capture's wavelengths the candidates measure."""
    where = "next_views: candidates: wavelength"
    if "wavelength" not in candidates.coords:
        return np.ones(capture.sizes.get("wavelength", 1), bool)
    if "wavelength" not in capture.coords or capture["wavelength"].ndim == 0:
        hint = "leave the coordinate out"
        raise FitError("the capture has no wavelengths", where=where, hint=hint)
    known = capture["wavelength"].to_numpy()
    asked = np.atleast_1d(candidates["wavelength"].to_numpy())
    unknown = asked[~np.isin(asked, known)]
    if unknown.size:
        what = f"{unknown[0]:g} nm has parameters of its own, which the capture does not determine"
        hint = f"give some of {', '.join(f'{x:g}' for x in known)}"
        raise FitError(what, where=where, hint=hint)
    return np.isin(known, asked)
