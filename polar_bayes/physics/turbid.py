"""A turbid body: polarized light scattered any number of times, turned back inside, and let out."""

import dataclasses
from collections.abc import Mapping
from typing import override

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.geometry import Geometry, cos_degrees, sin_degrees
from polar_bayes.physics.half_space import refract, scatter
from polar_bayes.physics.internal_reflection import InternalReflection
from polar_bayes.physics.part import Part, Setting, check_setting, names_in, value_of
from polar_bayes.physics.stokes import Light
from polar_bayes.physics.subsurface import AbstractSubsurface, Depolarizer
from polar_bayes.physics.surface import Interface


@dataclasses.dataclass(frozen=True)
class TurbidMedium(AbstractSubsurface):
    r"""A half space that scatters: a share by Rayleigh's law, the rest without polarization.

    All orders of scattering and of internal reflection (`polar_bayes.physics.half_space`); with E0
    and E1 of the way out, smooth or rough,

    $$ S = \frac{1}{n^2} [I E_0 + Q E_1,\; I E_1 + Q E_0,\; U \sqrt{E_0^2 - E_1^2}] $$

    Light enters and crosses the body as through a plane, and is turned back as by a bare one:
    roughness and coats act on the way in and out only.

    Args:
        polarized_fraction: Share of Rayleigh's law, 1, 0 to 1; a name fits it.
        internal_reflection: InternalReflection(), or None for an interface that turns nothing
            back.

    Raises:
        SceneError: The fraction is neither a number from 0 to 1 nor a name.
    """

    polarized_fraction: Setting = 0.5
    internal_reflection: InternalReflection | None = dataclasses.field(
        default_factory=InternalReflection
    )

    def __post_init__(self) -> None:
        check_setting(self.polarized_fraction, "TurbidMedium: polarized_fraction", 0.0, 1.0)

    @property
    @override
    def parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("absorption", *names_in(self.polarized_fraction))

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (Depolarizer(self.internal_reflection),)

    @override
    def light(
        self, parameters: Mapping[str, Array], geometry: Geometry, interface: Interface
    ) -> Light:
        n = parameters["refractive_index"]
        rays, entering = interface.beams(parameters, geometry)
        view = refract(sin_degrees(geometry.view_zenith), cos_degrees(geometry.view_zenith), n)
        light = refract(
            sin_degrees(rays.light_zenith), cos_degrees(rays.light_zenith), n[..., None]
        )
        # The half space counts u from e_s towards e_s x l, the other way round.
        incident = (
            entering.intensity,
            entering.intensity * entering.q,
            -entering.intensity * entering.u,
        )
        scattered = scatter(
            light,
            jax.tree.map(lambda array: array[..., None], view),
            rays.light_azimuth - rays.view_azimuth,
            incident,
            parameters["absorption"][..., None],
            value_of(self.polarized_fraction, parameters)[..., None],
            None if self.internal_reflection is None else n[..., None],
        )
        intensity, q, u = (jnp.sum(part, axis=-1) for part in scattered)

        leaving = interface.exit(parameters, geometry)
        total = intensity + q * leaving.q
        diagonal = jnp.sqrt(jnp.maximum((1.0 - leaving.q) * (1.0 + leaving.q), 0.0))
        return Light(
            leaving.intensity * total / n**2,
            (intensity * leaving.q + q) / total,
            (intensity * leaving.u - u * diagonal) / total,
        )
