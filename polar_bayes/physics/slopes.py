"""How steep facets are in which direction: alike all around, or along and across grooves."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar, NamedTuple, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.geometry import Geometry, cos_degrees, sin_degrees
from polar_bayes.physics.microfacet import SMOOTHEST
from polar_bayes.physics.part import Part, Setting, check_setting, names_in, value_of


class SlopeEllipse(NamedTuple):
    """Slopes seen by one viewer: x towards it, y across.

    With u and w isotropic of roughness 1: y = across w and x = along u + shear w.

    Args:
        across: Roughness of y. Shape (..., view), 1.
        along: Roughness of x for a given y. Same shape, 1.
        shear: How far x follows y; None where the surface is the same on both sides of the plane
            of the viewer, so that one side need not be sampled.
    """

    across: Array
    along: Array
    shear: Array | None

    def per_facet(self) -> "SlopeEllipse":
        """The same with an axis before the views, for many facets of each."""
        return SlopeEllipse(
            self.across[..., None, :],
            self.along[..., None, :],
            None if self.shear is None else self.shear[..., None, :],
        )


@dataclasses.dataclass(frozen=True)
class AbstractSlopes(Part):
    """The roughness of a surface, direction by direction."""

    @abc.abstractmethod
    def ellipse(self, parameters: Mapping[str, Array], geometry: Geometry) -> SlopeEllipse:
        """Slopes in the frame of each viewer.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            geometry: Directions. Shape (..., view), degree.

        Returns:
            SlopeEllipse.

        Raises:
            Nothing.
        """


@dataclasses.dataclass(frozen=True)
class IsotropicSlopes(AbstractSlopes):
    """The same roughness all around."""

    parameters: ClassVar[tuple[str, ...]] = ("roughness",)

    @override
    def ellipse(self, parameters: Mapping[str, Array], geometry: Geometry) -> SlopeEllipse:
        return SlopeEllipse(parameters["roughness"], parameters["roughness"], None)


@dataclasses.dataclass(frozen=True)
class AnisotropicSlopes(AbstractSlopes):
    r"""Two roughnesses: `roughness` along an azimuth, `roughness_across` at right angles to it.

    $$ \sigma_{xx} = \alpha^2\cos^2\delta + \alpha_\perp^2\sin^2\delta, \quad
       \sigma_{yy} = \alpha^2\sin^2\delta + \alpha_\perp^2\cos^2\delta, \quad
       \sigma_{xy} = (\alpha^2-\alpha_\perp^2)\sin\delta\cos\delta $$

    with delta the azimuth of `roughness` against the viewer's. Brushed metal, wood and veins.

    Args:
        azimuth: Direction of `roughness`, degree, -360 to 360; a name fits it.

    Raises:
        SceneError: The azimuth is neither a number in its range nor a name.
    """

    azimuth: Setting = 0.0

    def __post_init__(self) -> None:
        check_setting(self.azimuth, "AnisotropicSlopes: azimuth", -360.0, 360.0)

    @property
    @override
    def parameters(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("roughness", "roughness_across", *names_in(self.azimuth))

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (IsotropicSlopes(),)

    @override
    def ellipse(self, parameters: Mapping[str, Array], geometry: Geometry) -> SlopeEllipse:
        first = jnp.maximum(parameters["roughness"], SMOOTHEST)
        second = jnp.maximum(parameters["roughness_across"], SMOOTHEST)
        turn = value_of(self.azimuth, parameters) - geometry.view_azimuth
        sin, cos = sin_degrees(turn), cos_degrees(turn)
        across = jnp.sqrt((first * sin) ** 2 + (second * cos) ** 2)
        shear = (first - second) * (first + second) * sin * cos / across
        return SlopeEllipse(across, first * second / across, shear)
