"""What an instrument does to light before a number is written down. Every term is optional.

Terms aim first (the angles a light path really has), then record in the order given. Parameters
reach a term with a trailing view axis.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.stokes import Light

# Nearest to grazing, in degrees, that a shifted angle may come.
STEEPEST_ZENITH = 89.999


@dataclasses.dataclass(frozen=True)
class AbstractInstrumentTerm(abc.ABC):
    """One imperfection of an instrument. Override `aim`, `record`, or both."""

    parameters: ClassVar[tuple[str, ...]]

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
class Instrument:
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
