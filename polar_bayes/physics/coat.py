"""Layers on the body and behind it: coats, thin films, stacks, and the back of a plate.

A coat lies on every facet of a rough surface alike. One of your own says which layers it adds.
"""

import abc
import dataclasses
import math
from typing import Annotated, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.errors import SceneError
from polar_bayes.physics.part import Parameters, Part, Range, Setting, check_part, value_of
from polar_bayes.physics.stack import Layer, Stack


@dataclasses.dataclass(frozen=True)
class AbstractCoat(Part):
    """One or more layers on the body."""

    @abc.abstractmethod
    def layers(self, parameters: Parameters, wavelength: Array | None) -> tuple[Layer, ...]:
        """Return layers from the top down.

        Args:
            parameters: Material parameters by name. Each broadcasts with (..., view).
            wavelength: Wavelength in air, nm, broadcasts with (..., view); None where the
                capture has none.

        Returns:
            Layers.

        Raises:
            SceneError: The coat needs a wavelength and there is none.
        """

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)


@dataclasses.dataclass(frozen=True)
class ClearCoat(AbstractCoat):
    r"""A coat much thicker than the coherence of the light: reflections add as powers.

    $$ R = R_{12} + \frac{(1-R_{12})^2 R_{23} t^2}{1 - R_{12} R_{23} t^2}, \qquad
       t = e^{-\text{absorbance}/\cos\theta_\text{coat}} $$

    for s and p, over any base; light scattered in the body passes the coat twice and is partly
    turned back by it.

    Args:
        refractive_index: Of the coat, 1, 1 to 3; a name fits it.
        absorbance: Minus the log of the share that passes once at normal incidence, 1, >= 0; a
            name fits it, and 0 leaves it out.

    Raises:
        SceneError: A setting is neither a number in its range nor a name.
    """

    refractive_index: Annotated[Setting, Range(1.0, 3.0)] = "coat_refractive_index"
    absorbance: Annotated[Setting, Range(0.0, 100.0)] = "coat_absorbance"

    @override
    def layers(self, parameters: Parameters, wavelength: Array | None) -> tuple[Layer, ...]:
        clear = self.absorbance == 0.0
        index = value_of(self.refractive_index, parameters)
        return (Layer(index, None if clear else value_of(self.absorbance, parameters)),)


@dataclasses.dataclass(frozen=True)
class ThinFilm(AbstractCoat):
    """A film without absorption, thin enough for fringes over wavelength (Airy's formulas).

    Args:
        refractive_index: Of the film, 1, 1 to 3; a name fits it.
        thickness_nm: Thickness, nm, 0 to 1e5; a name fits it.

    Raises:
        SceneError: A setting is neither a number in its range nor a name.
    """

    refractive_index: Annotated[Setting, Range(1.0, 3.0)] = "film_refractive_index"
    thickness_nm: Annotated[Setting, Range(0.0, 1e5)] = "film_thickness"

    @override
    def layers(self, parameters: Parameters, wavelength: Array | None) -> tuple[Layer, ...]:
        if wavelength is None:
            what = "fringes depend on the wavelength, and there is none"
            hint = "give the geometry a wavelength in nm, or the capture such a coordinate"
            raise SceneError(what, where="ThinFilm", hint=hint)
        thickness = value_of(self.thickness_nm, parameters)
        index = value_of(self.refractive_index, parameters)
        return (Layer(index, wavenumber=4.0 * math.pi * thickness / wavelength),)


@dataclasses.dataclass(frozen=True)
class CoatStack(AbstractCoat):
    """Several coats, one on the other.

    Args:
        coats: From the top down.

    Raises:
        SceneError: Something in the tuple is no coat, or two coats would share a parameter.
    """

    coats: tuple[AbstractCoat, ...]

    def __post_init__(self) -> None:
        check_part(self.coats, "CoatStack", tuple, "a tuple: CoatStack((ThinFilm(), ClearCoat()))")
        for coat in self.coats:
            check_part(coat, "CoatStack", AbstractCoat, "coats such as ClearCoat() or ThinFilm()")
        names = [name for coat in self.coats for name in coat.parameters]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            hint = "name the parameters apart: ClearCoat(absorbance='lacquer_absorbance')"
            raise SceneError(f"two coats read {', '.join(repeated)}", where="CoatStack", hint=hint)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        others = [self.coats[:at] + self.coats[at + 1 :] for at in range(len(self.coats))]
        return tuple(CoatStack(coats) if coats else None for coats in others)

    @override
    def layers(self, parameters: Parameters, wavelength: Array | None) -> tuple[Layer, ...]:
        return tuple(layer for coat in self.coats for layer in coat.layers(parameters, wavelength))


@dataclasses.dataclass(frozen=True)
class BackFace(Part):
    r"""The back of a transparent plate: reflections from it add as powers.

    $$ R = R_{12} + \text{share} \cdot \frac{(1-R_{12})^2 R_{12} A^2}{1 - R_{12}^2 A^2}, \qquad
       A = e^{-\text{absorbance}/\cos\theta_\text{plate}} $$

    for s and p, with air behind the plate and $R_{12}$ of its front, coats included. Light from
    the back leaves the plate beside the first reflection, so that a detector may miss part of it.

    Args:
        share: Share of the light from the back that the detector catches, 1, 0 to 1; a name
            fits it.
        absorbance: Minus the log of the share of light that passes the plate once at normal
            incidence, 1, >= 0; a name fits it, and 0 leaves it out.

    Raises:
        SceneError: A setting is neither a number in its range nor a name.

    Source:
        Byrnes (2016), arXiv:1603.02720 (incoherent layers).
    """

    share: Annotated[Setting, Range(0.0, 1.0)] = "back_face_share"
    absorbance: Annotated[Setting, Range(0.0, 100.0)] = 0.0

    def behind(self, front: Stack, parameters: Parameters) -> Stack:
        """Return the stack of the whole plate: front, plate as a thick layer, and air behind it.

        Args:
            front: The body, which is the plate, and what lies on it.
            parameters: Material parameters by name. Each broadcasts with (..., view).

        Returns:
            Layers on air.
        """
        clear = self.absorbance == 0.0
        absorbance = None if clear else value_of(self.absorbance, parameters)
        plate = Layer(front.refractive_index, absorbance)
        return Stack(jnp.ones_like(front.refractive_index), (*front.layers, plate))

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)
