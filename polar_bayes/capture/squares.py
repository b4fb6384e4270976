"""How a frame is cut into readings and pixels of a capture.

Squares of `bin` x `bin` pixels are averaged into one reading. Squares of `window` x `window`
readings make one pixel of the capture: they are the views of one material, each with the
directions at its own place. One picture shows each place from one side only, and a fit needs two
views; a curved surface has them next to each other.
"""

import dataclasses
from numbers import Integral

import numpy as np

from polar_bayes.errors import CaptureError


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
            mend = "give a whole number of 1 or more"
            raise CaptureError(f"it is {value!r}", where=name, mend=mend)
    squares = Squares((frame[0], frame[1]), int(bin_), int(window))  # type: ignore[call-overload]
    if min(squares.counts) < 1:
        raise CaptureError(
            f"frames of {frame[0]} rows and {frame[1]} columns hold no square of "
            f"{squares.bin * squares.window} pixels",
            where="bin, window",
            mend="give smaller ones",
        )
    return squares
