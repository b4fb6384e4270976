r"""The half-normal prior of what readings seldom tell from zero.

NumPyro samples the log of a positive value. Where zero is as likely as anything, that log has a
tail without end to the left, in which chains walk for long. The normal score has none:

$$ z = \Phi^{-1}\big(2 \Phi(v/\sigma) - 1\big) $$

under which the prior is standard normal.
"""

import math
from typing import override

import jax
import jax.numpy as jnp
from jax.scipy.special import erf, erfc, erfinv, ndtr, ndtri
from jaxtyping import Array, ArrayLike, Float
from numpyro import distributions as dist
from numpyro.distributions import constraints, transforms

TWO_LOG_TWO = 2.0 * math.log(2.0)


class HalfNormal(dist.HalfNormal):
    """The half-normal distribution, sampled in its normal score."""

    @property
    @override
    def support(self) -> constraints.Constraint:
        return Scored(self.scale)


class Scored(constraints.Constraint):
    """Positive values, whose coordinate is the normal score under a half-normal distribution."""

    lower_bound = 0.0

    def __init__(self, scale: float) -> None:
        self.scale = scale

    @override
    def __call__(self, x: ArrayLike) -> Array:
        return jnp.greater(x, 0.0)

    @override
    def feasible_like(self, prototype: Array) -> Array:
        return jnp.broadcast_to(self.scale, jnp.shape(prototype))

    def eq(self, other: object, static: bool = False) -> bool:
        """Whether it is the same, as NumPyro asks."""
        return isinstance(other, Scored) and other.scale == self.scale

    def tree_flatten(self) -> tuple:
        """As NumPyro has it."""
        return (self.scale,), (("scale",), {})


@dist.biject_to.register(Scored)
def _by_score(support: Scored) -> "FromScore":
    return FromScore(support.scale)


class FromScore(transforms.Transform):
    """From a normal score to the value of that score."""

    domain = constraints.real
    codomain = constraints.positive

    def __init__(self, scale: float) -> None:
        self.scale = scale

    def __call__(self, x: Array) -> Array:
        """The value of a score."""
        return self.scale * folded(jnp.asarray(x))

    @override
    def _inverse(self, y: Array) -> Array:
        return unfolded(jnp.asarray(y) / self.scale)

    @override
    def log_abs_det_jacobian(
        self, x: Array, y: Array, intermediates: object | None = None
    ) -> Array:
        return jnp.log(0.5 * self.scale) + 0.5 * ((y / self.scale) ** 2 - x**2)

    def tree_flatten(self) -> tuple:
        """As NumPyro has it."""
        return (self.scale,), (("scale",), {})


@jax.custom_jvp
def folded(z: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""The half-normal quantile of a normal score: $\Phi^{-1}((1+\Phi(z))/2)$."""
    # Each half is computed from the tail that is small there. Beyond the smallest number of its
    # precision the tail of the right half is that of its asymptote.
    tail = 0.5 * ndtr(-z)
    known = tail >= jnp.finfo(tail.dtype).tiny
    high = jnp.where(known, -ndtri(tail), jnp.sqrt(z**2 + TWO_LOG_TWO))
    return jnp.where(z < 0.0, 2.0**0.5 * erfinv(ndtr(z)), high)


@folded.defjvp
def _slope_of_folded(z: tuple, dz: tuple) -> tuple[Array, Array]:
    x = folded(*z)
    return x, 0.5 * jnp.exp(0.5 * (x**2 - z[0] ** 2)) * dz[0]


@jax.custom_jvp
def unfolded(x: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""The normal score of a half-normal value: $\Phi^{-1}(2\Phi(x) - 1)$."""
    half = 2.0**-0.5
    tail = erfc(half * x)
    known = tail >= jnp.finfo(tail.dtype).tiny
    high = jnp.where(known, -ndtri(tail), jnp.sqrt(x**2 - TWO_LOG_TWO))
    return jnp.where(x < 0.5, ndtri(erf(half * x)), high)


@unfolded.defjvp
def _slope_of_unfolded(x: tuple, dx: tuple) -> tuple[Array, Array]:
    z = unfolded(*x)
    return z, 2.0 * jnp.exp(0.5 * (z**2 - x[0] ** 2)) * dx[0]
