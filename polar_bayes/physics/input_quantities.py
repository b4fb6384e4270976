"""Input quantities: possible errors of a set-up, such as the direction of a lamp.

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
"""Share of stray light in a frame that a perfect set-up would leave dark."""


@dataclasses.dataclass(frozen=True)
class AbstractInputQuantity(AbstractInstrumentTerm):
    """A quantity of the set-up with an uncertainty. Override `aim`, `record`, or both."""

    name: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ()
    """Variables of a capture without which the quantity changes no reading."""

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
        """Return the error of the set-up."""
        return parameters[self.parameters[0]]


def quantity_of(parameter: object) -> str:
    """Return the name of the quantity whose error a parameter is, as `known=` states it."""
    return str(parameter).removesuffix("_offset")


@dataclasses.dataclass(frozen=True)
class LightZenith(AbstractInputQuantity):
    """Error of the light's zenith: it is larger than stated by `light_zenith_offset` degrees."""

    name = "light_zenith"

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        return geometry.leaning(light=self.offset(parameters))


@dataclasses.dataclass(frozen=True)
class LightAzimuth(AbstractInputQuantity):
    """Error of the light's azimuth: it is larger than stated by `light_azimuth_offset` degrees."""

    name = "light_azimuth"

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        return geometry._replace(light_azimuth=geometry.light_azimuth + self.offset(parameters))


@dataclasses.dataclass(frozen=True)
class ViewZenithScale(AbstractInputQuantity):
    """Relative error of view zeniths, such as by a focal length, a gear or a scale."""

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
    """Tilt of the sample's normal away from the light, in its plane; unit degree.

    Views are meant to be in that plane: the turn of the plane of a view aside is left out.
    """

    name = "sample_lean"

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        lean = self.offset(parameters)
        apart = cos_degrees(geometry.view_azimuth - geometry.light_azimuth)
        return geometry.leaning(view=apart * lean, light=lean)


@dataclasses.dataclass(frozen=True)
class AnalyzerRoll(AbstractInputQuantity):
    """Error of the analyzer's zero, which mixes q and u; unit degree."""

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
    """Unpolarized ambient light, as a share of the brightest reading, in every view.

    No reading is brighter than full scale, whatever light a saturated highlight sends.
    """

    name = "ambient_light"

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        level = self.offset(parameters) * _brightest(parameters, light)
        return DarkLevel().record({"dark_level": level}, geometry, light)


@dataclasses.dataclass(frozen=True)
class ToneCurve(AbstractInputQuantity):
    """Error of the gamma: counts are a power of light whose exponent exceeds 1 by its offset."""

    name = "tone_curve"

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        offset = self.offset(parameters)
        brightest = _brightest(parameters, light)
        share = light.intensity / jnp.where(brightest > 0.0, brightest, 1.0)
        kept = jnp.exp(offset * jnp.log(at_least(share, STRAY)))
        return Light(kept * light.intensity, _bent(light.q, offset), _bent(light.u, offset))


def _brightest(parameters: Parameters, light: Light) -> Array:
    """Return the light of the brightest reading, at most what fills a sensor of known exposure."""
    most = jnp.max(light.intensity, axis=-1, keepdims=True)
    return jnp.minimum(most, 1.0 / parameters["exposure"]) if "exposure" in parameters else most


def _bent(contrast: Array, offset: Array) -> Array:
    """Contrast of two frames whose counts are light to the power 1 + offset."""
    inside = (1.0 - STRAY) * contrast
    return contrast + jnp.tanh((1.0 + offset) * jnp.arctanh(inside)) - inside
