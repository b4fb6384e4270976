"""Surface normals of an image: from a file, or of spheres.

Axes of the camera, here and in all imports of images: x to the right, y up, z from the scene to the
camera. Positions in a frame are rows (down) and columns (to the right), counted from zero at the
center of the first pixel; lengths are in pixels.
"""

import abc
import dataclasses
import os
from collections.abc import Sequence
from typing import override

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from polar_bayes.capture.schema import Interval, as_numbers
from polar_bayes.errors import CaptureError
from polar_bayes.importers.columns import read_table
from polar_bayes.importers.detector import os_name, read_array


class AbstractShape(abc.ABC):
    """Surface normals of a frame."""

    @abc.abstractmethod
    def normals(self, rows: np.ndarray, columns: np.ndarray, width: int) -> np.ndarray:
        """Return unit normals in the axes of the camera.

        Args:
            rows: Row at the center of each square of pixels, any shape.
            columns: Column at the same, same shape.
            width: Of the squares over which readings are averaged, pixels.

        Returns:
            Normals of shape (..., 3); NaN where there is no surface.
        """

    @abc.abstractmethod
    def check(self, shape: tuple[int, ...]) -> None:
        """Refuse frames of shape (row, column) that do not match the surface."""

    @property
    @abc.abstractmethod
    def description(self) -> str:
        """Text that describes the shape, for an attribute of the capture."""


@dataclasses.dataclass(frozen=True)
class Sphere:
    """Outline of a sphere that is seen from far away.

    Args:
        row: Of the center, pixels.
        column: Of the center.
        radius: Of the outline, >= 1 pixel.

    Raises:
        CaptureError: A number is none, or outside its range.
    """

    row: float
    column: float
    radius: float

    def __post_init__(self) -> None:
        Interval(-1e6, 1e6).check_fields(self, "row", "column")
        Interval(1.0, 1e6).check_fields(self, "radius")


@dataclasses.dataclass(frozen=True)
class Spheres(AbstractShape):
    """One or more spheres, none in front of another; there is no surface outside of them.

    Args:
        spheres: Their outlines.

    Raises:
        CaptureError: There is none.
    """

    spheres: tuple[Sphere, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.spheres, tuple) or not self.spheres:
            hint = "give a tuple such as (Sphere(500.0, 640.0, 210.0),)"
            raise CaptureError("there is no sphere", where="Spheres", hint=hint)
        for sphere in self.spheres:
            if not isinstance(sphere, Sphere):
                hint = "give Sphere(row, column, radius)"
                raise CaptureError(f"{sphere!r} is no sphere", where="Spheres", hint=hint)

    @override
    def normals(self, rows: np.ndarray, columns: np.ndarray, width: int) -> np.ndarray:
        found = np.full((*np.shape(rows), 3), np.nan)
        for sphere in self.spheres:
            x = (columns - sphere.column) / sphere.radius
            y = (sphere.row - rows) / sphere.radius
            # A square that the outline cuts also reads what is behind the sphere.
            reach = 0.5 * (width - 1) / sphere.radius
            whole = np.hypot(np.abs(x) + reach, np.abs(y) + reach) < 1.0
            z = np.sqrt(np.where(whole, 1.0 - x**2 - y**2, 1.0))
            found = np.where(whole[..., None], np.stack([x, y, z], axis=-1), found)
        return found

    @override
    def check(self, shape: tuple[int, ...]) -> None:
        for sphere in self.spheres:
            center, reach = (sphere.row, sphere.column), sphere.radius
            if not all(-reach < x < size + reach for x, size in zip(center, shape, strict=True)):
                what = f"it lies outside of frames of {shape[0]} rows and {shape[1]} columns"
                hint = "give row, column and radius in pixels of the frame, row first"
                raise CaptureError(what, where=repr(sphere), hint=hint)

    @property
    @override
    def description(self) -> str:
        return "; ".join(f"sphere {s.row:g} {s.column:g} {s.radius:g}" for s in self.spheres)


@dataclasses.dataclass(frozen=True, eq=False)
class NormalMap(AbstractShape):
    """Normals of a frame, one for each pixel.

    Args:
        values: Unit normals (x to the right, y up, z to the camera), shape (row, column, 3), or a
            .npy file of them; NaN or zeros where there is no surface.

    Raises:
        CaptureError: They have another shape, or a length that is not one.
    """

    values: np.ndarray | str | os.PathLike[str]
    _unit: np.ndarray = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        if isinstance(self.values, str | os.PathLike):
            where, values = str(self.values), read_array(self.values, "normals")
        else:
            where, values = "normals", np.asarray(self.values)
        if values.dtype.kind not in "iuf" or values.ndim != 3 or values.shape[-1] != 3:
            hint = "give x, y and z for each pixel: (row, column, 3)"
            what = f"it holds {values.dtype.name} of shape {values.shape}"
            raise CaptureError(what, where=where, hint=hint)
        values = values.astype(np.float64)
        length = np.linalg.norm(values, axis=-1, keepdims=True)
        missing = ~np.isfinite(length) | (length == 0.0)
        wrong = ~missing & (np.abs(length - 1.0) > 0.05)
        if wrong.any():
            row, column, _ = np.argwhere(wrong)[0]
            what = f"its length is {length[row, column, 0]:g}"
            hint = "give unit normals, from -1 to 1; colors c of 8 bits are 2 c/255 - 1"
            raise CaptureError(what, where=f"{where}[row={row}, column={column}]", hint=hint)
        unit = np.where(missing, np.nan, values) / np.where(missing, 1.0, length)
        object.__setattr__(self, "_unit", unit)

    @override
    def normals(self, rows: np.ndarray, columns: np.ndarray, width: int) -> np.ndarray:
        first_row = np.rint(np.asarray(rows) - 0.5 * (width - 1)).astype(int)
        first_column = np.rint(np.asarray(columns) - 0.5 * (width - 1)).astype(int)
        total = np.zeros((*first_row.shape, 3))
        for down in range(width):
            for right in range(width):  # one missing normal makes the sum NaN
                total += self._unit[first_row + down, first_column + right]
        length = np.linalg.norm(total, axis=-1, keepdims=True)
        return total / np.where(length > 0.0, length, np.nan)

    @override
    def check(self, shape: tuple[int, ...]) -> None:
        if self._unit.shape[:2] != tuple(shape):
            what = f"they are {self._unit.shape[:2]}, the frames {tuple(shape)}"
            hint = "give a normal for each pixel of the frame, before any averaging"
            raise CaptureError(what, where="normals", hint=hint)

    @property
    @override
    def description(self) -> str:
        if isinstance(self.values, np.ndarray):
            return "normals: array"
        return f"normals: {os_name(self.values)}"


def fit_sphere(rim: ArrayLike | os.PathLike[str]) -> Sphere:
    """Fit the outline of a sphere to points on its rim by least squares of distances.

    Args:
        rim: Four points or more: an array of shape (point, 2), row and column in pixels, or a
            table with the columns row and column.

    Returns:
        The outline.

    Raises:
        CaptureError: There are fewer points, or they lie on no circle: one is off by more than a
            tenth of the radius.
    """
    if isinstance(rim, str | os.PathLike):
        table = read_table(rim, ["row", "column"])
        where, points = table.source, np.stack([table.columns["row"], table.columns["column"]], -1)
        points = points[np.isfinite(points).all(axis=1)]
    else:
        where, points = "rim", _points(rim)
    if len(points) < 4:
        hint = "mark four points or more on the outline, all around"
        raise CaptureError(f"it has {len(points)} points", where=where, hint=hint)
    center = points.mean(axis=0)
    radius = np.linalg.norm(points - center, axis=1).mean()

    def distance(circle: np.ndarray) -> np.ndarray:
        return np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) - circle[2]

    found = least_squares(distance, [*center, radius]).x
    off = np.abs(distance(found)).max()
    if not found[2] > 1.0 or off > 0.1 * found[2]:
        what = f"a point is {off:.3g} pixels off the best circle, of radius {found[2]:.3g}"
        hint = "check for a swapped row and column, or give normals of another shape"
        raise CaptureError(what, where=where, hint=hint)
    return Sphere(*found.tolist())


ShapeLike = AbstractShape | Sphere | Sequence[Sphere] | np.ndarray | str | os.PathLike[str]


def as_shape(shape: object) -> AbstractShape:
    """Return a shape from a user's argument."""
    if isinstance(shape, AbstractShape):
        return shape
    if isinstance(shape, Sphere):
        return Spheres((shape,))
    if isinstance(shape, np.ndarray | str | os.PathLike):
        return NormalMap(shape)
    if isinstance(shape, Sequence):
        return Spheres(tuple(shape))
    hint = "give a Sphere, several, or normals of shape (row, column, 3)"
    raise CaptureError(f"a {type(shape).__name__} is no shape", where="shape", hint=hint)


def _points(rim: object) -> np.ndarray:
    points = as_numbers(rim)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        hint = "give an array of shape (point, 2): row and column"
        raise CaptureError("it is no list of points", where="rim", hint=hint)
    return points
