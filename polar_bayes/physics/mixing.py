"""Mixing rules: how light from the surface and light from the body add up."""

import abc
import dataclasses
from typing import ClassVar, override

import jax
import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.part import Part
from polar_bayes.physics.stokes import Light, degree_of_linear_polarization, direction


@dataclasses.dataclass(frozen=True)
class AbstractMixing(Part):
    """A rule that mixes surface and body by one fraction: 0 is surface alone, 1 body alone."""

    parameters: ClassVar[tuple[str, ...]] = ("subsurface_fraction",)

    @abc.abstractmethod
    def mix(self, fraction: Array, surface: Light, subsurface: Light) -> Light:
        """Light that reaches the viewer.

        Args:
            fraction: Subsurface fraction beta. Broadcasts with (..., view), 1, in [0, 1].
            surface: Light from the surface. Shape (..., view).
            subsurface: Light from the body. Shape (..., view).

        Returns:
            Light. Shape (..., view).
        """


@dataclasses.dataclass(frozen=True)
class DopMixing(AbstractMixing):
    r"""The paper's equation 1: degrees of polarization mix by one fraction for every view.

    $$ \rho = (1-\beta)\rho_\text{surf} + \beta\rho_\text{sub} $$

    Unsigned, as printed, the two never cancel, and the mixture points as the surface's light
    does. It is exact only where beta is the local share of the light.

    Args:
        signed: Mix q and u, which carry the sign, in place of their length.
    """

    signed: bool = False

    @override
    def mix(self, fraction: Array, surface: Light, subsurface: Light) -> Light:
        intensity = _blend(fraction, surface.intensity, subsurface.intensity)
        if self.signed:
            q = _blend(fraction, surface.q, subsurface.q)
            return Light(intensity, q, _blend(fraction, surface.u, subsurface.u))
        first = degree_of_linear_polarization(surface.q, surface.u)
        second = degree_of_linear_polarization(subsurface.q, subsurface.u)
        length = _blend(fraction, first, second)
        towards_q, towards_u = direction(surface.q, surface.u)
        return Light(intensity, length * towards_q, length * towards_u)


@dataclasses.dataclass(frozen=True)
class StokesMixing(AbstractMixing):
    r"""Stokes vectors add, so polarization is signed and weighted by brightness.

    $$ S = (1-\beta) S_\text{surf} + \beta S_\text{sub} $$
    """

    @override
    def mix(self, fraction: Array, surface: Light, subsurface: Light) -> Light:
        share = _share(fraction, surface.intensity, subsurface.intensity)
        return Light(
            _blend(fraction, surface.intensity, subsurface.intensity),
            _blend(share, surface.q, subsurface.q),
            _blend(share, surface.u, subsurface.u),
        )


def _blend(fraction: Array, first: Array, second: Array) -> Array:
    """Weighted mean of two values."""
    return (1.0 - fraction) * first + fraction * second


def _share(fraction: Array, surface: Array, subsurface: Array) -> Array:
    """Share of the body in the brightness, finite where all light vanishes."""
    # Far from the mirror direction a smooth surface sends no light at all; at a fraction of 0 the
    # share is then 0/0, and its slope is the ratio of the two intensities. A trace of the other
    # part, eps^1.25, keeps value, gradient and Hessian finite; it moves the share by at most
    # trace/fraction or trace/(1 - fraction), whichever is more. A common factor does not change the
    # share, so intensities are scaled by a constant first.
    trace = jnp.finfo(jnp.result_type(surface, subsurface)).eps ** 1.25
    # Darker than any reading: a black body on a surface far from its highlight is the surface's.
    surface = surface + jnp.finfo(jnp.result_type(surface, subsurface)).eps ** 1.5
    scale = jax.lax.stop_gradient(surface + subsurface)
    surface, subsurface = surface / scale, subsurface / scale
    from_surface = (1.0 - fraction) * surface + trace * subsurface
    from_body = fraction * subsurface + trace * surface
    return from_body / (from_surface + from_body)
