"""The interface of a material: reflection, transmission into the body, and out of it."""

import abc
import dataclasses
from typing import ClassVar, override

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.boundary import Diattenuation
from polar_bayes.physics.coat import BackFace
from polar_bayes.physics.facets import FacetQuadrature, Facets, Microsurface, seen, sum_facets
from polar_bayes.physics.geometry import (
    Geometry,
    cos_degrees,
    mirror_facet,
    per_facet,
    per_ray,
    sin_degrees,
)
from polar_bayes.physics.illumination import (
    FOUR_TURNS,
    AbstractIllumination,
    Beams,
    PointSource,
    Turns,
)
from polar_bayes.physics.microfacet import (
    AbstractMicrofacet,
    AbstractShadowing,
    AbstractSlopes,
    Beckmann,
    IsotropicSlopes,
    SeparableShadowing,
)
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.part import (
    Parameters,
    Part,
    check_part,
    like,
    parameters_of,
    quotient,
    squared_rule,
    value_of,
)
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import Light, mirror_light, polarized_through

# Directions inside, by zenith and by azimuth of grooves, where facets turn light back.
HEMISPHERE_NODES, GROOVE_AZIMUTHS = 8, 4

# --- The way out: what a surface does to light that leaves the body -------------------------------


@dataclasses.dataclass(frozen=True)
class AbstractExit(Part):
    """Passage of unpolarized light from the body to the viewer.

    Args:
        both_ways: Whether light enters the body as it leaves it, or as through a plane.
    """

    both_ways: ClassVar[bool] = False

    @abc.abstractmethod
    def light(self, facets: Microsurface, stack: Stack, geometry: Geometry) -> Light:
        """Transmittance towards the viewer, and the polarization that results.

        Args:
            facets: How they tilt in the frame of each viewer, which are seen, and how many stand
                for all.
            stack: What one facet is made of. Broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.

        Returns:
            Light whose intensity is the transmittance. Shape (..., view).
        """


@dataclasses.dataclass(frozen=True)
class SmoothExit(AbstractExit):
    """Passage through a plane, at any roughness."""

    @override
    def light(self, facets: Microsurface, stack: Stack, geometry: Geometry) -> Light:
        return exit_through_plane(stack, geometry)


@dataclasses.dataclass(frozen=True)
class RoughExit(AbstractExit):
    r"""Passage through the facets that the viewer sees.

    $$ E_0 = \sum_i w_i T_+, \qquad E_1 = -\sum_i w_i K \sin^2\theta_i \cos 2\psi_i $$

    Light enters as through a plane, which costs nothing. So viewer and light may not change
    places: at roughness .3 a body lit at 80 degrees and seen from the normal is 20 % darker than
    lit from the normal and seen at 80 degrees, over both cosines; at roughness .1, 4.5 %. Where
    that matters, `RoughPassage` enters through the facets, too.
    """

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (SmoothExit(),)

    @override
    def light(self, facets: Microsurface, stack: Stack, geometry: Geometry) -> Light:
        sample = facets.sample(geometry, seen)
        # A barrier keeps facets from being found anew for each of their readers; see `facets`.
        sample = Facets(*jax.lax.optimization_barrier(tuple(sample)))
        passing = self.passing(facets, sample, stack, geometry)
        area = jnp.sum(sample.weight, axis=-2)
        light = sum_facets(sample, sample.weight, passing)
        light = light._replace(intensity=quotient(light.intensity, area))
        return Light(*jax.lax.optimization_barrier(tuple(light)))

    def passing(
        self, facets: Microsurface, sample: Facets, stack: Stack, geometry: Geometry
    ) -> Diattenuation:
        """What comes through of the light at each facet of a sample."""
        del facets, geometry
        return per_facet(stack).transmission(sample.cos_incidence, sample.sin_squared)


@dataclasses.dataclass(frozen=True)
class RoughPassage(RoughExit):
    r"""Passage through facets on the way in and out, and reflection back inside.

    $$ S_0 = \frac{A \cos\theta_l E_0(l) E_0(v)}{\pi n^2 (1 - A F_i)}, \qquad
       1 - F_i = \frac{1}{n^2} \int_0^1 2\mu E_0(\mu)\, d\mu $$

    Viewer and light may change places, and surface and body together give back no more than comes.
    Each ray that enters, and each of 8 directions inside, costs as much as the way out.
    """

    both_ways: ClassVar[bool] = True

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (RoughExit(), SmoothExit())


def exit_through_plane(stack: Stack, geometry: Geometry) -> Light:
    """Transmittance and polarization by a plane surface, in shapes of `AbstractExit.light`."""
    cos_view, sin_view = cos_degrees(geometry.view_zenith), sin_degrees(geometry.view_zenith)
    passing = stack.transmission(cos_view, sin_view**2)
    q = quotient(passing.contrast * sin_view**2, passing.mean)
    return Light(passing.mean, q, jnp.zeros_like(q))


# --- The interface of a material: what it reflects, what it lets in, and what it lets out ---------


@dataclasses.dataclass(frozen=True)
class AbstractSurface(Part):
    """An interface between air and the body.

    Every method takes `parameters` (material parameters by name, each broadcasts with (..., view)),
    `geometry` (directions of shape (..., view), in degrees) and `stack` (what a single facet is
    made of: the bare body, or layers on it; broadcasts with (..., view)).
    """

    @abc.abstractmethod
    def light(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        """Light that the interface reflects to the viewer.

        Returns:
            Light; q > 0 is polarized across the plane of the viewer. Shape (..., view).
        """

    @abc.abstractmethod
    def entering(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        """Light that passes into the body.

        Returns:
            Power per area for unit irradiance, or for unit radiance of a disc or sky, and its
            polarization in the plane of the light. Shape (..., view).
        """

    @abc.abstractmethod
    def beams(
        self, parameters: Parameters, geometry: Geometry, stack: Stack, around: Turns = FOUR_TURNS
    ) -> Beams:
        """Light that passes into the body ray by ray, for bodies that depend on its direction.

        Args:
            parameters: As in all methods, and so are geometry and stack.
            geometry: Directions.
            stack: What a facet is made of.
            around: See `AbstractIllumination.rays`.

        Returns:
            `(rays, light)`: directions and light of shape (..., view, ray).
        """

    @abc.abstractmethod
    def exit(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        """Effect of the interface on unpolarized light on its way out to the viewer.

        Returns:
            Light whose intensity is the transmittance; q <= 0, along the plane of the viewer.
        """

    def escape(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Array:
        """Share of diffuse light that is not reflected back inside; broadcasts with views."""
        del parameters, geometry
        return stack.escape()


@dataclasses.dataclass(frozen=True)
class SmoothSurface(AbstractSurface):
    """A Fresnel mirror whose whole reflected beam reaches the detector: S0 = R+.

    Light falls in as a beam. The angle of incidence is half the angle between viewer and light.

    Args:
        beam: The light, whose polarization counts.
        back: BackFace(), where the body is a transparent plate that nobody blackened; or None.

    Raises:
        SceneError: The beam is no point source, or the back is no back face.
    """

    beam: PointSource = dataclasses.field(default_factory=PointSource)
    back: BackFace | None = None

    def __post_init__(self) -> None:
        check_part(self.beam, "SmoothSurface: beam", PointSource, "PointSource()")
        check_part(self.back, "SmoothSurface: back", BackFace | None, "BackFace() or None")

    @override
    def light(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        facet, incident = mirror_facet(geometry), self.beam.incident(parameters, geometry)
        front = mirror_light(stack, facet, geometry, incident)
        if self.back is None:
            return front
        plate = mirror_light(self.back.behind(stack, parameters), facet, geometry, incident)
        return StokesMixing().mix(value_of(self.back.share, parameters), front, plate)

    @override
    def entering(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        return self.beam.entering(stack, geometry, parameters)

    @override
    def beams(
        self, parameters: Parameters, geometry: Geometry, stack: Stack, around: Turns = FOUR_TURNS
    ) -> Beams:
        return self.beam.beams(stack, geometry, parameters, around)

    @override
    def exit(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        return exit_through_plane(stack, geometry)


@dataclasses.dataclass(frozen=True)
class RoughSurface(AbstractSurface):
    """A surface of small mirrors (facets), each of which reflects light once.

    Args:
        distribution: How facets tilt, such as Beckmann() or GGX().
        illumination: Where light comes from, such as PointSource(), Disc(5.0) or UniformSky().
        quadrature: How many facets stand for all.
        slopes: How steep they are in which direction.
        shadowing: Which of them are seen.
        way_out: Whether light from the body leaves through facets or a plane, or passes facets both
            ways.

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
            ("way_out", AbstractExit, "RoughExit() or SmoothExit(), RoughPassage()"),
        ):
            check_part(getattr(self, name), f"RoughSurface: {name}", kind, examples)

    @property
    @override
    def parameters(self) -> tuple[str, ...]:
        return parameters_of(self.distribution, self.slopes, self.illumination)

    def facets(self, parameters: Parameters, geometry: Geometry) -> Microsurface:
        """The surface as a population of facets."""
        ellipse = self.slopes.ellipse(parameters, geometry)
        return Microsurface(self.distribution, self.shadowing, self.quadrature, ellipse)

    @override
    def light(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        facets = self.facets(parameters, geometry)
        return self.illumination.reflect(facets, stack, geometry, parameters)

    @override
    def entering(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        if not self.way_out.both_ways:
            return self.illumination.entering(stack, geometry, parameters)
        light = self.beams(parameters, geometry, stack)[1]
        total = jnp.sum(light.intensity, axis=-1)
        q, u = (jnp.sum(light.intensity * share, axis=-1) for share in (light.q, light.u))
        return Light(total, quotient(q, total), quotient(u, total))

    @override
    def beams(
        self, parameters: Parameters, geometry: Geometry, stack: Stack, around: Turns = FOUR_TURNS
    ) -> Beams:
        if not self.way_out.both_ways:
            return self.illumination.beams(stack, geometry, parameters, around)
        rays, irradiance = self.illumination.rays(geometry, parameters, around)
        each = per_ray(dict(parameters))
        passing = self.exit(each, rays.reversed(), per_ray(stack))
        power = irradiance * cos_degrees(rays.light_zenith) * passing.intensity
        incident = self.illumination.incident(each, rays)
        if incident is None:
            return rays, passing._replace(intensity=power)
        return rays, polarized_through(passing._replace(intensity=power), *incident)

    @override
    def exit(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Light:
        return self.way_out.light(self.facets(parameters, geometry), stack, geometry)

    @override
    def escape(self, parameters: Parameters, geometry: Geometry, stack: Stack) -> Array:
        if not self.way_out.both_ways:
            return stack.escape()
        # Azimuths a right angle apart see the same grooves from both sides of an axis of theirs.
        cosine, weight = (like(x, geometry.view_zenith) for x in squared_rule(HEMISPHERE_NODES))
        count = GROOVE_AZIMUTHS if self.slopes.turned else 1
        turns = jnp.arange(count, dtype=cosine.dtype) * (180.0 / count)
        zenith, azimuth = jnp.meshgrid(jnp.rad2deg(jnp.arccos(cosine)), turns)
        start = 0.0 * geometry.view_zenith
        axes = self.slopes.ellipse(parameters, geometry).axes
        if axes is not None:
            # From the grooves, whatever azimuth counts from: a rule of so few is not exact.
            start = geometry.view_azimuth + jnp.rad2deg(jnp.arctan2(axes.sin, axes.cos))
        some = per_ray(start) * 0.0
        down, around = some + zenith.ravel(), per_ray(start) + azimuth.ravel()
        views = Geometry(down, around, down, around)
        passing = self.exit(per_ray(dict(parameters)), views, per_ray(stack)).intensity
        share = jnp.tile(2.0 * cosine * weight, count) / count
        more = jnp.sum(share * passing, axis=-1) - stack.hemispherical_transmission()
        return stack.escape() + more / parameters["refractive_index"] ** 2


@dataclasses.dataclass(frozen=True)
class Interface:
    """A surface with its stack, geometry and parameters, as the body below needs it."""

    surface: AbstractSurface
    stack: Stack

    def entering(self, parameters: Parameters, geometry: Geometry) -> Light:
        """Light that passes into the body; see `AbstractSurface.entering`."""
        return self.surface.entering(parameters, geometry, self.stack)

    def beams(
        self, parameters: Parameters, geometry: Geometry, around: Turns = FOUR_TURNS
    ) -> Beams:
        """Light that passes into the body ray by ray; see `AbstractSurface.beams`."""
        return self.surface.beams(parameters, geometry, self.stack, around)

    def exit(self, parameters: Parameters, geometry: Geometry) -> Light:
        """Effect of the interface on light that leaves; see `AbstractSurface.exit`."""
        return self.surface.exit(parameters, geometry, self.stack)

    def escape(self, parameters: Parameters, geometry: Geometry) -> Array:
        """Share of diffuse light that is not reflected back inside; see `Stack.escape`."""
        return self.surface.escape(parameters, geometry, self.stack)


# --- What the interface turns back into the body: light gets another chance to come out -----------


@dataclasses.dataclass(frozen=True)
class InternalReflection(Part):
    r"""Diffuse light that the interface reflects back and the body scatters again.

    $$ 1 + A F_i + (A F_i)^2 + \dots = \frac{1}{1 - A F_i} $$

    for a body of albedo A. Where a body's `internal_reflection` is None, F_i = 0.
    """

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)
