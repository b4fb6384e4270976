"""Directions of viewer and light, and the facet that mirrors one into the other.

The surface normal is z. Azimuths 180 degrees apart are the specular side. Nothing here subtracts
two nearly equal numbers: cosines near grazing come from the complement of the zenith angle, and
differences of directions from half angles.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

# Nearest to grazing, in degrees, that single precision or a shifted angle may come.
STEEPEST_ZENITH = 89.999


class Geometry(NamedTuple):
    """Directions of viewer and light, in degrees, one entry per view.

    A negative zenith means the same zenith on the other side of the normal, so that a small shift
    through the normal is smooth.

    Args:
        view_zenith: Angle of the viewer from the normal. Shape (..., view), degree, `|angle| < 90`.
        view_azimuth: Azimuth of the viewer. Shape (..., view), degree.
        light_zenith: Angle of the light from the normal. Shape (..., view), degree, `|angle| < 90`.
        light_azimuth: Azimuth of the light. Shape (..., view), degree.
        wavelength: Wavelength in air, nm, broadcasts with (..., view); None where it is not known.
        light_turn: Cosine and sine of twice the angle from the s axis in which polarized light is
            stated to the light's own, (..., view); None where they are one.
    """

    view_zenith: Array
    view_azimuth: Array
    light_zenith: Array
    light_azimuth: Array
    wavelength: Array | None = None
    light_turn: tuple[Array, Array] | None = None

    @classmethod
    def from_degrees(
        cls,
        *,
        view_zenith: ArrayLike,
        view_azimuth: ArrayLike,
        light_zenith: ArrayLike,
        light_azimuth: ArrayLike,
        wavelength: ArrayLike | None = None,
    ) -> "Geometry":
        """Directions broadcast to one shape; a viewer on the normal looks away from the light.

        On the normal there is no plane of incidence for the viewer, so the frame of Stokes is
        taken from the light: the view azimuth becomes the light's plus 180 degrees.

        Args:
            view_zenith: Angle of the viewer from the normal. Any shape, degree, 0 <= . < 90.
            view_azimuth: Azimuth of the viewer. Any shape, degree.
            light_zenith: Angle of the light from the normal. Any shape, degree, 0 <= . < 90.
            light_azimuth: Azimuth of the light. Any shape, degree.
            wavelength: Wavelength in air. Broadcasts with (..., view), nm: several colors have
                shape (wavelength, 1).

        Returns:
            Geometry of shape (..., view); a lone angle counts as one view.
        """
        given = (view_zenith, view_azimuth, light_zenith, light_azimuth, wavelength)
        # Numbers and NumPy arrays need no compiled program for each step.
        of = jnp if any(isinstance(each, jax.Array) for each in given) else np
        dtype = jnp.result_type(float, *map(of.asarray, given[:4]))
        angles = [of.atleast_1d(of.asarray(angle, dtype)) for angle in given[:4]]
        view_zenith, view_azimuth, light_zenith, light_azimuth = of.broadcast_arrays(*angles)
        view_azimuth = of.where(view_zenith == 0.0, light_azimuth + 180.0, view_azimuth)
        if wavelength is not None:
            wavelength = of.asarray(wavelength, dtype)
        found = (view_zenith, view_azimuth, light_zenith, light_azimuth, wavelength)
        return cls(*(jax.device_put(found) if of is np else found))

    def leaning(self, view: ArrayLike = 0.0, light: ArrayLike = 0.0) -> "Geometry":
        """Increase all zeniths by an angle in degrees, up to 89.999."""
        return self._replace(
            view_zenith=jnp.minimum(self.view_zenith + view, STEEPEST_ZENITH),
            light_zenith=jnp.minimum(self.light_zenith + light, STEEPEST_ZENITH),
        )

    def reversed(self) -> "Geometry":
        """Exchange viewer and light."""
        view, light = self[:2], self[2:4]
        return Geometry(*light, *view, self.wavelength)

    def resolved(self) -> "Geometry":
        """Limit zeniths to 89.999 degrees in single precision, which resolves 8e-6 degrees."""
        if jnp.finfo(self.dtype).eps < 1e-10:
            return self
        view, light = (
            jnp.clip(zenith, -STEEPEST_ZENITH, STEEPEST_ZENITH)
            for zenith in (self.view_zenith, self.light_zenith)
        )
        return self._replace(view_zenith=view, light_zenith=light)

    @property
    def dtype(self) -> jnp.dtype:
        """Floating type of the angles."""
        return jnp.result_type(float, *jax.tree.leaves(self))


class MirrorFacet(NamedTuple):
    """The facet that mirrors the light to the viewer: its incidence, tilt and orientation.

    Args:
        cos_incidence: Cosine of the angle between facet and viewer. Shape (..., view), 1.
        sin_squared: Squared sine of the same angle. Shape (..., view), 1.
        tan_squared_tilt: Squared slope of the facet. Shape (..., view), 1.
        along_s: sin_squared times cos(2 psi); psi turns the facet's s axis to the viewer's.
        across_s: sin_squared times sin(2 psi). Both (..., view) and regular everywhere.
    """

    cos_incidence: Array
    sin_squared: Array
    tan_squared_tilt: Array
    along_s: Array
    across_s: Array


def sin_degrees(angle: Array) -> Array:
    """Sine of an angle in degrees. Any shape; returns the same shape."""
    # XLA would compute it anew in every loop that it is fused into: that was four fifths of a
    # gradient wherever directions depend on parameters.
    return jax.lax.optimization_barrier(jnp.sin(jnp.deg2rad(angle)))


def cos_degrees(angle: Array) -> Array:
    """Cosine of an angle in degrees, accurate up to 90, where a plain cosine loses its digits."""
    return sin_degrees(90.0 - angle)


def resolved_cosine(cosine: Array) -> Array:
    """Cosine of a zenith from 0 to 90 degrees, as `Geometry.resolved` takes it."""
    if jnp.finfo(cosine.dtype).eps < 1e-10:
        return cosine
    return jnp.maximum(cosine, math.cos(math.radians(STEEPEST_ZENITH)))


def double_angle(cos: Array, sin: Array) -> tuple[Array, Array]:
    """Cosine and sine of twice an angle; of a vector (cos, sin), times its squared length."""
    return (cos - sin) * (cos + sin), 2.0 * sin * cos


def unit_vectors(directions: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "... 3"]:
    """Unit vectors of directions: zenith and azimuth, unit degree."""
    finite = np.where(np.isfinite(directions), directions, np.nan)
    zenith, azimuth = np.moveaxis(np.radians(finite), -1, 0)
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)


def per_ray[T](arrays: T) -> T:
    """Arrays with a trailing axis, for many rays or quadrature nodes of each view."""
    return jax.tree.map(lambda array: array[..., None] if array.ndim else array, arrays)


def per_facet[T](arrays: T) -> T:
    """Arrays with an axis before the views, for many facets of each."""
    return jax.tree.map(lambda array: array[..., None, :] if array.ndim else array, arrays)


def mirror_facet(geometry: Geometry) -> MirrorFacet:
    r"""Facet whose normal is half-way between viewer and light, in half angles.

    $$ \sin^2\theta_d = \sin^2\tfrac{\theta_v-\theta_l}{2} + s_v s_l \sin^2\tfrac{\varphi}{2},
       \qquad \tan^2\theta_h = \frac{(s_v-s_l)^2 + 4 s_v s_l \cos^2(\varphi/2)}{(c_v+c_l)^2} $$

    With X = s_v c_l - c_v s_l cos(phi) and Y = s_l sin(phi) the s axis of the facet is turned by
    psi, where tan(psi) = Y/X and X^2 + Y^2 = 4 sin^2 cos^2: so sin^2 cos(2 psi) needs no angle.
    """
    sin_half, cos_half = _half_azimuth(geometry.light_azimuth - geometry.view_azimuth)
    sin_view, cos_view = sin_degrees(geometry.view_zenith), cos_degrees(geometry.view_zenith)
    sin_light, cos_light = sin_degrees(geometry.light_zenith), cos_degrees(geometry.light_zenith)
    half_difference = 0.5 * (geometry.view_zenith - geometry.light_zenith)
    cos_half_sum = _cos_half_sum(geometry)
    sin_sin = sin_view * sin_light

    sin_squared = sin_degrees(half_difference) ** 2 + sin_sin * sin_half**2
    cos_squared = cos_half_sum**2 + sin_sin * cos_half**2
    cosine_sum = cos_view + cos_light
    slope_in_plane = 2.0 * cos_half_sum * sin_degrees(half_difference) / cosine_sum
    slope_squared = slope_in_plane**2 + sin_sin * (2.0 * cos_half / cosine_sum) ** 2

    x = sin_degrees(2.0 * half_difference) + 2.0 * cos_view * sin_light * sin_half**2
    y = 2.0 * sin_light * sin_half * cos_half
    scale = 4.0 * cos_squared
    return MirrorFacet(
        cos_incidence=jnp.sqrt(cos_squared),
        sin_squared=sin_squared,
        tan_squared_tilt=slope_squared,
        along_s=(x**2 - y**2) / scale,
        across_s=2.0 * x * y / scale,
    )


def mirror_slopes(geometry: Geometry) -> tuple[Array, Array]:
    """Slopes of the mirror facet in the viewer's frame: towards it, and across."""
    sin_half, cos_half = _half_azimuth(geometry.light_azimuth - geometry.view_azimuth)
    sin_light = sin_degrees(geometry.light_zenith)
    cosine_sum = cos_degrees(geometry.view_zenith) + cos_degrees(geometry.light_zenith)
    half_difference = sin_degrees(0.5 * (geometry.view_zenith - geometry.light_zenith))
    in_plane = 2.0 * (half_difference * _cos_half_sum(geometry) + sin_light * cos_half**2)
    return in_plane / cosine_sum, 2.0 * sin_light * sin_half * cos_half / cosine_sum


def turn_between_frames(geometry: Geometry) -> tuple[Array, Array]:
    r"""Cosine and sine of twice the angle from the light's s axis to the viewer's, over a mirror.

    $$ \tan\frac{\psi_v+\psi_l}{2} = \frac{\cos\frac{\theta_v-\theta_l}{2}}
       {\cos\frac{\theta_v+\theta_l}{2}} \cot\frac{\varphi}{2} $$

    Regular wherever viewer and light are above the surface, also where they coincide.

    Source:
        Napier's analogies for the triangle of normal, viewer and light.
    """
    sin_half, cos_half = _half_azimuth(geometry.light_azimuth - geometry.view_azimuth)
    half_difference = 0.5 * (geometry.view_zenith - geometry.light_zenith)
    up = cos_degrees(half_difference) * cos_half
    down = _cos_half_sum(geometry) * sin_half
    length = up**2 + down**2
    cos, sin = double_angle(down, up)
    return double_angle(cos / length, sin / length)


def _cos_half_sum(geometry: Geometry) -> Array:
    """Cosine of half the sum of both zeniths."""
    # From their complements, which are exact near grazing, where single precision rounds the sum.
    return sin_degrees(0.5 * ((90.0 - geometry.view_zenith) + (90.0 - geometry.light_zenith)))


def _half_azimuth(azimuth: Array) -> tuple[Array, Array]:
    """Sine and cosine of half an azimuth difference, exact on the mirror side and behind."""
    azimuth = azimuth - 360.0 * jnp.round(azimuth / 360.0)
    forwards = jnp.where(azimuth < 0.0, -azimuth, azimuth)
    return sin_degrees(0.5 * azimuth), cos_degrees(0.5 * forwards)
