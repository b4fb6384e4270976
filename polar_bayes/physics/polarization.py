r"""Light that is polarized before it meets the surface.

A facet multiplies the components of the field by its reflectances. With P = q + iu of the light in
its own frame and W = B exp(2 i psi) of either frame (B the squared sine of incidence),

    S0 = R+ + K Re(P W_l)
    S1 + i S2 = K conj(W_v) + (R+ + x)/2 P exp(-2i(psi_v + psi_l)) + J/2 conj(P W_l W_v)

where K, J and x are the contrast, shortfall and cross term of `Diattenuation`: nothing is singular
where viewer and light coincide. Only linear polarization is followed: what total reflection or a
thin film turns into circular light counts as unpolarized.
"""

import dataclasses
from collections.abc import Mapping
from typing import override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.diattenuation import Diattenuation
from polar_bayes.physics.geometry import (
    Geometry,
    MirrorFacet,
    cos_degrees,
    mirror_facet,
    sin_degrees,
    turn_between_frames,
)
from polar_bayes.physics.part import Part, Setting, check_setting, names_in, value_of
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import Light


@dataclasses.dataclass(frozen=True)
class LinearPolarization(Part):
    """How the light is polarized: its normalized Stokes vector (1, q, u).

    Args:
        degree: Degree of linear polarization, 1, 0 to 1; a name fits it.
        angle: Angle from the light's s axis, (z x l)/|z x l|, towards l x e_s, degree, -180 to
            180; a name fits it. 0 is perpendicular to the plane of normal and light.

    Raises:
        SceneError: A setting is neither a number in its range nor a name.
    """

    degree: Setting = 1.0
    angle: Setting = 0.0

    def __post_init__(self) -> None:
        check_setting(self.degree, "LinearPolarization: degree", 0.0, 1.0)
        check_setting(self.angle, "LinearPolarization: angle", -180.0, 180.0)

    @property
    @override
    def parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return names_in(self.degree, self.angle)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)

    def stokes(self, parameters: Mapping[str, Array]) -> tuple[Array, Array]:
        """The components q and u of the light, in its own frame."""
        degree = value_of(self.degree, parameters)
        angle = 2.0 * value_of(self.angle, parameters)
        return degree * cos_degrees(angle), degree * sin_degrees(angle)


def mirror_light(
    stack: Stack,
    facet: MirrorFacet,
    geometry: Geometry,
    incident: tuple[Array, Array] | None,
) -> Light:
    """Light that one facet mirrors to the viewer.

    Args:
        stack: What the facet is made of. Broadcasts with (..., view).
        facet: The facet that mirrors light to viewer. Shape (..., view).
        geometry: Directions. Shape (..., view), degree.
        incident: Components q and u of the light in its own frame; None for unpolarized light.

    Returns:
        Light whose intensity is the reflectance. Shape (..., view).

    Raises:
        Nothing.
    """
    power = stack.relative_reflection(facet.cos_incidence, facet.sin_squared)
    if incident is None:
        polarizance = power.contrast / power.mean
        mean = stack.scale * power.mean
        return Light(mean, polarizance * facet.along_s, -polarizance * facet.across_s)
    (q, u), source = incident, mirror_facet(geometry.reversed())
    along = q * source.along_s - u * source.across_s
    across = q * source.across_s + u * source.along_s
    cos, sin = turn_between_frames(geometry)
    turned = 0.5 * (power.mean + power.cross)
    folded = 0.5 * power.shortfall
    total = power.mean + power.contrast * along
    first = (
        power.contrast * facet.along_s
        + turned * (q * cos + u * sin)
        + folded * (along * facet.along_s - across * facet.across_s)
    )
    second = (
        -power.contrast * facet.across_s
        + turned * (u * cos - q * sin)
        - folded * (along * facet.across_s + across * facet.along_s)
    )
    # Fully p-polarized light at Brewster's angle is not reflected at all: 0/0 is then kept finite.
    lit = jnp.maximum(total, jnp.finfo(total.dtype).eps * power.mean)
    return Light(stack.scale * total, first / lit, second / lit)


def let_in(passing: Diattenuation, cos_light: Array, incident: tuple[Array, Array] | None) -> Light:
    """Light that passes the surface into the body, in the frame of the light.

    Args:
        passing: What the surface lets in from the light's direction. Shape (..., view).
        cos_light: Cosine of the light's zenith. Shape (..., view), 1.
        incident: Components q and u of the light in its own frame; None for unpolarized light.

    Returns:
        Power per area for unit irradiance, with its polarization. Shape (..., view).

    Raises:
        Nothing.
    """
    contrast = passing.contrast * passing.sin_squared
    if incident is None:
        q = contrast / passing.mean
        return Light(cos_light * passing.mean, q, jnp.zeros_like(q))
    q, u = incident
    total = passing.mean + contrast * q
    return Light(
        cos_light * total, (contrast + passing.mean * q) / total, passing.cross * u / total
    )
