"""From a normal variable to a truncated one, smoothly and for any width."""

import math

import jax.numpy as jnp
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float

# A spread below this share of the interval cuts nothing off that a sampler could see.
NARROW = 1e-6


def onto_interval(
    value: Float[Array, "..."],
    location: Float[Array, "..."],
    spread: Float[Array, "..."],
    low: float,
    high: float,
) -> Float[Array, "..."]:
    r"""Map x ~ Normal(location, spread) to that distribution truncated to [low, high].

    $$ F\Big(\frac{y-m}{s}\Big) = F(a) + [F(b) - F(a)]\, F\Big(\frac{x-m}{s}\Big), \qquad
       a = \frac{l-m}{s}, \quad b = \frac{h-m}{s} $$

    with F the normal distribution function. Where nothing is cut off, y = x. So a parameter with
    bounds gets a coordinate without bounds, in which its population is exactly normal; both
    halves are computed from their own tail, so that none loses digits.

    Args:
        value: x, any real number.
        location: m, in [low, high].
        spread: s, > 0.
        low: Lower bound, or -inf.
        high: Upper bound, or inf.

    Returns:
        y, in [low, high]; broadcast shape, same unit.

    Raises:
        Nothing.
    """
    width = high - low if math.isfinite(high - low) else 1.0
    scale = jnp.maximum(spread, NARROW * width)
    standard = (value - location) / scale
    # So far out the normal distribution function and its inverse still have all their digits.
    reach = 8.0 if standard.dtype == jnp.float64 else 5.0
    inner = jnp.clip(standard, -reach, reach)
    below, above = ndtr((low - location) / scale), ndtr((location - high) / scale)
    kept = jnp.maximum(1.0 - below - above, jnp.finfo(standard.dtype).tiny)
    is_low = inner <= 0.0
    tail = jnp.where(is_low, below, above) + kept * ndtr(-jnp.abs(inner))
    distance = ndtri(jnp.clip(tail, jnp.finfo(tail.dtype).tiny, 1.0 - jnp.finfo(tail.dtype).eps))
    mapped = jnp.where(is_low, distance, -distance) + (standard - inner)
    return jnp.clip(location + scale * mapped, low, high)
