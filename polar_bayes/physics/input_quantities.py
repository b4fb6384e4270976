"""What a set-up is known to: terms of an instrument that are off from what a capture states.

Each has one parameter, its offset, which is zero in a perfect set-up and has a normal prior whose
width is the standard uncertainty of the quantity. Readings seldom determine an offset alone; they
tell what it does to the parameters of the material, whose intervals then hold what it leaves open.

Source: JCGM 100:2008 (GUM), 4.1 and 4.3: input quantities, and type B evaluation of their standard
uncertainty.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.geometry import Geometry, cos_degrees
from polar_bayes.physics.instrument import AbstractInstrumentTerm, DarkLevel, DolpGain
from polar_bayes.physics.part import Parameters, Part, at_least
from polar_bayes.physics.stokes import Light, in_turned_frame

__all__ = [
    "AmbientLight",
    "AnalyzerRoll",
    "IncidenceAngle",
    "LightAzimuth",
    "LightZenith",
    "PolarizationLoss",
    "SampleLean",
    "ToneCurve",
    "ViewZenithScale",
]

STRAY = 1e-6
"""Share of the light that reaches a frame which a perfect set-up would leave dark."""


@dataclasses.dataclass(frozen=True)
class AbstractInputQuantity(AbstractInstrumentTerm):
    """Something that a set-up is known to. Override `aim`, `record`, or both."""

    name: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ()
    """Variables of a capture without which it changes no reading."""

    @property
    @override
    def parameters(self) -> tuple[str, ...]:
        return (f"{self.name}_offset",)

    @property
    @override
    def neutral(self) -> Mapping[str, float]:  # type: ignore[override]
        return MappingProxyType(dict.fromkeys(self.parameters, 0.0))

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return ()  # it is no effect that readings could call for

    def offset(self, parameters: Parameters) -> Array:
        """How far the set-up is off."""
        return parameters[self.parameters[0]]


@dataclasses.dataclass(frozen=True)
class LightZenith(AbstractInputQuantity):
    """The light is further from the normal than stated, by `light_zenith_offset` degrees."""

    name = "light_zenith"

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        return geometry.leaning(light=self.offset(parameters))


@dataclasses.dataclass(frozen=True)
class LightAzimuth(AbstractInputQuantity):
    """The light is turned about the normal, by `light_azimuth_offset` degrees."""

    name = "light_azimuth"

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        return geometry._replace(light_azimuth=geometry.light_azimuth + self.offset(parameters))


@dataclasses.dataclass(frozen=True)
class ViewZenithScale(AbstractInputQuantity):
    """Zeniths of the views are larger than read by a share: a focal length, a gear, a scale."""

    name = "view_zenith_scale"

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        return geometry.leaning(view=self.offset(parameters) * geometry.view_zenith)


@dataclasses.dataclass(frozen=True)
class IncidenceAngle(AbstractInputQuantity):
    """Light and viewer, set by one angle, are further from the normal by some degrees."""

    name = "incidence_angle"

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        return geometry.leaning(self.offset(parameters), self.offset(parameters))


@dataclasses.dataclass(frozen=True)
class SampleLean(AbstractInputQuantity):
    """The normal of the sample leans away from the light, in its plane; unit degree."""

    name = "sample_lean"

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        lean = self.offset(parameters)
        apart = cos_degrees(geometry.view_azimuth - geometry.light_azimuth)
        return geometry.leaning(view=apart * lean, light=lean)


@dataclasses.dataclass(frozen=True)
class AnalyzerRoll(AbstractInputQuantity):
    """The zero of the analyzer is turned, which mixes q and u; unit degree."""

    name = "analyzer_roll"
    needs = ("q", "u")

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        twice = 2.0 * self.offset(parameters)
        turn = cos_degrees(twice), -cos_degrees(90.0 - twice)
        return Light(light.intensity, *in_turned_frame(light.q, light.u, turn))


@dataclasses.dataclass(frozen=True)
class PolarizationLoss(AbstractInputQuantity):
    """Readings lose a share of polarization: an analyzer's extinction, cross-talk of pixels."""

    name = "polarization_loss"

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        return DolpGain().record({"dolp_gain": 1.0 - self.offset(parameters)}, geometry, light)


@dataclasses.dataclass(frozen=True)
class AmbientLight(AbstractInputQuantity):
    """Unpolarized light besides the lamp's adds a share of the brightest reading to every view."""

    name = "ambient_light"

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        level = self.offset(parameters) * jnp.max(light.intensity, axis=-1, keepdims=True)
        return DarkLevel().record({"dark_level": level}, geometry, light)


@dataclasses.dataclass(frozen=True)
class ToneCurve(AbstractInputQuantity):
    """Counts grow as a power of light, whose exponent (gamma) is above 1 by its offset."""

    name = "tone_curve"

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        offset = self.offset(parameters)
        brightest = jnp.max(light.intensity, axis=-1, keepdims=True)
        share = light.intensity / jnp.where(brightest > 0.0, brightest, 1.0)
        kept = jnp.exp(offset * jnp.log(at_least(share, STRAY)))
        return Light(kept * light.intensity, _bent(light.q, offset), _bent(light.u, offset))


def _bent(contrast: Array, offset: Array) -> Array:
    """The contrast of two frames whose counts are a power 1 + offset of light."""
    inside = (1.0 - STRAY) * contrast
    return contrast + jnp.tanh((1.0 + offset) * jnp.arctanh(inside)) - inside
