"""Light as brightness and normalized Stokes components, in the viewer's frame.

Its first axis is e_s = (z x v)/|z x v|: q > 0 is polarized perpendicular to the plane of normal and
viewer (s), q < 0 parallel to it (p), and u > 0 at 45 degrees from e_s.

A facet multiplies the components of the field by its reflectances. With P = q + iu of the light in
its own frame and W = B exp(2 i psi) of either frame (B the squared sine of incidence),

    S0 = R+ + K Re(P W_l)
    S1 + i S2 = K conj(W_v) + (R+ + x)/2 P exp(-2i(psi_v + psi_l)) + J/2 conj(P W_l W_v)

where K, J and x are the contrast, shortfall and cross term of `Diattenuation`: nothing is singular
where viewer and light coincide. Only linear polarization is followed: what total reflection or a
thin film turns into circular light counts as unpolarized.
"""

import dataclasses
from typing import Annotated, NamedTuple, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.boundary import Diattenuation
from polar_bayes.physics.geometry import (
    Geometry,
    MirrorFacet,
    cos_degrees,
    mirror_facet,
    sin_degrees,
    turn_between_frames,
)
from polar_bayes.physics.part import Parameters, Part, Range, Setting, quotient, value_of
from polar_bayes.physics.stack import Stack

# Rounds the tip of the cone |(q, u)|: small against any reading, large enough that the Hessian at
# the tip, 1/TIP, and the squares on the way to it exist in single precision.
TIP = 1e-12


class Light(NamedTuple):
    """Brightness with its linear polarization; the Stokes vector is intensity * (1, q, u).

    Args:
        intensity: Brightness per unit irradiance (or radiance). Shape (..., view), >= 0.
        q: Polarized share along s minus along p. Shape (..., view), in [-1, 1].
        u: The same between the diagonals. Shape (..., view), in [-1, 1].
    """

    intensity: Array
    q: Array
    u: Array


def to_stokes(light: Light) -> Array:
    """Stokes vector (S0, S1, S2) on a new last axis: (..., view) -> (..., view, 3)."""
    intensity, q, u = light
    return jnp.stack(jnp.broadcast_arrays(intensity, intensity * q, intensity * u), axis=-1)


def degree_of_linear_polarization(q: Array, u: Array) -> Array:
    r"""Length of (q, u), with the kink at zero rounded off.

    $$ \sqrt{q^2 + u^2 + \epsilon^2}, \qquad \epsilon = 10^{-12} $$

    So unpolarized light has the value 1e-12, gradient zero and a finite Hessian; above 1e-7 the
    rounding changes the value by less than 1e-10 of itself.
    """
    return jnp.sqrt(q**2 + u**2 + TIP**2)


def direction(q: Array, u: Array) -> tuple[Array, Array]:
    """Unit vector along (q, u); along s where there is no polarization to point anywhere."""
    polarized = q**2 + u**2 > TIP**2
    q, u = jnp.where(polarized, q, 1.0), jnp.where(polarized, u, 0.0)
    length = jnp.sqrt(q**2 + u**2)
    return q / length, u / length


def in_turned_frame(q: Array, u: Array, turn: tuple[Array, Array]) -> tuple[Array, Array]:
    r"""Components along an s axis that is rotated by an angle, towards the second axis.

    $$ q' + i u' = (q + i u) e^{-2i\chi} $$
    """
    cos, sin = turn
    return q * cos + u * sin, u * cos - q * sin


def diattenuate(light: Light, contrast: Array, balance: Array) -> Light:
    r"""Light behind a filter with transmittance 1 + t of s and 1 - t of p (diattenuator).

    $$ I' = I (1 + q t), \quad q' = \frac{q+t}{1+qt}, \quad u' = \frac{u\sqrt{1-t^2}}{1+qt} $$
    """
    total = 1.0 + light.q * contrast
    return Light(light.intensity * total, (light.q + contrast) / total, light.u * balance / total)


def polarized_through(passing: Light, q: Array, u: Array) -> Light:
    r"""Polarized light behind a filter, given its effect on unpolarized light.

    $$ I' = I (1 + d \cdot s), \qquad (1 + d \cdot s) s' = b s
       + \left(1 + \frac{d \cdot s}{1 + b}\right) d, \qquad b = \sqrt{1-d^2} $$
    """
    along = passing.q * q + passing.u * u
    balance = jnp.sqrt(jnp.maximum(1.0 - passing.q**2 - passing.u**2, 0.0))
    total, share = 1.0 + along, 1.0 + along / (1.0 + balance)
    return Light(
        passing.intensity * total,
        (balance * q + share * passing.q) / total,
        (balance * u + share * passing.u) / total,
    )


def angle_of_linear_polarization(q: Array, u: Array) -> Array:
    """Angle of polarization from the s axis, atan2(u, q)/2; 0 where there is none."""
    cos_double, sin_double = direction(q, u)
    return 0.5 * jnp.rad2deg(jnp.arctan2(sin_double, cos_double))


# --- Light that is polarized before it meets the surface ------------------------------------------


@dataclasses.dataclass(frozen=True)
class LinearPolarization(Part):
    """Polarization of the light: its normalized Stokes vector (1, q, u).

    Args:
        degree: Degree of linear polarization, 1, 0 to 1; a name fits it.
        angle: Angle from the light's s axis, `(z x l)/|z x l|`, towards l x e_s, degree, -180 to
            180; a name fits it. 0 is perpendicular to the plane of normal and light.

    Raises:
        SceneError: A setting is neither a number in its range nor a name.
    """

    degree: Annotated[Setting, Range(0.0, 1.0)] = 1.0
    angle: Annotated[Setting, Range(-180.0, 180.0)] = 0.0

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)

    def stokes(self, parameters: Parameters) -> tuple[Array, Array]:
        """The components q and u of the light, in its own frame."""
        degree = value_of(self.degree, parameters)
        angle = 2.0 * value_of(self.angle, parameters)
        return degree * cos_degrees(angle), degree * sin_degrees(angle)


def mirror_light(
    stack: Stack, facet: MirrorFacet, geometry: Geometry, incident: tuple[Array, Array] | None
) -> Light:
    """Light that one facet mirrors to the viewer."""
    mean, power = stack.mirror(facet.cos_incidence, facet.sin_squared)
    if incident is None:
        polarizance = power.contrast / power.mean
        return Light(mean, polarizance * facet.along_s, -polarizance * facet.across_s)
    (q, u), source = incident, mirror_facet(geometry.reversed())
    along = q * source.along_s - u * source.across_s
    across = q * source.across_s + u * source.along_s
    turned_q, turned_u = in_turned_frame(q, u, turn_between_frames(geometry))
    turned = 0.5 * (power.mean + power.cross)
    folded = 0.5 * power.shortfall
    total = power.mean + power.contrast * along
    first = (
        power.contrast * facet.along_s
        + turned * turned_q
        + folded * (along * facet.along_s - across * facet.across_s)
    )
    second = (
        -power.contrast * facet.across_s
        + turned * turned_u
        - folded * (along * facet.across_s + across * facet.along_s)
    )
    # Fully p-polarized light at Brewster's angle is not reflected at all: 0/0 is then kept finite.
    lit = jnp.maximum(total, jnp.finfo(total.dtype).eps * power.mean)
    return Light(mean * total / power.mean, first / lit, second / lit)


def transmit_inward(
    passing: Diattenuation, cos_light: Array, incident: tuple[Array, Array] | None
) -> Light:
    """Light that passes the surface into the body, in the frame of the light."""
    light = cos_light * passing.mean
    q = quotient(passing.contrast * passing.sin_squared, passing.mean)
    if incident is None:
        return Light(light, q, jnp.zeros_like(q))
    return diattenuate(Light(light, *incident), q, passing.cross / passing.mean)
