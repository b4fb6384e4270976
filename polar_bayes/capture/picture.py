"""A picture of polarized light as a capture, in the plane of each piece of surface.

A reading that says nothing stays, marked valid=False, and is counted under one reason, the first
that applies: outside the surface, turned away from the camera, in shadow (its own; a shadow that
something else throws is not known), saturated, too dark, overpolarized.
"""

import dataclasses
from typing import Any

import numpy as np
import xarray as xr

from polar_bayes.capture.contract import EXCESS_POLARIZATION
from polar_bayes.capture.detector import Signal
from polar_bayes.capture.places import (
    AbstractPlace,
    Direction,
    Directions,
    Highlight,
    Surroundings,
    as_place,
    directions,
    mirrored,
)
from polar_bayes.capture.schema import validate
from polar_bayes.capture.shapes import AbstractShape, as_shape
from polar_bayes.capture.squares import Squares
from polar_bayes.capture.stokes import StokesImage, fit_stokes, unbiased_dop
from polar_bayes.errors import CaptureError

DARKEST = 10.0
"""Least intensity over its error: below it a quotient is no longer normal."""


@dataclasses.dataclass(frozen=True, eq=False)
class Setting:
    """What stood where in front of the camera, checked."""

    shape: AbstractShape
    view: AbstractPlace
    light: AbstractPlace | Highlight | Surroundings


def setting_of(shape: Any, view: Any, light: Any, frame: tuple[int, ...]) -> Setting:
    """What stood in front of the camera, from what a user gave."""
    surface = as_shape(shape)
    surface.check(frame)
    return Setting(
        surface,
        as_place(view, "view"),
        light if isinstance(light, Highlight | Surroundings) else as_place(light, "light"),
    )


def picture_capture(
    light: np.ndarray,
    variance: np.ndarray,
    saturated: np.ndarray,
    signal: Signal,
    angles: Any,
    squares: Squares,
    setting: Setting,
    attributes: dict[str, str | int | float],
) -> xr.Dataset:
    """A capture from averaged readings behind a polarizer."""
    places, light_said = _directions(squares, setting)
    relative = float(signal.said["relative_error"])
    stokes = fit_stokes(light, variance + (relative * light) ** 2, angles)
    turned = stokes.turned(places.cos_twice, places.sin_twice)
    dop, dop_error = unbiased_dop(turned)
    reasons = _reasons(turned, places, saturated)
    valid = ~np.logical_or.reduce(list(reasons.values()))
    attributes = {
        **attributes,
        "setup": "picture",
        "analyzer_angles": ", ".join(f"{angle:g}" for angle in np.asarray(angles)),
        "bin": squares.bin,
        "window": squares.window,
        "left_over_rows": squares.left_over[0],
        "left_over_columns": squares.left_over[1],
        **signal.said,
        "surface": setting.shape.said,
        "view": repr(setting.view),
        "light": light_said,
        **{f"masked_{reason}": int(where.sum()) for reason, where in reasons.items()},
    }
    if not valid.any():
        told = ", ".join(f"{int(w.sum())} {r}" for r, w in reasons.items() if w.any())
        raise CaptureError(
            f"no reading is left ({told})".replace("_", " "),
            where=str(attributes.get("name", "frames")),
            mend="check shape, light and exposure, or average more pixels (bin)",
        )
    attributes |= _noise_said(turned, valid)
    readings = {
        "dop": np.clip(dop, 0.0, 1.0),  # above one by noise alone, where it is valid; counted
        "q": turned.q,
        "u": turned.u,
        "intensity": turned.intensity,
        "dop_error": dop_error,
        "q_error": np.sqrt(turned.q_variance),
        "u_error": np.sqrt(turned.u_variance),
        "intensity_error": np.sqrt(turned.intensity_variance),
    }
    attributes["dop_at_one"] = int((valid & (dop > 1.0)).sum())
    dims = ("y", "x", "view")
    variables = {
        name: (dims, squares.views(getattr(places, name)))
        for name in ("view_zenith", "view_azimuth", "light_zenith", "light_azimuth")
    }
    for name, values in readings.items():
        kept = np.where(valid, values, np.nan)
        units = {"units": "counts"} if name.startswith("intensity") else {}
        variables[name] = (dims, squares.views(kept), units)  # type: ignore[assignment]
    variables["saturated"] = (dims, squares.views(saturated))
    variables["valid"] = (dims, squares.views(valid))
    capture = xr.Dataset(variables, attrs=attributes)
    capture["intensity"].attrs["saturation_level"] = signal.full_scale
    rows, columns = squares.centers(squares.bin * squares.window)
    return validate(capture.assign_coords(y=rows, x=columns), source=str(attributes["name"]))


def _directions(squares: Squares, setting: Setting) -> tuple[Directions, str]:
    """Directions at every reading, and the light in words."""
    rows, columns = np.meshgrid(*squares.centers(squares.bin), indexing="ij")
    normals = setting.shape.normals(rows, columns, squares.bin)
    points = _points(rows, columns, squares.frame)
    view = setting.view.towards(points)
    light, said = setting.light, repr(setting.light)
    if isinstance(light, Surroundings):
        return directions(normals, view, mirrored(normals, view)), said
    if isinstance(light, Highlight):
        light = _light_of(light, setting, squares.frame)
        said = f"{said}: {light!r}"
    return directions(normals, view, light.towards(points)), said


def _light_of(highlight: Highlight, setting: Setting, frame: tuple[int, int]) -> AbstractPlace:
    row, column = np.array([highlight.row]), np.array([highlight.column])
    inside = highlight.row <= frame[0] - 1 and highlight.column <= frame[1] - 1
    normal = setting.shape.normals(row, column, 1)[0] if inside else np.full(3, np.nan)
    if not np.isfinite(normal).all():
        mend = "give row and column of the highlight, row first, in pixels of the frame"
        raise CaptureError("there is no surface", where=repr(highlight), mend=mend)
    view = setting.view.towards(_points(row, column, frame))[0]
    return Direction(*(float(x) for x in mirrored(normal, view)))


def _points(rows: np.ndarray, columns: np.ndarray, frame: tuple[int, int]) -> np.ndarray:
    """Places of the frame in the camera's axes, on the plane z = 0."""
    x, y = columns - 0.5 * (frame[1] - 1), 0.5 * (frame[0] - 1) - rows
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def _reasons(
    stokes: StokesImage, places: Directions, saturated: np.ndarray
) -> dict[str, np.ndarray]:
    """Why readings say nothing, each under its first reason."""
    with np.errstate(invalid="ignore"):
        dark = ~(stokes.intensity > DARKEST * np.sqrt(stokes.intensity_variance))
        squared = stokes.q**2 + stokes.u**2
        largest = np.maximum(np.abs(stokes.q), np.abs(stokes.u))
        overpolarized = ~(squared <= 1.0 + EXCESS_POLARIZATION) | ~(largest <= 1.0)
    reasons = {
        "outside": places.outside,
        "turned_away": places.turned_away,
        "in_shadow": places.in_shadow,
        "saturated": saturated,
        "too_dark": dark,
        "overpolarized": overpolarized,
    }
    known = np.zeros_like(saturated)
    for reason, where in reasons.items():
        reasons[reason] = where & ~known
        known = known | where
    return reasons


def _noise_said(stokes: StokesImage, valid: np.ndarray) -> dict[str, float]:
    """What no variable of a capture holds: correlation of q and u, and how well readings fit."""
    said = {"largest_correlation_of_q_and_u": float(np.abs(stokes.correlation[valid]).max())}
    if stokes.misfit is not None:
        said["median_misfit"] = float(np.median(stokes.misfit[valid]))
    return said
