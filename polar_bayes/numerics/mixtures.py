"""Proposals for importance sampling: single ones for a batch of pixels, and mixtures.

A single proposal is a normal or Student t distribution. Population Monte Carlo (Cappe et al. 2004)
fits it to the weighted draws of the previous round: normal first, then Student t, whose tails are
longer than those of nearly every posterior, so that the weights are bounded. A mixture of Student t
distributions (Cappe et al. 2008) also follows a posterior that is curved or has several modes.
Draws of two mixtures are combined by multiple importance sampling with the balance heuristic
(Veach & Guibas 1995). `benchmarks/calibration.py` has the measurements.

Source:
    Cappe, Guillin, Marin & Robert (2004), J. Comput. Graph. Stat. 13(4), 907-929; Cappe, Douc,
    Guillin, Marin & Robert (2008), Stat. Comput. 18, 447-459; Veach & Guibas (1995), SIGGRAPH,
    419-428; Cornuet, Marin, Mira & Robert (2012), Scand. J. Stat. 39(4), 798-812.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float
from scipy.stats import qmc

from polar_bayes.numerics.psis import systematic_resample

# --- One normal or Student t distribution for each pixel ------------------------------------------


PROPOSAL_DEGREES_OF_FREEDOM = 6.0
"""Degrees of freedom of the Student t proposal: few enough for longer tails than those of a
posterior, many enough to spend few draws on them."""


class Points(NamedTuple):
    """Quasi-random draws of a standard distribution, which all pixels share."""

    z: Float[np.ndarray, "draw size"]
    log_density: Float[np.ndarray, " draw"]

    def split(self, count: int) -> list["Points"]:
        """Split the points into parts of one size."""
        parts = (np.split(array, count) for array in self)
        return [Points(*part) for part in zip(*parts, strict=True)]


class Proposal(NamedTuple):
    """A proposal distribution for every pixel; its draws are `center + points.z @ root`."""

    center: Float[np.ndarray, "pixel size"]
    root: Float[np.ndarray, "pixel size size"]

    def rotated(self, rotations: Float[np.ndarray, "pixel size size"]) -> "Proposal":
        """Return the distribution with its points rotated differently in each pixel."""
        return Proposal(self.center, rotations @ self.root)

    def draws(self, points: Points) -> Float[np.ndarray, "pixel draw size"]:
        """Return unconstrained vectors of all draws."""
        return self.center[:, None] + points.z @ self.root


def normal_points(count: int, size: int, seed: int) -> Points:
    """Return quasi-random points of the standard normal distribution."""
    # Their radii are quantiles of the chi distribution, one of each, so that over all rotations of
    # the points every quantile in every direction is right.
    points = scipy.special.ndtri(_sobol(-(-count // 2), size, seed))
    radius = np.linalg.norm(points, axis=-1)
    share = (np.argsort(np.argsort(radius)) + 0.5) / len(points)
    points *= (np.sqrt(2.0 * scipy.special.gammaincinv(0.5 * size, share)) / radius)[:, None]
    z = _antithetic(points)[:count]
    return Points(z, -0.5 * np.sum(z**2, axis=-1))


def student_t_points(count: int, size: int, seed: int) -> Points:
    """Return quasi-random points of a standard multivariate Student t distribution."""
    freedom = PROPOSAL_DEGREES_OF_FREEDOM
    share = _sobol(-(-count // 2), size + 1, seed)
    chi_squared = 2.0 * scipy.special.gammaincinv(0.5 * freedom, share[:, :1])
    z = _antithetic(scipy.special.ndtri(share[:, 1:]) / np.sqrt(chi_squared / freedom))[:count]
    squares = np.sum(z**2, axis=-1) / freedom
    return Points(z, -0.5 * (freedom + size) * np.log1p(squares))


def _sobol(count: int, size: int, seed: int) -> Float[np.ndarray, "count size"]:
    """Return scrambled Sobol' points in (0, 1) (Owen 1998, J. Complexity 14(4), 466-489)."""
    points = qmc.Sobol(size, rng=np.random.default_rng(seed)).random(count)
    return np.clip(points, 1e-12, 1.0 - 1e-12)


def _antithetic(points: Float[np.ndarray, "half size"]) -> Float[np.ndarray, "count size"]:
    """Pair each point with its mirror image."""
    return np.stack([points, -points], axis=1).reshape(-1, points.shape[1])


def random_rotations(keys: np.ndarray, size: int) -> Float[np.ndarray, "pixel size size"]:
    """Draw a random rotation or reflection per pixel (Mezzadri 2007, Notices AMS 54(5))."""
    # Otherwise the error of a few points in a quantile would be the same in all pixels.
    # Integers are the same however a program was compiled, and for however many pixels.
    share = (np.asarray(_random_integers(keys, size)) + 0.5) / 2.0**32
    q, r = np.linalg.qr(scipy.special.ndtri(share))
    return q * np.sign(np.einsum("pii->pi", r))[:, None, :]


@functools.partial(jax.jit, static_argnums=1)
def _random_integers(keys: Array, size: int) -> Array:
    return jax.vmap(lambda key: jax.random.bits(key, (size, size), np.uint32))(
        jax.random.wrap_key_data(keys)
    )


def fit_t(
    draws: Float[np.ndarray, "pixel draw size"], weights: Float[np.ndarray, "pixel draw"]
) -> Proposal:
    """Return a proposal with the mean and covariance of weighted draws."""
    center = np.einsum("pd,pds->ps", weights, draws)
    centered = draws - center[:, None]
    covariance = np.einsum("pd,pds,pdt->pst", weights, centered, centered)
    root = np.full_like(covariance, np.nan)
    for pixel, matrix in enumerate(covariance):
        try:
            root[pixel] = np.linalg.cholesky(matrix).T
        except np.linalg.LinAlgError:
            continue  # stays NaN: no weight of this proposal is finite
    return Proposal(center, root)


# --- Mixtures of Student t distributions ----------------------------------------------------------


DEGREES_OF_FREEDOM = 8
"""Degrees of freedom of each component: longer tails than most posteriors' bound the weights."""

EM_STEPS = 15
"""Steps of expectation maximization; the mixture need not be optimal."""

WIDE_SHARE, WIDE_SCALE = 0.15, 2.0
"""Weight and scale of an additional component around all draws, which covers tails that the draws
represent too little."""


class Mixture(NamedTuple):
    """A mixture in coordinates in which all draws have mean 0 and covariance 1."""

    center: Float[Array, " size"]
    half: Float[Array, "size size"]
    log_share: Float[Array, " component"]
    mean: Float[Array, "component size"]
    scale: Float[Array, "component size size"]


def moments(
    z: Float[Array, "draw size"], weights: Float[Array, " draw"]
) -> tuple[Float[Array, " size"], Float[Array, "size size"]]:
    """Return the mean of weighted draws, and the lower Cholesky factor of their covariance."""
    center = weights @ z
    centered = z - center
    sd = jnp.sqrt(weights @ centered**2)
    sd = jnp.where(sd > 0.0, sd, 1.0)
    scaled = centered / sd
    correlation = scaled.T @ (scaled * weights[:, None])
    lifted = correlation + 1e-6 * jnp.eye(sd.size)  # single precision rounds
    return center, sd[:, None] * jnp.linalg.cholesky(lifted)


def fit_mixture(
    z: Float[Array, "draw size"], weights: Float[Array, " draw"], components: int, key: Array
) -> Mixture:
    """Fit normal components by EM, with covariances shrunk towards that of all draws."""
    size = z.shape[-1]
    center, half = moments(z, weights)
    x = (z - center) @ _inverse(half).T
    counts = weights / jnp.sum(weights**2)  # their sum is the effective sample size
    begin = jax.random.choice(key, len(x), (components,), replace=False, p=weights)
    # Of a component without draws, half as wide as all draws.
    unit = 0.5 * jnp.eye(size, dtype=z.dtype)
    products = (x[:, :, None] * x[:, None, :]).reshape(len(x), -1)

    def improve(_: int, parts: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        log_share, mean, scale = parts
        squares, log_volume = _whitened(x, mean, scale)
        share = jax.nn.softmax(log_share - 0.5 * squares - log_volume, axis=-1) * counts[:, None]
        total = jnp.sum(share, axis=0) + 1e-3
        mean = (share.T @ x) / total[:, None]
        second = ((share.T @ products) / total[:, None]).reshape(components, size, size)
        found = second - mean[:, :, None] * mean[:, None, :]
        own = (total / (total + size + 2.0))[:, None, None]
        covariance = own * found + (1.0 - own) * unit
        return jnp.log(total / jnp.sum(total)), mean, jnp.linalg.cholesky(covariance)

    log_share = jnp.full(components, -jnp.log(components), z.dtype)
    scale = jnp.broadcast_to(jnp.linalg.cholesky(unit), (components, size, size))
    log_share, mean, scale = jax.lax.fori_loop(0, EM_STEPS, improve, (log_share, x[begin], scale))
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
    """Draw from the mixture, with components chosen by systematic resampling."""
    key_which, key_normal = jax.random.split(key)
    share = jnp.exp(mixture.log_share)
    which = systematic_resample(share, count, jax.random.uniform(key_which))
    # Squares of normal draws: a sampler of chi-squared would compile for seconds.
    dtype, freedom = mixture.mean.dtype, DEGREES_OF_FREEDOM
    drawn = jax.random.normal(key_normal, (count, freedom + mixture.mean.shape[-1]), dtype)
    tail = jnp.mean(drawn[:, :freedom] ** 2, axis=1, keepdims=True)
    noise = drawn[:, freedom:] / jnp.sqrt(tail)
    x = mixture.mean[which] + jnp.einsum("dij,dj->di", mixture.scale[which], noise)
    return mixture.center + x @ mixture.half.T


def log_density(mixture: Mixture, z: Float[Array, "draw size"]) -> Float[Array, " draw"]:
    """Return the log density of the mixture, up to a constant common to all mixtures."""
    freedom, size = DEGREES_OF_FREEDOM, z.shape[-1]
    x = (z - mixture.center) @ _inverse(mixture.half).T
    squares, log_volume = _whitened(x, mixture.mean, mixture.scale)
    each = -0.5 * (freedom + size) * jnp.log1p(squares / freedom) - log_volume
    whole = jnp.sum(jnp.log(jnp.diagonal(mixture.half)))
    return logsumexp(each + mixture.log_share, axis=-1) - whole


def _whitened(x: Array, mean: Array, scale: Array) -> tuple[Array, Array]:
    """Return squared distances (draw, component) from components, and their log volumes."""

    def squares(mean: Array, scale: Array) -> Array:
        return jnp.sum(((x - mean) @ _inverse(scale).T) ** 2, axis=-1)

    volume = jnp.sum(jnp.log(jnp.diagonal(scale, axis1=-2, axis2=-1)), axis=-1)
    return jax.vmap(squares, out_axes=-1)(mean, scale), volume


def _inverse(scale: Array) -> Array:
    """Invert a small triangular matrix without a library call that is split among cores."""
    return solve_triangular(scale, jnp.eye(len(scale), dtype=scale.dtype), lower=True)
