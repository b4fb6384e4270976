"""The way out: what a surface does to light that leaves the body."""

import abc
import dataclasses
from typing import override

import jax
import jax.numpy as jnp

from polar_bayes.physics.facets import Facets, seen
from polar_bayes.physics.geometry import Geometry, cos_degrees, sin_degrees
from polar_bayes.physics.microsurface import Microsurface, gather
from polar_bayes.physics.part import Part
from polar_bayes.physics.slopes import SlopeEllipse
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import Light


@dataclasses.dataclass(frozen=True)
class AbstractExit(Part):
    """How unpolarized light passes from the body to the viewer."""

    @abc.abstractmethod
    def light(
        self, facets: Microsurface, ellipse: SlopeEllipse, stack: Stack, geometry: Geometry
    ) -> Light:
        """Transmittance towards the viewer, and the polarization that it gives.

        Args:
            facets: How they tilt, which are seen, and how many stand for all.
            ellipse: Their slopes in the frame of each viewer. Broadcasts with (..., view).
            stack: What one facet is made of. Broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Light whose intensity is the transmittance. Shape (..., view).

        Raises:
            Nothing.
        """


@dataclasses.dataclass(frozen=True)
class SmoothExit(AbstractExit):
    """Through a plane, whatever the roughness."""

    @override
    def light(
        self, facets: Microsurface, ellipse: SlopeEllipse, stack: Stack, geometry: Geometry
    ) -> Light:
        return exit_through_plane(stack, geometry)


@dataclasses.dataclass(frozen=True)
class RoughExit(AbstractExit):
    r"""Through the facets that the viewer sees.

    $$ E_0 = \sum_i w_i T_+, \qquad E_1 = -\sum_i w_i K \sin^2\theta_i \cos 2\psi_i $$
    """

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (SmoothExit(),)

    @override
    def light(
        self, facets: Microsurface, ellipse: SlopeEllipse, stack: Stack, geometry: Geometry
    ) -> Light:
        sample = facets.sample(ellipse, geometry, seen)
        # A barrier keeps facets from being found anew for each of their readers; see `facets`.
        sample = Facets(*jax.lax.optimization_barrier(tuple(sample)))
        passing = stack.per_facet().transmission(sample.cos_incidence, sample.sin_squared)
        area = jnp.sum(sample.weight, axis=-2)
        light = gather(sample, sample.weight, passing)
        light = light._replace(intensity=light.intensity / area)
        return Light(*jax.lax.optimization_barrier(tuple(light)))


def exit_through_plane(stack: Stack, geometry: Geometry) -> Light:
    """Transmittance and polarization of a plane surface; the shapes of `AbstractExit.light`."""
    cos_view, sin_view = cos_degrees(geometry.view_zenith), sin_degrees(geometry.view_zenith)
    passing = stack.transmission(cos_view, sin_view**2)
    q = passing.contrast * sin_view**2 / passing.mean
    return Light(passing.mean, q, jnp.zeros_like(q))
