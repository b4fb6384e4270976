r"""What a camera does to light, and how well each of its numbers is known.

A raw count R of a pixel with dark count D and relative sensitivity F (the flat field, of mean 1)
stands for the signal and has the variance

$$ s = (R - D)/F, \qquad
   \sigma^2 = \frac{\sigma_r^2 + 1/12 + g \max(s F, 0)}{F^2 N} + (\epsilon s)^2 $$

with read noise $\sigma_r$ (counts), rounding to whole counts, photon noise of gain g (counts per
electron), and N pixels averaged. What averaging does not reduce is $\epsilon$: analyzers that do
not pass alike, light that flickers, a flat field of yesterday.

PNG and TIFF files go through Pillow, which every plotting library brings along; .npy files hold
what a script saved. A frame in color is refused: its channels would have to be told apart first.
"""

import dataclasses
import os
import warnings
from numbers import Real
from typing import Any

import numpy as np
from PIL import Image

from polar_bayes.capture.schema import Interval
from polar_bayes.errors import CaptureError
from polar_bayes.paths import existing_file

# --- Frames of a camera as arrays of numbers, from files or from memory; nothing is guessed -------


Frame = str | os.PathLike[str] | np.ndarray

FORMATS = ("PNG", "TIFF")
"""Of image files, those that keep counts as they are."""

GRAY_MODES = ("L", "I;16", "I;16L", "I;16B", "I", "F")
LARGEST_COUNT = 1e9


def read_frame(frame: Any, where: str) -> tuple[np.ndarray, float | None]:
    """One frame of gray values."""
    values = _array(frame, where)
    if values.dtype.kind not in "uif" or values.ndim != 2 or values.size == 0:
        raise CaptureError(
            f"it holds {values.dtype.name} of shape {values.shape}, not one frame of gray values",
            where=_place(frame, where),
            hint="give rows and columns of numbers; of a color frame, one channel",
        )
    counts = values.astype(np.float64)
    if not np.isfinite(counts).all() or np.abs(counts).max() > LARGEST_COUNT:
        row, column = np.argwhere(~(np.abs(counts) <= LARGEST_COUNT))[0]
        raise CaptureError(
            f"{counts[row, column]:g} is no reading",
            where=f"{_place(frame, where)}[row={row}, column={column}]",
            hint=f"give finite counts up to {LARGEST_COUNT:g}",
        )
    return counts, 255.0 if values.dtype == np.uint8 else None


def read_array(path: str | os.PathLike[str], where: str) -> np.ndarray:
    """The array of a .npy file."""
    file = existing_file(path, where)
    hint = "save one array with numpy.save"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what old versions of NumPy wrote can still be read
            # Mapped, so that a header that declares terabytes is compared with the file first.
            mapped = np.load(file, mmap_mode="r", allow_pickle=False)
        if isinstance(mapped, np.memmap):
            if mapped.offset + mapped.nbytes != file.stat().st_size:
                what = f"its header says {mapped.nbytes} bytes of numbers, and it holds others"
                raise CaptureError(what, where=str(file), hint=hint)
            return np.array(mapped)
        mapped.close()  # a .npz archive
    except CaptureError:
        raise
    except Exception as error:  # NumPy raises nearly every type for a broken header
        raise CaptureError("it cannot be read as .npy", where=str(file), hint=hint) from error
    raise CaptureError("it holds several arrays", where=str(file), hint=hint)


def _array(frame: Any, where: str) -> np.ndarray:
    if not isinstance(frame, str | os.PathLike):
        return np.asarray(frame)
    file = existing_file(frame, where)
    if file.suffix == ".npy":
        return read_array(file, where)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(file, formats=FORMATS) as image:
                if image.mode not in GRAY_MODES:
                    what = f"its pixels are {image.mode}, not gray values"
                    hint = "save it with 8 or 16 bits of gray, or give one channel as .npy"
                    raise CaptureError(what, where=str(file), hint=hint)
                if (pages := getattr(image, "n_frames", 1)) > 1:
                    hint = "save each page as a file of its own"
                    raise CaptureError(f"it holds {pages} frames", where=str(file), hint=hint)
                return np.asarray(image)
    except CaptureError:
        raise
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        hint = "cut it to what matters, or give it as .npy"
        raise CaptureError("it is larger than any camera", where=str(file), hint=hint) from error
    except Exception as error:  # Pillow raises many types for a broken file
        hint = "give PNG, TIFF or .npy"
        raise CaptureError("it cannot be read as an image", where=str(file), hint=hint) from error


def _place(frame: Any, where: str) -> str:
    return str(frame) if isinstance(frame, str | os.PathLike) else where


# --- What a camera does to light, and how well each of its numbers is known -----------------------


FULL_WELL = 10_000.0
"""Electrons that fill a pixel of a machine-vision sensor, where the gain is not stated."""

ROUNDING = 1.0 / 12.0
DARKEST_FLAT = 0.05

POSITIVE = Interval(0.0, 1e9, open_low=True)
NOISE = Interval(0.0, 1e9)
FRACTION = Interval(0.0, 1.0, open_high=True)


@dataclasses.dataclass(frozen=True, eq=False)
class Detector:
    """How counts become light, and their noise.

    Args:
        saturation_level: Count at which a pixel is full, > 0; it may be left out for 8-bit frames,
            which are full at 255.
        dark: A frame without light, to be taken off: the mean of several, so that its own noise is
            small. A number is the same for all pixels.
        flat: A frame of even unpolarized light, already less its dark frame: the sensitivity of
            each pixel; its scale does not matter.
        gain: Counts per electron, > 0; by default the saturation level over 10,000 electrons.
        read_noise: Standard deviation of a pixel without light, in counts, >= 0.
        relative_error: What stays unknown of every reading however many pixels are averaged, over
            the reading, in [0, 1).

    Raises:
        CaptureError: A number is outside its range.
    """

    saturation_level: float | None = None
    dark: Frame | float = 0.0
    flat: Frame | None = None
    gain: float | None = None
    read_noise: float = 1.0
    relative_error: float = 0.01

    def __post_init__(self) -> None:
        for name, allowed, optional in (
            ("saturation_level", POSITIVE, True),
            ("gain", POSITIVE, True),
            ("read_noise", NOISE, False),
            ("relative_error", FRACTION, False),
        ):
            value = getattr(self, name)
            if not (optional and value is None):
                check_number(name, value, allowed)


@dataclasses.dataclass(frozen=True, eq=False)
class Signal:
    """Frames with dark and flat field taken out."""

    light: np.ndarray
    variance: np.ndarray
    saturated: np.ndarray
    full_scale: float
    said: dict[str, str | float]


def signal_of(frames: list[np.ndarray], level: float | None, detector: Detector) -> Signal:
    """Light from raw frames."""
    full = detector.saturation_level if detector.saturation_level is not None else level
    if full is None:
        raise CaptureError(
            "the frames do not say at which count a pixel is full",
            where="saturation_level",
            hint="give it: 4095 for 12 bits, 65535 for 16 bits",
        )
    raw = np.stack(frames)
    shape = raw.shape[1:]
    dark = _dark(detector.dark, shape)
    flat = _flat(detector.flat, shape)
    if not (dark < full).all():
        hint = "check it and the saturation level"
        raise CaptureError(f"it reaches the full count {full:g}", where="dark", hint=hint)
    gain = full / FULL_WELL if detector.gain is None else float(detector.gain)
    counts = raw - dark
    variance = detector.read_noise**2 + ROUNDING + gain * np.maximum(counts, 0.0)
    said: dict[str, str | float] = {
        "saturation_level": float(full),
        "dark": _said(detector.dark),
        "flat": _said(detector.flat),
        "gain": gain,
        "gain_is": "assumed" if detector.gain is None else "given",
        "read_noise": float(detector.read_noise),
        "relative_error": float(detector.relative_error),
    }
    return Signal(
        light=counts / flat,
        variance=variance / flat**2,
        saturated=raw >= full,
        full_scale=float(np.max((full - dark) / flat)),
        said=said,
    )


def check_number(name: str, value: Any, allowed: Interval) -> float:
    """A number given by the user."""
    if isinstance(value, Real) and not isinstance(value, bool) and allowed.contains(value):
        return float(value)
    raise CaptureError(f"it is {value!r}", where=name, hint=f"give {allowed}")


def _dark(dark: Frame | float, shape: tuple[int, ...]) -> np.ndarray:
    if isinstance(dark, Real):
        return np.full(shape, check_number("dark", dark, Interval(-1e9, 1e9)))
    return _matching(read_frame(dark, "dark")[0], shape, "dark")


def _flat(flat: Frame | None, shape: tuple[int, ...]) -> np.ndarray:
    if flat is None:
        return np.ones(shape)
    values = _matching(read_frame(flat, "flat")[0], shape, "flat")
    mean = float(values.mean())
    if not mean > 0.0 or not (values > DARKEST_FLAT * mean).all():
        row, column = np.unravel_index(np.argmin(values), shape)
        raise CaptureError(
            f"{values[row, column]:g} is less than a twentieth of its mean {mean:g}",
            where=f"flat[row={row}, column={column}]",
            hint="take it less its dark frame, of even light; mend dead pixels",
        )
    return values / mean


def _matching(values: np.ndarray, shape: tuple[int, ...], where: str) -> np.ndarray:
    if values.shape == shape:
        return values
    hint = "take it with the same camera at the same size"
    raise CaptureError(f"it is {values.shape}, the frames are {shape}", where=where, hint=hint)


def _said(frame: Frame | float | None) -> str | float:
    if frame is None:
        return "none"
    if isinstance(frame, Real):
        return float(frame)
    return "array" if isinstance(frame, np.ndarray) else os_name(frame)


def os_name(path: Any) -> str:
    """The last part of a path, which says what was read without saying on whose machine."""
    return str(path).replace("\\", "/").rstrip("/").split("/")[-1]
