"""What a capture says about itself, and readings that no light explains.

A validated capture may still hold the channels swapped or the directions of another convention.
Where unpolarized light falls in, a view at the mirror angle sees light of the surface, whose s
share is the larger one (Fresnel), and light of the body, which is partly p polarized by its
refraction at the surface. So no mixture of them has a q below that of the body alone, and on the
light's own side none is polarized more than a facet that mirrors the light, or the body. The
bounds are those of the largest and the smallest index that a dielectric is likely to have.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

SMALLEST_INDEX, LARGEST_INDEX = 1.2, 2.5
SMALLEST_VIEWS = 3
"""Views below which nothing is concluded from their polarization."""
MIRROR_ZENITH, MIRROR_AZIMUTH = 2.5, 5.0
"""Departure from the mirror direction, in degrees, within which a view still counts as one."""
SAME_SIDE_AZIMUTH = 20.0
JUDGED_ZENITHS = (15.0, 80.0)
"""Zeniths, in degrees, between which surface and body are polarized enough to be told apart."""
NOISE_ERRORS, UNSTATED_ERROR = 3.0, 0.03
OVERPOLARIZED_ERRORS, OVERPOLARIZED_SHARE = 5.0, 0.01
PI_TOLERANCE = 0.01
BREWSTER_ZENITHS = (20.0, 85.0)
BREWSTER_GAP = 10.0
"""Largest step, in degrees, between mirror views from which Brewster's angle is read by eye."""
BREWSTER_PEAK, PURE_PEAK = 0.5, 0.9
"""Polarization from which a peak is one, and from which the surface alone makes it."""
MAX_LISTED = 4


def cautions(capture: xr.Dataset) -> tuple[str, ...]:
    """Readings or directions of a capture that are unlikely, each with its likely cause.

    Args:
        capture: A validated capture.

    Returns:
        A sentence for each, none for a capture in which nothing is unlikely.
    """
    parts = _materials(capture)
    return tuple(
        dict.fromkeys(
            itertools.chain(
                _azimuth_cautions(capture),
                _excess_cautions(capture),
                *(_sign_cautions(name, part) for name, part in parts),
                *(_side_cautions(name, part) for name, part in parts),
                *(_scale_cautions(name, part) for name, part in parts),
            )
        )
    )


def inferred(capture: xr.Dataset) -> tuple[str, ...]:
    """What a capture holds and what its readings say at first sight, for its user to confirm.

    Args:
        capture: A validated capture.

    Returns:
        Sentences on readings, directions, wavelengths, the sign of q and Brewster's angle by eye,
        as far as the capture has them.
    """
    return tuple(
        itertools.chain(
            [_readings_sentence(capture)],
            *(_sign_sentences(name, part) for name, part in _materials(capture)),
            *(_brewster_sentences(name, part) for name, part in _materials(capture)),
        )
    )


def stated(capture: xr.Dataset) -> tuple[str, ...]:
    """What a capture states for its fits: the set-up and the incident levels.

    Args:
        capture: A validated capture.

    Returns:
        A sentence on the set-up, and one on the incident levels of a goniometer.
    """
    setup = (
        "Set-up: not stated, so a fit takes 'paper', a point source and an unsigned degree of "
        "polarization; name it by setup= at import or scene= of the fit."
    )
    if "setup" in capture.attrs:
        setup = f"Set-up: {capture.attrs['setup']}, which its fits take by default."
    levels = {
        "given": ("Incident levels: given, so s and p are on one scale.",),
        "not given": (
            "Incident levels: not given, so s and p are taken to be on one scale; a fit gives the "
            "ratio of their gains (channel_gain_ratio) a wider prior than otherwise.",
        ),
    }
    return (setup, *levels.get(capture.attrs.get("incident_levels", ""), ()))


# --- Directions -----------------------------------------------------------------------------------


def _materials(capture: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """The capture of each material or patch, with words that name it; an image is one."""
    dim = next((name for name in ("material", "patch") if name in capture.dims), None)
    if dim is None:
        return [("", capture)]
    labels = capture[dim].values  # numbers from 0 where the capture has none
    return [(f" of {dim} {label}", capture.isel({dim: k})) for k, label in enumerate(labels)]


def _azimuth_difference(capture: xr.Dataset) -> xr.DataArray:
    """Angle between the azimuths of viewer and light, degree, 0 to 180."""
    return abs((capture["view_azimuth"] - capture["light_azimuth"] + 180.0) % 360.0 - 180.0)


def _at_mirror(capture: xr.Dataset) -> xr.DataArray:
    """Views at the mirror angle of the light."""
    apart = abs(capture["view_zenith"] - capture["light_zenith"])
    opposite = _azimuth_difference(capture) >= 180.0 - MIRROR_AZIMUTH
    return (apart <= MIRROR_ZENITH) & opposite


def _judged(capture: xr.Dataset, where: xr.DataArray, signal: str) -> xr.DataArray:
    """Measured readings at those views, where the zenith lets surface and body be told apart."""
    low, high = JUDGED_ZENITHS
    zenith = capture["view_zenith"]
    valid = capture.get("valid", xr.DataArray(True))
    return where & (zenith >= low) & (zenith <= high) & valid & capture[signal].notnull()


def _noise(capture: xr.Dataset, signal: str) -> xr.DataArray:
    """How far noise may carry a reading."""
    return NOISE_ERRORS * capture.get(f"{signal}_error", xr.DataArray(UNSTATED_ERROR))


# --- What light can be ----------------------------------------------------------------------------


def fresnel(zenith: Any, index: float) -> tuple[Any, Any]:
    """Shares of s and p light that a smooth surface reflects at a zenith in degrees."""
    cos, sin = np.cos(np.deg2rad(zenith)), np.sin(np.deg2rad(zenith))
    inside = np.sqrt(index**2 - sin**2)
    s = ((cos - inside) / (cos + inside)) ** 2
    p = ((index**2 * cos - inside) / (index**2 * cos + inside)) ** 2
    return s, p


def _body_polarization(zenith: Any) -> Any:
    """Largest degree of polarization, along p, of light that leaves a body at a zenith."""
    s, p = fresnel(zenith, LARGEST_INDEX)
    return (s - p) / (2.0 - s - p)


# --- Cautions -------------------------------------------------------------------------------------


def _azimuth_cautions(capture: xr.Dataset) -> Iterator[str]:
    largest = max(float(abs(capture[f"{each}_azimuth"]).max()) for each in ("view", "light"))
    at_pi = abs(_azimuth_difference(capture) - np.pi) < PI_TOLERANCE
    if largest <= 2.0 * np.pi + PI_TOLERANCE and bool(at_pi.any()):
        yield (
            "Viewer and light are pi degrees of azimuth apart, which looks like radians: give 180 "
            "for the mirror side of the light."
        )


def _excess_cautions(capture: xr.Dataset) -> Iterator[str]:
    """Readings of q and u together beyond 1 by more than their errors allow."""
    if "q_error" not in capture or "u_error" not in capture:
        return
    q, u = capture["q"], capture["u"]
    degree = (q**2 + u**2) ** 0.5
    error = ((q * capture["q_error"]) ** 2 + (u * capture["u_error"]) ** 2) ** 0.5 / degree
    valid = degree.notnull() & capture.get("valid", xr.DataArray(True))
    wrong = valid & (degree > 1.0 + OVERPOLARIZED_ERRORS * error)
    count, total = int(wrong.sum()), int(valid.sum())
    if count > OVERPOLARIZED_SHARE * total:
        largest = float(degree.where(wrong).max())
        yield (
            f"{count} of {total} readings have sqrt(q^2 + u^2) above 1 by more than "
            f"{OVERPOLARIZED_ERRORS:g} stated errors (up to {largest:.3g}): "
            "no light has it, so errors are stated too small, or dark level, background or the "
            "gains of the channels are off."
        )


def _sign_cautions(name: str, capture: xr.Dataset) -> Iterator[str]:
    """Views at the mirror angle with more p light than the body alone can send."""
    if "q" not in capture:
        return
    judged = _judged(capture, _at_mirror(capture), "q")
    below = judged & (
        capture["q"] < -_body_polarization(capture["view_zenith"]) - _noise(capture, "q")
    )
    count, total = int(below.sum()), int(judged.sum())
    if total >= SMALLEST_VIEWS and 2 * count >= total:
        yield (
            f"q{name} is negative at {count} of {total} mirror angles, more than surface and body "
            "can make it: s and p are likely swapped, or q is defined with the other sign (here "
            "q > 0 is s light, perpendicular to the plane of normal and viewer); swap them, or "
            "turn the sign."
        )


def _side_cautions(name: str, capture: xr.Dataset) -> Iterator[str]:
    """Views on the light's own side that are polarized as only a mirror angle can be."""
    signal = next((each for each in ("dop", "q") if each in capture), None)
    if signal is None or capture.attrs.get("setup") == "picture":  # light from everywhere
        return
    apart = _azimuth_difference(capture)
    if not bool((apart <= SAME_SIDE_AZIMUTH).all()):
        return
    judged = _judged(capture, apart <= SAME_SIDE_AZIMUTH, signal)
    view, light = (np.deg2rad(capture[f"{each}_zenith"]) for each in ("view", "light"))
    cos = np.cos(view) * np.cos(light) + np.sin(view) * np.sin(light) * np.cos(np.deg2rad(apart))
    s, p = fresnel(0.5 * np.rad2deg(np.arccos(np.clip(cos, -1.0, 1.0))), SMALLEST_INDEX)
    most = np.maximum((s - p) / (s + p), _body_polarization(capture["view_zenith"]))
    above = judged & (abs(capture[signal]) > most + _noise(capture, signal))
    count, total = int(above.sum()), int(judged.sum())
    if total >= SMALLEST_VIEWS and 2 * count >= total:
        yield (
            f"Every view{name} is on the side of the light, and {count} of {total} are polarized "
            "more than any light that returns there: the detector was likely on the mirror side, "
            "where view_azimuth and light_azimuth are 180 degrees apart."
        )


def _scale_cautions(name: str, capture: xr.Dataset) -> Iterator[str]:
    """A Brewster angle below that of vacuum, as if angles counted from the surface."""
    peak = _brewster(capture)
    if peak is not None and peak[2] < 45.0:
        yield (
            f"The polarization{name} is largest near {peak[1]:.0f} degrees, which would be "
            f"Brewster's angle of an index of {_index(peak[1])}, below that of vacuum: the angles "
            "were likely counted from the surface; give 90 degrees less each of them, from the "
            "normal."
        )


# --- What was inferred ----------------------------------------------------------------------------


def _readings_sentence(capture: xr.Dataset) -> str:
    signals = [name for name in ("dop", "q", "u", "intensity") if name in capture]
    names = [f"{n} ({'' if f'{n}_error' in capture else 'no '}errors stated)" for n in signals]
    zenith = capture["view_zenith"]
    views = capture.sizes["view"]
    mirror = int(_at_mirror(capture).any([x for x in zenith.dims if x != "view"]).sum())
    colors = "no wavelength is stated"
    if "wavelength" in capture.coords:
        values = np.atleast_1d(capture["wavelength"].values)
        more = f" and {len(values) - MAX_LISTED} more" if len(values) > MAX_LISTED else ""
        colors = f"{', '.join(f'{x:g}' for x in values[:MAX_LISTED])}{more} nm"
    return (
        f"Readings: {', '.join(names)}; {views} view{'s' if views != 1 else ''} from "
        f"{float(zenith.min()):g} to {float(zenith.max()):g} degrees from the normal, {mirror} of "
        f"them at the mirror angle; {colors}."
    )


def _sign_sentences(name: str, capture: xr.Dataset) -> Iterator[str]:
    if "q" not in capture:
        return
    judged = _judged(capture, _at_mirror(capture), "q")
    if total := int(judged.sum()):
        count = int((judged & (capture["q"] > 0.0)).sum())
        yield f"Sign: q{name} is positive (s light) at {count} of {total} mirror angles."


def _brewster_sentences(name: str, capture: xr.Dataset) -> Iterator[str]:
    peak = _brewster(capture)
    if peak is not None:
        low, center, high, top = peak
        moved = (
            f"; the peak is {top:.2f}, so light of the body has likely moved it to larger "
            "angles, and the index is smaller"
        )
        moved = "" if top >= PURE_PEAK else moved
        yield (
            f"Brewster's angle by eye{name}: the polarization is largest near {center:.0f} "
            f"degrees, which would mean an index near {_index(center)} "
            f"({_index(low)} to {_index(high)}){moved}."
        )


def _index(angle: float) -> str:
    return f"{np.tan(np.deg2rad(angle)):.2f}"


def _brewster(capture: xr.Dataset) -> tuple[float, float, float, float] | None:
    """Least, middle and largest angle at which mirror views are polarized most, and how much."""
    signal = next((each for each in ("q", "dop") if each in capture), None)
    if signal is None or {"y", "x"} & set(capture.dims):
        return None
    low, high = BREWSTER_ZENITHS
    zenith = capture["view_zenith"]
    used = _at_mirror(capture) & (zenith >= low) & (zenith <= high)
    used = used & capture.get("valid", xr.DataArray(True))
    readings = capture[signal].where(used)
    others = [dim for dim in readings.dims if dim != "view"]
    values = readings.mean(others).to_numpy()  # over wavelengths
    kept = np.isfinite(values)
    angles, values = zenith.to_numpy()[kept], values[kept]
    angles, position = np.unique(angles, return_inverse=True)
    if len(angles) < 2 * SMALLEST_VIEWS:
        return None
    values = np.bincount(position, values) / np.bincount(position)
    top = float(values.max())
    noise = float(_noise(capture, signal).where(used).median()) / NOISE_ERRORS
    near = np.flatnonzero(values >= top - max(2.0 * noise, 0.01))
    first, last = int(near[0]), int(near[-1])
    if top < BREWSTER_PEAK or first == 0 or last == len(angles) - 1:
        return None
    below, above = angles[first - 1 : first + 1], angles[last : last + 2]
    if max(np.ptp(below), np.ptp(above), *np.diff(angles[first : last + 1]), 0.0) > BREWSTER_GAP:
        return None
    center = float(np.mean(angles[near]))
    return float(np.mean(below)), center, float(np.mean(above)), top
