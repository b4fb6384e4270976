"""A rough surface as a population of facets: how they tilt, and which of them are seen.

A point source asks for the one facet that mirrors it (`density`), an extended source and the way
out of the body for a sample of them (`sample`).
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.diattenuation import Diattenuation
from polar_bayes.physics.facets import FacetQuadrature, Facets, Window, sample_facets
from polar_bayes.physics.geometry import Geometry, cos_degrees, mirror_slopes, sin_degrees
from polar_bayes.physics.microfacet import AbstractMicrofacet, AbstractShadowing, SlopeEllipse
from polar_bayes.physics.stokes import Light

Border = Callable[[Array, Array], Window]


@dataclasses.dataclass(frozen=True)
class Microsurface:
    """Facets of a surface.

    Args:
        distribution: How facets tilt.
        shadowing: Which of them are seen.
        quadrature: How many stand for all.
    """

    distribution: AbstractMicrofacet
    shadowing: AbstractShadowing
    quadrature: FacetQuadrature

    def density(self, ellipse: SlopeEllipse, geometry: Geometry, tan_squared: Array) -> Array:
        """Facet area per steradian around the facet that mirrors the light to the viewer.

        Args:
            ellipse: Slopes in the frame of each viewer. Shape (..., view).
            geometry: Directions. Shape (..., view), degree.
            tan_squared: Squared slope of that facet. Shape (..., view), 1.

        Returns:
            D. Shape (..., view), 1/sr.

        Raises:
            Nothing.
        """
        if ellipse.shear is None:
            return self.distribution.density(tan_squared, ellipse.across)
        # The slopes of an isotropic surface with the same peak that are met as often as these.
        in_plane, out_of_plane = mirror_slopes(geometry)
        w = out_of_plane / ellipse.across
        u = (in_plane - ellipse.shear * w) / ellipse.along
        peak = ellipse.across * ellipse.along
        alike = peak * (u**2 + w**2)
        stretch = (1.0 + tan_squared) / (1.0 + alike)
        return self.distribution.density(alike, jnp.sqrt(peak)) * stretch**2

    def visible(self, ellipse: SlopeEllipse, x: Array, y: Array) -> Array:
        """G1, the share of facets that see one direction.

        Args:
            ellipse: Slopes in the frame of each viewer. Shape (..., view).
            x: Tangent of the direction's zenith in the plane of the viewer. Broadcasts, 1.
            y: The same across it. Broadcasts, 1.

        Returns:
            G1. Broadcast shape, 1, in (0, 1].

        Raises:
            Nothing.
        """
        if ellipse.shear is None:
            return self.distribution.shadowing(x**2 + y**2, ellipse.across)
        peak = ellipse.across * ellipse.along
        steepness = (ellipse.along * x) ** 2 + (ellipse.shear * x + ellipse.across * y) ** 2
        return self.distribution.shadowing(steepness / peak, jnp.sqrt(peak))

    def sample(self, ellipse: SlopeEllipse, geometry: Geometry, border: Border) -> Facets:
        """Facets inside a border, weighted by the area that they show to the viewer.

        Args:
            ellipse: Slopes in the frame of each viewer. Shape (..., view).
            geometry: Directions. Shape (..., view), degree.
            border: Window of a view, from its sine and cosine.

        Returns:
            Facets of shape (..., facet, view).

        Raises:
            Nothing.
        """
        return sample_facets(
            self.distribution,
            self.quadrature,
            ellipse,
            sin_degrees(geometry.view_zenith),
            cos_degrees(geometry.view_zenith),
            border,
        )


def gather(
    sample: Facets, weight: Array, power: Diattenuation, *, least: float | None = None
) -> Light:
    """Light of all facets together.

    Args:
        sample: The facets. Shape (..., facet, view).
        weight: How much each counts. Same shape.
        power: What each reflects or lets pass. Same shape.
        least: Smallest sum that counts, where there may be no facet; None where there always is.

    Returns:
        Light whose intensity is the weighted sum. Shape (..., view).

    Raises:
        Nothing.
    """
    total = jnp.sum(weight * power.mean, axis=-2)
    if least is not None:
        total = jnp.maximum(total, least)
    polarized = weight * power.contrast
    q = jnp.sum(polarized * sample.along_s, axis=-2) / total
    if sample.across_s is None:
        return Light(total, q, jnp.zeros_like(q))
    return Light(total, q, -jnp.sum(polarized * sample.across_s, axis=-2) / total)
