r"""A picture of polarized light as a capture, in the plane of each piece of surface.

A reading that says nothing stays, marked valid=False, and is counted under one reason, the first
that applies: outside the surface, turned away from the camera, in shadow (its own; a shadow that
something else throws is not known), saturated, too dark, overpolarized.

Squares of `bin` x `bin` pixels are averaged into one reading. Squares of `window` x `window`
readings make one pixel of the capture: they are the views of one material, each with the
directions at its own place. One picture shows each place from one side only, and a fit needs two
views; a curved surface has them next to each other.

One frame for each angle, everything else still; `polar_bayes.importers.stokes` tells how they
become Stokes parameters, `polar_bayes.importers.detector` what noise they have, and
`polar_bayes.importers.images` what becomes of places that say nothing.

Four neighboring pixels stand behind four polarizers. polanalyser fills in for each angle what the
pixels of the other angles would have read, from their neighbors (bilinear). The values of one
angle are then no longer independent, so what matters is how much noise is left in the average over
a square of b x b pixels: along each axis a pixel inside counts 2, one on the border 3/2, and one
beyond it 1/2, of b in all, so that

$$ \sigma^2_{mean} = \Big(\frac{2b - 3/2}{b^2}\Big)^2 \sigma^2 $$

for even b. (Averages of pixels that were read alone would have 4/b^2.)
"""

import dataclasses
import importlib
import importlib.metadata
from collections.abc import Sequence
from numbers import Integral
from types import ModuleType
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.ndimage import binary_dilation

from polar_bayes.capture.schema import EXCESS_POLARIZATION, POSITIVE, validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.camera_geometry import (
    AbstractPlace,
    Direction,
    Directions,
    Highlight,
    Surroundings,
    as_place,
    directions,
    mirrored,
)
from polar_bayes.importers.detector import (
    Detector,
    Frame,
    Signal,
    check_number,
    os_name,
    read_frame,
    signal_of,
)
from polar_bayes.importers.normals import AbstractShape, Sphere, as_shape
from polar_bayes.importers.stokes import StokesImage, check_angles, fit_stokes, unbiased_dop

# --- How a frame is cut into readings and pixels of a capture -------------------------------------


@dataclasses.dataclass(frozen=True)
class Squares:
    """Squares of pixels that are averaged, and those that are read as one material."""

    frame: tuple[int, int]
    bin: int
    window: int

    @property
    def counts(self) -> tuple[int, int]:
        """Pixels of the capture along rows and columns."""
        wide = self.bin * self.window
        return self.frame[0] // wide, self.frame[1] // wide

    @property
    def left_over(self) -> tuple[int, int]:
        """Rows and columns at the far edges that fill no square."""
        wide = self.bin * self.window
        return self.frame[0] % wide, self.frame[1] % wide

    def centers(self, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns at the middle of squares of that width, each along one axis."""
        whole = [n * self.bin * self.window for n in self.counts]
        rows, columns = (np.arange(0, n, width) + 0.5 * (width - 1) for n in whole)
        return rows, columns

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Averages of (..., row, column) over the squares."""
        return self._cut(values).mean(axis=(-3, -1))

    def any(self, values: np.ndarray) -> np.ndarray:
        """True where one of a square is."""
        return self._cut(values).any(axis=(-3, -1))

    def views(self, values: np.ndarray) -> np.ndarray:
        """Averages (row, column) as (y, x, view)."""
        (rows, columns), w = self.counts, self.window
        cut = values.reshape(rows, w, columns, w).transpose(0, 2, 1, 3)
        return cut.reshape(rows, columns, w * w)

    def _cut(self, values: np.ndarray) -> np.ndarray:
        rows, columns = (n * self.window for n in self.counts)
        kept = values[..., : rows * self.bin, : columns * self.bin]
        return kept.reshape(*values.shape[:-2], rows, self.bin, columns, self.bin)


def squares_of(frame: tuple[int, ...], bin_: object, window: object) -> Squares:
    """How a frame is cut."""
    for name, value in (("bin", bin_), ("window", window)):
        if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
            hint = "give a whole number of 1 or more"
            raise CaptureError(f"it is {value!r}", where=name, hint=hint)
    squares = Squares((frame[0], frame[1]), int(bin_), int(window))  # type: ignore[call-overload]
    if min(squares.counts) < 1:
        raise CaptureError(
            f"frames of {frame[0]} rows and {frame[1]} columns hold no square of "
            f"{squares.bin * squares.window} pixels",
            where="bin, window",
            hint="give smaller ones",
        )
    return squares


# --- A picture of polarized light as a capture, in the plane of each piece of surface -------------


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
            hint="check shape, light and exposure, or average more pixels (bin)",
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
        hint = "give row and column of the highlight, row first, in pixels of the frame"
        raise CaptureError("there is no surface", where=repr(highlight), hint=hint)
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


# --- Frames behind a polarizer that stands at three or more angles, as a capture ------------------


POLARIZER = "polarizer"
FACING = Direction(0.0, 0.0, 1.0)
"""A camera that is far away."""


def from_polarizer(
    frames: Sequence[Frame],
    angles: ArrayLike,
    *,
    shape: AbstractShape | Sphere | Sequence[Sphere] | Any,
    light: AbstractPlace | Highlight | Surroundings | Sequence[float],
    view: AbstractPlace | Sequence[float] = FACING,
    detector: Detector | None = None,
    bin: int = 1,
    window: int = 2,
    wavelength: float | None = None,
    name: str | None = None,
) -> xr.Dataset:
    """A capture from frames of a camera behind a linear polarizer.

    Axes of the camera: x to the right, y up, z from the scene to the camera; rows and columns of a
    frame count from zero at its upper left pixel.

    Args:
        frames: One for each angle: PNG, TIFF or .npy files, or arrays of shape (row, column), in
            counts that grow in proportion to light.
        angles: Of the polarizer's axis (that of the light that passes), from x counterclockwise as
            the camera sees it, degree. Three different ones or more, shape (frame,).
        shape: Where the surface points: a `Sphere`, several, or unit normals of shape
            (row, column, 3), NaN where there is no surface, also in a .npy file.
        light: Where the light stands: `Direction`, `Position`, `Highlight`, or `Surroundings`.
        view: Where the camera stands: `Direction`, or `Position(0, 0, f)` for a focal length of f
            pixels.
        detector: How counts become light, and their noise.
        bin: Width of the squares of pixels that are averaged into one reading.
        window: Readings along each side of a pixel of the capture: window^2 views.
        wavelength: In nm, > 0.
        name: Of the capture; by default that of the first file.

    Returns:
        The validated capture with dims (y, x, view): dop, q, u, intensity and their errors, in the
        plane of each piece of surface; `saturated` and `valid`. Its attributes say what was used,
        and how many readings are masked for which reason.

    Raises:
        CaptureError: A frame, an angle, a place or an option is wrong, or no reading is left.
    """
    detector = Detector() if detector is None else detector
    degrees = check_angles(angles)
    if isinstance(frames, str) or not hasattr(frames, "__len__"):
        hint = "give a list of frames, one for each angle"
        raise CaptureError(f"a {type(frames).__name__} is no list", where="frames", hint=hint)
    if len(frames) != len(degrees):
        what = f"there are {len(frames)} frames and {len(degrees)} angles"
        raise CaptureError(what, where="frames", hint="give one frame for each angle")
    read = [read_frame(frame, f"frames[{k}]") for k, frame in enumerate(frames)]
    raw, levels = [values for values, _ in read], [level for _, level in read]
    for k, values in enumerate(raw):
        if values.shape != raw[0].shape:
            what = f"it is {values.shape}, the first {raw[0].shape}"
            hint = "give frames of one size"
            raise CaptureError(what, where=f"frames[{k}]", hint=hint)
    squares = squares_of(raw[0].shape, bin, window)
    setting = setting_of(shape, view, light, raw[0].shape)
    signal = signal_of(raw, None if None in levels else levels[0], detector)
    files = [os_name(frame) for frame in frames if not hasattr(frame, "shape")]
    capture = picture_capture(
        squares.mean(signal.light),
        squares.mean(signal.variance) / squares.bin**2,
        squares.any(signal.saturated).any(axis=0),
        signal,
        degrees,
        squares,
        setting,
        {
            "name": name or (files[0].rsplit(".", 1)[0] if files else POLARIZER),
            "source": ", ".join(files) or "arrays",
        },
    )
    return with_wavelength(capture, wavelength)


def with_wavelength(capture: xr.Dataset, wavelength: float | None) -> xr.Dataset:
    """The capture with its one color stated, where it is known."""
    if wavelength is None:
        return capture
    nanometers = check_number("wavelength", wavelength, POSITIVE)
    return validate(capture.assign_coords(wavelength=nanometers))


# --- One frame of a sensor with a polarizer on each pixel (division of focal plane), as a capture


MOSAIC = "mosaic"
SONY = ((90.0, 45.0), (135.0, 0.0))
"""Angles of the four pixels of IMX250MZR and its relatives."""

AT = ((1, 1), (0, 1), (0, 0), (1, 0))
"""Row and column of the pixels that polanalyser takes for 0, 45, 90 and 135 degrees."""

DEEPEST = 65535.0


def from_mosaic(
    frame: Frame,
    *,
    shape: AbstractShape | Sphere | Sequence[Sphere] | Any,
    light: AbstractPlace | Highlight | Surroundings | Sequence[float],
    view: AbstractPlace | Sequence[float] = FACING,
    layout: ArrayLike = SONY,
    detector: Detector | None = None,
    bin: int = 2,
    window: int = 2,
    wavelength: float | None = None,
    name: str | None = None,
) -> xr.Dataset:
    """A capture from one frame of a polarization camera without color.

    Args:
        frame: A PNG, TIFF or .npy file, or an array of shape (row, column): raw counts, with an
            even number of rows and columns.
        shape: See `polar_bayes.from_polarizer`; the arguments that are not explained here too.
        light: Where the light stands.
        view: Where the camera stands.
        layout: Angle of the polarizer of each of the four pixels, two rows of two, in degrees from
            x counterclockwise as the camera sees it.
        detector: How counts become light, and their noise.
        bin: Width of the squares of pixels that are averaged into one reading; even.
        window: Readings along each side of a pixel of the capture: window^2 views.
        wavelength: In nm, > 0.
        name: Of the capture; by default that of the file.

    Returns:
        As `polar_bayes.from_polarizer` does.

    Raises:
        CaptureError: polanalyser is not installed, the frame, a place or an option is wrong, or no
            reading is left.
    """
    polanalyser = _polanalyser()
    detector = Detector() if detector is None else detector
    angles = _angles(layout)
    counts, level = read_frame(frame, "frame")
    if counts.shape[0] % 2 or counts.shape[1] % 2:
        hint = "give the frame as the sensor has it, from its first row and column"
        raise CaptureError(f"it is {counts.shape}, not even", where="frame", hint=hint)
    squares = squares_of(counts.shape, bin, window)
    if squares.bin % 2:
        hint = "give an even number: each square holds all four polarizers"
        raise CaptureError(f"it is {bin}", where="bin", hint=hint)
    setting = setting_of(shape, view, light, counts.shape)
    signal = signal_of([counts], level, detector)
    # A full pixel spreads to the neighbors that are filled in from it.
    stopped = binary_dilation(signal.saturated[0], np.ones((3, 3), bool))
    file = None if hasattr(frame, "shape") else os_name(frame)
    capture = picture_capture(
        squares.mean(_demosaiced(polanalyser, signal.light[0])),
        _variance(signal.variance[0], squares),
        squares.any(stopped),
        signal,
        angles,
        squares,
        setting,
        {
            "name": name or (file.rsplit(".", 1)[0] if file else MOSAIC),
            "source": file or "array",
            "demosaicing": f"polanalyser {importlib.metadata.version('polanalyser')}, bilinear",
        },
    )
    return with_wavelength(capture, wavelength)


def _demosaiced(polanalyser: ModuleType, light: np.ndarray) -> np.ndarray:
    """Light at each angle in every pixel, (angle, row, column)."""
    # The library works on whole numbers up to 65535 and cuts off what lies outside. Filling in is
    # linear, so the frame is shifted and stretched to just that range and back: dark pixels whose
    # noise lies below zero stay what they are.
    low, high = float(light.min()), float(light.max())
    step = (high - low) / DEEPEST if high > low else 1.0
    whole = np.rint((light - low) / step).astype(np.uint16)
    return np.stack(polanalyser.demosaicing(whole)).astype(np.float64) * step + low


def _variance(variance: np.ndarray, squares: Squares) -> np.ndarray:
    """Of the average of each angle over each square, (angle, row, column)."""
    b = squares.bin
    left = ((2.0 * b - 1.5) / b**2) ** 2
    half = Squares((squares.frame[0] // 2, squares.frame[1] // 2), b // 2, squares.window)
    return left * np.stack([half.mean(variance[row::2, column::2]) for row, column in AT])


def _angles(layout: ArrayLike) -> np.ndarray:
    try:
        four = np.asarray(layout, dtype=np.float64)
    except (TypeError, ValueError):
        four = np.full(0, np.nan)
    if four.shape != (2, 2):
        hint = "give two rows of two angles, such as ((90, 45), (135, 0))"
        raise CaptureError(f"it is {layout!r}", where="layout", hint=hint)
    return check_angles([four[row, column] for row, column in AT])


def _polanalyser() -> ModuleType:
    try:
        return importlib.import_module("polanalyser")
    except ImportError as error:
        raise CaptureError(
            f"the library for mosaics of polarizers is not installed ({error.name})",
            where=MOSAIC,
            hint="pip install 'polar_bayes[camera]'",
        ) from error
