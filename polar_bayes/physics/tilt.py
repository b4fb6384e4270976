"""A normal that leans away from the one that was stated: what a patch sees if it is not level.

Directions are stated in the frame of an assumed normal. The optics is told them in the frame of the
true one, and the Stokes components that come out are turned back. Nothing is lost where the normal
does not lean: the directions are then those that were stated, to the last bit or two.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.geometry import Geometry, cos_degrees, sin_degrees
from polar_bayes.physics.instrument import STEEPEST_ZENITH
from polar_bayes.physics.part import Part, Setting, check_setting, names_in, value_of
from polar_bayes.physics.stokes import Light, in_turned_frame

# Largest lean along either axis, in degrees: a sampler may ask for more, and gets this.
LARGEST_TILT = 80.0


class Direction(NamedTuple):
    """A direction in the frame of the true normal.

    Args:
        zenith: Angle from the true normal. Shape (..., view), degree.
        azimuth: Around the true normal. Shape (..., view), degree.
        turn: Cosine and sine of twice the angle from the s axis of the stated normal to that of
            the true one. Each (..., view).
    """

    zenith: Array
    azimuth: Array
    turn: tuple[Array, Array]


@dataclasses.dataclass(frozen=True)
class TiltedNormal(Part):
    r"""The true normal leans by small angles towards azimuth 0 and towards azimuth 90.

    $$ n \propto (\tan t_x, \tan t_y, 1) $$

    in the frame in which the directions are stated: seen along azimuth 90 the normal leans by t_x,
    seen along azimuth 0 by t_y. The axes of the true frame are those of the stated one, carried
    along by the rotation that takes the stated normal to the true one the shortest way; so are the
    grooves of an anisotropic surface, and a sky or disc that lights it.

    A direction that the lean carries below the horizon counts as grazing, 89.999 degrees (or as
    stated, where that is nearer to 90): the light it has left is next to none, and its slope with
    the tilt is zero. Exactly on the true normal, where azimuth has no meaning, the azimuth as
    stated is kept, and slopes are those along the stated plane.

    Args:
        tilt_x: t_x, degree, -60 to 60; a name fits it.
        tilt_y: t_y, degree, -60 to 60; a name fits it.

    Raises:
        SceneError: A setting is neither a number in its range nor a name.
    """

    tilt_x: Setting = "normal_tilt_x"
    tilt_y: Setting = "normal_tilt_y"

    def __post_init__(self) -> None:
        check_setting(self.tilt_x, "TiltedNormal: tilt_x", -60.0, 60.0)
        check_setting(self.tilt_y, "TiltedNormal: tilt_y", -60.0, 60.0)

    @property
    @override
    def parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return names_in(self.tilt_x, self.tilt_y)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)

    def enter(
        self, parameters: Mapping[str, Array], geometry: Geometry
    ) -> tuple[Geometry, tuple[Array, Array]]:
        """Directions in the frame of the true normal.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions in the stated frame. Shape (..., view), degree.

        Returns:
            The directions, and the turn of the viewer's frame as in `Direction`. Broadcast shape.

        Raises:
            Nothing.
        """
        slopes = self._slopes(parameters)
        view = lean(geometry.view_zenith, geometry.view_azimuth, *slopes)
        light = lean(geometry.light_zenith, geometry.light_azimuth, *slopes)
        inside = Geometry(
            view.zenith, view.azimuth, light.zenith, light.azimuth, geometry.wavelength, light.turn
        )
        return inside, view.turn

    def leave(self, light: Light, turn: tuple[Array, Array]) -> Light:
        """Light in the stated frame of the viewer.

        Args:
            light: Light in the true frame. Shape (..., view).
            turn: As `enter` gave it.

        Returns:
            Light of the same shape.

        Raises:
            Nothing.
        """
        cos, sin = turn
        return Light(light.intensity, *in_turned_frame(light.q, light.u, (cos, -sin)))

    def _slopes(self, parameters: Mapping[str, Array]) -> tuple[Array, Array]:
        tilts = (value_of(setting, parameters) for setting in (self.tilt_x, self.tilt_y))
        bounded = [jnp.deg2rad(jnp.clip(tilt, -LARGEST_TILT, LARGEST_TILT)) for tilt in tilts]
        return jnp.tan(bounded[0]), jnp.tan(bounded[1])


def lean(zenith: Array, azimuth: Array, slope_x: Array, slope_y: Array) -> Direction:
    r"""A direction as the normal (slope_x, slope_y, 1)/N sees it.

    With p and t the slopes along and across the plane of the direction, s and c its sine and
    cosine, the true normal's cross product with the direction has the components

    $$ \frac{s - p c}{N}, \quad \frac{-t}{N} $$

    along the stated s axis and the one at right angles to it: their length is the sine of the
    angle from the true normal, and their angle is that between both s axes. The zenith is given
    as the stated one plus a difference, which is exactly zero without a lean.

    Args:
        zenith: Angle from the stated normal. Shape (..., view), degree.
        azimuth: Around the stated normal. Shape (..., view), degree.
        slope_x: Tangent of the lean towards azimuth 0. Broadcasts, 1.
        slope_y: Tangent of the lean towards azimuth 90. Broadcasts, 1.

    Returns:
        The direction in the true frame.

    Raises:
        Nothing.
    """
    sin, cos = sin_degrees(zenith), cos_degrees(zenith)
    sin_azimuth, cos_azimuth = sin_degrees(azimuth), cos_degrees(azimuth)
    towards = slope_x * cos_azimuth + slope_y * sin_azimuth
    across = slope_y * cos_azimuth - slope_x * sin_azimuth
    length = jnp.sqrt(1.0 + slope_x**2 + slope_y**2)

    height = (cos + towards * sin) / length
    along_s, along_p = (sin - towards * cos) / length, -across / length
    lift = (cos + towards * sin / (1.0 + length)) / length
    x, y = sin - towards * lift, -across * lift

    # On the true normal only the plane as stated tells where the direction came from.
    squared = along_s**2 + along_p**2
    overhead = squared <= jnp.finfo(squared.dtype).eps ** 1.5
    signed = along_s
    along_s, along_p = jnp.where(overhead, 1.0, along_s), jnp.where(overhead, 0.0, along_p)
    x, y = jnp.where(overhead, 1.0, x), jnp.where(overhead, 0.0, y)
    squared = along_s**2 + along_p**2
    sine = jnp.where(overhead, signed, jnp.sqrt(squared))

    steeper = jnp.rad2deg(jnp.arctan2(sine * cos - height * sin, height * cos + sine * sin))
    horizon = jnp.maximum(zenith, STEEPEST_ZENITH)
    return Direction(
        jnp.minimum(zenith + steeper, horizon),
        azimuth + jnp.rad2deg(jnp.arctan2(y, x)),
        ((along_s - along_p) * (along_s + along_p) / squared, 2.0 * along_s * along_p / squared),
    )
