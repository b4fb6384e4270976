"""Views at the mirror angle: conversion of angle scales, and directions of views.

The angle of incidence counts from the surface normal. Other scales name the same directions: the
angle from the surface, 90 degrees less it; two theta, the angle between both arms on the side of
the normal, twice it; and the deviation of the beam, 180 degrees less that (the two theta of
X-rays). A scan through zero reads the same angle on both sides, with both signs.
"""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from polar_bayes.capture.schema import FROM_NORMAL, ZENITH, check_choice
from polar_bayes.errors import CaptureError

ANGLE_IS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = MappingProxyType(
    {
        "incidence": lambda angle: angle,
        "from-surface": lambda angle: 90.0 - angle,
        "two-theta": lambda angle: 0.5 * angle,
        "deviation": lambda angle: 90.0 - 0.5 * angle,
    }
)
"""Conversion of each angle scale to the angle of incidence, in degrees, >= 0."""


def as_incidence(
    angle: np.ndarray,
    angle_is: str | None,
    places: Sequence[str],
    reading: np.ndarray | None = None,
) -> np.ndarray:
    """Convert angles of some scale to angles of incidence, in degrees.

    Args:
        angle: As read off, degree. Shape (row,).
        angle_is: A name in `ANGLE_IS`, whose absolute value is taken; None: the angle of incidence.
        places: Where each angle stands, for errors.
        reading: Light that grows with the angle of incidence, such as that of s; from it an error
            tells two theta from the deviation.

    Raises:
        CaptureError: The first angle in the order of the file that is none, or no such scale.
    """
    check_choice(angle_is, (None, *ANGLE_IS), "angle_is")
    found = angle if angle_is is None else ANGLE_IS[angle_is](np.abs(angle))
    if (wrong := ~ZENITH.contains(found)).any():
        first = int(np.argmax(wrong))
        scale = "" if angle_is is None else f", as {angle_is} an incidence of {found[first]:g}"
        what = f"the angle is outside {ZENITH} (angle {angle[first]:g}{scale})"
        hint = _guess(angle, reading) if angle_is is None else "check angle_is="
        raise CaptureError(what, where=places[first], hint=hint)
    return found


def _guess(angle: np.ndarray, reading: np.ndarray | None) -> str:
    """Suggest the scale of angles that cannot be angles of incidence."""
    if np.nanmin(angle) < 0.0 and np.nanmax(np.abs(angle)) < 90.0:
        what = "a scan through zero" if np.nanmax(angle) > 0.0 else "the other side of the normal"
        return (
            f"{FROM_NORMAL}; this looks like {what}: angle_is='incidence' takes the absolute value"
        )
    if np.nanmax(np.abs(angle)) > 180.0:
        return FROM_NORMAL
    scales = ["two-theta", "deviation"]
    if np.nanmax(np.abs(angle)) == 90.0:
        scales.append("from-surface")
    if reading is not None and np.isfinite(reading).sum() > 2:
        known = np.isfinite(reading)
        grows = np.corrcoef(np.abs(angle[known]), reading[known])[0, 1] > 0.0
        scales = ["two-theta"] if grows else [each for each in scales if each != "two-theta"]
    names = " or ".join(f"angle_is='{each}'" for each in scales)
    return f"{FROM_NORMAL}; this looks like {names}"


def mirror_views(incidence: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
    """Return directions of views in the mirror direction; angles in degrees, (view,)."""
    return {
        "view_zenith": ("view", incidence),
        "view_azimuth": ("view", np.full_like(incidence, 180.0)),
        "light_zenith": ("view", incidence),
        "light_azimuth": ("view", np.zeros_like(incidence)),
    }
