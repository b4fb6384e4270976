"""Dispersion laws: the index of the body over wavelength, in place of one index per wavelength."""

import abc
import dataclasses
from typing import Annotated, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.part import Parameters, Part, Range, Setting, value_of

# Wavelengths are in nm outside and in micrometers inside, as coefficients are tabulated.
NANOMETERS = 1e-3


@dataclasses.dataclass(frozen=True)
class AbstractDispersion(Part):
    """A law for the refractive index over wavelength."""

    @abc.abstractmethod
    def index(self, parameters: Parameters, wavelength: Array) -> Array:
        """Return the refractive index.

        Args:
            parameters: The law's parameters by name. Each broadcasts with (..., view).
            wavelength: Wavelength in air. Broadcasts with (..., view), nm, > 0.

        Returns:
            n. Broadcast shape, 1.
        """


@dataclasses.dataclass(frozen=True)
class Cauchy(AbstractDispersion):
    r"""Cauchy's law, for transparent bodies in the visible.

    $$ n(\lambda) = A + B/\lambda^2 + C/\lambda^4 $$

    with the wavelength in micrometers, as A, B and C are tabulated.

    Args:
        a: A, the index towards long waves, 1, 1 to 3; a name fits it.
        b: B, micrometer^2, 0 to 1; a name fits it.
        c: C, micrometer^4, -1 to 1; a name fits it.

    Raises:
        SceneError: A setting is neither a number in its range nor a name.
    """

    a: Annotated[Setting, Range(1.0, 3.0)] = "cauchy_a"
    b: Annotated[Setting, Range(0.0, 1.0)] = "cauchy_b"
    c: Annotated[Setting, Range(-1.0, 1.0)] = 0.0

    @override
    def index(self, parameters: Parameters, wavelength: Array) -> Array:
        a, b = value_of(self.a, parameters), value_of(self.b, parameters)
        inverse = 1.0 / (NANOMETERS * wavelength) ** 2
        if self.c == 0.0:
            return a + b * inverse
        return a + inverse * (b + value_of(self.c, parameters) * inverse)


@dataclasses.dataclass(frozen=True)
class Sellmeier(AbstractDispersion):
    r"""Sellmeier's law, one resonance or more.

    $$ n^2(\lambda) = 1 + \sum_i \frac{B_i \lambda^2}{\lambda^2 - C_i} $$

    with the wavelength in micrometers. One resonance in the ultraviolet fits most bodies over the
    visible; the tabulated glasses have three.

    Args:
        strengths: B_i, 1, 0 to 10 each; names fit them.
        resonances: C_i, the squared wavelengths of the resonances, micrometer^2, 0 to 0.1 (or
            above 1, for one in the infrared); names fit them.

    Raises:
        SceneError: The two are not tuples of one length, or a setting is neither a number in its
            range nor a name.
    """

    strengths: Annotated[tuple[Setting, ...], Range(0.0, 10.0)] = ("sellmeier_strength",)
    resonances: Annotated[tuple[Setting, ...], Range(0.0, 1e4)] = ("sellmeier_resonance",)

    @override
    def __post_init__(self) -> None:
        both = (self.strengths, self.resonances)
        are_tuples = all(isinstance(each, tuple) and each for each in both)
        if not are_tuples or len(self.strengths) != len(self.resonances):
            what = f"strengths={self.strengths!r} and resonances={self.resonances!r} do not pair"
            hint = "give two tuples of one length: Sellmeier((1.04, 0.23), (0.006, 0.02))"
            raise SceneError(what, where="Sellmeier", hint=hint)
        super().__post_init__()

    @override
    def index(self, parameters: Parameters, wavelength: Array) -> Array:
        inverse = 1.0 / (NANOMETERS * wavelength) ** 2
        square = jnp.ones_like(inverse)
        for strength, resonance in zip(self.strengths, self.resonances, strict=True):
            depth = 1.0 - value_of(resonance, parameters) * inverse
            square = square + value_of(strength, parameters) / depth
        return jnp.sqrt(jnp.maximum(square, 1.0))
