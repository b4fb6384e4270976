r"""Camera frames, corrected for dark level and flat field, and their noise.

A raw count R of a pixel with dark count D and relative sensitivity F (the flat field, of mean 1)
gives the signal, with the variance

$$ s = (R - D)/F, \qquad
   \sigma^2 = \frac{\sigma_r^2 + 1/12 + g \max(s F, 0)}{F^2 N} + (\epsilon s)^2 $$

with read noise $\sigma_r$ (counts), rounding to whole counts (or to their common divisor, where 10
to 14 bits are aligned to the left in 16), photon noise of gain g (counts per
electron), and N pixels averaged. Averaging does not reduce $\epsilon$: unequal transmission
of the analyzers, light that flickers, a flat field that has changed.

PNG, TIFF and JPEG files go through Pillow, which every plotting library brings along; .npy files
hold what a script saved. A frame in color is refused: its channels would have to be separated
first. A frame that states a tone curve is refused unless `Detector.transfer` says what to do about
it. Where a curve is undone (`polar_bayes.importers.transfer`), R, D, F and the saturation level are
linear counts, with the white of the file, and rounding is that of one count of the file:
$w^2/12$ where such a count is w linear counts wide.
"""

import dataclasses
import os
import warnings
from collections.abc import Callable, Sequence
from numbers import Real

import numpy as np
from PIL import Image

from polar_bayes.capture.schema import Interval
from polar_bayes.errors import CaptureError
from polar_bayes.importers.transfer import as_transfer, stated_curve
from polar_bayes.paths import existing_file

# --- Reading frames -------------------------------------------------------------------------------

Frame = str | os.PathLike[str] | np.ndarray


def read_frame(
    frame: object, where: str, transfer: str | float | None = None
) -> tuple[np.ndarray, float | None]:
    """Read one frame of gray values, and its full-scale count if the format states it.

    Raises:
        CaptureError: It is no frame, or it states a tone curve and no transfer function is given.
    """
    values, curve = read_image(frame, where, ("PNG", "TIFF", "JPEG"))
    where = str(frame) if isinstance(frame, str | os.PathLike) else where
    if curve and transfer is None:
        what = f"it states a tone curve ({curve}), so its counts are not in proportion to light"
        hint = (
            "undo it by transfer='srgb' or transfer=GAMMA, or state by transfer='linear' that the "
            "counts are linear nevertheless"
        )
        raise CaptureError(what, where=where, hint=hint)
    if values.dtype.kind not in "uif" or values.ndim != 2 or values.size == 0:
        what = f"it holds {values.dtype.name} of shape {values.shape}, not one frame of gray values"
        hint = "give rows and columns of numbers; of a color frame, one channel"
        raise CaptureError(what, where=where, hint=hint)
    counts = values.astype(np.float64)
    is_reading = np.abs(counts) <= 1e9
    if not is_reading.all():
        row, column = np.argwhere(~is_reading)[0]
        what, hint = f"{counts[row, column]:g} is no reading", "give finite counts up to 1e+09"
        raise CaptureError(what, where=f"{where}[row={row}, column={column}]", hint=hint)
    return counts, 255.0 if values.dtype == np.uint8 else None


def read_array(path: str | os.PathLike[str], where: str) -> np.ndarray:
    """Read the array of a .npy file."""
    file = existing_file(path, where)
    hint = "save one array with numpy.save"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what old versions of NumPy wrote can still be read
            # Mapped, so that a header that declares terabytes is compared with the file first.
            mapped = np.load(file, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # NumPy raises nearly every type for a broken header
        raise CaptureError("it cannot be read as .npy", where=str(file), hint=hint) from error
    if not isinstance(mapped, np.memmap):
        mapped.close()  # a .npz archive
        raise CaptureError("it holds several arrays", where=str(file), hint=hint)
    if mapped.offset + mapped.nbytes != file.stat().st_size:
        what = f"its header declares {mapped.nbytes} bytes of numbers, and the file holds others"
        raise CaptureError(what, where=str(file), hint=hint)
    return np.array(mapped)


def read_image(
    frame: object, where: str, formats: tuple[str, ...] = ("PNG", "TIFF")
) -> tuple[np.ndarray, str]:
    """Read one channel of an image file or array, and the tone curve that it states."""
    if not isinstance(frame, str | os.PathLike):
        return np.asarray(frame), ""
    file, gray = existing_file(frame, where), ("L", "I;16", "I;16L", "I;16B", "I", "F")
    if file.suffix == ".npy":
        return read_array(file, where), ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(file, formats=formats) as image:
                mode, pages = image.mode, getattr(image, "n_frames", 1)
                is_frame = mode in gray and pages == 1
                curve = stated_curve(image)
                values = np.asarray(image) if is_frame else None
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        hint = "cut it to what matters, or give it as .npy"
        raise CaptureError("it is larger than any camera", where=str(file), hint=hint) from error
    except Exception as error:  # Pillow raises many types for a broken file
        hint = "give PNG, TIFF or .npy"
        if file.suffix.lower() in (".raw", ".bin", ".dat", ".img"):
            hint = (
                "a raw file does not say how it is packed: unpack it with NumPy (docs/camera.md "
                "has the lines for 12 bits), save it as .npy and give that"
            )
        raise CaptureError("it cannot be read as an image", where=str(file), hint=hint) from error
    if values is not None:
        return values, curve
    what, hint = f"it holds {pages} frames", "save each page as a file of its own"
    if mode not in gray:
        stated = (
            f", and state by transfer= the curve that the copy does not ({curve})" if curve else ""
        )
        hint = f"save it with 8 or 16 bits of gray, or give one channel as .npy{stated}"
        what = f"its pixels are {mode}, not gray values"
    raise CaptureError(what, where=str(file), hint=hint)


# --- Correction and noise -------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Detector:
    """Camera model: the conversion from counts to light, and the noise.

    Args:
        saturation_level: Count at which a pixel is full, > 0; it may be left out for 8-bit frames,
            which are full at 255.
        dark: A frame without light, to be taken off: the mean of several, so that its own noise is
            small. A number is the same for all pixels.
        flat: A frame of even unpolarized light, already less its dark frame: the sensitivity of
            each pixel; its scale does not matter. Where a curve is undone, the difference of counts
            serves as far as the dark frame is small beside it.
        gain: Counts per electron, > 0; by default the saturation level over 10,000 electrons.
        read_noise: Standard deviation of a pixel without light, in counts, >= 0.
        relative_error: What stays unknown of every reading however many pixels are averaged, over
            the reading, in [0, 1).
        transfer: Opto-electronic transfer function of all frames, which is undone first: "srgb",
            a gamma from 0.2 to 5 (light is the count to that power), or "linear": counts are in
            proportion to light, whatever files state. By default they are, and files that state
            a tone curve are refused. Saturation level, dark and flat are given in the counts of
            the files, gain and read noise in linear counts with the same white: 255 for 8 bits,
            else the saturation level.

    Raises:
        CaptureError: A number is outside its range, or there is no such transfer function.
    """

    saturation_level: float | None = None
    dark: Frame | float = 0.0
    flat: Frame | None = None
    gain: float | None = None
    read_noise: float = 1.0
    relative_error: float = 0.01
    transfer: str | float | None = None

    def __post_init__(self) -> None:
        for name in ("saturation_level", "gain"):
            if getattr(self, name) is not None:
                Interval(0.0, 1e9, open_low=True).check(getattr(self, name), name)
        Interval(0.0, 1e9).check(self.read_noise, "read_noise")
        Interval(0.0, 1.0, open_high=True).check(self.relative_error, "relative_error")
        as_transfer(self.transfer)


@dataclasses.dataclass(frozen=True, eq=False)
class Signal:
    """Frames corrected for dark level and flat field, with the metadata of the correction."""

    light: np.ndarray
    variance: np.ndarray
    saturated: np.ndarray
    full_scale: float
    metadata: dict[str, str | float]


def signal_of(frames: Sequence[np.ndarray], level: float | None, detector: Detector) -> Signal:
    """Compute light and its variance from raw frames."""
    full = level if detector.saturation_level is None else detector.saturation_level
    if full is None:
        what = "the frames do not say at which count a pixel is full"
        hint = "give it: 4095 for 12 bits, 65535 for 16 bits, 1 for shares of full light"
        raise CaptureError(what, where="saturation_level", hint=hint)
    if detector.read_noise >= 0.1 * full:
        what = f"it is {detector.read_noise:g}, and a pixel is full at {full:g}"
        hint = "give read_noise= and gain= in the unit of the frames, such as 1/4095 for 12 bits"
        raise CaptureError(what, where="read_noise", hint=hint)
    step = _count_step(frames)
    if step > 1 and full % step:
        bits = 16 - (step.bit_length() - 1)
        what = f"all counts are multiples of {step}: {bits} bits aligned to the left"
        hint = f"give the full count as it is in the file by saturation_level=, here {65536 - step}"
        raise CaptureError(what, where="saturation_level", hint=hint)
    transfer = as_transfer(detector.transfer)
    white = full if level is None else level

    def linear(counts: np.ndarray) -> np.ndarray:
        return transfer.linear(counts, white)

    raw = np.stack(frames)
    shape, dark = raw.shape[1:], detector.dark
    if isinstance(dark, Real):
        dark = np.full(shape, Interval(-1e9, 1e9).check(dark, "dark"))
    else:
        dark = _calibration_frame(dark, shape, "dark", detector)
    if not (dark < full).all():
        hint = "check it and the saturation level"
        raise CaptureError(f"it reaches the full count {full:g}", where="dark", hint=hint)
    flat = _flat(detector, shape, linear)
    half = 0.5 * step if full > 1.0 else 0.0  # shares of full light are no whole numbers
    rounding, saturated = linear(raw + half) - linear(raw - half), raw >= full
    raw, dark, full = linear(raw), linear(dark), float(linear(np.array(float(full))))
    # Electrons that fill a pixel of a machine-vision sensor.
    gain = full / 10_000.0 if detector.gain is None else float(detector.gain)
    counts = raw - dark
    variance = detector.read_noise**2 + rounding**2 / 12.0 + gain * np.maximum(counts, 0.0)
    return Signal(
        light=counts / flat,
        variance=variance / flat**2,
        saturated=saturated,
        full_scale=float(np.max((full - dark) / flat)),
        metadata={
            **transfer.metadata,
            "saturation_level": full,
            "dark": _source(detector.dark),
            "flat": _source(detector.flat),
            "gain": gain,
            "gain_is": "assumed" if detector.gain is None else "given",
            "read_noise": float(detector.read_noise),
            "relative_error": float(detector.relative_error),
        },
    )


def _count_step(frames: Sequence[np.ndarray]) -> int:
    """Return the power of two, from 4 on, that divides all counts of wide frames; else 1."""
    values = np.unique(np.stack(frames))
    # Few different counts may have a divisor by chance, and 8 bits are not aligned.
    if values.size < 16 or values[-1] < 1024 or (values % 1.0).any():
        return 1
    step = int(np.gcd.reduce(values.astype(np.int64)))
    return step if step >= 4 and step & (step - 1) == 0 else 1


def _flat(
    detector: Detector, shape: tuple[int, ...], linear: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return the relative sensitivity of each pixel, of mean 1."""
    if detector.flat is None:
        return np.ones(shape)
    values = linear(_calibration_frame(detector.flat, shape, "flat", detector))
    mean = float(values.mean())
    if not mean > 0.0 or not (values > 0.05 * mean).all():
        row, column = np.unravel_index(np.argmin(values), shape)
        what = f"{values[row, column]:g} is less than a twentieth of its mean {mean:g}"
        hint = "subtract its dark frame, use even light, and correct dead pixels"
        raise CaptureError(what, where=f"flat[row={row}, column={column}]", hint=hint)
    return values / mean


def _calibration_frame(
    frame: object, shape: tuple[int, ...], where: str, detector: Detector
) -> np.ndarray:
    values, _ = read_frame(frame, where, detector.transfer)
    if values.shape != shape:
        what = f"it is {values.shape}, the frames are {shape}"
        hint = "take it with the same camera at the same size"
        raise CaptureError(what, where=where, hint=hint)
    return values


def _source(frame: Frame | float | None) -> str | float:
    """Name the source of a calibration frame, for an attribute."""
    if frame is None:
        return "none"
    if isinstance(frame, Real):
        return float(frame)
    return "array" if isinstance(frame, np.ndarray) else os_name(frame)


def os_name(path: object) -> str:
    """Return the last part of a path, so that results do not contain folders of this machine."""
    return str(path).replace("\\", "/").rstrip("/").split("/")[-1]
