"""Views that could be taken, beside those that were: one capture that holds both."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.identifiability.peak import Question
from polar_bayes.identifiability.rig import Directions
from polar_bayes.inference.request import Request
from polar_bayes.observation.data import ANGLES, READINGS
from polar_bayes.observation.links import AbstractLink
from polar_bayes.setups import SETUPS

HARMLESS = {"dop": 0.5, "q": 0.0, "u": 0.0, "intensity": 0.0}
"""Stand for readings that were not taken; nothing looks at them."""

STEP = 2.5
"""Degrees between the zeniths of the views that are tried where none are given."""


class Views(NamedTuple):
    """Measured and possible views in one capture."""

    capture: xr.Dataset
    measured: int
    directions: Directions
    wavelengths: np.ndarray


def directions_of(views: xr.Dataset) -> Directions:
    """The four angles of every view, (view, 4); those of the first patch where each has its own."""
    columns = []
    for name in ANGLES:
        angle = views[name]
        angle = angle.isel({dim: 0 for dim in angle.dims if dim != "view"})
        columns.append(np.broadcast_to(angle.to_numpy(), views.sizes["view"]))
    return np.stack(columns, axis=-1).astype(float)


def default_candidates(capture: xr.Dataset, limit: float) -> xr.Dataset:
    """Views every 2.5 degrees in the azimuths and under the lights that the capture has."""
    # Where the light stands at the mirrored zenith in every view, as on a goniometer, it does so in
    # the candidates.
    measured = directions_of(capture)
    zeniths = np.arange(STEP, min(limit, 87.5) + 1e-9, STEP)
    if np.allclose(measured[:, 0], measured[:, 2]) and np.ptp(measured[:, 0]) > 0.0:
        rows = [(z, a, z, b) for a, b in np.unique(measured[:, [1, 3]], axis=0) for z in zeniths]
    else:
        stands = np.unique(measured[:, 1:], axis=0)
        rows = [(z, *stand) for stand in stands for z in zeniths]
    angles = np.array(rows, float).T
    return xr.Dataset({name: ("view", angle) for name, angle in zip(ANGLES, angles, strict=True)})


def links_of_new(
    question: Question, readings: Sequence[str] | Mapping[str, AbstractLink] | None
) -> dict[str, AbstractLink]:
    """How the readings of new views scatter."""
    request, observed = question.request, question.program.observed
    if readings is None:
        return {name: link for name, link in request.links.items() if name in observed}
    if isinstance(readings, str):
        readings = (readings,)
    given = dict(readings) if isinstance(readings, Mapping) else dict.fromkeys(readings)
    found = {name: _link_of(request, name, link) for name, link in given.items()}
    if not found:
        raise FitError(
            "new views record nothing",
            where="next_views: readings",
            mend=f"give some of {', '.join(READINGS)}",
        )
    if "dop" in found and {"q", "u"} & set(found):
        raise FitError(
            "the degree of polarization is made of q and u, and would count twice",
            where="next_views: readings",
            mend="leave out dop, or q and u",
        )
    return found


def _link_of(request: Request, name: str, given: AbstractLink | None) -> AbstractLink:
    """The link of a reading: as given, as measured, as the set-up has it, or as its siblings'."""
    where = f"next_views: readings: {name!r}"
    if name not in READINGS:
        raise FitError(
            "there is no such reading", where=where, mend=f"give some of {', '.join(READINGS)}"
        )
    named = (request.scene_name, str(request.capture.attrs.get("setup")))
    setup = next((SETUPS[word] for word in named if word in SETUPS), None)
    known = setup.links if setup is not None else {}
    beside = {n: link for link in request.links.values() for n in link.observables}
    own = given or request.links.get(name) or beside.get(name) or known.get(name)
    if own is None or name not in own.observables:
        raise FitError(
            f"nothing says how {name} scatters",
            where=where,
            mend=f"give its link: readings={{{name!r}: ...}}",
        )
    if own != request.links.get(name, own):
        raise FitError(
            f"new readings of {name} scatter otherwise than those that were measured",
            where=where,
            mend=f"leave out its link, which is {request.links[name]!r}",
        )
    return own


def join(capture: xr.Dataset, candidates: xr.Dataset, readings: Sequence[str]) -> Views:
    """Put candidates behind the views of a capture."""
    candidates = _with_light(capture, candidates)
    count, measured = candidates.sizes["view"], capture.sizes["view"]
    old = _with_room(capture, candidates, readings)
    measures = _wavelengths(capture, candidates)
    new = old.isel(view=np.zeros(count, int)).copy(deep=True)
    for name in ANGLES:
        bare = xr.DataArray(candidates[name].to_numpy(), dims="view")
        new[name] = (xr.zeros_like(new[name]) + bare).transpose(*new[name].dims)
    has_colors = "wavelength" in new["valid"].dims
    is_in = xr.DataArray(measures, dims="wavelength") if has_colors else True
    new["valid"] = (xr.ones_like(new["valid"]) & is_in).transpose(*new["valid"].dims)
    if "saturated" in new:
        new["saturated"] = xr.zeros_like(new["saturated"])
    for name in (n for n in READINGS if n in new):
        new[name] = xr.full_like(new[name], HARMLESS[name])
    for name in (*(f"{reading}_error" for reading in READINGS), "normal_confidence"):
        if name in old and "view" in old[name].dims:
            new[name] = _as_before(old[name], new[name], candidates.get(name))
    whole = xr.concat(
        [old, new], dim="view", data_vars="minimal", coords="minimal", compat="override"
    )
    return Views(whole, measured, directions_of(candidates), measures)


def _with_room(capture: xr.Dataset, candidates: xr.Dataset, readings: Sequence[str]) -> xr.Dataset:
    """The capture with every variable that the model and the candidates have."""
    labels = ["view"] if "view" in capture.coords else []
    old = capture.drop_vars([n for n in capture if str(n).startswith("true_")] + labels)
    signal = next(old[name] for name in READINGS if name in old)
    old["valid"] = old.get("valid", xr.ones_like(signal, dtype=bool))
    for name in (n for n in readings if n not in old):
        old[name] = xr.full_like(signal, HARMLESS[name]).assign_attrs(units="1")
        if name == "intensity":
            old[name].attrs = {"saturation_level": 1.0}
    for name in (f"{n}_error" for n in readings):
        if name in candidates and name not in old:
            old[name] = xr.ones_like(signal).assign_attrs(units="1")
    return old


def _with_light(capture: xr.Dataset, candidates: xr.Dataset) -> xr.Dataset:
    if not isinstance(candidates, xr.Dataset) or "view" not in candidates.dims:
        raise FitError(
            "they are no views",
            where="next_views: candidates",
            mend="give an xarray.Dataset with view_zenith and view_azimuth over a dim view",
        )
    given = [name for name in (*ANGLES, "wavelength") if name in candidates.variables]
    errors = [f"{name}_error" for name in READINGS if f"{name}_error" in candidates]
    candidates = candidates[given + errors]
    for name in ANGLES:
        if name not in candidates:
            same = np.unique(capture[name].to_numpy())
            if not name.startswith("light") or same.size > 1:
                raise FitError(
                    "it is missing",
                    where=f"next_views: candidates: {name}",
                    mend=f"add {name} in degree, with dim view",
                )
            candidates[name] = ("view", np.full(candidates.sizes["view"], same[0]))
        if candidates[name].dims != ("view",):
            raise FitError(
                f"its dims are ({', '.join(map(str, candidates[name].dims))})",
                where=f"next_views: candidates: {name}",
                mend="give it the one dim view",
            )
        _check_angle(name, candidates[name].to_numpy())
    return candidates


def _check_angle(name: str, angle: np.ndarray) -> None:
    inside = np.isfinite(angle)
    if name.endswith("zenith"):
        inside &= (angle >= 0.0) & (angle < 90.0)
    if not inside.all():
        at = int(np.argmin(inside))
        raise FitError(
            f"{angle[at]:g} is no direction",
            where=f"next_views: candidates: {name}[view={at}]",
            mend="give degrees; a zenith is from 0 to below 90",
        )


def _wavelengths(capture: xr.Dataset, candidates: xr.Dataset) -> np.ndarray:
    """Which of the capture's wavelengths new views measure."""
    if "wavelength" not in capture.coords or capture["wavelength"].ndim == 0:
        if "wavelength" in candidates.coords:
            raise FitError(
                "the capture has no wavelengths",
                where="next_views: candidates: wavelength",
                mend="leave the coordinate out",
            )
        return np.ones(1, bool)
    has = capture["wavelength"].to_numpy()
    if "wavelength" not in candidates.coords:
        return np.ones(has.size, bool)
    asked = np.atleast_1d(candidates["wavelength"].to_numpy())
    strange = asked[~np.isin(asked, has)]
    if strange.size:
        raise FitError(
            f"{strange[0]:g} nm has parameters of its own, of which the capture says nothing",
            where="next_views: candidates: wavelength",
            mend=f"give some of {', '.join(f'{x:g}' for x in has)}",
        )
    return np.isin(has, asked)


def _as_before(old: xr.DataArray, new: xr.DataArray, given: xr.DataArray | None) -> xr.DataArray:
    """The candidates' own value, or the median of the views that were measured."""
    if given is None:
        return xr.zeros_like(new) + old.median("view")
    return (xr.zeros_like(new) + given.drop_vars(given.coords)).transpose(*new.dims)
