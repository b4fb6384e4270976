"""What the interface turns back into the body: light gets another chance to come out."""

import dataclasses
from typing import override

from jaxtyping import Array

from polar_bayes.physics.part import Part
from polar_bayes.physics.surface import Interface


@dataclasses.dataclass(frozen=True)
class InternalReflection(Part):
    r"""Diffuse light under the interface is turned back and scattered again.

    $$ 1 + A F_i + (A F_i)^2 + \dots = \frac{1}{1 - A F_i} $$

    for a body of albedo A. Where a body's `internal_reflection` is None, F_i = 0.
    """

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (None,)

    def escape(self, interface: Interface) -> Array:
        """Share of diffuse light that leaves, 1 - F_i. Broadcasts with (..., view), in (0, 1]."""
        return interface.escape()
