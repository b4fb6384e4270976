"""Parts of a scene: the base class, settings, names and ranges of parameters.

A part is a frozen value. A part that can be replaced by something cheaper says so in `simpler`;
that is all the ledger of effects needs to weigh it (`polar_bayes.choose_effects`). A part that
another could replace as well says so in `alternatives`: every fit tells what it would change.
"""

import abc
import dataclasses
from collections.abc import Iterator, Mapping
from types import UnionType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from polar_bayes.errors import SceneError
from polar_bayes.repr_html import HTMLRepr

Setting = float | str
"""A known number, or the name of a parameter that supplies it."""


Parameters = Mapping[str, Array]
"""Parameters by name; each broadcasts with (..., view)."""


class Range(NamedTuple):
    """Range of a field: `absorbance: Annotated[Setting, Range(0.0, 100.0)]`."""

    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Part(HTMLRepr, abc.ABC):
    """A part of a scene, which describes one effect."""

    defines: ClassVar[tuple[str, ...]] = ()
    """Parameters whose meaning depends on this part."""

    def __post_init__(self) -> None:
        for name, allowed, value in self._values():
            if allowed is not None:
                check_setting(value, f"{type(self).__name__}: {name}", *allowed)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that the part reads, by its settings and its parts."""
        names: list[str] = []
        for _, allowed, value in self._values():
            if isinstance(value, Part):
                names += value.parameters
            elif isinstance(value, str) and allowed is not None:
                names.append(value)
        return tuple(dict.fromkeys(names))

    def _values(self) -> Iterator[tuple[str, Range | None, object]]:
        """Yield every field with its range and value, or each value of a tuple."""
        for field in dataclasses.fields(self):
            notes = getattr(field.type, "__metadata__", ())
            allowed = next((note for note in notes if isinstance(note, Range)), None)
            value = getattr(self, field.name)
            is_many = isinstance(value, tuple)
            if allowed is not None:  # a tuple is no value of a field for one number
                is_many = is_many and isinstance(field.default, tuple)
            for one in value if is_many else (value,):
                yield field.name, allowed, one

    def simpler(self) -> "tuple[Part | None, ...]":
        """Return simpler replacements: cheaper parts, or None to leave the part out.

        Returns:
            Replacements to be judged, each alone; empty where there is nothing simpler.
        """
        return ()

    def alternatives(self) -> "tuple[Part | None, ...]":
        """Return parts that could replace this one, and that readings may not distinguish.

        Returns:
            Parts that every fit compares with this one, each alone, and None where the part may be
            absent, which a fit compares if the part may send nothing; empty where there are none.
        """
        return ()


def value_of(setting: Setting, parameters: Parameters) -> Array:
    """Return a setting's number in the parameters' precision, or the parameter it names."""
    if isinstance(setting, str):
        return parameters[setting]
    return jnp.asarray(setting, jnp.result_type(float, *parameters.values()))


def parameters_of(*parts: Any) -> tuple[str, ...]:
    """Return the parameters that several parts read, each once; parts may be None."""
    names = (name for part in parts if part is not None for name in part.parameters)
    return tuple(dict.fromkeys(names))


def check_part(value: object, where: str, kind: type | UnionType, allowed: str) -> None:
    """Refuse a part of a wrong kind, and name the right kinds."""
    if not isinstance(value, kind):
        raise SceneError(f"{value!r} is no such part", where=where, hint=f"give {allowed}")


def check_setting(value: object, where: str, low: float, high: float) -> None:
    """Refuse a setting that is neither a name nor a number in its range."""
    if isinstance(value, str) and value.isidentifier():
        return
    numeric = isinstance(value, int | float) and not isinstance(value, bool)
    if not (numeric and low <= value <= high):  # type: ignore[operator]
        what = f"{value!r} is neither a number from {low:g} to {high:g} nor a parameter's name"
        hint = "give the number where it is known, or a name such as 'coat_absorbance' to fit it"
        raise SceneError(what, where=where, hint=hint)


def unit_rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on (0, 1)."""
    node, weight = np.polynomial.legendre.leggauss(count)
    return 0.5 * (node + 1.0), 0.5 * weight


def squared_rule(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on (0, 1) that are denser at 0, where light is at grazing."""
    node, weight = unit_rule(count)
    return node**2, 2.0 * node * weight


def at_least(value: Array, floor: float) -> Array:
    """Return the larger of two values; the slope at the floor is that from above."""
    return jnp.where(value < floor, floor, value)


def quotient(numerator: Array, denominator: Array) -> Array:
    """Return a quotient whose second derivatives are finite in single precision."""
    # The Hessian divides by the denominator's cube, which for light of 1e-13 does not exist there.
    # A factor, since XLA would turn two quotients into one of products.
    scale = 1.0 / jax.lax.stop_gradient(denominator)
    return numerator * scale / (denominator * scale)


def like(values: ArrayLike, array: Array) -> Array:
    """Convert constants to the precision of the data."""
    return jnp.asarray(values, jnp.result_type(float, array))


# --- Parameters of scenes and links as readers see them: symbol, meaning, unit --------------------


class Quantity(NamedTuple):
    """Notation of a parameter: symbol, meaning and unit.

    Args:
        symbol: The paper's or the field's letter; empty where there is none.
        meaning: In words.
        unit: As xarray and ArviZ show it.
    """

    symbol: str
    meaning: str
    unit: str = "1"


MATERIAL: dict[str, Quantity] = {
    "roughness": Quantity("r", "roughness"),
    "subsurface_fraction": Quantity("beta", "subsurface fraction"),
    "absorption": Quantity("a", "absorption relative to scattering"),
    "refractive_index": Quantity("n", "refractive index"),
    "roughness_across": Quantity("", "roughness across the direction of `roughness`"),
    "roughness_azimuth": Quantity("", "azimuth along which `roughness` is meant", "degree"),
    "albedo": Quantity("A", "albedo of the body"),
    "anisotropy": Quantity("g", "mean cosine of scattering"),
    "polarized_fraction": Quantity("", "share of scattering that polarizes"),
    "cauchy_a": Quantity("A", "Cauchy's A"),
    "cauchy_b": Quantity("B", "Cauchy's B", "micrometer^2"),
    "sellmeier_strength": Quantity("B", "Sellmeier's strength"),
    "sellmeier_resonance": Quantity("C", "Sellmeier's squared resonance", "micrometer^2"),
    "coat_refractive_index": Quantity("", "refractive index of the coat"),
    "coat_absorbance": Quantity("", "absorbance of the coat at normal incidence"),
    "film_refractive_index": Quantity("", "refractive index of the film"),
    "film_thickness": Quantity("", "thickness of the film", "nm"),
    "back_face_share": Quantity("", "share of the light from the back of a plate that is caught"),
    "normal_tilt_x": Quantity("", "lean of the normal towards azimuth 0", "degree"),
    "normal_tilt_y": Quantity("", "lean of the normal towards azimuth 90", "degree"),
}
"""Parameters of a material, in the order of tables; all others belong to a whole capture."""

NOTATION: dict[str, Quantity] = {
    **MATERIAL,
    "refractive_index_level": Quantity("", "level of n over wavelength"),
    "refractive_index_amplitude": Quantity("", "departure of n from its level"),
    "refractive_index_length": Quantity("", "length over which n changes", "nm"),
    "absorption_level": Quantity("", "level of a over wavelength"),
    "absorption_amplitude": Quantity("", "departure of log a from its level"),
    "absorption_length": Quantity("", "length over which a changes", "nm"),
    "sky_radiance": Quantity("L", "radiance of the sky over the irradiance of the sun", "1/sr"),
    "angle_zero": Quantity("", "offset of both zenith angles", "degree"),
    "beam_overlap_zenith": Quantity("", "zenith where the beam fills the sample", "degree"),
    "dolp_gain": Quantity("", "share of the polarization that is recorded"),
    "channel_gain_ratio": Quantity("", "gain of the s channel over the p channel"),
    "leakage": Quantity("", "share of each channel seen in the other"),
    "dark_level": Quantity("", "unpolarized light added to every view"),
    "discrepancy_amplitude": Quantity("", "size of smooth errors over angle"),
    "discrepancy_weights": Quantity("", "shape of smooth errors over angle"),
    "light_zenith_offset": Quantity("", "zenith of the light", "degree"),
    "light_azimuth_offset": Quantity("", "azimuth of the light", "degree"),
    "view_zenith_scale_offset": Quantity("", "scale of the viewing zenith"),
    "incidence_angle_offset": Quantity("", "angle of incidence", "degree"),
    "sample_lean_offset": Quantity("", "lean of the sample in the plane of the light", "degree"),
    "analyzer_roll_offset": Quantity("", "roll of the analyzer", "degree"),
    "polarization_loss_offset": Quantity("", "loss of polarization"),
    "ambient_light_offset": Quantity("", "ambient light over the brightest reading"),
    "tone_curve_offset": Quantity("", "exponent of the sensor's tone curve"),
    "concentration_scale": Quantity("", "concentration of the noise of dop"),
    "logit_scale": Quantity("", "noise of the log odds of dop"),
    "normal_scale": Quantity("", "noise of the readings"),
    "stokes_scale": Quantity("", "noise of q and u in full light"),
    "stokes_error_factor": Quantity("", "true errors of q and u over those in the capture"),
    "exposure": Quantity("", "recorded over predicted intensity"),
    "exposure_share": Quantity("", "log-average of the light on the scale of the sensor"),
    "intensity_scale": Quantity("", "noise of the intensity"),
}


class Absence(NamedTuple):
    """Values at which what a parameter describes is absent or perfect.

    Args:
        value: Of the parameter, an end of its range.
        words: What is then not there.
        part: Name of the field of a scene whose part then sends nothing; empty where none is idle.
    """

    value: float
    words: str
    part: str = ""


ABSENT: dict[str, Absence] = {
    "roughness": Absence(0.0, "no roughness"),
    "subsurface_fraction": Absence(0.0, "no light from the body", "subsurface"),
    "absorption": Absence(0.0, "no absorption"),
    "coat_absorbance": Absence(0.0, "no absorption in the coat"),
    "back_face_share": Absence(0.0, "no light from the back of the plate"),
    "leakage": Absence(0.0, "no leakage between the channels"),
    "dolp_gain": Absence(1.0, "no loss of polarization in the polarizer"),
    "discrepancy_amplitude": Absence(0.0, "no smooth error over angle"),
    "ambient_light_offset": Absence(0.0, "no ambient light"),
    "polarization_loss_offset": Absence(0.0, "no loss of polarization"),
}
"""Absence by parameter: a bare and smooth surface, and an instrument without faults."""


UNPOLARIZED = ("leakage", "subsurface_fraction")
"""Shares of light that lose their polarization, whose sum readings determine best."""


def notation(name: str) -> Quantity:
    """Return the notation of a parameter, or of its population, or one made from its name."""
    population = {"_location": "population median of", "_spread": "population spread of"}
    for ending, words in population.items():
        if name.endswith(ending) and name.removesuffix(ending) in NOTATION:
            _, meaning, unit = NOTATION[name.removesuffix(ending)]
            return Quantity("", f"{words} {meaning}", unit if ending == "_location" else "1")
    return NOTATION.get(name, Quantity("", name.replace("_", " ")))


def absence(name: str) -> Absence | None:
    """Return the absence of a parameter, or of its population's location; None without any."""
    return ABSENT.get(name.removesuffix("_location"))
