"""Views that could be taken, beside those that were: one capture that holds both."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from polar_bayes.design.setup import Question
from polar_bayes.errors import FitError
from polar_bayes.inference.request import Request
from polar_bayes.observation.data import ANGLES, READINGS
from polar_bayes.observation.links import AbstractLink
from polar_bayes.setups import SETUPS

# --- Choosing some of many: greedily, then by exchange until no exchange helps --------------------


GAIN = 1e-9
"""Smallest gain for which an exchange is made: below it lies rounding."""

Loss = Callable[[Float[np.ndarray, "draw option size size"]], Float[np.ndarray, " option"]]


class Chosen(NamedTuple):
    """A choice in the order in which each adds most to those before."""

    picks: list[int]
    losses: list[float]
    exchanges: int


def choose(
    loss: Loss,
    base: Float[np.ndarray, "draw size size"],
    each: Float[np.ndarray, "draw candidate size size"],
    allowed: Bool[np.ndarray, " candidate"],
    clashes: Bool[np.ndarray, "candidate candidate"],
    count: int,
) -> Chosen:
    """Pick candidates that make a loss of the summed information small."""
    # Source: Fedorov (1972), Theory of Optimal Experiments, chapter 3: exchange.

    def best(picks: list[int]) -> tuple[int, float]:
        """The candidate that adds most to some picks."""
        free = np.flatnonzero(allowed & ~clashes[picks].any(axis=0))
        if free.size == 0:
            return -1, np.inf
        known = base + each[:, picks].sum(axis=1)
        losses = loss(known[:, None] + each[:, free])
        at = int(np.argmin(losses))
        return int(free[at]), float(losses[at])

    picks: list[int] = []
    for number in range(count):
        pick, reached = best(picks)
        if pick < 0:
            raise FitError(
                f"only {number} of {len(allowed)} candidates can be taken together",
                where="next_views",
                hint="ask for fewer, or give more candidates or a rig that can do more",
            )
        picks.append(pick)
    exchanges, before = 0, -1
    while exchanges > before:  # each exchange lowers the loss, so this ends
        before = exchanges
        for place in range(count):
            pick, lower = best(picks[:place] + picks[place + 1 :])
            if lower < reached - GAIN * max(1.0, abs(reached)):
                picks[place], reached, exchanges = pick, lower, exchanges + 1
    return _in_order(loss, base, each, picks, exchanges)


def _in_order(
    loss: Loss, base: np.ndarray, each: np.ndarray, picks: list[int], exchanges: int
) -> Chosen:
    """The same picks, each time the one first that adds most."""
    left, ordered, known = list(picks), [], base
    losses = [float(loss(known[:, None])[0])]
    while left:
        found = loss(known[:, None] + each[:, left])
        at = int(np.argmin(found))
        losses.append(float(found[at]))
        ordered.append(left.pop(at))
        known = known + each[:, ordered[-1]]
    return Chosen(ordered, losses, exchanges)


# --- Which views a rig can take, and which of them together ---------------------------------------


Directions = Float[np.ndarray, "view 4"]
"""View zenith and azimuth, light zenith and azimuth, in degree."""


@dataclasses.dataclass(frozen=True)
class Rig:
    """The limits of a set-up.

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

    def __post_init__(self) -> None:
        for name in ("view_zenith", "light_zenith"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 90.0:
                raise FitError(
                    f"{name} is ({low:g}, {high:g})",
                    where="Rig",
                    hint="give two rising angles from 0 to 90 degrees",
                )
        for name in ("from_light", "minimum_separation"):
            if not 0.0 <= getattr(self, name) <= 180.0:
                raise FitError(
                    f"{name} is {getattr(self, name):g}",
                    where="Rig",
                    hint="give degrees from 0 to 180",
                )

    def allows(self, candidates: Directions, measured: Directions) -> Bool[np.ndarray, " view"]:
        """Which candidates can be taken at all.

        Args:
            candidates: Directions, (view, 4), degree.
            measured: Of the views that are there already.

        Returns:
            True where the limits hold.

        Raises:
            Nothing.
        """
        allowed = np.ones(len(candidates), bool)
        for column, (low, high) in ((0, self.view_zenith), (2, self.light_zenith)):
            allowed &= (candidates[:, column] >= low) & (candidates[:, column] <= high)
        viewer, light = candidates[:, :2], candidates[:, 2:]
        allowed &= _angle(viewer, light) >= self.from_light
        if not self.repeatable and len(measured):
            allowed &= ~self._too_near(candidates, measured).any(axis=1)
        return allowed

    def clashes(self, candidates: Directions) -> Bool[np.ndarray, "view view"]:
        """Which pairs cannot be taken both; a view with itself, where it cannot be repeated.

        Args:
            candidates: Directions, (view, 4), degree.

        Returns:
            Symmetric; True where one excludes the other.

        Raises:
            Nothing.
        """
        near = self._too_near(candidates, candidates)
        if self.repeatable:
            near &= _distance(candidates, candidates) > SAME
        return near

    def _too_near(self, some: Directions, others: Directions) -> Bool[np.ndarray, "some other"]:
        return _distance(some, others) < max(self.minimum_separation, SAME)


SAME = 1e-4
"""Directions within so many degrees are one."""


def _distance(some: Directions, others: Directions) -> Float[np.ndarray, "some other"]:
    """The larger of the angles between two viewers and between two lights."""
    return np.maximum(
        _angle(some[:, None, :2], others[None, :, :2]),
        _angle(some[:, None, 2:], others[None, :, 2:]),
    )


def _angle(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Degrees between directions (zenith, azimuth)."""
    first, second = (
        np.stack(
            [np.sin(z) * np.cos(a), np.sin(z) * np.sin(a), np.cos(z) * np.ones_like(a)], axis=-1
        )
        for z, a in (np.moveaxis(np.radians(x), -1, 0) for x in (some, others))
    )
    half = 0.5 * np.linalg.norm(first - second, axis=-1)  # an arc cosine loses small angles
    return np.degrees(2.0 * np.arcsin(np.minimum(half, 1.0)))


# --- Views that could be taken, beside those that were: one capture that holds both ---------------


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
            hint=f"give some of {', '.join(READINGS)}",
        )
    if "dop" in found and {"q", "u"} & set(found):
        raise FitError(
            "the degree of polarization is made of q and u, and would count twice",
            where="next_views: readings",
            hint="leave out dop, or q and u",
        )
    return found


def _link_of(request: Request, name: str, given: AbstractLink | None) -> AbstractLink:
    """The link of a reading: as given, as measured, as the set-up has it, or as its siblings'."""
    where = f"next_views: readings: {name!r}"
    if name not in READINGS:
        raise FitError(
            "there is no such reading", where=where, hint=f"give some of {', '.join(READINGS)}"
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
            hint=f"give its link: readings={{{name!r}: ...}}",
        )
    if own != request.links.get(name, own):
        raise FitError(
            f"new readings of {name} scatter otherwise than those that were measured",
            where=where,
            hint=f"leave out its link, which is {request.links[name]!r}",
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
            hint="give an xarray.Dataset with view_zenith and view_azimuth over a dim view",
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
                    hint=f"add {name} in degree, with dim view",
                )
            candidates[name] = ("view", np.full(candidates.sizes["view"], same[0]))
        if candidates[name].dims != ("view",):
            raise FitError(
                f"its dims are ({', '.join(map(str, candidates[name].dims))})",
                where=f"next_views: candidates: {name}",
                hint="give it the one dim view",
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
            hint="give degrees; a zenith is from 0 to below 90",
        )


def _wavelengths(capture: xr.Dataset, candidates: xr.Dataset) -> np.ndarray:
    """Which of the capture's wavelengths new views measure."""
    if "wavelength" not in capture.coords or capture["wavelength"].ndim == 0:
        if "wavelength" in candidates.coords:
            raise FitError(
                "the capture has no wavelengths",
                where="next_views: candidates: wavelength",
                hint="leave the coordinate out",
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
            hint=f"give some of {', '.join(f'{x:g}' for x in has)}",
        )
    return np.isin(has, asked)


def _as_before(old: xr.DataArray, new: xr.DataArray, given: xr.DataArray | None) -> xr.DataArray:
    """The candidates' own value, or the median of the views that were measured."""
    if given is None:
        return xr.zeros_like(new) + old.median("view")
    return (xr.zeros_like(new) + given.drop_vars(given.coords)).transpose(*new.dims)
