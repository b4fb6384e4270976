"""Light that entered the body, was scattered, and leaves through the interface again."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics import fresnel
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.stokes import Light
from polar_bayes.physics.surface import AbstractSurface

# The reflectance of a body changes with the square root of absorption: its slope at zero is
# infinite, so absorption below this counts as this.
CLEAREST = 1e-4


@dataclasses.dataclass(frozen=True)
class AbstractSubsurface(abc.ABC):
    """A body that scatters. Parameters broadcast with (..., view)."""

    parameters: ClassVar[tuple[str, ...]]

    @abc.abstractmethod
    def light(
        self, parameters: Mapping[str, Array], geometry: Geometry, interface: AbstractSurface
    ) -> Light:
        """Light from the body that reaches the viewer.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.
            interface: The surface that lets light in and out.

        Returns:
            Light; q < 0 is polarized along the plane of the viewer. Shape (..., view).

        Raises:
            Nothing.
        """


@dataclasses.dataclass(frozen=True)
class Unpolarized(AbstractSubsurface):
    """A diffuse body whose light leaves without polarization: rho = 0.

    Porous bodies without a smooth interface behave so; white PTFE was measured to.

    Args:
        albedo: Share of entering light that comes back to the interface, 1, 0 to 1.

    Raises:
        SceneError: The albedo is outside 0 to 1.
    """

    albedo: float = 1.0

    parameters: ClassVar[tuple[str, ...]] = ("refractive_index",)

    def __post_init__(self) -> None:
        _check_albedo(self)

    @override
    def light(
        self, parameters: Mapping[str, Array], geometry: Geometry, interface: AbstractSurface
    ) -> Light:
        brightness = _diffuse(self.albedo, parameters, geometry, interface)
        return Light(brightness, jnp.zeros_like(brightness), jnp.zeros_like(brightness))


@dataclasses.dataclass(frozen=True)
class Lambertian(AbstractSubsurface):
    r"""A diffuse body whose light is polarized only on its way out.

    $$ S = \frac{\text{albedo}}{\pi} \cos\theta_l T_+(l) [T_+(v), T_-(v), 0] $$

    Args:
        albedo: Share of entering light that comes back to the interface, 1, 0 to 1.

    Raises:
        SceneError: The albedo is outside 0 to 1.

    Source:
        Baek et al. 2018, Simultaneous acquisition of polarimetric SVBRDF and normals.
    """

    albedo: float = 1.0

    parameters: ClassVar[tuple[str, ...]] = ("refractive_index",)

    def __post_init__(self) -> None:
        _check_albedo(self)

    @override
    def light(
        self, parameters: Mapping[str, Array], geometry: Geometry, interface: AbstractSurface
    ) -> Light:
        leaving = interface.exit(parameters, geometry)
        entering = interface.entering(parameters, geometry)
        return leaving._replace(intensity=self.albedo / jnp.pi * entering * leaving.intensity)


@dataclasses.dataclass(frozen=True)
class Depolarizer(AbstractSubsurface):
    r"""A body that depolarizes the more, the brighter it is (Umov's effect).

    $$ \rho = (1 - R_b(a, n)) \rho_\text{exit}(v; n, r), \qquad
       S_0 = \text{entering} \frac{R_d(a)}{\pi n^2 (1 - F_i R_d)} T_\text{exit}(v) $$

    An absorbing body scatters light few times, so that more of its polarization is kept.
    """

    parameters: ClassVar[tuple[str, ...]] = ("absorption", "refractive_index")

    @override
    def light(
        self, parameters: Mapping[str, Array], geometry: Geometry, interface: AbstractSurface
    ) -> Light:
        absorption, n = parameters["absorption"], parameters["refractive_index"]
        leaving = interface.exit(parameters, geometry)
        entering = interface.entering(parameters, geometry)
        lost = half_space_loss(absorption)
        # 1 - Fi Rd, as a sum of two positive terms.
        not_trapped = lost + (1.0 - lost) * fresnel.escape(n)
        returned = (1.0 - lost) / (jnp.pi * n**2 * not_trapped)
        kept = body_loss(absorption, n)
        return Light(entering * returned * leaving.intensity, kept * leaving.q, kept * leaving.u)


def half_space_loss(absorption: Array) -> Array:
    r"""Share of diffuse light that a half space absorbs, 1 - Rd.

    $$ R_d = \frac{(1-g)(1-0.139 g)}{1+1.170 g}, \qquad g = \sqrt{a/(1+a)} $$

    Written as g (2.309 - 0.139 g)/(1 + 1.170 g), it keeps its digits for a clear body.

    Args:
        absorption: a, relative to reduced scattering. Any shape, 1, >= 0 (bounded at 1e-4).

    Returns:
        1 - Rd. Same shape, 1, in (0, 1).

    Raises:
        Nothing.

    Source:
        van de Hulst 1980, Multiple light scattering, the spherical albedo of a half space.
    """
    absorption = jnp.maximum(absorption, CLEAREST)
    g = jnp.sqrt(absorption / (1.0 + absorption))
    return g * (2.309 - 0.139 * g) / (1.0 + 1.170 * g)


def body_loss(absorption: Array, refractive_index: Array) -> Array:
    r"""Share of diffuse light that a body behind its interface absorbs, 1 - Rb.

    $$ R_b = \frac{(1-F_i) R_d}{1 - F_i R_d}, \qquad
       1 - R_b = \frac{1-R_d}{(1-R_d) + R_d (1-F_i)} $$

    Args:
        absorption: a. Any shape, 1, >= 0.
        refractive_index: n. Broadcasts, 1, >= 1.

    Returns:
        1 - Rb. Broadcast shape, 1, in (0, 1).

    Raises:
        Nothing.
    """
    lost = half_space_loss(absorption)
    return lost / (lost + (1.0 - lost) * fresnel.escape(refractive_index))


def _diffuse(
    albedo: float,
    parameters: Mapping[str, Array],
    geometry: Geometry,
    interface: AbstractSurface,
) -> Array:
    """Brightness of a diffuse body seen through its interface."""
    entering = interface.entering(parameters, geometry)
    return albedo / jnp.pi * entering * interface.exit(parameters, geometry).intensity


def _check_albedo(part: Unpolarized | Lambertian) -> None:
    """Refuse an albedo that creates light."""
    if not 0.0 <= part.albedo <= 1.0:
        raise SceneError(
            f"albedo={part.albedo!r} is no share of light",
            where=type(part).__name__,
            mend="give a number from 0 to 1",
        )
