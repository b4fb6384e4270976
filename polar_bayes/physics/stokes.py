"""Light as brightness and normalized Stokes components, in the viewer's frame.

Its first axis is e_s = (z x v)/|z x v|: q > 0 is polarized perpendicular to the plane of normal and
viewer (s), q < 0 parallel to it (p), and u > 0 at 45 degrees from e_s.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

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
    return jnp.stack(
        jnp.broadcast_arrays(light.intensity, light.intensity * light.q, light.intensity * light.u),
        axis=-1,
    )


def degree_of_linear_polarization(q: Array, u: Array) -> Array:
    r"""Length of (q, u), with the kink at zero rounded off.

    $$ \sqrt{q^2 + u^2 + \epsilon^2}, \qquad \epsilon = 10^{-12} $$

    So unpolarized light has the value 1e-12, gradient zero and a finite Hessian; above 1e-7 the
    rounding changes the value by less than 1e-10 of itself.

    Args:
        q: Normalized Stokes component. Any shape, in [-1, 1].
        u: Normalized Stokes component. Same shape, in [-1, 1].

    Returns:
        Degree of linear polarization. Same shape, > 0.

    Raises:
        Nothing.
    """
    return jnp.sqrt(q**2 + u**2 + TIP**2)


def direction(q: Array, u: Array) -> tuple[Array, Array]:
    """Unit vector along (q, u); along s where there is no polarization to point anywhere.

    Args:
        q: Normalized Stokes component. Any shape.
        u: Normalized Stokes component. Same shape.

    Returns:
        `(cos, sin)` of twice the angle of polarization. Same shape.

    Raises:
        Nothing.
    """
    polarized = q**2 + u**2 > TIP**2
    q, u = jnp.where(polarized, q, 1.0), jnp.where(polarized, u, 0.0)
    length = jnp.sqrt(q**2 + u**2)
    return q / length, u / length


def in_turned_frame(q: Array, u: Array, turn: tuple[Array, Array]) -> tuple[Array, Array]:
    r"""Components along an s axis that is turned by an angle, towards the second axis.

    $$ q' + i u' = (q + i u) e^{-2i\chi} $$

    Args:
        q: Normalized Stokes component. Any shape.
        u: Normalized Stokes component. Same shape.
        turn: Cosine and sine of twice the angle. Each broadcasts with them.

    Returns:
        `(q', u')`. Broadcast shape.

    Raises:
        Nothing.
    """
    cos, sin = turn
    return q * cos + u * sin, u * cos - q * sin


def angle_of_linear_polarization(q: Array, u: Array) -> Array:
    """Angle of polarization from the s axis, atan2(u, q)/2; 0 where there is none.

    Args:
        q: Normalized Stokes component. Any shape.
        u: Normalized Stokes component. Same shape.

    Returns:
        Angle. Same shape, degree, in (-90, 90].

    Raises:
        Nothing.
    """
    cos_double, sin_double = direction(q, u)
    return 0.5 * jnp.rad2deg(jnp.arctan2(sin_double, cos_double))
