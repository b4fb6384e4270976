"""What all parts of a scene share: the parameters they read, and what to put in their place.

A part is a frozen value. A part that can be replaced by something cheaper says so in `simpler`;
that is all the ledger of effects needs to weigh it (`polar_bayes.choose_effects`).
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from polar_bayes.cards import Carded
from polar_bayes.errors import SceneError

Setting = float | str
"""A known number, or the name of a parameter that stands for it."""


@dataclasses.dataclass(frozen=True)
class Part(Carded, abc.ABC):
    """One effect of a scene."""

    parameters: ClassVar[tuple[str, ...]] = ()
    """Names of the parameters that it reads, its own parts' included."""

    def simpler(self) -> "tuple[Part | None, ...]":
        """What may stand in its place: a cheaper part, or None for leaving it out.

        Returns:
            Replacements to be weighed, each alone; empty where there is nothing simpler.

        Raises:
            Nothing.
        """
        return ()


def value_of(setting: Setting, parameters: Mapping[str, Array]) -> Array:
    """The number of a setting in the parameters' precision, or the parameter that it names."""
    if isinstance(setting, str):
        return parameters[setting]
    return jnp.asarray(setting, jnp.result_type(float, *parameters.values()))


def names_in(*settings: Setting) -> tuple[str, ...]:
    """The parameters that settings name, each once."""
    return tuple(dict.fromkeys(setting for setting in settings if isinstance(setting, str)))


def parameters_of(*parts: Part | None) -> tuple[str, ...]:
    """The parameters that several parts read, each once."""
    return tuple(
        dict.fromkeys(name for part in parts if part is not None for name in part.parameters)
    )


def check_part(value: object, where: str, kind: type, allowed: str) -> None:
    """Refuse a part of the wrong kind, naming the right ones."""
    if not isinstance(value, kind):
        raise SceneError(f"{value!r} is no such part", where=where, mend=f"give {allowed}")


def check_setting(value: object, where: str, low: float, high: float) -> None:
    """Refuse a setting that is neither a name nor a number in its range."""
    if isinstance(value, str) and value.isidentifier():
        return
    numeric = isinstance(value, int | float) and not isinstance(value, bool)
    if not (numeric and low <= value <= high):  # type: ignore[operator]
        raise SceneError(
            f"{value!r} is neither a number from {low:g} to {high:g} nor a parameter's name",
            where=where,
            mend="give the number where it is known, or a name such as 'coat_absorbance' to fit it",
        )


def like(values: ArrayLike, array: Array) -> Array:
    """Constants in the precision of the data."""
    return jnp.asarray(values, jnp.result_type(float, array))
