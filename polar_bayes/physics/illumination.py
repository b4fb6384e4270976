"""Illumination: how light reaches a rough surface, and how much of it enters the body."""

import abc
import dataclasses
import math
from typing import Annotated, ClassVar, override

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.facets import Microsurface, Window, above_horizon, inside_disc, sum_facets
from polar_bayes.physics.geometry import (
    Geometry,
    cos_degrees,
    mirror_facet,
    per_facet,
    per_ray,
    sin_degrees,
)
from polar_bayes.physics.part import (
    Parameters,
    Part,
    Range,
    Setting,
    check_part,
    like,
    quotient,
    squared_rule,
    unit_rule,
    value_of,
)
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import (
    Light,
    LinearPolarization,
    in_turned_frame,
    mirror_light,
    transmit_inward,
)

Beams = tuple[Geometry, Light]
"""Rays from the light source, and the part of each that enters the body."""

Turns = tuple[tuple[float, float], ...]
"""Azimuths in degrees with their weights, which sum to 1."""

FOUR_TURNS: Turns = ((0.0, 0.25), (90.0, 0.25), (180.0, 0.25), (270.0, 0.25))
"""Azimuths whose first and second harmonics vanish: Rayleigh scattering has no others."""


@dataclasses.dataclass(frozen=True)
class AbstractIllumination(Part):
    """Light from a point, a disc or the whole sky."""

    @abc.abstractmethod
    def reflect(
        self, facets: Microsurface, stack: Stack, geometry: Geometry, parameters: Parameters
    ) -> Light:
        """Light that facets mirror to the viewer.

        Args:
            facets: How they tilt in the frame of each viewer, which are seen, and how many stand
                for all.
            stack: What one facet is made of. Broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.
            parameters: Material parameters by name, for those of the light itself.

        Returns:
            Light per unit irradiance (point) or unit radiance (disc, sky). Shape (..., view).
        """

    @abc.abstractmethod
    def entering(self, stack: Stack, geometry: Geometry, parameters: Parameters) -> Light:
        """Irradiance that passes the interface into the body; arguments as in `reflect`.

        Returns:
            Power per area, for unit irradiance (point) or unit radiance (disc, sky), with its
            polarization in the light's own plane. Shape (..., view).
        """

    @abc.abstractmethod
    def rays(
        self, geometry: Geometry, parameters: Parameters, around: Turns = FOUR_TURNS
    ) -> tuple[Geometry, Array]:
        """Beams that represent the source, for bodies that depend on the direction of light.

        Args:
            geometry: Directions. Shape (..., view), degree.
            parameters: Material parameters by name, for those of the light itself.
            around: Azimuths from that of the viewer, degree, and their shares, which stand for
                all azimuths of a source that is alike all around.

        Returns:
            `(geometry, irradiance)` with a ray axis: directions of shape (..., view, ray), and what
            each beam brings across itself. Broadcasts with them.
        """

    def incident(self, parameters: Parameters, geometry: Geometry) -> tuple[Array, Array] | None:
        """Components q and u of the light in its own frame; None for unpolarized light."""
        del parameters, geometry
        return None

    def beams(
        self,
        stack: Stack,
        geometry: Geometry,
        parameters: Parameters,
        around: Turns = FOUR_TURNS,
    ) -> Beams:
        """Light that passes into the body, ray by ray; see `rays` and `entering`."""
        rays, irradiance = self.rays(geometry, parameters, around)
        cos_light = cos_degrees(rays.light_zenith)
        passing = per_ray(stack).transmission(cos_light, sin_degrees(rays.light_zenith) ** 2)
        light = transmit_inward(passing, cos_light, self.incident(per_ray(dict(parameters)), rays))
        return rays, light._replace(intensity=irradiance * light.intensity)


@dataclasses.dataclass(frozen=True)
class PointSource(AbstractIllumination):
    r"""A collimated beam of unit irradiance from the light's direction.

    $$ S = \frac{D(h) G(v, l)}{4 \cos\theta_v}
       [R_+, R_- \cos 2\psi, -R_- \sin 2\psi](\theta_d) $$

    Roughness changes the brightness but not the polarization: only one facet mirrors the light.

    Args:
        polarization: How the beam is polarized; None for unpolarized light.

    Raises:
        SceneError: The polarization is not such a part.
    """

    polarization: LinearPolarization | None = None

    def __post_init__(self) -> None:
        if self.polarization is not None:
            allowed = "LinearPolarization(degree=1.0, angle=0.0) or None"
            check_part(self.polarization, "PointSource: polarization", LinearPolarization, allowed)

    @override
    def reflect(
        self, facets: Microsurface, stack: Stack, geometry: Geometry, parameters: Parameters
    ) -> Light:
        facet = mirror_facet(geometry)
        cos_view, cos_light = cos_degrees(geometry.view_zenith), cos_degrees(geometry.light_zenith)
        to_viewer = sin_degrees(geometry.view_zenith) / cos_view
        to_light = sin_degrees(geometry.light_zenith) / cos_light
        azimuth = geometry.light_azimuth - geometry.view_azimuth
        seen = facets.shadowing.both(
            facets.visible(to_viewer, jnp.zeros_like(to_viewer)),
            facets.visible(to_light * cos_degrees(azimuth), to_light * sin_degrees(azimuth)),
        )
        mirrored = mirror_light(stack, facet, geometry, self.incident(parameters, geometry))
        density = facets.density(geometry, facet.tan_squared_tilt)
        return mirrored._replace(intensity=density * seen / (4.0 * cos_view) * mirrored.intensity)

    @override
    def entering(self, stack: Stack, geometry: Geometry, parameters: Parameters) -> Light:
        cos_light = cos_degrees(geometry.light_zenith)
        passing = stack.transmission(cos_light, sin_degrees(geometry.light_zenith) ** 2)
        return transmit_inward(passing, cos_light, self.incident(parameters, geometry))

    @override
    def rays(
        self, geometry: Geometry, parameters: Parameters, around: Turns = FOUR_TURNS
    ) -> tuple[Geometry, Array]:
        rays = per_ray(geometry)
        return rays, jnp.ones_like(rays.light_zenith)

    @override
    def incident(self, parameters: Parameters, geometry: Geometry) -> tuple[Array, Array] | None:
        if self.polarization is None:
            return None
        q, u = self.polarization.stokes(parameters)
        turn = geometry.light_turn
        return (q, u) if turn is None else in_turned_frame(q, u, turn)


@dataclasses.dataclass(frozen=True)
class AbstractExtendedSource(AbstractIllumination):
    r"""A source of unit radiance, unpolarized, symmetric about the plane of the viewer.

    $$ S_0 = \frac{1}{\cos\theta_v} \sum_i w_i G(v, l_i) R_+, \qquad
       S_1 = \frac{1}{\cos\theta_v} \sum_i w_i G(v, l_i) K \sin^2\theta_i \cos 2\psi_i $$

    The light's direction in the geometry is not used. The factor in front of G1(v) is what one
    over the seen area is in Smith's theory, so nothing has to be normalized by a sum.
    """

    @abc.abstractmethod
    def border(self, sin_view: Array, cos_view: Array) -> Window:
        """Boundary of the facets that mirror the viewer's ray into the source.

        Args:
            sin_view: Sine of the view zenith. Shape (..., view), 1.
            cos_view: Its cosine. Same shape, 1, > 0.
        """

    @override
    def reflect(
        self, facets: Microsurface, stack: Stack, geometry: Geometry, parameters: Parameters
    ) -> Light:
        sin_view, cos_view = sin_degrees(geometry.view_zenith), cos_degrees(geometry.view_zenith)
        sample = facets.sample(geometry, self.border)
        power = per_facet(stack).relative_reflection(sample.cos_incidence, sample.sin_squared)
        cos_light = jnp.clip(sample.cos_light, 1e-6, 1.0)
        to_viewer = sin_view / cos_view
        seen = facets.shadowing.both(
            facets.visible(to_viewer, jnp.zeros_like(to_viewer))[..., None, :],
            facets.per_facet().visible(
                sample.light_in_plane / cos_light, sample.light_out_of_plane / cos_light
            ),
        )
        lit = sample.weight * seen
        # A trace, far below any reading: no facet may be left where grooves are far too deep.
        light = sum_facets(sample, lit, power, least=float(jnp.finfo(lit.dtype).eps) ** 1.75)
        return light._replace(intensity=stack.scale / cos_view * light.intensity)


@dataclasses.dataclass(frozen=True)
class UniformSky(AbstractExtendedSource):
    """The whole upper hemisphere, of unit radiance."""

    @override
    def border(self, sin_view: Array, cos_view: Array) -> Window:
        return above_horizon(sin_view, cos_view)

    @override
    def entering(self, stack: Stack, geometry: Geometry, parameters: Parameters) -> Light:
        passing = jnp.pi * stack.hemispherical_transmission() + jnp.zeros_like(geometry.view_zenith)
        return Light(passing, jnp.zeros_like(passing), jnp.zeros_like(passing))

    @override
    def rays(
        self, geometry: Geometry, parameters: Parameters, around: Turns = FOUR_TURNS
    ) -> tuple[Geometry, Array]:
        # A squared cosine for the nodes, since transmission is steep at grazing.
        cosine, weight = squared_rule(8)
        rays = per_ray(geometry)
        zenith = like(np.repeat(np.degrees(np.arccos(cosine)), len(around)), rays.view_zenith)
        turns, shares = np.tile(around, (cosine.size, 1)).T
        solid_angle = like(2.0 * np.pi * np.repeat(weight, len(around)) * shares, zenith)
        azimuth = rays.view_azimuth + like(turns, rays.view_azimuth)
        return rays._replace(light_zenith=zenith, light_azimuth=azimuth), solid_angle


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
            what = f"half_width={self.half_width!r} is no half width of a disc"
            hint = "give degrees from 0.01 to 90, or use PointSource() or UniformSky()"
            raise SceneError(what, where="Disc", hint=hint)

    @override
    def border(self, sin_view: Array, cos_view: Array) -> Window:
        return inside_disc(sin_view, cos_view, math.sin(math.radians(self.half_width) / 2.0))

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (PointSource(),)

    @override
    def entering(self, stack: Stack, geometry: Geometry, parameters: Parameters) -> Light:
        cosine, sine_cosine, solid_angle = self._directions()
        sin_view = sin_degrees(geometry.view_zenith)[..., None]
        cos_view = cos_degrees(geometry.view_zenith)[..., None]
        cos_light = jnp.asarray(cosine, cos_view.dtype) * cos_view
        cos_light = cos_light + jnp.asarray(sine_cosine, cos_view.dtype) * sin_view
        cos_light = jnp.clip(cos_light, 1e-4, 1.0)
        sin_squared = (1.0 - cos_light) * (1.0 + cos_light)
        through = per_ray(stack).transmission(cos_light, sin_squared)
        passing = jnp.sum(cos_light * through.mean * like(solid_angle, cos_view), axis=-1)
        # Around the light's own plane the disc is nearly symmetric: what polarization is left
        # after averaging belongs to its middle.
        return Light(passing, jnp.zeros_like(passing), jnp.zeros_like(passing))

    @override
    def rays(
        self, geometry: Geometry, parameters: Parameters, around: Turns = FOUR_TURNS
    ) -> tuple[Geometry, Array]:
        rays = per_ray(geometry)
        sin_view, cos_view = sin_degrees(rays.view_zenith), cos_degrees(rays.view_zenith)
        cosine, along, solid_angle = (like(x, cos_view) for x in self._directions())
        across = jnp.sqrt(jnp.maximum((1.0 - cosine) * (1.0 + cosine) - along**2, 0.0))
        up = cosine * cos_view + along * sin_view
        forwards = along * cos_view - cosine * sin_view
        zenith = jnp.rad2deg(jnp.arctan2(jnp.hypot(forwards, across), jnp.maximum(up, 1e-4)))
        azimuth = jnp.rad2deg(jnp.arctan2(across, forwards))
        irradiance = jnp.where(up > 0.0, 0.5 * solid_angle, 0.0)
        # Both sides of the plane of the viewer.
        azimuth = jnp.concatenate([azimuth, -azimuth], axis=-1)
        zenith, irradiance = (jnp.concatenate([x, x], axis=-1) for x in (zenith, irradiance))
        rays = rays._replace(light_zenith=zenith, light_azimuth=rays.view_azimuth + azimuth)
        return rays, irradiance

    def _directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cosine from the axis, sine times cosine of azimuth, and solid angle of directions."""
        # Exact to 1e-6 of the light that enters the body while the disc is above the horizon, and
        # to .002 (half width 15, 89 degrees) where the horizon cuts it.
        count = 8  # of angles from the center, and of azimuths
        node, weight = unit_rule(count)
        # Equal steps in the squared sine of half the angle are equal solid angles.
        square = math.sin(math.radians(self.half_width) / 2.0) ** 2
        ring = node * square
        cosine = 1.0 - 2.0 * ring
        sine = 2.0 * np.sqrt(ring * (1.0 - ring))
        azimuth = np.pi * (np.arange(count) + 0.5) / count
        ring_solid_angle = 4.0 * np.pi * weight * square / count
        along = np.outer(sine, np.cos(azimuth)).ravel()
        return np.repeat(cosine, count), along, np.repeat(ring_solid_angle, count)


@dataclasses.dataclass(frozen=True)
class SunAndSky(AbstractIllumination):
    r"""A beam of unit irradiance under a uniform sky, both unpolarized.

    $$ S = S_\text{point} + L S_\text{sky} $$

    Args:
        sky_radiance: L, what a steradian of the sky brings over what the beam brings across itself,
            1/sr, 0 to 1000; a name fits it. A clear sky gives about a sixth of the sun's light:
            .05.

    Raises:
        SceneError: The radiance is neither a number in that range nor a name.
    """

    sky_radiance: Annotated[Setting, Range(0.0, 1e3)]
    _sources: ClassVar[tuple[AbstractIllumination, AbstractIllumination]] = (
        PointSource(),
        UniformSky(),
    )

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return self._sources

    @override
    def reflect(
        self, facets: Microsurface, stack: Stack, geometry: Geometry, parameters: Parameters
    ) -> Light:
        sun, sky = (source.reflect(facets, stack, geometry, parameters) for source in self._sources)
        return self._both(sun, sky, parameters)

    @override
    def entering(self, stack: Stack, geometry: Geometry, parameters: Parameters) -> Light:
        sun, sky = (source.entering(stack, geometry, parameters) for source in self._sources)
        return self._both(sun, sky, parameters)

    @override
    def rays(
        self, geometry: Geometry, parameters: Parameters, around: Turns = FOUR_TURNS
    ) -> tuple[Geometry, Array]:
        (sun, beam), (sky, radiance) = (
            source.rays(geometry, parameters, around) for source in self._sources
        )
        radiance = per_ray(value_of(self.sky_radiance, parameters)) * radiance
        views = jnp.broadcast_shapes(*(x.shape[:-1] for x in (beam, sky.light_azimuth, radiance)))
        zenith, azimuth, irradiance = (
            jnp.concatenate([jnp.broadcast_to(x, (*views, x.shape[-1])) for x in both], axis=-1)
            for both in (
                (sun.light_zenith, sky.light_zenith),
                (sun.light_azimuth, sky.light_azimuth),
                (beam, radiance),
            )
        )
        return sun._replace(light_zenith=zenith, light_azimuth=azimuth), irradiance

    def _both(self, sun: Light, sky: Light, parameters: Parameters) -> Light:
        """The sum of their Stokes vectors."""
        of_sky = value_of(self.sky_radiance, parameters) * sky.intensity
        total = sun.intensity + of_sky
        # Where neither sends light, the polarization is the sun's; a smaller floor would leave
        # single precision in the Hessian.
        share = quotient(of_sky, total + jnp.finfo(total.dtype).eps)
        q, u = (one + share * (other - one) for one, other in ((sun.q, sky.q), (sun.u, sky.u)))
        return Light(total, q, u)
