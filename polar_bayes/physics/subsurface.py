"""Subsurface light: it entered the body, was scattered, and leaves through the interface."""

import abc
import dataclasses
from typing import Annotated, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.geometry import Geometry, cos_degrees, per_ray, sin_degrees
from polar_bayes.physics.half_space import CLEAREST, Ray, refract, scatter
from polar_bayes.physics.part import Parameters, Part, Range, Setting, at_least, quotient, value_of
from polar_bayes.physics.phase_function import AbstractPhaseFunction, Isotropic
from polar_bayes.physics.stokes import Light, polarized_through
from polar_bayes.physics.surface import Interface, InternalReflection


@dataclasses.dataclass(frozen=True)
class AbstractSubsurface(Part):
    """A scattering body. Parameters broadcast with (..., view)."""

    @abc.abstractmethod
    def light(self, parameters: Parameters, geometry: Geometry, interface: Interface) -> Light:
        """Light from the body that reaches the viewer.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.
            interface: The surface, with what lies on it, that lets light in and out.

        Returns:
            Light; q < 0 is polarized along the plane of the viewer. Shape (..., view).
        """


@dataclasses.dataclass(frozen=True)
class DiffuseBody(AbstractSubsurface):
    r"""A body that returns a share of the light, equally in all directions.

    $$ S_0 = \frac{A}{\pi} \cos\theta_l T_+(l) T_+(v), \qquad \text{with internal reflection }
       S_0 = \frac{A}{\pi n^2 (1 - A F_i)} \cos\theta_l T_+(l) T_+(v) $$

    Args:
        albedo: A, the share of entering light that comes back to the interface, 1, 0 to 1; a
            name fits it.
        internal_reflection: InternalReflection(), or None for an albedo that includes all that
            happens under the interface.

    Raises:
        SceneError: The albedo is neither a number from 0 to 1 nor a name.
    """

    albedo: Annotated[Setting, Range(0.0, 1.0)] = 1.0
    internal_reflection: InternalReflection | None = None

    def diffuse(
        self, parameters: Parameters, geometry: Geometry, interface: Interface
    ) -> tuple[Array, Light]:
        """Brightness inside, and the effect of the interface on light that leaves."""
        albedo = value_of(self.albedo, parameters)
        entering = interface.entering(parameters, geometry).intensity
        brightness = albedo / jnp.pi * entering
        if self.internal_reflection is not None:
            escape = interface.escape(parameters, geometry)
            # 1 - A Fi, as a sum of two positive terms.
            not_trapped = (1.0 - albedo) + albedo * escape
            brightness = brightness / (parameters["refractive_index"] ** 2 * not_trapped)
        return brightness, interface.exit(parameters, geometry)


@dataclasses.dataclass(frozen=True)
class Unpolarized(DiffuseBody):
    """A diffuse body whose light leaves without polarization: rho = 0.

    Porous bodies without a smooth interface behave so; white PTFE was measured to. Fields and
    errors are those of `DiffuseBody`.
    """

    @override
    def light(self, parameters: Parameters, geometry: Geometry, interface: Interface) -> Light:
        brightness, leaving = self.diffuse(parameters, geometry, interface)
        brightness = brightness * leaving.intensity
        return Light(brightness, jnp.zeros_like(brightness), jnp.zeros_like(brightness))


@dataclasses.dataclass(frozen=True)
class Lambertian(DiffuseBody):
    r"""A diffuse body whose light is polarized only by the interface on its way out.

    $$ S = \frac{A}{\pi} \cos\theta_l T_+(l) [T_+(v), T_-(v), 0] $$

    Fields and errors are those of `DiffuseBody`.

    Source:
        Baek et al. 2018, Simultaneous acquisition of polarimetric SVBRDF and normals.
    """

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (Unpolarized(self.albedo, self.internal_reflection),)

    @override
    def alternatives(self) -> tuple[Part | None, ...]:
        return Depolarizer(), None

    @override
    def light(self, parameters: Parameters, geometry: Geometry, interface: Interface) -> Light:
        brightness, leaving = self.diffuse(parameters, geometry, interface)
        return leaving._replace(intensity=brightness * leaving.intensity)


@dataclasses.dataclass(frozen=True)
class Depolarizer(AbstractSubsurface):
    r"""A body that depolarizes light more, the brighter it is (Umov's effect).

    $$ \rho = (1 - R_b(a, n)) \rho_\text{exit}(v; n, r), \qquad
       S_0 = \text{entering} \frac{R(l, v; a, n)}{\pi n^2} T_\text{exit}(v) $$

    An absorbing body scatters light few times, so that more of its polarization is kept. R is that
    of the phase function (`polar_bayes.physics.phase_function`), for light that enters and leaves
    as through a plane. The factor 1 - R_b is the paper's. A body that only depolarizes has none:
    its light has the polarization of the way out at every albedo, as that of `Lambertian` and of
    `TurbidMedium(polarized_fraction=0.0)` has.

    Args:
        internal_reflection: InternalReflection(), or None for an interface that turns nothing
            back: then R_b = R_d.
        phase_function: Isotropic() or HenyeyGreenstein().
    """

    internal_reflection: InternalReflection | None = dataclasses.field(
        default_factory=InternalReflection
    )
    phase_function: AbstractPhaseFunction = dataclasses.field(default_factory=Isotropic)

    @property
    @override
    def parameters(self) -> tuple[str, ...]:
        return ("absorption", *super().parameters)

    @override
    def light(self, parameters: Parameters, geometry: Geometry, interface: Interface) -> Light:
        absorption, n = parameters["absorption"], parameters["refractive_index"]
        escape = jnp.ones_like(n)
        if self.internal_reflection is not None:
            escape = interface.escape(parameters, geometry)
        rays, entering = interface.beams(parameters, geometry, self.phase_function.turns)
        view = _inside(geometry.view_zenith, n)
        light = _inside(rays.light_zenith, n[..., None])
        names = "refractive_index", *self.parameters
        body, view, escaping = per_ray(({name: parameters[name] for name in names}, view, escape))
        azimuth = rays.light_azimuth - rays.view_azimuth
        reflectance = self.phase_function.reflectance(body, light, view, azimuth, escaping)
        returned = jnp.sum(entering.intensity * reflectance, axis=-1) / (jnp.pi * n**2)
        leaving, kept = interface.exit(parameters, geometry), body_loss(absorption, escape)
        return Light(returned * leaving.intensity, kept * leaving.q, kept * leaving.u)


def _inside(zenith: Array, refractive_index: Array) -> Ray:
    """Direction in the body of light that meets a plane surface at a zenith, degree."""
    return refract(sin_degrees(zenith), cos_degrees(zenith), refractive_index)


def half_space_loss(absorption: Array) -> Array:
    r"""Share of diffuse light that a half space absorbs, 1 - Rd.

    $$ R_d = \frac{(1-g)(1-0.139 g)}{1+1.170 g}, \qquad g = \sqrt{a/(1+a)} $$

    Written as g (2.309 - 0.139 g)/(1 + 1.170 g), it keeps its digits for a clear body.

    Source:
        van de Hulst 1980, Multiple light scattering, the spherical albedo of a half space.
    """
    absorption = at_least(absorption, CLEAREST)
    g = jnp.sqrt(absorption / (1.0 + absorption))
    return g * (2.309 - 0.139 * g) / (1.0 + 1.170 * g)


def body_loss(absorption: Array, escape: Array | float) -> Array:
    r"""Share of diffuse light that a body behind its interface absorbs, 1 - Rb.

    $$ R_b = \frac{(1-F_i) R_d}{1 - F_i R_d}, \qquad
       1 - R_b = \frac{1-R_d}{(1-R_d) + R_d (1-F_i)} $$
    """
    lost = half_space_loss(absorption)
    return lost / (lost + (1.0 - lost) * escape)


# --- A turbid body: polarized light scattered any number of times, turned back inside, and let out


@dataclasses.dataclass(frozen=True)
class TurbidMedium(AbstractSubsurface):
    r"""A scattering half space: a share scatters by Rayleigh's law, the rest without polarization.

    All orders of scattering and of internal reflection (`polar_bayes.physics.half_space`); with E0
    and E1 of the way out, smooth or rough,

    $$ S = \frac{1}{n^2} [I E_0 + Q E_1,\; I E_1 + Q E_0,\; U \sqrt{E_0^2 - E_1^2}] $$

    where the way out polarizes along the plane of the viewer. Grooves polarize along an axis of
    their own, along which Q and U count in the same way (`polarized_through`).

    Light enters and crosses the body as through a plane, and is turned back as by a bare one:
    roughness and coats act on the way in and out only.

    Args:
        polarized_fraction: Share of Rayleigh's law, 1, 0 to 1; a name fits it.
        internal_reflection: InternalReflection(), or None for an interface that turns nothing
            back.

    Raises:
        SceneError: The fraction is neither a number from 0 to 1 nor a name.
    """

    polarized_fraction: Annotated[Setting, Range(0.0, 1.0)] = 0.5
    internal_reflection: InternalReflection | None = dataclasses.field(
        default_factory=InternalReflection
    )

    @property
    @override
    def parameters(self) -> tuple[str, ...]:
        return ("absorption", *super().parameters)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (Depolarizer(self.internal_reflection),)

    @override
    def light(self, parameters: Parameters, geometry: Geometry, interface: Interface) -> Light:
        n = parameters["refractive_index"]
        rays, entering = interface.beams(parameters, geometry)
        view = _inside(geometry.view_zenith, n)
        light = _inside(rays.light_zenith, n[..., None])
        # The half space counts u from e_s towards e_s x l, the other way round.
        power = entering.intensity
        incident = power, power * entering.q, -power * entering.u
        scattered = scatter(
            light,
            per_ray(view),
            rays.light_azimuth - rays.view_azimuth,
            incident,
            parameters["absorption"][..., None],
            value_of(self.polarized_fraction, parameters)[..., None],
            None if self.internal_reflection is None else n[..., None],
        )
        intensity, q, u = (jnp.sum(part, axis=-1) for part in scattered)

        leaving = interface.exit(parameters, geometry)
        brightness = leaving.intensity * intensity / n**2
        polarization = quotient(q, intensity), -quotient(u, intensity)
        return polarized_through(leaving._replace(intensity=brightness), *polarization)
