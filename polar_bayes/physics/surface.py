"""The interface of a material: what it reflects, what it lets in, and what it lets out."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import override

from jaxtyping import Array

from polar_bayes.physics.exit import AbstractExit, RoughExit, exit_through_plane
from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry, mirror_facet
from polar_bayes.physics.illumination import AbstractIllumination, PointSource
from polar_bayes.physics.microfacet import AbstractMicrofacet, Beckmann
from polar_bayes.physics.microsurface import Microsurface
from polar_bayes.physics.part import Part, check_part, parameters_of
from polar_bayes.physics.polarization import mirror_light
from polar_bayes.physics.shadowing import AbstractShadowing, SeparableShadowing
from polar_bayes.physics.slopes import AbstractSlopes, IsotropicSlopes
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import Light


@dataclasses.dataclass(frozen=True)
class AbstractSurface(Part):
    """An interface between air and the body. Parameters broadcast with (..., view).

    What a single facet is made of (the bare body, or layers on it) comes as a `Stack`.
    """

    @abc.abstractmethod
    def light(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        """Light that the interface reflects to the viewer.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.
            stack: Layers and body. Broadcasts with (..., view).

        Returns:
            Light; q > 0 is polarized across the plane of the viewer. Shape (..., view).

        Raises:
            Nothing.
        """

    @abc.abstractmethod
    def entering(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        """Light that passes into the body.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.
            stack: Layers and body. Broadcasts with (..., view).

        Returns:
            Power per area for unit irradiance, or for unit radiance of a disc or sky, and its
            polarization in the plane of the light. Shape (..., view).

        Raises:
            Nothing.
        """

    @abc.abstractmethod
    def beams(
        self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack
    ) -> tuple[Geometry, Light]:
        """The same light ray by ray, for a body that asks where it comes from.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.
            stack: Layers and body. Broadcasts with (..., view).

        Returns:
            `(rays, light)`: directions and light of shape (..., view, ray).

        Raises:
            Nothing.
        """

    @abc.abstractmethod
    def exit(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        """What the interface does to unpolarized light on its way out to the viewer.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.
            stack: Layers and body. Broadcasts with (..., view).

        Returns:
            Light whose intensity is the transmittance; q <= 0, along the plane of the viewer.

        Raises:
            Nothing.
        """


@dataclasses.dataclass(frozen=True)
class SmoothSurface(AbstractSurface):
    """A Fresnel mirror, seen by a detector that catches the whole reflected beam: S0 = R+.

    Light falls in as a beam. The angle of incidence is half the angle between viewer and light.

    Args:
        beam: The light, whose polarization counts.

    Raises:
        SceneError: The beam is no point source.
    """

    beam: PointSource = dataclasses.field(default_factory=PointSource)

    def __post_init__(self) -> None:
        check_part(self.beam, "SmoothSurface: beam", PointSource, "PointSource()")

    @property
    @override
    def parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.beam.parameters

    @override
    def light(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        incident = self.beam.incident(parameters, geometry)
        return mirror_light(stack, mirror_facet(geometry), geometry, incident)

    @override
    def entering(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        return self.beam.entering(stack, geometry, parameters)

    @override
    def beams(
        self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack
    ) -> tuple[Geometry, Light]:
        return self.beam.beams(stack, geometry, parameters)

    @override
    def exit(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        return exit_through_plane(stack, geometry)


@dataclasses.dataclass(frozen=True)
class RoughSurface(AbstractSurface):
    """Facets that are small mirrors, each hit by light once.

    Args:
        distribution: How facets tilt, such as Beckmann() or GGX().
        illumination: Where light comes from, such as PointSource(), Disc(5.0) or UniformSky().
        quadrature: How many facets stand for all.
        slopes: How steep they are in which direction.
        shadowing: Which of them are seen.
        way_out: Whether light from the body leaves through facets or a plane.

    Raises:
        SceneError: A part is of the wrong kind.
    """

    distribution: AbstractMicrofacet = dataclasses.field(default_factory=Beckmann)
    illumination: AbstractIllumination = dataclasses.field(default_factory=PointSource)
    quadrature: FacetQuadrature = dataclasses.field(default_factory=FacetQuadrature)
    slopes: AbstractSlopes = dataclasses.field(default_factory=IsotropicSlopes)
    shadowing: AbstractShadowing = dataclasses.field(default_factory=SeparableShadowing)
    way_out: AbstractExit = dataclasses.field(default_factory=RoughExit)

    def __post_init__(self) -> None:
        for name, kind, examples in (
            ("distribution", AbstractMicrofacet, "Beckmann() or GGX()"),
            ("illumination", AbstractIllumination, "PointSource(), Disc(5.0) or UniformSky()"),
            ("quadrature", FacetQuadrature, "FacetQuadrature(along=6, across=5)"),
            ("slopes", AbstractSlopes, "IsotropicSlopes() or AnisotropicSlopes(azimuth=0.0)"),
            ("shadowing", AbstractShadowing, "SeparableShadowing(), NoShadowing()"),
            ("way_out", AbstractExit, "RoughExit() or SmoothExit()"),
        ):
            check_part(getattr(self, name), f"RoughSurface: {name}", kind, examples)

    @property
    @override
    def parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return parameters_of(self.distribution, self.slopes, self.illumination)

    @property
    def facets(self) -> Microsurface:
        """The surface as a population of facets."""
        return Microsurface(self.distribution, self.shadowing, self.quadrature)

    @override
    def light(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        ellipse = self.slopes.ellipse(parameters, geometry)
        return self.illumination.reflect(self.facets, ellipse, stack, geometry, parameters)

    @override
    def entering(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        return self.illumination.entering(stack, geometry, parameters)

    @override
    def beams(
        self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack
    ) -> tuple[Geometry, Light]:
        return self.illumination.beams(stack, geometry, parameters)

    @override
    def exit(self, parameters: Mapping[str, Array], geometry: Geometry, stack: Stack) -> Light:
        ellipse = self.slopes.ellipse(parameters, geometry)
        return self.way_out.light(self.facets, ellipse, stack, geometry)


@dataclasses.dataclass(frozen=True)
class Interface:
    """A surface with all it is made of, as a body under it needs it.

    Args:
        surface: The surface.
        stack: Layers and body. Broadcasts with (..., view).
    """

    surface: AbstractSurface
    stack: Stack

    def entering(self, parameters: Mapping[str, Array], geometry: Geometry) -> Light:
        """Light that passes into the body; see `AbstractSurface.entering`."""
        return self.surface.entering(parameters, geometry, self.stack)

    def beams(self, parameters: Mapping[str, Array], geometry: Geometry) -> tuple[Geometry, Light]:
        """The same ray by ray; see `AbstractSurface.beams`."""
        return self.surface.beams(parameters, geometry, self.stack)

    def exit(self, parameters: Mapping[str, Array], geometry: Geometry) -> Light:
        """What happens to light on its way out; see `AbstractSurface.exit`."""
        return self.surface.exit(parameters, geometry, self.stack)

    def escape(self) -> Array:
        """Share of diffuse light in the body that is not turned back; see `Stack.escape`."""
        return self.stack.escape()
