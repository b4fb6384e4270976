"""What an instrument does to light before a number is written down. Every term is optional.

Terms aim first (the angles a light path really has), then record in the order given. Parameters
reach a term with a trailing view axis.
"""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.cards import Carded
from polar_bayes.errors import SceneError
from polar_bayes.physics.geometry import Geometry, cos_degrees, sin_degrees
from polar_bayes.physics.part import Part, check_setting
from polar_bayes.physics.stokes import Light

# Nearest to grazing, in degrees, that a shifted angle may come.
STEEPEST_ZENITH = 89.999


@dataclasses.dataclass(frozen=True)
class AbstractInstrumentTerm(Part):
    """One imperfection of an instrument. Override `aim`, `record`, or both."""

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)

    def aim(self, parameters: Mapping[str, Array], geometry: Geometry) -> Geometry:
        """Directions the light really takes, from those that were read off.

        Args:
            parameters: Instrument parameters by name. Each broadcasts with (..., view).
            geometry: Directions as read off. Shape (..., view), degree.

        Returns:
            Geometry of the same shape.

        Raises:
            Nothing.
        """
        del parameters
        return geometry

    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        """Light as the instrument records it.

        Args:
            parameters: Instrument parameters by name. Each broadcasts with (..., view).
            geometry: Directions as read off. Shape (..., view), degree.
            light: Light that arrives. Shape (..., view).

        Returns:
            Light of the same shape.

        Raises:
            Nothing.
        """
        del parameters, geometry
        return light


@dataclasses.dataclass(frozen=True)
class Instrument(Carded):
    """Terms that act one after the other.

    Args:
        terms: Instrument terms, in the order in which light meets them.

    Raises:
        SceneError: Something in the tuple is no instrument term, or a term is given twice.
    """

    terms: tuple[AbstractInstrumentTerm, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.terms, tuple) or not all(
            isinstance(term, AbstractInstrumentTerm) for term in self.terms
        ):
            raise SceneError(
                f"{self.terms!r} is no tuple of instrument terms",
                where="Instrument",
                mend="write Instrument((DolpGain(), AngleZero())), with both pairs of brackets",
            )
        names = [type(term).__name__ for term in self.terms]
        if len(set(names)) < len(names):
            raise SceneError(
                f"the terms {', '.join(names)} repeat one",
                where="Instrument",
                mend="give each term once, since its parameters have one name",
            )

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of all parameters, in the order of the terms."""
        return tuple(name for term in self.terms for name in term.parameters)

    def aim(self, parameters: Mapping[str, Array], geometry: Geometry) -> Geometry:
        """Directions the light really takes; see `AbstractInstrumentTerm.aim`."""
        for term in self.terms:
            geometry = term.aim(parameters, geometry)
        return geometry

    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        """Light as recorded; see `AbstractInstrumentTerm.record`."""
        for term in self.terms:
            light = term.record(parameters, geometry, light)
        return light


@dataclasses.dataclass(frozen=True)
class AngleZero(AbstractInstrumentTerm):
    """The angle scale is off: both zeniths are larger by `angle_zero` degrees than read."""

    parameters: ClassVar[tuple[str, ...]] = ("angle_zero",)

    @override
    def aim(self, parameters: Mapping[str, Array], geometry: Geometry) -> Geometry:
        shift = parameters["angle_zero"]
        return geometry._replace(
            view_zenith=jnp.minimum(geometry.view_zenith + shift, STEEPEST_ZENITH),
            light_zenith=jnp.minimum(geometry.light_zenith + shift, STEEPEST_ZENITH),
        )


@dataclasses.dataclass(frozen=True)
class DolpGain(AbstractInstrumentTerm):
    """A polarizer that is not perfect: q and u shrink to `dolp_gain` of themselves."""

    parameters: ClassVar[tuple[str, ...]] = ("dolp_gain",)

    @override
    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        gain = parameters["dolp_gain"]
        return Light(light.intensity, gain * light.q, gain * light.u)


@dataclasses.dataclass(frozen=True)
class ChannelGain(AbstractInstrumentTerm):
    """The s channel is `channel_gain_ratio` times as sensitive as the p channel."""

    parameters: ClassVar[tuple[str, ...]] = ("channel_gain_ratio",)

    @override
    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        ratio = parameters["channel_gain_ratio"]
        return diattenuate(
            light, (ratio - 1.0) / (ratio + 1.0), 2.0 * jnp.sqrt(ratio) / (ratio + 1.0)
        )


@dataclasses.dataclass(frozen=True)
class Leakage(AbstractInstrumentTerm):
    """Each channel also sees a share `leakage` of the other: s' = s + l p, p' = p + l s.

    Readings are normalized so that the brightness stays: q and u shrink by (1 - l)/(1 + l).
    """

    parameters: ClassVar[tuple[str, ...]] = ("leakage",)

    @override
    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        leakage = parameters["leakage"]
        kept = (1.0 - leakage) / (1.0 + leakage)
        return Light(light.intensity, kept * light.q, kept * light.u)


@dataclasses.dataclass(frozen=True)
class DarkLevel(AbstractInstrumentTerm):
    """Unpolarized light `dark_level`, in units of the predicted intensity, adds to every view."""

    parameters: ClassVar[tuple[str, ...]] = ("dark_level",)

    @override
    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        intensity = light.intensity + parameters["dark_level"]
        # A trace below rounding: a view without any light keeps its polarization, and a dark
        # level below zero does not divide by it.
        trace = jnp.finfo(intensity.dtype).eps ** 1.5
        lit = (light.intensity + trace) / jnp.maximum(intensity + trace, trace)
        return Light(intensity, lit * light.q, lit * light.u)


@dataclasses.dataclass(frozen=True)
class BeamOverlap(AbstractInstrumentTerm):
    r"""Towards grazing the beam's footprint outgrows the sample, and light is lost.

    $$ I' = I \Big(1 + \Big(\frac{\cos\theta_o}{\cos\theta_v}\Big)^{8}\Big)^{-1/8} $$

    a smooth form of min(1, cos(theta_v)/cos(theta_o)), where the footprint fills the sample at
    `beam_overlap_zenith` degrees.
    """

    parameters: ClassVar[tuple[str, ...]] = ("beam_overlap_zenith",)

    @override
    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        fills = cos_degrees(parameters["beam_overlap_zenith"])
        # In the smaller of the two ratios, since the eighth power of the other may overflow.
        view = cos_degrees(geometry.view_zenith)
        larger = jnp.maximum(fills, view)
        kept = ((view / larger) ** 8 + (fills / larger) ** 8) ** -0.125 * view / larger
        return light._replace(intensity=kept * light.intensity)


@dataclasses.dataclass(frozen=True)
class Analyzer(AbstractInstrumentTerm):
    r"""Intensity is recorded behind a linear polarizer.

    $$ I' = I (1 + q \cos 2\chi + u \sin 2\chi)/2 $$

    Polarization is what the polarizer was turned to measure, and stays.

    Args:
        angle: Angle of the polarizer from the viewer's s axis, degree; one for all views, or a
            tuple with one for each.

    Raises:
        SceneError: An angle is no number.
    """

    angle: float | tuple[float, ...] = 0.0

    parameters: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        angles = self.angle if isinstance(self.angle, tuple) else (self.angle,)
        for angle in angles:
            if isinstance(angle, str):
                raise SceneError(
                    f"{angle!r} is no angle",
                    where="Analyzer",
                    mend="give degrees, or a tuple with one number for each view",
                )
            check_setting(angle, "Analyzer: angle", -360.0, 360.0)

    @override
    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        twice = 2.0 * jnp.asarray(self.angle, light.q.dtype)
        passed = 1.0 + light.q * cos_degrees(twice) + light.u * sin_degrees(twice)
        return light._replace(intensity=0.5 * passed * light.intensity)


@dataclasses.dataclass(frozen=True)
class Saturation(AbstractInstrumentTerm):
    """The sensor stops at a level: brighter views are recorded as that level.

    For predictions and simulations; `StudentTLink` knows the level of a capture by itself.

    Args:
        level: Full scale, in units of the predicted intensity, > 0.

    Raises:
        SceneError: The level is no positive number.
    """

    level: float

    parameters: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if isinstance(self.level, str) or not self.level > 0.0:
            raise SceneError(
                f"level={self.level!r} is no full scale",
                where="Saturation",
                mend="give a number above 0",
            )

    @override
    def record(self, parameters: Mapping[str, Array], geometry: Geometry, light: Light) -> Light:
        return light._replace(intensity=jnp.minimum(light.intensity, self.level))


def diattenuate(light: Light, contrast: Array, balance: Array) -> Light:
    r"""Light seen by channels s and p of sensitivity 1 + t and 1 - t.

    $$ I' = I (1 + q t), \quad q' = \frac{q+t}{1+qt}, \quad u' = \frac{u\sqrt{1-t^2}}{1+qt} $$

    Args:
        light: Light that arrives. Shape (..., view).
        contrast: t. Broadcasts, 1, in (-1, 1).
        balance: sqrt(1 - t^2), from a form that keeps its digits. Broadcasts, 1, in (0, 1].

    Returns:
        Light as recorded. Broadcast shape.

    Raises:
        Nothing.
    """
    total = 1.0 + light.q * contrast
    return Light(light.intensity * total, (light.q + contrast) / total, light.u * balance / total)
