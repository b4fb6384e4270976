r"""Positions of camera and light, and the local geometry of each piece of surface.

Stokes parameters of a camera count from its own axes: from x (to the right) counterclockwise as
the camera sees it. Models count from the s axis of each piece of surface,
$e_s = (n \times v)/|n \times v|$ (docs/conventions.md), towards $v \times e_s$. The two are rotated
by $\psi = atan2(e_s \cdot b, e_s \cdot a)$, where a and b are the camera's axes carried to the
direction of view v: a lens bends each ray in the plane of ray and axis, so

$$ a = x - \frac{v_x}{1 + v_z} (z + v), \qquad b = v \times a $$
"""

import abc
import dataclasses
from typing import override

import numpy as np

from polar_bayes.capture.schema import Interval
from polar_bayes.errors import CaptureError

ON_NORMAL = 1e-6
"""Sine of the zenith below which a direction counts as the normal itself."""

EDGE_ON = 1e-9
"""Smallest cosine of a surface that faces something; its zenith stays below 90 degrees."""


class AbstractLocation(abc.ABC):
    """Location of a camera or light, as directions from points of the surface."""

    @abc.abstractmethod
    def towards(self, points: np.ndarray) -> np.ndarray:
        """Return unit vectors from points of the surface to the location.

        Args:
            points: In the camera's axes, pixels from the center of the frame, (..., 3).

        Returns:
            Shape (..., 3).
        """


@dataclasses.dataclass(frozen=True)
class Direction(AbstractLocation):
    """A distant camera or light: the same direction from every point.

    Args:
        x: To the right, in any unit.
        y: Up.
        z: From the scene to the camera.

    Raises:
        CaptureError: A component is no number, or all are zero.
    """

    x: float
    y: float
    z: float

    def __post_init__(self) -> None:
        _check_components(self)
        if not any(dataclasses.astuple(self)):
            hint = "give a vector that is not zero"
            raise CaptureError("it points nowhere", where=repr(self), hint=hint)

    @override
    def towards(self, points: np.ndarray) -> np.ndarray:
        vector = np.array([self.x, self.y, self.z], float)
        return np.broadcast_to(vector / np.linalg.norm(vector), points.shape)


@dataclasses.dataclass(frozen=True)
class Position(AbstractLocation):
    """A near camera or light, in pixels of the frame from its center; the surface is at z = 0.

    A camera of focal length f pixels is at (0, 0, f).

    Args:
        x: To the right.
        y: Up.
        z: From the surface to the camera, > 0.

    Raises:
        CaptureError: A coordinate is no number, or z is not above the surface.
    """

    x: float
    y: float
    z: float

    def __post_init__(self) -> None:
        _check_components(self)
        if not self.z > 0.0:
            hint = "give z above 0, in pixels of the frame"
            raise CaptureError("it is behind the surface", where=repr(self), hint=hint)

    @override
    def towards(self, points: np.ndarray) -> np.ndarray:
        vector = np.array([self.x, self.y, self.z], float) - points
        return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


@dataclasses.dataclass(frozen=True)
class Highlight:
    """Distant light, located by the point where the surface mirrors it.

    Args:
        row: Of the middle of the highlight, pixels.
        column: Of the same.

    Raises:
        CaptureError: A coordinate is no number.
    """

    row: float
    column: float

    def __post_init__(self) -> None:
        Interval(0.0, 1e6).check_fields(self, "row", "column")


@dataclasses.dataclass(frozen=True)
class Surroundings:
    """Light from everywhere: each piece of a smooth surface reflects its surroundings.

    No lamp need be known: the light's direction is the mirror direction of each piece, in its plane
    of incidence.
    """


@dataclasses.dataclass(frozen=True, eq=False)
class LocalGeometry:
    """Directions in the frame of each piece of surface, and rotation of axes; all of one shape."""

    view_zenith: np.ndarray
    view_azimuth: np.ndarray
    light_zenith: np.ndarray
    light_azimuth: np.ndarray
    cos_twice: np.ndarray
    sin_twice: np.ndarray
    outside: np.ndarray
    turned_away: np.ndarray
    in_shadow: np.ndarray


def local_geometry(normals: np.ndarray, view: np.ndarray, light: np.ndarray) -> LocalGeometry:
    """Return zeniths, azimuths and the rotation of axes, from vectors in the camera's axes."""
    outside = ~np.isfinite(normals).all(axis=-1)
    n = np.where(outside[..., None], view, normals)
    light = np.where(np.isfinite(light), light, view)
    cos_view, cos_light = _dot(n, view), _dot(n, light)
    turned_away = ~outside & (cos_view <= EDGE_ON)
    in_shadow = ~outside & ~turned_away & (cos_light <= EDGE_ON)
    seen = ~(outside | turned_away | in_shadow)
    across_view, across_light = np.cross(n, view), np.cross(n, light)
    sin_view = np.linalg.norm(across_view, axis=-1)
    sin_light = np.linalg.norm(across_light, axis=-1)
    upright, from_above = sin_view < ON_NORMAL, sin_light < ON_NORMAL
    # On the normal the frame is the light's, as if the viewer were opposite to it; where both are
    # on the normal, any frame will do.
    first = _first_axis(view)
    fallback = np.where(from_above[..., None], first, -across_light)
    s_axis = np.where(upright[..., None], fallback, across_view)
    s_axis = s_axis / np.linalg.norm(s_axis, axis=-1, keepdims=True)
    cos, sin = _dot(s_axis, first), _dot(s_axis, np.cross(view, first))
    length = np.hypot(cos, sin)
    cos, sin = cos / length, sin / length
    # n x l and n x v turn around n as l and v themselves do.
    around = _dot(n, np.cross(across_light, across_view))
    azimuth = np.arctan2(around, _dot(across_light, across_view))
    azimuth = np.where(upright | from_above, np.pi, azimuth)
    return LocalGeometry(
        view_zenith=np.where(seen & ~upright, np.rad2deg(np.arctan2(sin_view, cos_view)), 0.0),
        view_azimuth=np.where(seen, np.rad2deg(azimuth), 180.0),
        light_zenith=np.where(seen, np.rad2deg(np.arctan2(sin_light, cos_light)), 0.0),
        light_azimuth=np.zeros_like(cos_view),
        cos_twice=cos**2 - sin**2,
        sin_twice=2.0 * cos * sin,
        outside=outside,
        turned_away=turned_away,
        in_shadow=in_shadow,
    )


def mirror_direction(normals: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Return the direction from which a mirror sends light to the viewer."""
    return 2.0 * _dot(normals, view)[..., None] * normals - view


def as_location(location: object, where: str) -> AbstractLocation:
    """Return a location from a user's argument."""
    if isinstance(location, AbstractLocation):
        return location
    if isinstance(location, list | tuple | np.ndarray) and len(location) == 3:
        return Direction(*location)
    hint = "give Direction(x, y, z) or Position(x, y, z)"
    raise CaptureError(f"{location!r} is neither direction nor position", where=where, hint=hint)


def _first_axis(view: np.ndarray) -> np.ndarray:
    """Rotate the camera's x axis to be perpendicular to a direction of view."""
    x, z = np.eye(3)[[0, 2]]
    return x - (view[..., :1] / (1.0 + view[..., 2:])) * (z + view)


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.sum(first * second, axis=-1)


def _check_components(location: Direction | Position) -> None:
    Interval(-1e9, 1e9).check_fields(location, "x", "y", "z")
