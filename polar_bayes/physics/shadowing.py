"""Which facets see the viewer, the light, or both: Smith's shadowing and masking."""

import abc
import dataclasses
from typing import override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.part import Part


@dataclasses.dataclass(frozen=True)
class AbstractShadowing(Part):
    """How two directions, each with its own share G1 of visible facets, combine."""

    @abc.abstractmethod
    def both(self, view: Array, light: Array) -> Array:
        """Share of facets that see viewer and light.

        Args:
            view: G1 of the viewer. Any shape, 1, in (0, 1].
            light: G1 of the light. Broadcasts, 1, in (0, 1].

        Returns:
            G. Broadcast shape, 1, in (0, 1].

        Raises:
            Nothing.
        """


@dataclasses.dataclass(frozen=True)
class SeparableShadowing(AbstractShadowing):
    """Viewer and light as if independent: G = G1(v) G1(l).

    Source:
        Walter et al. 2007, Microfacet models for refraction through rough surfaces.
    """

    @override
    def both(self, view: Array, light: Array) -> Array:
        return view * light


@dataclasses.dataclass(frozen=True)
class HeightCorrelatedShadowing(AbstractShadowing):
    r"""A high facet is seen by both, a deep one by neither.

    $$ G = \frac{1}{1 + \Lambda_v + \Lambda_l}, \qquad \Lambda = 1/G_1 - 1 $$

    Source:
        Heitz 2014, Understanding the masking-shadowing function in microfacet-based BRDFs.
    """

    @override
    def both(self, view: Array, light: Array) -> Array:
        return view * light / (view + light - view * light)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (SeparableShadowing(),)


@dataclasses.dataclass(frozen=True)
class NoShadowing(AbstractShadowing):
    """Every facet is seen and lit: brighter towards grazing than any surface can be."""

    @override
    def both(self, view: Array, light: Array) -> Array:
        return jnp.ones_like(view)
