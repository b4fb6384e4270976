"""Where the light comes from: how it lights a rough surface and how much of it enters the body."""

import abc
import dataclasses
import math
from typing import override

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics import fresnel
from polar_bayes.physics.facets import (
    FacetQuadrature,
    Window,
    above_horizon,
    inside_disc,
    sample_facets,
)
from polar_bayes.physics.geometry import Geometry, cos_degrees, mirror_facet, sin_degrees
from polar_bayes.physics.microfacet import AbstractMicrofacet
from polar_bayes.physics.stokes import Light

# Directions in a disc, by angle from its center and by azimuth, when counting the light that
# enters the body: exact to 1e-6 of it while the disc is above the horizon, and to .002 (half
# width 15, 89 degrees) where the horizon cuts it.
DISC_NODES = 8


@dataclasses.dataclass(frozen=True)
class AbstractIllumination(abc.ABC):
    """Unpolarized light from a point, a disc or the whole sky."""

    @abc.abstractmethod
    def reflect(
        self,
        distribution: AbstractMicrofacet,
        quadrature: FacetQuadrature,
        roughness: Array,
        refractive_index: Array,
        geometry: Geometry,
    ) -> Light:
        """Light that facets mirror to the viewer.

        Args:
            distribution: How facets tilt.
            quadrature: How many facets stand for all, where an average is taken.
            roughness: Slope parameter. Broadcasts with (..., view), 1.
            refractive_index: n. Broadcasts with (..., view), 1.
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Light per unit irradiance (point) or unit radiance (disc, sky). Shape (..., view).

        Raises:
            Nothing.
        """

    @abc.abstractmethod
    def entering(self, refractive_index: Array, geometry: Geometry) -> Array:
        """Irradiance that passes the interface into the body.

        Args:
            refractive_index: n. Broadcasts with (..., view), 1.
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Power per area, for unit irradiance (point) or unit radiance (disc, sky). (..., view).

        Raises:
            Nothing.
        """


@dataclasses.dataclass(frozen=True)
class PointSource(AbstractIllumination):
    r"""A collimated beam of unit irradiance from the light's direction.

    $$ S = \frac{D(h) G_1(v) G_1(l)}{4 \cos\theta_v}
       [R_+, R_- \cos 2\psi, -R_- \sin 2\psi](\theta_d) $$

    Roughness changes the brightness but not the polarization: only one facet mirrors the light.
    """

    @override
    def reflect(
        self,
        distribution: AbstractMicrofacet,
        quadrature: FacetQuadrature,
        roughness: Array,
        refractive_index: Array,
        geometry: Geometry,
    ) -> Light:
        facet = mirror_facet(geometry)
        cos_view, cos_light = cos_degrees(geometry.view_zenith), cos_degrees(geometry.light_zenith)
        view_slope = (sin_degrees(geometry.view_zenith) / cos_view) ** 2
        light_slope = (sin_degrees(geometry.light_zenith) / cos_light) ** 2
        mean, _ = fresnel.reflection(facet.cos_incidence, facet.sin_squared, refractive_index)
        facets_seen = (
            distribution.density(facet.tan_squared_tilt, roughness)
            * distribution.shadowing(view_slope, roughness)
            * distribution.shadowing(light_slope, roughness)
            / (4.0 * cos_view)
        )
        polarizance = fresnel.polarizance(facet.cos_incidence, facet.sin_squared, refractive_index)
        return Light(facets_seen * mean, polarizance * facet.along_s, -polarizance * facet.across_s)

    @override
    def entering(self, refractive_index: Array, geometry: Geometry) -> Array:
        cos_light = cos_degrees(geometry.light_zenith)
        return cos_light * fresnel.transmission(cos_light, refractive_index)


@dataclasses.dataclass(frozen=True)
class AbstractExtendedSource(AbstractIllumination):
    r"""A source of unit radiance that is symmetric about the plane of the viewer.

    $$ S_0 = \frac{G_1(v)}{\cos\theta_v} \sum_i w_i G_1(l_i) R_+, \qquad
       S_1 = \frac{G_1(v)}{\cos\theta_v} \sum_i w_i G_1(l_i) K \sin^2\theta_i \cos 2\psi_i $$

    The light's direction in the geometry is not used. The factor in front is what one over the
    seen area is in Smith's theory, so nothing has to be normalized by a sum.
    """

    @abc.abstractmethod
    def border(self, sin_view: Array, cos_view: Array) -> Window:
        """Facets that mirror the viewer's ray into the source.

        Args:
            sin_view: Sine of the view zenith. Shape (..., view), 1.
            cos_view: Its cosine. Same shape, 1, > 0.

        Returns:
            Window of slopes.

        Raises:
            Nothing.
        """

    @override
    def reflect(
        self,
        distribution: AbstractMicrofacet,
        quadrature: FacetQuadrature,
        roughness: Array,
        refractive_index: Array,
        geometry: Geometry,
    ) -> Light:
        sin_view, cos_view = sin_degrees(geometry.view_zenith), cos_degrees(geometry.view_zenith)
        facets = sample_facets(distribution, quadrature, roughness, sin_view, cos_view, self.border)
        mean, contrast = fresnel.relative_reflection(
            facets.cos_incidence, facets.sin_squared, refractive_index[..., None]
        )
        cos_light = jnp.clip(facets.cos_light, 1e-6, 1.0)
        light_slope = (1.0 - cos_light) * (1.0 + cos_light) / cos_light**2
        lit = facets.weight * distribution.shadowing(light_slope, roughness[..., None])
        total = jnp.sum(lit * mean, axis=-1)
        polarized = jnp.sum(lit * contrast * facets.along_s, axis=-1)
        seen = distribution.shadowing((sin_view / cos_view) ** 2, roughness) / cos_view
        brightness = seen * fresnel.index_step(refractive_index) * total
        return Light(brightness, polarized / total, jnp.zeros_like(total))


@dataclasses.dataclass(frozen=True)
class UniformSky(AbstractExtendedSource):
    """The whole upper hemisphere, of unit radiance."""

    @override
    def border(self, sin_view: Array, cos_view: Array) -> Window:
        return above_horizon(sin_view, cos_view)

    @override
    def entering(self, refractive_index: Array, geometry: Geometry) -> Array:
        reflected = fresnel.hemispherical_reflection(refractive_index)
        return jnp.pi * (1.0 - reflected) + jnp.zeros_like(geometry.view_zenith)


@dataclasses.dataclass(frozen=True)
class Disc(AbstractExtendedSource):
    """A disc of unit radiance around the viewer's mirror direction, cut at the horizon.

    Args:
        half_width: Angle from the disc's center to its rim, degree, 0.01 to 90.

    Raises:
        SceneError: The half width is not an angle in that range.
    """

    half_width: float

    def __post_init__(self) -> None:
        if not 0.01 <= self.half_width <= 90.0:
            raise SceneError(
                f"half_width={self.half_width!r} is no half width of a disc",
                where="Disc",
                mend="give degrees from 0.01 to 90, or use PointSource() or UniformSky()",
            )

    @override
    def border(self, sin_view: Array, cos_view: Array) -> Window:
        return inside_disc(sin_view, cos_view, math.sin(math.radians(self.half_width) / 2.0))

    @override
    def entering(self, refractive_index: Array, geometry: Geometry) -> Array:
        cosine, sine_cosine, solid_angle = self._directions()
        sin_view = sin_degrees(geometry.view_zenith)[..., None]
        cos_view = cos_degrees(geometry.view_zenith)[..., None]
        cos_light = jnp.asarray(cosine, cos_view.dtype) * cos_view
        cos_light = cos_light + jnp.asarray(sine_cosine, cos_view.dtype) * sin_view
        cos_light = jnp.clip(cos_light, 1e-4, 1.0)
        passing = cos_light * fresnel.transmission(cos_light, refractive_index[..., None])
        return jnp.sum(passing * jnp.asarray(solid_angle, cos_view.dtype), axis=-1)

    def _directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cosine from the axis, sine times cosine of azimuth, and solid angle of each direction."""
        node, weight = np.polynomial.legendre.leggauss(DISC_NODES)
        # Equal steps in the squared sine of half the angle are equal solid angles.
        square = math.sin(math.radians(self.half_width) / 2.0) ** 2
        ring = 0.5 * (node + 1.0) * square
        cosine = 1.0 - 2.0 * ring
        sine = 2.0 * np.sqrt(ring * (1.0 - ring))
        azimuth = np.pi * (np.arange(DISC_NODES) + 0.5) / DISC_NODES
        ring_solid_angle = 2.0 * np.pi * weight * square / DISC_NODES
        return (
            np.repeat(cosine, DISC_NODES),
            np.outer(sine, np.cos(azimuth)).ravel(),
            np.repeat(ring_solid_angle, DISC_NODES),
        )
