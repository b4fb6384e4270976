"""Instrument terms: effects on light before a number is recorded. Every term is optional.

Terms aim first (the angles a light path really has), then record in the order given. Parameters
reach a term with a trailing view axis.

Directions are stated in the frame of an assumed normal. The optics receives them in the frame of
the true one, and the Stokes components that come out are turned back. Nothing is lost where the
normal is not tilted: the directions are then those that were stated, to the last bit or two.
"""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, ClassVar, NamedTuple, override

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.geometry import (
    STEEPEST_ZENITH,
    Geometry,
    cos_degrees,
    double_angle,
    sin_degrees,
)
from polar_bayes.physics.part import (
    Parameters,
    Part,
    Range,
    Setting,
    check_setting,
    parameters_of,
    value_of,
)
from polar_bayes.physics.stokes import Light, diattenuate, in_turned_frame
from polar_bayes.repr_html import HTMLRepr

__all__ = [
    "Analyzer",
    "AngleZero",
    "BeamOverlap",
    "ChannelGain",
    "DarkLevel",
    "Discrepancy",
    "DolpGain",
    "Instrument",
    "Leakage",
    "Saturation",
    "TiltedNormal",
]


@dataclasses.dataclass(frozen=True)
class AbstractInstrumentTerm(Part):
    """One imperfection of an instrument. Override `aim`, `record`, or both.

    `neutral` has values of parameters at which the term changes nothing. A fit of the same readings
    without the term then compiles nothing.
    """

    neutral: ClassVar[Mapping[str, float]] = MappingProxyType({})

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)

    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        """Return the true directions of light, from those that were read.

        Args:
            parameters: Instrument parameters by name. Each broadcasts with (..., view).
            geometry: Directions as read off. Shape (..., view), degree.

        Returns:
            Geometry of the same shape.
        """
        del parameters
        return geometry

    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        """Return the light as the instrument records it.

        Args:
            parameters: Instrument parameters by name. Each broadcasts with (..., view).
            geometry: Directions as read off. Shape (..., view), degree.
            light: Light that arrives. Shape (..., view).

        Returns:
            Light of the same shape.
        """
        del parameters, geometry
        return light


@dataclasses.dataclass(frozen=True)
class Instrument(HTMLRepr):
    """Terms that are applied one after the other.

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
            what = f"{self.terms!r} is no tuple of instrument terms"
            hint = "write Instrument((DolpGain(), AngleZero())), with both pairs of brackets"
            raise SceneError(what, where="Instrument", hint=hint)
        names = [type(term).__name__ for term in self.terms]
        if len(set(names)) < len(names):
            what = f"the terms {', '.join(names)} repeat one"
            hint = "give each term once, since its parameters have one name"
            raise SceneError(what, where="Instrument", hint=hint)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of all parameters, in the order of the terms."""
        return parameters_of(*self.terms)

    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        """Return the true directions of light; see `AbstractInstrumentTerm.aim`."""
        for term in self.terms:
            geometry = term.aim(parameters, geometry)
        return geometry

    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        """Return the light as recorded; see `AbstractInstrumentTerm.record`."""
        for term in self.terms:
            light = term.record(parameters, geometry, light)
        return light


@dataclasses.dataclass(frozen=True)
class AngleZero(AbstractInstrumentTerm):
    """Offset of the angle scale: both zeniths are larger by `angle_zero` degrees than read."""

    parameters: ClassVar[tuple[str, ...]] = ("angle_zero",)
    neutral: ClassVar[Mapping[str, float]] = MappingProxyType({"angle_zero": 0.0})

    @override
    def aim(self, parameters: Parameters, geometry: Geometry) -> Geometry:
        return geometry.leaning(parameters["angle_zero"], parameters["angle_zero"])


@dataclasses.dataclass(frozen=True)
class DolpGain(AbstractInstrumentTerm):
    """Imperfect polarizer: q and u are multiplied by `dolp_gain`."""

    parameters: ClassVar[tuple[str, ...]] = ("dolp_gain",)
    neutral: ClassVar[Mapping[str, float]] = MappingProxyType({"dolp_gain": 1.0})

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        gain = parameters["dolp_gain"]
        return Light(light.intensity, gain * light.q, gain * light.u)


@dataclasses.dataclass(frozen=True)
class ChannelGain(AbstractInstrumentTerm):
    """Gain ratio of the channels: s is `channel_gain_ratio` times as sensitive as p."""

    parameters: ClassVar[tuple[str, ...]] = ("channel_gain_ratio",)
    neutral: ClassVar[Mapping[str, float]] = MappingProxyType({"channel_gain_ratio": 1.0})

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        ratio = parameters["channel_gain_ratio"]
        return diattenuate(
            light, (ratio - 1.0) / (ratio + 1.0), 2.0 * jnp.sqrt(ratio) / (ratio + 1.0)
        )


@dataclasses.dataclass(frozen=True)
class Leakage(AbstractInstrumentTerm):
    """Leakage of each channel into the other: s' = s + l p, p' = p + l s, with l = `leakage`.

    Readings are normalized so that the brightness stays: q and u shrink by (1 - l)/(1 + l).
    """

    parameters: ClassVar[tuple[str, ...]] = ("leakage",)
    neutral: ClassVar[Mapping[str, float]] = MappingProxyType({"leakage": 0.0})

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        leakage = parameters["leakage"]
        kept = (1.0 - leakage) / (1.0 + leakage)
        return Light(light.intensity, kept * light.q, kept * light.u)


@dataclasses.dataclass(frozen=True)
class DarkLevel(AbstractInstrumentTerm):
    """Unpolarized light `dark_level`, in units of the predicted intensity, in every view."""

    parameters: ClassVar[tuple[str, ...]] = ("dark_level",)
    neutral: ClassVar[Mapping[str, float]] = MappingProxyType({"dark_level": 0.0})

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        intensity = light.intensity + parameters["dark_level"]
        # A trace below rounding: a view without any light keeps its polarization, and a dark
        # level below zero does not divide by it.
        trace = jnp.finfo(intensity.dtype).eps ** 1.5
        lit = (light.intensity + trace) / jnp.maximum(intensity + trace, trace)
        return Light(intensity, lit * light.q, lit * light.u)


@dataclasses.dataclass(frozen=True)
class BeamOverlap(AbstractInstrumentTerm):
    r"""Loss of light near grazing, where the footprint of the beam is larger than the sample.

    $$ I' = I \Big(1 + \Big(\frac{\cos\theta_o}{\cos\theta_v}\Big)^{8}\Big)^{-1/8} $$

    a smooth form of min(1, cos(theta_v)/cos(theta_o)), where the footprint fills the sample at
    `beam_overlap_zenith` degrees.
    """

    parameters: ClassVar[tuple[str, ...]] = ("beam_overlap_zenith",)
    neutral: ClassVar[Mapping[str, float]] = MappingProxyType({"beam_overlap_zenith": 90.0})

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        fills = cos_degrees(parameters["beam_overlap_zenith"])
        # In the smaller of the two ratios, since the eighth power of the other may overflow.
        view = cos_degrees(geometry.view_zenith)
        larger = jnp.maximum(fills, view)
        kept = ((view / larger) ** 8 + (fills / larger) ** 8) ** -0.125 * view / larger
        return light._replace(intensity=kept * light.intensity)


@dataclasses.dataclass(frozen=True)
class Analyzer(AbstractInstrumentTerm):
    r"""A linear polarizer in front of the detector of the intensity.

    $$ I' = I (1 + q \cos 2\chi + u \sin 2\chi)/2 $$

    Polarization is what the polarizer was turned to measure, and stays.

    Args:
        angle: Angle of the polarizer from the viewer's s axis, degree; one for all views, or a
            tuple with one for each.

    Raises:
        SceneError: An angle is no number.
    """

    angle: float | tuple[float, ...] = 0.0

    @override
    def __post_init__(self) -> None:
        angles = self.angle if isinstance(self.angle, tuple) else (self.angle,)
        for angle in angles:
            if isinstance(angle, str):
                hint = "give degrees, or a tuple with one number for each view"
                raise SceneError(f"{angle!r} is no angle", where="Analyzer", hint=hint)
            check_setting(angle, "Analyzer: angle", -360.0, 360.0)

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        twice = 2.0 * jnp.asarray(self.angle, light.q.dtype)
        passed = 1.0 + light.q * cos_degrees(twice) + light.u * sin_degrees(twice)
        return light._replace(intensity=0.5 * passed * light.intensity)


@dataclasses.dataclass(frozen=True)
class Saturation(AbstractInstrumentTerm):
    """Saturation of the sensor: brighter views are recorded as its level.

    For predictions and simulations; `StudentTLink` knows the level of a capture by itself.

    Args:
        level: Full scale, in units of the predicted intensity, > 0.

    Raises:
        SceneError: The level is no positive number.
    """

    level: float

    @override
    def __post_init__(self) -> None:
        if isinstance(self.level, str) or not self.level > 0.0:
            what = f"level={self.level!r} is no full scale"
            raise SceneError(what, where="Saturation", hint="give a number above 0")

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        return light._replace(intensity=jnp.minimum(light.intensity, self.level))


# --- A tilted normal: what a patch sees if it is not level ----------------------------------------


class Direction(NamedTuple):
    """A direction in the frame of the true normal, in degrees.

    `turn` is the cosine and sine of twice the angle from the s axis of the stated normal to that
    of the true one.
    """

    zenith: Array  # (..., view)
    azimuth: Array
    turn: tuple[Array, Array]


@dataclasses.dataclass(frozen=True)
class TiltedNormal(Part):
    r"""Tilt of the true normal by small angles towards azimuth 0 and towards azimuth 90.

    $$ n \propto (\tan t_x, \tan t_y, 1) $$

    in the frame in which the directions are stated: seen along azimuth 90 the tilt is t_x,
    seen along azimuth 0 by t_y. The axes of the true frame are those of the stated one, carried
    along by the rotation that takes the stated normal to the true one the shortest way; so are the
    grooves of an anisotropic surface, and a sky or disc that lights it.

    A direction that the tilt carries below the horizon counts as grazing, 89.999 degrees (or as
    stated, where that is nearer to 90): the light it has left is next to none, and its slope with
    the tilt is zero. Exactly on the true normal, where azimuth has no meaning, the azimuth as
    stated is kept, and slopes are those along the stated plane.

    Args:
        tilt_x: t_x, degree, -60 to 60; a name fits it.
        tilt_y: t_y, degree, -60 to 60; a name fits it.

    Raises:
        SceneError: A setting is neither a number in its range nor a name.
    """

    tilt_x: Annotated[Setting, Range(-60.0, 60.0)] = "normal_tilt_x"
    tilt_y: Annotated[Setting, Range(-60.0, 60.0)] = "normal_tilt_y"

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)

    def enter(
        self, parameters: Parameters, geometry: Geometry
    ) -> tuple[Geometry, tuple[Array, Array]]:
        """Return directions in the frame of the true normal, and the turn of the viewer's frame."""
        tilts = (value_of(tilt, parameters) for tilt in (self.tilt_x, self.tilt_y))
        # A sampler may ask for more than 80 degrees along an axis, and gets 80.
        slopes = [jnp.tan(jnp.deg2rad(jnp.clip(tilt, -80.0, 80.0))) for tilt in tilts]
        view = tilted_direction(geometry.view_zenith, geometry.view_azimuth, *slopes)
        light = tilted_direction(geometry.light_zenith, geometry.light_azimuth, *slopes)
        inside = Geometry(
            view.zenith, view.azimuth, light.zenith, light.azimuth, geometry.wavelength, light.turn
        )
        return inside, view.turn

    def leave(self, light: Light, turn: tuple[Array, Array]) -> Light:
        """Return light in the stated frame of the viewer, from that in the true frame."""
        cos, sin = turn
        return Light(light.intensity, *in_turned_frame(light.q, light.u, (cos, -sin)))


def tilted_direction(zenith: Array, azimuth: Array, slope_x: Array, slope_y: Array) -> Direction:
    r"""Return a direction in the frame of the normal (slope_x, slope_y, 1)/N.

    $$ \frac{s - p c}{N}, \quad \frac{-t}{N} $$

    along the stated s axis and the one at right angles to it: their length is the sine of the
    angle from the true normal, and their angle is that between both s axes. The zenith is given
    as the stated one plus a difference, which is exactly zero without a tilt.
    """
    # With p and t the slopes along and across the plane of the direction, s and c its sine and
    # cosine, the true normal's cross product with the direction has the components
    sin, cos = sin_degrees(zenith), cos_degrees(zenith)
    sin_azimuth, cos_azimuth = sin_degrees(azimuth), cos_degrees(azimuth)
    towards = slope_x * cos_azimuth + slope_y * sin_azimuth
    across = slope_y * cos_azimuth - slope_x * sin_azimuth
    length = jnp.sqrt(1.0 + slope_x**2 + slope_y**2)

    height = (cos + towards * sin) / length
    along_s, along_p = (sin - towards * cos) / length, -across / length
    lift = (cos + towards * sin / (1.0 + length)) / length
    x, y = sin - towards * lift, -across * lift

    # On the true normal only the plane as stated says where the direction came from.
    squared = along_s**2 + along_p**2
    overhead = squared <= jnp.finfo(squared.dtype).eps ** 1.5
    signed = along_s
    along_s, along_p = jnp.where(overhead, 1.0, along_s), jnp.where(overhead, 0.0, along_p)
    x, y = jnp.where(overhead, 1.0, x), jnp.where(overhead, 0.0, y)
    squared = along_s**2 + along_p**2
    sine = jnp.where(overhead, signed, jnp.sqrt(squared))

    cos_turn, sin_turn = double_angle(along_s, along_p)
    steeper = jnp.rad2deg(jnp.arctan2(sine * cos - height * sin, height * cos + sine * sin))
    horizon = jnp.maximum(zenith, STEEPEST_ZENITH)
    return Direction(
        jnp.minimum(zenith + steeper, horizon),
        azimuth + jnp.rad2deg(jnp.arctan2(y, x)),
        (cos_turn / squared, sin_turn / squared),
    )


# --- Discrepancy: a smooth unknown factor between the channels, over angle ------------------------


# View angles run over 0 to 90 degrees; sines vanish at the ends of a domain that begins so many
# degrees before and is so many degrees long.
BEFORE, SPAN = 13.5, 117.0


@dataclasses.dataclass(frozen=True)
class Discrepancy(AbstractInstrumentTerm):
    r"""Smooth factor exp(f) on the ratio of channels s and p, over the view zenith.

    $$ f(\theta) = \text{amplitude} \sum_j w_j \phi_j(\theta), \qquad
       q' = \frac{q+t}{1+qt}, \quad t = \tanh(f/2) $$

    A Gaussian process with squared-exponential kernel, in its Hilbert-space approximation by sines
    $\sqrt{S(\omega_j)} \sin(\omega_j(\theta + 13.5))$, $\omega_j = j\pi/117$ per degree, and
    conditioned on f(0) = 0: an isotropic sample reflects s and p alike at normal incidence, so that
    a ratio there is a gain (`ChannelGain`). The functions $\phi_j$ are the combinations of one sine
    more that vanish at 0. With standard normal weights the amplitude is the root mean square of f
    over 0 to 90 degrees.

    Parameters are `discrepancy_amplitude` (...) and `discrepancy_weights` (..., basis).

    Args:
        basis: Number of basis functions, at least 1.
        length: Length scale, degree, > 0.

    Raises:
        SceneError: The number or the length is not positive.

    Source:
        Solin and Sarkka 2020, Hilbert space methods for reduced-rank Gaussian process regression;
        Rasmussen and Williams 2006, Gaussian processes for machine learning, eq. 2.19 (conditioned
        on a value without noise).
    """

    basis: int = 3
    length: float = 25.0

    parameters: ClassVar[tuple[str, ...]] = ("discrepancy_amplitude", "discrepancy_weights")
    neutral: ClassVar[Mapping[str, float]] = MappingProxyType({"discrepancy_amplitude": 0.0})

    @override
    def __post_init__(self) -> None:
        if not (isinstance(self.basis, int) and self.basis >= 1 and self.length > 0.0):
            what = f"basis={self.basis!r} and length={self.length!r} make no smooth function"
            hint = "give a whole number of functions from 1 on and a length above 0 degrees"
            raise SceneError(what, where="Discrepancy", hint=hint)

    @override
    def record(self, parameters: Parameters, geometry: Geometry, light: Light) -> Light:
        # Weights come as (..., basis, 1): the scene's view axis stands last, as in the functions.
        weights = parameters["discrepancy_weights"]
        smooth = jnp.sum(weights * self.functions(geometry.view_zenith), axis=-2)
        half_log_ratio = 0.5 * parameters["discrepancy_amplitude"] * smooth
        return diattenuate(light, jnp.tanh(half_log_ratio), 1.0 / jnp.cosh(half_log_ratio))

    def functions(self, view_zenith: Array) -> Array:
        """Return basis functions that vanish at 0: (..., view) -> (..., basis, view)."""
        dtype = jnp.result_type(float, view_zenith)
        frequency, mixing = (jnp.asarray(x, dtype) for x in self._sines())
        sines = jnp.sin(frequency[:, None] * (view_zenith[..., None, :] + BEFORE))
        return jnp.einsum("bs,...sv->...bv", mixing, sines)

    def _sines(self) -> tuple[np.ndarray, np.ndarray]:
        """Return frequencies (sine,) and coefficients in each function (basis, sine)."""
        frequency = math.pi * np.arange(1, self.basis + 2) / SPAN
        scale = np.exp(-((self.length * frequency) ** 2) / 4.0)
        # A reflection that takes the values at 0 to the first axis: the others vanish there.
        normal = scale * np.sin(frequency * BEFORE)
        normal[0] += math.copysign(float(np.linalg.norm(normal)), normal[0])
        reflection = np.eye(normal.size) - 2.0 * np.outer(normal, normal) / (normal @ normal)
        mixing = reflection[1:] * scale
        angle = np.linspace(0.0, 90.0, 181)[:, None] + BEFORE
        variance = np.mean(np.sum((np.sin(frequency * angle) @ mixing.T) ** 2, axis=1))
        return frequency, mixing / math.sqrt(variance)
