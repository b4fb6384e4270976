r"""Captures from camera frames of polarized light, by the local plane of incidence.

A reading that cannot be used stays, marked valid=False, and is counted under one reason, the first
that applies: outside the surface, turned away from the camera, in its own shadow (cast shadows are
not known), saturated, too dark, overpolarized.

Blocks of `bin` x `bin` pixels are averaged into one reading. Blocks of `window` x `window` readings
make one pixel of the capture: they are the views of one material, each with the directions at its
own position. One frame shows each point from one side only, and a fit needs two views; a curved
surface has them next to each other.

`polar_bayes.importers.stokes` explains how frames at several angles of a polarizer become Stokes
parameters, and `polar_bayes.importers.detector` what noise they have.

In a mosaic, four neighboring pixels lie behind four polarizers. polanalyser interpolates for each
angle what the pixels of the other angles would have read, bilinearly from their neighbors. The
values of one angle are then no longer independent. In the average over a block of b x b pixels, a
pixel inside counts 2 along each axis, one on the border 3/2, and one beyond it 1/2, of b in all, so
the average has the variance

$$ \sigma^2_{mean} = \Big(\frac{2b - 3/2}{b^2}\Big)^2 \sigma^2 $$

for even b. (Averages of pixels that were read independently would have 4/b^2.)

A color mosaic repeats such squares of four behind the colors of a Bayer pattern, red at the upper
left. polanalyser fills in colors first, then angles; the share of each pixel in the average over a
block is measured, by a frame in which that pixel alone is bright. The colors become wavelengths.
"""

import dataclasses
import importlib
import importlib.metadata
from collections.abc import Sequence
from numbers import Integral
from types import ModuleType

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.ndimage import binary_dilation

from polar_bayes.capture.schema import EXCESS_POLARIZATION, POSITIVE, as_numbers, validate
from polar_bayes.errors import CaptureError
from polar_bayes.importers.camera_geometry import (
    AbstractLocation,
    Direction,
    Highlight,
    LocalGeometry,
    Surroundings,
    as_location,
    local_geometry,
    mirror_direction,
)
from polar_bayes.importers.detector import Detector, Frame, Signal, os_name, read_frame, signal_of
from polar_bayes.importers.linearity import restoring_exponent
from polar_bayes.importers.normals import AbstractShape, ShapeLike, as_shape
from polar_bayes.importers.stokes import StokesImage, check_angles, fit_stokes, unbiased_dop

# --- Binning --------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Binning:
    """Averages of `bin` x `bin` pixels in blocks, and of `window` x `window` blocks in pixels."""

    frame: tuple[int, int]
    bin: int
    window: int

    def __post_init__(self) -> None:
        for name, value in (("bin", self.bin), ("window", self.window)):
            if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
                hint = "give a whole number of 1 or more"
                raise CaptureError(f"it is {value!r}", where=name, hint=hint)
        if min(self.shape) < 1:
            frames = f"frames of {self.frame[0]} rows and {self.frame[1]} columns"
            what = f"{frames} hold no square of {self.width} pixels"
            raise CaptureError(what, where="bin= and window=", hint="give smaller ones")

    @property
    def width(self) -> int:
        """Width of a pixel of the capture in pixels of the frame."""
        return self.bin * self.window

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of the capture; the rest at the far edges is unused."""
        return self.frame[0] // self.width, self.frame[1] // self.width

    def centers(self, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns at the centers of blocks of that width."""
        ends = (n * self.width for n in self.shape)
        rows, columns = (np.arange(0, end, width) + 0.5 * (width - 1) for end in ends)
        return rows, columns

    def blocks(self, values: np.ndarray) -> np.ndarray:
        """Reshape values (..., row, column) to (..., row, column, pixel of the block)."""
        rows, columns = (n * self.window for n in self.shape)
        used = values[..., : rows * self.bin, : columns * self.bin]
        return used.reshape(*values.shape[:-2], rows, self.bin, columns, self.bin)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Average values (..., row, column) over the blocks."""
        return self.blocks(values).mean(axis=(-3, -1))

    def any(self, values: np.ndarray) -> np.ndarray:
        """Return True for blocks in which any value is true."""
        return self.blocks(values).any(axis=(-3, -1))

    def views(self, values: np.ndarray) -> np.ndarray:
        """Reshape readings (row, column) to (y, x, view)."""
        (rows, columns), w = self.shape, self.window
        windows = values.reshape(rows, w, columns, w).transpose(0, 2, 1, 3)
        return windows.reshape(rows, columns, w * w)


# --- A capture from binned readings behind a polarizer --------------------------------------------


FACING = Direction(0.0, 0.0, 1.0)
"""View from a distant camera, along the axis of the frame."""


def _locate(
    shape: object, view: object, light: object, binning: Binning
) -> tuple[LocalGeometry, dict[str, str]]:
    """Return directions at every reading, and attributes of surface, view and light."""
    surface, view = as_shape(shape), as_location(view, "view")
    surface.check(binning.frame)
    rows, columns = np.meshgrid(*binning.centers(binning.bin), indexing="ij")
    normals = surface.normals(rows, columns, binning.bin)
    points = _points(rows, columns, binning.frame)
    to_view = view.towards(points)
    if isinstance(light, Surroundings):
        description, to_light = repr(light), mirror_direction(normals, to_view)
    elif isinstance(light, Highlight):
        direction = _light_of_highlight(light, surface, view, binning.frame)
        description, to_light = f"{light!r}: {direction!r}", direction.towards(points)
    else:
        location = as_location(light, "light")
        description, to_light = repr(location), location.towards(points)
    attributes = {"surface": surface.description, "view": repr(view), "light": description}
    return local_geometry(normals, to_view, to_light), attributes


def _light_of_highlight(
    highlight: Highlight, surface: AbstractShape, view: AbstractLocation, frame: tuple[int, int]
) -> Direction:
    """Return the direction of distant light from the place of its mirror image."""
    row, column = np.array([highlight.row]), np.array([highlight.column])
    inside = highlight.row <= frame[0] - 1 and highlight.column <= frame[1] - 1
    normal = surface.normals(row, column, 1)[0] if inside else np.full(3, np.nan)
    if not np.isfinite(normal).all():
        hint = "give row and column of the highlight, row first, in pixels of the frame"
        raise CaptureError("there is no surface", where=repr(highlight), hint=hint)
    to_view = view.towards(_points(row, column, frame))[0]
    return Direction(*mirror_direction(normal, to_view).tolist())


def _points(rows: np.ndarray, columns: np.ndarray, frame: tuple[int, int]) -> np.ndarray:
    """Return points of the frame in the camera's axes, on the plane z = 0."""
    x, y = columns - 0.5 * (frame[1] - 1), 0.5 * (frame[0] - 1) - rows
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def _capture(
    light: np.ndarray,
    variance: np.ndarray,
    saturated: np.ndarray,
    angles: np.ndarray,
    *,
    binning: Binning,
    geometry: LocalGeometry,
    signal: Signal,
    attributes: dict[str, str],
    wavelength: float | None,
) -> xr.Dataset:
    """Make a capture from binned light (angle, row, column), its variance, and flags."""
    relative = float(signal.metadata["relative_error"])
    stokes = fit_stokes(light, variance + (relative * light) ** 2, angles)
    stokes = stokes.rotated(geometry.cos_twice, geometry.sin_twice)
    dop, dop_error = unbiased_dop(stokes)
    reasons = _reasons_to_mask(stokes, geometry, saturated)
    valid = ~np.logical_or.reduce(list(reasons.values()))
    if not valid.any():
        counts = ", ".join(f"{int(w.sum())} {r}" for r, w in reasons.items() if w.any())
        what = f"no reading is left ({counts})".replace("_", " ")
        hint = "check shape, light and exposure, or average more pixels by bin="
        raise CaptureError(what, where=attributes["name"], hint=hint)
    readings = {
        "dop": np.clip(dop, 0.0, 1.0),  # noise alone may carry it past one; such bins are counted
        "q": stokes.q,
        "u": stokes.u,
        "intensity": stokes.intensity,
        "dop_error": dop_error,
        "q_error": np.sqrt(stokes.q_variance),
        "u_error": np.sqrt(stokes.u_variance),
        "intensity_error": np.sqrt(stokes.intensity_variance),
    }
    directions = ("view_zenith", "view_azimuth", "light_zenith", "light_azimuth")
    variables = {
        **{name: getattr(geometry, name) for name in directions},
        **{name: np.where(valid, values, np.nan) for name, values in readings.items()},
        "saturated": saturated,
        "valid": valid,
    }
    misfit = stokes.misfit
    bright = stokes.intensity > 10.0 * np.sqrt(stokes.intensity_variance)
    described = attributes | {
        "setup": "picture",
        "errors": "by the import's model of the sensor",
        "analyzer_angles": ", ".join(f"{angle:g}" for angle in angles),
        "bin": binning.bin,
        "window": binning.window,
        "left_over_rows": binning.frame[0] % binning.width,
        "left_over_columns": binning.frame[1] % binning.width,
        **signal.metadata,
        **{f"masked_{reason}": int(where.sum()) for reason, where in reasons.items()},
        "largest_correlation_of_q_and_u": float(np.abs(stokes.correlation[valid]).max()),
        **({} if misfit is None else {"median_misfit": float(np.median(misfit[valid]))}),
        "dop_at_one": int((valid & (dop > 1.0)).sum()),
        **_measured_gamma(light, variance, angles, bright & ~saturated, signal),
    }
    rows, columns = binning.centers(binning.width)
    capture = xr.Dataset(
        {name: (("y", "x", "view"), binning.views(x)) for name, x in variables.items()},
        {"y": rows, "x": columns},
        described,
    )
    capture["intensity"].attrs = {"units": "counts", "saturation_level": signal.full_scale}
    capture["intensity_error"].attrs = {"units": "counts"}
    if wavelength is not None:
        capture = capture.assign_coords(wavelength=POSITIVE.check(wavelength, "wavelength"))
    return validate(capture, source=attributes["name"])


def _measured_gamma(
    light: np.ndarray, variance: np.ndarray, angles: np.ndarray, used: np.ndarray, signal: Signal
) -> dict[str, float]:
    """Estimate the gamma of the files from redundant angles, as attributes."""
    # Noise is to be small, and the shape of the light is to stay.
    coarse, metadata = Binning(used.shape, max(1, min(used.shape) // 32), 1), signal.metadata
    noise, used = coarse.mean(variance) / coarse.bin**2, ~coarse.any(~used)
    error, undone = float(metadata["relative_error"]), float(metadata["transfer_gamma"])
    found = restoring_exponent(coarse.mean(light), noise, error, angles, used)
    names = "measured_gamma", "measured_gamma_error"
    return {name: undone * value for name, value in zip(names, found or (), strict=False)}


def _reasons_to_mask(
    stokes: StokesImage, geometry: LocalGeometry, saturated: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the readings that cannot be used, each under its first reason."""
    with np.errstate(invalid="ignore"):
        # In darker light a quotient is no longer normal.
        dark = ~(stokes.intensity > 10.0 * np.sqrt(stokes.intensity_variance))
        squared = stokes.q**2 + stokes.u**2
        largest = np.maximum(np.abs(stokes.q), np.abs(stokes.u))
        overpolarized = ~(squared <= 1.0 + EXCESS_POLARIZATION) | ~(largest <= 1.0)
    reasons = {
        "outside": geometry.outside,
        "turned_away": geometry.turned_away,
        "in_shadow": geometry.in_shadow,
        "saturated": saturated,
        "too_dark": dark,
        "overpolarized": overpolarized,
    }
    masked = np.zeros_like(saturated)
    for reason, where in reasons.items():
        reasons[reason] = where & ~masked
        masked = masked | where
    return reasons


def _names(frames: Sequence[Frame], name: str | None, default: str) -> dict[str, str]:
    """Return the attributes `name` and `source` of a capture."""
    files = [os_name(frame) for frame in frames if not isinstance(frame, np.ndarray)]
    stem = files[0].rsplit(".", 1)[0] if files else default
    return {"name": name or stem, "source": ", ".join(files) or "arrays"}


# --- Frames behind a polarizer at three or more angles --------------------------------------------


def from_polarizer(
    frames: Sequence[Frame],
    angles: ArrayLike,
    *,
    shape: ShapeLike,
    light: AbstractLocation | Highlight | Surroundings | Sequence[float],
    view: AbstractLocation | Sequence[float] = FACING,
    detector: Detector | None = None,
    bin: int = 1,
    window: int = 2,
    wavelength: float | None = None,
    name: str | None = None,
) -> xr.Dataset:
    """Make a capture from frames of a camera behind a linear polarizer.

    Axes of the camera: x to the right, y up, z from the scene to the camera; rows and columns of a
    frame count from zero at its upper left pixel.

    Args:
        frames: One for each angle: PNG, TIFF, JPEG or .npy files, or arrays of shape (row, column),
            in counts that grow in proportion to light, or with a `Detector.transfer`.
        angles: Of the polarizer's axis (that of the light that passes), from x counterclockwise as
            the camera sees it, degree. Three different ones or more, shape (frame,).
        shape: Where the surface points: a `Sphere`, several, or unit normals of shape
            (row, column, 3), NaN where there is no surface, also in a .npy file.
        light: Location of the light: `Direction`, `Position`, `Highlight`, or `Surroundings`.
        view: Location of the camera: `Direction`, or `Position(0, 0, f)` for a focal length of f
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
    degrees, detector = check_angles(angles), detector or Detector()
    if isinstance(frames, str) or not hasattr(frames, "__len__"):
        hint = "give a list of frames, one for each angle"
        raise CaptureError(f"a {type(frames).__name__} is no list", where="frames", hint=hint)
    if len(frames) != len(degrees):
        what = f"there are {len(frames)} frames and {len(degrees)} angles"
        raise CaptureError(what, where="frames", hint="give one frame for each angle")
    raw, levels = zip(
        *(read_frame(each, f"frames[{k}]", detector.transfer) for k, each in enumerate(frames)),
        strict=True,
    )
    for k, values in enumerate(raw):
        if values.shape != raw[0].shape:
            what = f"it is {values.shape}, the first {raw[0].shape}"
            hint = "give frames of one size"
            raise CaptureError(what, where=f"frames[{k}]", hint=hint)
    binning = Binning(raw[0].shape, bin, window)
    geometry, placement = _locate(shape, view, light, binning)
    signal = signal_of(raw, None if None in levels else levels[0], detector)
    return _capture(
        binning.mean(signal.light),
        binning.mean(signal.variance) / binning.bin**2,
        binning.any(signal.saturated).any(axis=0),
        degrees,
        binning=binning,
        geometry=geometry,
        signal=signal,
        attributes=_names(frames, name, "polarizer") | placement,
        wavelength=wavelength,
    )


# --- One frame of a sensor with a polarizer on each pixel (division of focal plane) ---------------


SONY = ((90.0, 45.0), (135.0, 0.0))
"""Polarizer angles of the four pixels of IMX250MZR and related sensors."""

AT = ((1, 1), (0, 1), (0, 0), (1, 0))
"""Row and column of the pixels that polanalyser assigns to 0, 45, 90 and 135 degrees."""


REACH = 4
"""Largest distance, in pixels, over which polanalyser interpolates a color mosaic."""


def from_mosaic(
    frame: Frame,
    *,
    shape: ShapeLike,
    light: AbstractLocation | Highlight | Surroundings | Sequence[float],
    view: AbstractLocation | Sequence[float] = FACING,
    layout: ArrayLike = SONY,
    color: Sequence[float] | None = None,
    detector: Detector | None = None,
    bin: int | None = None,
    window: int = 2,
    wavelength: float | None = None,
    name: str | None = None,
) -> xr.Dataset:
    """Make a capture from one raw frame of a polarization camera, monochrome or in color.

    Args:
        frame: A PNG, TIFF, JPEG or .npy file, or an array of shape (row, column): raw counts, with
            an even number of rows and columns; one of a color sensor before any color is filled in.
        shape: See `polar_bayes.from_polarizer`; the arguments that are not explained here too.
        light: Location of the light.
        view: Location of the camera.
        layout: Angle of the polarizer of each of the four pixels, two rows of two, in degrees from
            x counterclockwise as the camera sees it.
        color: Center of the red, green and blue filter, nm, of a color sensor such as IMX250MYR;
            None: monochrome.
        detector: How counts become light, and their noise.
        bin: Width of the squares of pixels that are averaged into one reading; even, by default 2;
            of a color sensor a multiple of 4, by default 4.
        window: Readings along each side of a pixel of the capture: window^2 views.
        wavelength: In nm, > 0.
        name: Of the capture; by default that of the file.

    Returns:
        As `polar_bayes.from_polarizer` does; in color with the dim wavelength, short ones first.

    Raises:
        CaptureError: polanalyser is not installed, the frame, a place or an option is wrong, or no
            reading is left.
    """
    polanalyser = _polanalyser()
    angles, detector = _angles(layout), detector or Detector()
    counts, level = read_frame(frame, "frame", detector.transfer)
    if counts.shape[0] % 2 or counts.shape[1] % 2:
        hint = "give the frame as the sensor has it, from its first row and column"
        raise CaptureError(f"it is {counts.shape}, not even", where="frame", hint=hint)
    period = 2 if color is None else 4
    binning = Binning(counts.shape, period if bin is None else bin, window)
    if binning.bin % period:
        hint = "give an even number: each square holds all four polarizers"
        if color is not None:
            hint = "give a multiple of 4: each square holds all four polarizers of each color"
        raise CaptureError(f"it is {bin}", where="bin", hint=hint)
    centers = _centers(color, wavelength)
    geometry, placement = _locate(shape, view, light, binning)
    signal = signal_of([counts], level, detector)
    version = f"polanalyser {importlib.metadata.version('polanalyser')}, bilinear"
    # A full pixel spreads to the neighbors that are filled in from it.
    spread = np.ones((2 * period - 1,) * 2, bool)
    filled = _demosaiced(polanalyser, signal.light[0], is_color=color is not None)
    captures = [
        _capture(
            binning.mean(filled[..., k]),
            _variance(signal.variance[0], binning)
            if color is None
            else _color_variance(polanalyser, signal.variance[0], binning, k),
            binning.any(binary_dilation(signal.saturated[0], spread)),
            angles,
            binning=binning,
            geometry=geometry,
            signal=signal,
            attributes=_names([frame], name, "mosaic") | placement | {"demosaicing": version},
            wavelength=center,
        )
        for k, center in enumerate(centers)
    ]
    return captures[0] if color is None else _spectral(captures)


def _centers(color: Sequence[float] | None, wavelength: float | None) -> tuple[float | None, ...]:
    """Return the wavelength of each color, blue first."""
    if color is None:
        return (wavelength,)
    if wavelength is not None:
        hint = "leave it out: color= has three"
        raise CaptureError("a color mosaic has no one wavelength", where="wavelength", hint=hint)
    centers = as_numbers(color)
    if centers.shape != (3,) or not (np.diff(centers) < 0.0).all():
        hint = "give the centers of red, green and blue in nm, such as 610 530 460"
        raise CaptureError(f"it is {color!r}", where="color", hint=hint)
    return tuple(centers[::-1].tolist())


def _spectral(captures: Sequence[xr.Dataset]) -> xr.Dataset:
    """Combine the captures of all colors along wavelength, and count masked readings."""
    kept = [name for name in captures[0].data_vars if str(name).endswith(("zenith", "azimuth"))]
    colors = xr.concat([each.drop_vars(kept) for each in captures], "wavelength")
    attributes = {name: x for each in reversed(captures) for name, x in each.attrs.items()}
    for name in attributes:
        of_colors = [each.attrs[name] for each in captures if name in each.attrs]
        if str(name).startswith("masked_") or name == "dop_at_one":
            attributes[name] = sum(map(int, of_colors))
        elif str(name).startswith(("measured_gamma", "median_misfit")):
            attributes[name] = float(np.median(of_colors))  # dark colors may not tell theirs
    merged = xr.merge([captures[0][kept].drop_vars("wavelength"), colors]).assign_attrs(attributes)
    return validate(merged, source=str(attributes["name"]))


def _demosaiced(polanalyser: ModuleType, light: np.ndarray, *, is_color: bool) -> np.ndarray:
    """Return light at each angle in every pixel, (angle, row, column, color), blue first."""
    # The library works on whole numbers up to 65535 and cuts off what lies outside. Filling in is
    # linear, so the frame is shifted and stretched to just that range and back: dark pixels whose
    # noise lies below zero stay what they are.
    low, high = float(light.min()), float(light.max())
    step = (high - low) / 65535.0 if high > low else 1.0
    whole = np.rint((light - low) / step).astype(np.uint16)
    code = polanalyser.COLOR_PolarRGB if is_color else polanalyser.COLOR_PolarMono
    filled = np.stack(polanalyser.demosaicing(whole, code)).astype(np.float64) * step + low
    return filled if is_color else filled[..., None]


def _color_variance(
    polanalyser: ModuleType, variance: np.ndarray, binning: Binning, color: int
) -> np.ndarray:
    """Return variances of angle averages over bins in one color, (angle, row, column)."""
    b, width = binning.bin, binning.bin + 4 * REACH
    block = slice(2 * REACH, 2 * REACH + b)
    square, ours = np.zeros(4), np.zeros((4, width, width), bool)
    for row, column in np.ndindex(width, width):
        bright = np.zeros((width, width))
        bright[row, column] = 1.0
        share = _demosaiced(polanalyser, bright, is_color=True)[:, block, block, color]
        share = share.mean(axis=(1, 2))
        ours[:, row, column] = share > 0.0
        square += share**2
    tiles = tuple(-(-n // b) for n in variance.shape)
    found = []
    for k in range(4):
        mine = np.tile(ours[k, block, block], tiles)[: variance.shape[0], : variance.shape[1]]
        found.append(square[k] * binning.mean(np.where(mine, variance, 0.0)) / mine[:b, :b].mean())
    return np.stack(found)


def _variance(variance: np.ndarray, binning: Binning) -> np.ndarray:
    """Return variances of angle averages over bins, (angle, row, column)."""
    b = binning.bin
    ratio = ((2.0 * b - 1.5) / b**2) ** 2
    half = Binning((binning.frame[0] // 2, binning.frame[1] // 2), b // 2, binning.window)
    return ratio * np.stack([half.mean(variance[row::2, column::2]) for row, column in AT])


def _angles(layout: ArrayLike) -> np.ndarray:
    four = as_numbers(layout)
    if four.shape != (2, 2):
        hint = "give two rows of two angles, such as ((90, 45), (135, 0))"
        raise CaptureError(f"it is {layout!r}", where="layout", hint=hint)
    return check_angles([four[row, column] for row, column in AT])


def _polanalyser() -> ModuleType:
    try:
        return importlib.import_module("polanalyser")
    except ImportError as error:
        what = f"the library for mosaics of polarizers is not installed ({error.name})"
        hint = "pip install 'polar_bayes[camera]'"
        raise CaptureError(what, where="mosaic", hint=hint) from error
