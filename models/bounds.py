"""A coordinate without bounds for a parameter that has some."""

import math
from typing import Any, override

import jax
import jax.numpy as jnp
from jaxtyping import Array
from numpyro.distributions import constraints
from numpyro.distributions.transforms import Transform

BEND = 80.0
"""The bend at a bound is this many times narrower than the interval."""


class Bent(Transform):
    r"""The identity inside an interval, bent at its ends.

    $$ y = l + s \log\frac{1 + e^{(x-l)/s}}{1 + e^{(x-h)/s}}, \qquad s = (h-l)/80 $$

    Away from the ends y = x, so what is normal stays normal, and what readings know of y they know
    of x. NumPyro's own map onto an interval bends everywhere.

    Args:
        low: l, finite.
        high: h, or inf.
    """

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high

    @property
    def scale(self) -> float:
        """s, in the unit of the parameter."""
        return (self.high - self.low) / BEND if math.isfinite(self.high) else 1.0 / BEND

    @property
    @override
    def domain(self) -> constraints.Constraint:
        return constraints.real

    @property
    @override
    def codomain(self) -> constraints.Constraint:
        return constraints.interval(self.low, self.high)

    @override
    def __call__(self, x: Array) -> Array:
        above = self.low + self.scale * jax.nn.softplus((x - self.low) / self.scale)
        if math.isinf(self.high):
            return above
        bent = above - self.scale * jax.nn.softplus((x - self.high) / self.scale)
        return jnp.clip(bent, self.low, self.high)  # a rounding error may lie outside

    @override
    def _inverse(self, y: Array) -> Array:
        # The nearest number inside: at a bound itself the coordinate is infinite.
        least = jnp.finfo(y.dtype).eps
        above = jnp.maximum((y - self.low) / self.scale, least)
        x = self.low + self.scale * (above + jnp.log(-jnp.expm1(-above)))
        if math.isinf(self.high):
            return x
        below = jnp.maximum((self.high - y) / self.scale, least)
        return x - self.scale * jnp.log(-jnp.expm1(-below))

    @override
    def log_abs_det_jacobian(self, x: Array, y: Array, intermediates: Any = None) -> Array:
        slope = jax.nn.log_sigmoid((x - self.low) / self.scale)
        if math.isinf(self.high):
            return slope
        constant = math.log1p(-math.exp(-BEND))
        return slope + jax.nn.log_sigmoid((self.high - x) / self.scale) + constant

    @override
    def tree_flatten(self) -> tuple[tuple, tuple]:
        return (), ((), {"low": self.low, "high": self.high})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Bent) and (self.low, self.high) == (other.low, other.high)

    def __hash__(self) -> int:
        return hash((self.low, self.high))
