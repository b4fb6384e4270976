"""Mixtures of Student t distributions, fitted to weighted draws: proposals for bent posteriors.

One normal or t distribution wastes most of its draws on a posterior that bends or has two modes; a
few together follow it. Measured in `benchmarks/calibration.py`.

Each round takes mean and covariance of the weighted draws of the last, and draws from a Student t
distribution with both: its tails are longer than those of nearly every posterior, so weights are
bounded where those of a normal distribution are not. A round takes a small part of the time of
short chains.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from polar_bayes.inference.levenberg_marquardt import AnyArray
from polar_bayes.inference.program import Values
from polar_bayes.inference.psis import Points, even, mirrored
from polar_bayes.inference.smc import spread

DEGREES_OF_FREEDOM = 8.0
"""Of the tails: longer than those of most posteriors, which bounds the weights."""

STEPS = 15
"""Of expectation and maximization; the mixture need not be the best one, only a good one."""

WIDE_SHARE, WIDE_SCALE = 0.15, 2.0
"""Of one more component around all draws: it shows a tail that they have too little of."""

PRIOR_SCALE = 0.5
"""Scale of a component that no draws belong to, in units of that of all draws."""


class Mixture(NamedTuple):
    """A mixture in coordinates in which all draws together have mean 0 and covariance 1."""

    center: Float[Array, " size"]
    half: Float[Array, "size size"]
    log_share: Float[Array, " component"]
    mean: Float[Array, "component size"]
    scale: Float[Array, "component size size"]


class Proposed(NamedTuple):
    """Draws of a mixture for every pixel of a row."""

    mixture: Mixture
    z: AnyArray
    parameters: Values
    log_posterior: AnyArray


def fit_mixture(
    z: Float[Array, "draw size"], weights: Float[Array, " draw"], components: int, key: Array
) -> Mixture:
    """Fit normal components by expectation and maximization."""
    # Components shrink towards the whole as far as they have few draws.
    # Source: Cappe, Douc, Guillin, Marin & Robert (2008), Stat. Comput. 18, 447-459: adaptive
    # importance sampling by mixtures.
    size = z.shape[-1]
    center, half = spread(z, weights)
    x = (z - center) @ _inverse(half).T
    worth = weights / jnp.sum(weights**2)  # they sum to what the draws are worth
    begin = jax.random.choice(key, len(x), (components,), replace=False, p=weights)
    unit = PRIOR_SCALE * jnp.eye(size, dtype=z.dtype)

    def improve(_: int, parts: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        log_share, mean, scale = parts
        squares, log_volume = _whitened(x, mean, scale)
        share = jax.nn.softmax(log_share - 0.5 * squares - log_volume, axis=-1) * worth[:, None]
        held = jnp.sum(share, axis=0) + 1e-3
        mean = (share.T @ x) / held[:, None]
        apart = x[:, None] - mean
        found = jnp.einsum("dk,dki,dkj->kij", share, apart, apart) / held[:, None, None]
        own = (held / (held + size + 2.0))[:, None, None]
        covariance = own * found + (1.0 - own) * unit
        return jnp.log(held / jnp.sum(held)), mean, jnp.linalg.cholesky(covariance)

    log_share = jnp.full(components, -jnp.log(components), z.dtype)
    scale = jnp.broadcast_to(jnp.linalg.cholesky(unit), (components, size, size))
    log_share, mean, scale = jax.lax.fori_loop(0, STEPS, improve, (log_share, x[begin], scale))
    wide = WIDE_SCALE * jnp.eye(size, dtype=z.dtype)
    shares = log_share + jnp.log1p(-WIDE_SHARE), jnp.log(jnp.full(1, WIDE_SHARE, z.dtype))
    return Mixture(
        center,
        half,
        jnp.concatenate(shares),
        jnp.concatenate([mean, jnp.zeros((1, size), z.dtype)]),
        jnp.concatenate([scale, wide[None]]),
    )


def draw_mixture(mixture: Mixture, count: int, key: Array) -> Float[Array, "draw size"]:
    """Draws of the mixture with tails of Student's t, each component's share evenly."""
    components, size = mixture.mean.shape
    key_which, key_normal, key_tail = jax.random.split(key, 3)
    even = (jnp.arange(count) + jax.random.uniform(key_which)) / count
    which = jnp.searchsorted(jnp.cumsum(jnp.exp(mixture.log_share)), even)
    which = jnp.clip(which, 0, components - 1)
    dtype = mixture.mean.dtype
    freedom = DEGREES_OF_FREEDOM
    tail = jax.random.gamma(key_tail, 0.5 * freedom, (count, 1), dtype) * 2.0 / freedom
    noise = jax.random.normal(key_normal, (count, size), dtype) / jnp.sqrt(tail)
    x = mixture.mean[which] + jnp.einsum("dij,dj->di", mixture.scale[which], noise)
    return mixture.center + x @ mixture.half.T


def log_density(mixture: Mixture, z: Float[Array, "draw size"]) -> Float[Array, " draw"]:
    """Log density of a mixture with tails of Student's t."""
    freedom, size = DEGREES_OF_FREEDOM, z.shape[-1]
    x = (z - mixture.center) @ _inverse(mixture.half).T
    squares, log_volume = _whitened(x, mixture.mean, mixture.scale)
    each = -0.5 * (freedom + size) * jnp.log1p(squares / freedom) - log_volume
    whole = jnp.sum(jnp.log(jnp.diagonal(mixture.half)))
    return logsumexp(each + mixture.log_share, axis=-1) - whole


def _whitened(x: Array, mean: Array, scale: Array) -> tuple[Array, Array]:
    """Squared distances of draws from components, (draw, component), and log volumes of these."""

    def squares(mean: Array, scale: Array) -> Array:
        return jnp.sum(((x - mean) @ _inverse(scale).T) ** 2, axis=-1)

    volume = jnp.sum(jnp.log(jnp.diagonal(scale, axis1=-2, axis2=-1)), axis=-1)
    return jax.vmap(squares, out_axes=-1)(mean, scale), volume


def _inverse(scale: Array) -> Array:
    """Of a small triangle: with many right-hand sides, a library would share them among cores."""
    return solve_triangular(scale, jnp.eye(len(scale), dtype=scale.dtype), lower=True)


# --- Proposals that learn from their own weighted draws, for pixels the normal one does not fit ---


ADAPTED_DEGREES_OF_FREEDOM = 6.0
"""Of the tails: few enough to outlast a posterior's, many enough to waste few draws on them."""

TIMES = 2
"""How many times the draws of the first look a round takes."""

FEWEST_EFFECTIVE = 100
"""Independent draws that the weighted ones of a round must be worth to be the answer."""


class Proposal(NamedTuple):
    """Where the draws of every pixel are taken: `center + points @ half`."""

    center: Float[np.ndarray, "pixel size"]
    half: Float[np.ndarray, "pixel size size"]

    def turned(self, turns: Float[np.ndarray, "pixel size size"]) -> "Proposal":
        """The same distribution, whose points are turned first, in each pixel by another way."""
        return Proposal(self.center, turns @ self.half)

    def places(self, points: Points) -> Float[np.ndarray, "pixel draw size"]:
        """Unconstrained vectors of all draws."""
        return self.center[:, None] + points.places @ self.half


def heavy_points(count: int, size: int, seed: int) -> Points:
    """Evenly spread points of a standard Student t distribution."""
    share = even(-(-count // 2), size + 1, seed)
    chi_squared = 2.0 * scipy.special.gammaincinv(0.5 * ADAPTED_DEGREES_OF_FREEDOM, share[:, :1])
    half = scipy.special.ndtri(share[:, 1:]) / np.sqrt(chi_squared / ADAPTED_DEGREES_OF_FREEDOM)
    places = mirrored(half)[:count]
    squares = np.sum(places**2, axis=-1) / ADAPTED_DEGREES_OF_FREEDOM
    return Points(places, -0.5 * (ADAPTED_DEGREES_OF_FREEDOM + size) * np.log1p(squares))


def learn(
    places: Float[np.ndarray, "pixel draw size"], weights: Float[np.ndarray, "pixel draw"]
) -> Proposal:
    """Mean and covariance of weighted draws."""
    # Source: Cappe, Guillin, Marin & Robert (2004), J. Comput. Graph. Stat. 13(4), 907-929:
    # population Monte Carlo.
    center = np.einsum("pd,pds->ps", weights, places)
    apart = places - center[:, None]
    covariance = np.einsum("pd,pds,pdt->pst", weights, apart, apart)
    half = np.full_like(covariance, np.nan)
    for pixel, matrix in enumerate(covariance):
        try:
            half[pixel] = np.linalg.cholesky(matrix).T
        except np.linalg.LinAlgError:
            continue  # stays NaN, which no weight trusts
    return Proposal(center, half)
