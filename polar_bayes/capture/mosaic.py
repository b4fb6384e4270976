r"""One frame of a sensor with a polarizer on each pixel (division of focal plane), as a capture.

Four neighboring pixels stand behind four polarizers. polanalyser fills in for each angle what the
pixels of the other angles would have read, from their neighbors (bilinear). The values of one
angle are then no longer independent, so what matters is how much noise is left in the average over
a square of b x b pixels: along each axis a pixel inside counts 2, one on the border 3/2, and one
beyond it 1/2, of b in all, so that

$$ \sigma^2_{mean} = \Big(\frac{2b - 3/2}{b^2}\Big)^2 \sigma^2 $$

for even b. (Averages of pixels that were read alone would have 4/b^2.)
"""

import importlib
import importlib.metadata
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.ndimage import binary_dilation

from polar_bayes.capture.detector import Detector, os_name, signal_of
from polar_bayes.capture.frames import Frame, read_frame
from polar_bayes.capture.picture import picture_capture, setting_of
from polar_bayes.capture.places import AbstractPlace, Highlight, Surroundings
from polar_bayes.capture.polarizer import FACING, with_wavelength
from polar_bayes.capture.shapes import AbstractShape, Sphere
from polar_bayes.capture.squares import Squares, squares_of
from polar_bayes.capture.stokes import check_angles
from polar_bayes.errors import CaptureError

WHERE = "mosaic"
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
        mend = "give the frame as the sensor has it, from its first row and column"
        raise CaptureError(f"it is {counts.shape}, not even", where="frame", mend=mend)
    squares = squares_of(counts.shape, bin, window)
    if squares.bin % 2:
        mend = "give an even number: each square holds all four polarizers"
        raise CaptureError(f"it is {bin}", where="bin", mend=mend)
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
            "name": name or (file.rsplit(".", 1)[0] if file else WHERE),
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
        mend = "give two rows of two angles, such as ((90, 45), (135, 0))"
        raise CaptureError(f"it is {layout!r}", where="layout", mend=mend)
    return check_angles([four[row, column] for row, column in AT])


def _polanalyser() -> ModuleType:
    try:
        return importlib.import_module("polanalyser")
    except ImportError as error:
        raise CaptureError(
            f"the library for mosaics of polarizers is not installed ({error.name})",
            where=WHERE,
            mend="pip install 'polar_bayes[camera]'",
        ) from error
