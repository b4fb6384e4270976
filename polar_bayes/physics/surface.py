"""The interface of a material: what it reflects, what it lets in, and what it lets out."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar, override

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics import fresnel
from polar_bayes.physics.facets import FacetQuadrature, Facets, sample_facets, seen
from polar_bayes.physics.geometry import Geometry, cos_degrees, mirror_facet, sin_degrees
from polar_bayes.physics.illumination import AbstractIllumination, PointSource
from polar_bayes.physics.microfacet import AbstractMicrofacet, Beckmann
from polar_bayes.physics.stokes import Light


@dataclasses.dataclass(frozen=True)
class AbstractSurface(abc.ABC):
    """An interface between air and the body. Parameters broadcast with (..., view)."""

    parameters: ClassVar[tuple[str, ...]]

    @abc.abstractmethod
    def light(self, parameters: Mapping[str, Array], geometry: Geometry) -> Light:
        """Light that the interface reflects to the viewer.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Light; q > 0 is polarized across the plane of the viewer. Shape (..., view).

        Raises:
            Nothing.
        """

    @abc.abstractmethod
    def entering(self, parameters: Mapping[str, Array], geometry: Geometry) -> Array:
        """Power per area that passes into the body.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Power for unit irradiance, or for unit radiance of a disc or sky. Shape (..., view).

        Raises:
            Nothing.
        """

    @abc.abstractmethod
    def exit(self, parameters: Mapping[str, Array], geometry: Geometry) -> Light:
        """What the interface does to unpolarized light on its way out to the viewer.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Light whose intensity is the transmittance; q <= 0, along the plane of the viewer.

        Raises:
            Nothing.
        """


@dataclasses.dataclass(frozen=True)
class SmoothSurface(AbstractSurface):
    """A Fresnel mirror, seen by a detector that catches the whole reflected beam: S0 = R+.

    Light falls in as a beam. The angle of incidence is half the angle between viewer and light.
    """

    parameters: ClassVar[tuple[str, ...]] = ("refractive_index",)

    @override
    def light(self, parameters: Mapping[str, Array], geometry: Geometry) -> Light:
        n = parameters["refractive_index"]
        facet = mirror_facet(geometry)
        mean, _ = fresnel.reflection(facet.cos_incidence, facet.sin_squared, n)
        polarizance = fresnel.polarizance(facet.cos_incidence, facet.sin_squared, n)
        return Light(mean, polarizance * facet.along_s, -polarizance * facet.across_s)

    @override
    def entering(self, parameters: Mapping[str, Array], geometry: Geometry) -> Array:
        return PointSource().entering(parameters["refractive_index"], geometry)

    @override
    def exit(self, parameters: Mapping[str, Array], geometry: Geometry) -> Light:
        n = parameters["refractive_index"]
        cos_view = cos_degrees(geometry.view_zenith)
        sin_squared = sin_degrees(geometry.view_zenith) ** 2
        q = -fresnel.exit_polarization(cos_view, sin_squared, n)
        return Light(fresnel.transmission(cos_view, n), q, jnp.zeros_like(q))


@dataclasses.dataclass(frozen=True)
class RoughSurface(AbstractSurface):
    r"""Facets that are small mirrors, each hit by light once.

    The way out is an average over the facets that the viewer sees:

    $$ E_0 = \sum_i w_i T_+, \qquad E_1 = -\sum_i w_i K \sin^2\theta_i \cos 2\psi_i $$

    Args:
        distribution: How facets tilt, such as Beckmann() or GGX().
        illumination: Where light comes from, such as PointSource(), Disc(5.0) or UniformSky().
        quadrature: How many facets stand for all.

    Raises:
        SceneError: A part is of the wrong kind.
    """

    distribution: AbstractMicrofacet = dataclasses.field(default_factory=Beckmann)
    illumination: AbstractIllumination = dataclasses.field(default_factory=PointSource)
    quadrature: FacetQuadrature = dataclasses.field(default_factory=FacetQuadrature)

    parameters: ClassVar[tuple[str, ...]] = ("roughness", "refractive_index")

    def __post_init__(self) -> None:
        for name, kind, examples in (
            ("distribution", AbstractMicrofacet, "Beckmann() or GGX()"),
            ("illumination", AbstractIllumination, "PointSource(), Disc(5.0) or UniformSky()"),
            ("quadrature", FacetQuadrature, "FacetQuadrature(along=6, across=5)"),
        ):
            if not isinstance(getattr(self, name), kind):
                raise SceneError(
                    f"{name}={getattr(self, name)!r} is not such a part",
                    where="RoughSurface",
                    mend=f"give {examples}",
                )

    @override
    def light(self, parameters: Mapping[str, Array], geometry: Geometry) -> Light:
        return self.illumination.reflect(
            self.distribution,
            self.quadrature,
            parameters["roughness"],
            parameters["refractive_index"],
            geometry,
        )

    @override
    def entering(self, parameters: Mapping[str, Array], geometry: Geometry) -> Array:
        return self.illumination.entering(parameters["refractive_index"], geometry)

    @override
    def exit(self, parameters: Mapping[str, Array], geometry: Geometry) -> Light:
        facets = sample_facets(
            self.distribution,
            self.quadrature,
            parameters["roughness"],
            sin_degrees(geometry.view_zenith),
            cos_degrees(geometry.view_zenith),
            seen,
        )
        # Without a barrier XLA's CPU compiler fuses the facets into each of their many readers and
        # computes them anew for each: a gradient then takes up to five times as long.
        facets = Facets(*jax.lax.optimization_barrier(tuple(facets)))
        n = parameters["refractive_index"][..., None]
        _, contrast = fresnel.reflection(facets.cos_incidence, facets.sin_squared, n)
        passing = jnp.sum(facets.weight * fresnel.transmission(facets.cos_incidence, n), axis=-1)
        polarized = -jnp.sum(facets.weight * contrast * facets.along_s, axis=-1)
        area = jnp.sum(facets.weight, axis=-1)
        way_out = Light(passing / area, polarized / passing, jnp.zeros_like(passing))
        return Light(*jax.lax.optimization_barrier(tuple(way_out)))
