"""Frames of a camera as arrays of numbers, from files or from memory; nothing is guessed.

PNG and TIFF files go through Pillow, which every plotting library brings along; .npy files hold
what a script saved. A frame in color is refused: its channels would have to be told apart first.
"""

import os
import warnings
from typing import Any

import numpy as np
from PIL import Image

from polar_bayes.errors import CaptureError
from polar_bayes.paths import existing_file

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
            mend="give rows and columns of numbers; of a color frame, one channel",
        )
    counts = values.astype(np.float64)
    if not np.isfinite(counts).all() or np.abs(counts).max() > LARGEST_COUNT:
        row, column = np.argwhere(~(np.abs(counts) <= LARGEST_COUNT))[0]
        raise CaptureError(
            f"{counts[row, column]:g} is no reading",
            where=f"{_place(frame, where)}[row={row}, column={column}]",
            mend=f"give finite counts up to {LARGEST_COUNT:g}",
        )
    return counts, 255.0 if values.dtype == np.uint8 else None


def read_array(path: str | os.PathLike[str], where: str) -> np.ndarray:
    """The array of a .npy file."""
    file = existing_file(path, where)
    mend = "save one array with numpy.save"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what old versions of NumPy wrote can still be read
            # Mapped, so that a header that declares terabytes is compared with the file first.
            mapped = np.load(file, mmap_mode="r", allow_pickle=False)
        if isinstance(mapped, np.memmap):
            if mapped.offset + mapped.nbytes != file.stat().st_size:
                what = f"its header says {mapped.nbytes} bytes of numbers, and it holds others"
                raise CaptureError(what, where=str(file), mend=mend)
            return np.array(mapped)
        mapped.close()  # a .npz archive
    except CaptureError:
        raise
    except Exception as error:  # NumPy raises nearly every type for a broken header
        raise CaptureError("it cannot be read as .npy", where=str(file), mend=mend) from error
    raise CaptureError("it holds several arrays", where=str(file), mend=mend)


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
                    mend = "save it with 8 or 16 bits of gray, or give one channel as .npy"
                    raise CaptureError(what, where=str(file), mend=mend)
                if (pages := getattr(image, "n_frames", 1)) > 1:
                    mend = "save each page as a file of its own"
                    raise CaptureError(f"it holds {pages} frames", where=str(file), mend=mend)
                return np.asarray(image)
    except CaptureError:
        raise
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        mend = "cut it to what matters, or give it as .npy"
        raise CaptureError("it is larger than any camera", where=str(file), mend=mend) from error
    except Exception as error:  # Pillow raises many types for a broken file
        mend = "give PNG, TIFF or .npy"
        raise CaptureError("it cannot be read as an image", where=str(file), mend=mend) from error


def _place(frame: Any, where: str) -> str:
    return str(frame) if isinstance(frame, str | os.PathLike) else where
