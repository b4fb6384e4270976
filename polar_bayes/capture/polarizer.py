"""Frames behind a polarizer that stands at three or more angles, as a capture.

One frame for each angle, everything else still; `polar_bayes.capture.stokes` tells how they become
Stokes parameters, `polar_bayes.capture.detector` what noise they have, and
`polar_bayes.capture.picture` what becomes of places that say nothing.
"""

from collections.abc import Sequence
from typing import Any

import xarray as xr
from numpy.typing import ArrayLike

from polar_bayes.capture.contract import POSITIVE
from polar_bayes.capture.detector import Detector, check_number, os_name, signal_of
from polar_bayes.capture.frames import Frame, read_frame
from polar_bayes.capture.picture import picture_capture, setting_of
from polar_bayes.capture.places import AbstractPlace, Direction, Highlight, Surroundings
from polar_bayes.capture.schema import validate
from polar_bayes.capture.shapes import AbstractShape, Sphere
from polar_bayes.capture.squares import squares_of
from polar_bayes.capture.stokes import check_angles
from polar_bayes.errors import CaptureError

WHERE = "polarizer"
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
        mend = "give a list of frames, one for each angle"
        raise CaptureError(f"a {type(frames).__name__} is no list", where="frames", mend=mend)
    if len(frames) != len(degrees):
        what = f"there are {len(frames)} frames and {len(degrees)} angles"
        raise CaptureError(what, where="frames", mend="give one frame for each angle")
    read = [read_frame(frame, f"frames[{k}]") for k, frame in enumerate(frames)]
    raw, levels = [values for values, _ in read], [level for _, level in read]
    for k, values in enumerate(raw):
        if values.shape != raw[0].shape:
            what = f"it is {values.shape}, the first {raw[0].shape}"
            mend = "give frames of one size"
            raise CaptureError(what, where=f"frames[{k}]", mend=mend)
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
            "name": name or (files[0].rsplit(".", 1)[0] if files else WHERE),
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
