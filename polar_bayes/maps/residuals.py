r"""Residuals of the readings of many pixels at their modes, tested against noise after a fit.

Residuals are normal scores of the readings under the noise at the mode, $\Phi^{-1}(F_i(y_i))$. What
the parameters can change is taken out of them once more, as least squares would: at a bound, or
where the prior pulls, a mode is not the best fit. With the readings in units of their noise, and U
an orthonormal basis of what the parameters change,

$$ e = (I - U U^T)\, \Phi^{-1}(F(y)), \qquad \mathrm{Cov}(e) = M = I - U U^T $$

in the linear-Gaussian approximation. No pixel is fitted again, and nothing is simulated. Where
noise alone is left, $e_i^2 / (M_{ii}\, e^T e)$ has a Beta and $e^T e$ a $\chi^2$ distribution, and
the tail of $e^T K e / e^T e$ at c is the probability that a sum of squares of normal numbers, whose
weights are the eigenvalues of $M (K - c I) M$, is above zero.

Source: Dunn & Smyth (1996), J. Comput. Graph. Stat. 5, 236 (normal scores as residuals); Moran
(1950), Biometrika 37, 17 (autocorrelation); Lugannani & Rice (1980), Adv. Appl. Probab. 12, 475
(tails by a saddlepoint).
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import distributions as dist
from scipy import special

from polar_bayes.inference.batching import batched
from polar_bayes.inference.checks import ANGLE_SCALES
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.numerics.batches import AnyArray
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.observation.data import Observations
from polar_bayes.observation.distributions import MeanConcentrationBeta, SensorStudentT
from polar_bayes.physics.geometry import Geometry, unit_vectors

LEAST_READINGS, LEAST_FREEDOM = 6, 1.5
"""Fewest readings, and fewest residual degrees of freedom, with which residuals are tested."""

HALVINGS, SMALLEST = 40, 1e-12
"""Bisections in the search for a saddlepoint; smallest divisor there."""

# --- Normal scores of readings --------------------------------------------------------------------


class Distance(NamedTuple):
    """Distance of a reading from its prediction in scales of Student's t, and both limits."""

    distance: AnyArray
    freedom: AnyArray
    low: AnyArray
    high: AnyArray

    def scores(self) -> np.ndarray:
        """Return normal scores; NaN where the distance is NaN."""
        distance, freedom, *ends = (np.asarray(x, float) for x in self)
        if np.isinf(freedom).all():  # normal noise, which has no limits
            return distance
        low, high = (
            special.stdtr(freedom, sign * x) for sign, x in zip((1, -1), ends, strict=True)
        )
        below, above = (special.stdtr(freedom, sign * distance) for sign in (1, -1))
        return _scores(below - low, above - high)


class Share(NamedTuple):
    """A reading between 0 and 1, and the shapes of its Beta distribution."""

    value: AnyArray
    first: AnyArray
    second: AnyArray

    def scores(self) -> np.ndarray:
        """Return normal scores."""
        x, a, b = (np.asarray(each, float) for each in self)
        return _scores(special.betainc(a, b, x), special.betaincc(a, b, x))


def _scores(below: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Return normal scores of lower and upper tails, each exact where it is small."""
    low, high = (special.ndtri(each / (below + above)) for each in (below, above))
    return np.where(below < above, low, -high)


class Reading(NamedTuple):
    """A reading relative to its noise, and its prediction in units of that noise."""

    standard: Distance | Share
    center: Array
    unit: Array


@functools.singledispatch
def standardize(noise: dist.Distribution, value: Array) -> Reading | None:
    """A reading by the distribution of its noise, inside a program; None where it is not known."""
    return None


@standardize.register
def _(noise: dist.Normal, value: Array) -> Reading:
    return _by_distance(noise.loc, noise.scale, value, math.inf)


@standardize.register
def _(noise: dist.StudentT, value: Array) -> Reading:
    return _by_distance(noise.loc, noise.scale, value, noise.df)


@standardize.register
def _(noise: SensorStudentT, value: Array) -> Reading:
    value = jnp.where(noise.saturated | (value <= 0.0), jnp.nan, value)
    ends = ((end - noise.location) / noise.scale for end in (0.0, noise.full_scale))
    return _by_distance(noise.location, noise.scale, value, noise.degrees_of_freedom, *ends)


@standardize.register
def _(noise: MeanConcentrationBeta, value: Array) -> Reading:
    value, mean, sd = jnp.broadcast_arrays(value, noise.mean_value, jnp.sqrt(noise.variance))
    first = mean * noise.concentration
    return Reading(Share(value, first, noise.concentration - first), mean, sd)


@standardize.register
def _(noise: dist.TransformedDistribution, value: Array) -> Reading | None:
    for transform in reversed(noise.transforms):
        value = transform.inv(value)
    return standardize(noise.base_dist, value)


@standardize.register(dist.Independent)
@standardize.register(dist.ExpandedDistribution)
@standardize.register(dist.distribution.MaskedDistribution)
def _(noise: dist.Distribution, value: Array) -> Reading | None:
    return standardize(noise.base_dist, value)


def _by_distance(
    center: Array,
    scale: Array,
    value: Array,
    freedom: Array | float,
    low: Array | float = -math.inf,
    high: Array | float = math.inf,
) -> Reading:
    value, center, scale = jnp.broadcast_arrays(value, center, scale)
    freedom, low, high = (jnp.broadcast_to(x, value.shape) for x in (freedom, low, high))
    distance = (value - center) / scale
    # The Fisher information of Student's t about its location is this share of a normal one.
    share = jnp.where(jnp.isinf(freedom), 1.0, (freedom + 1.0) / (freedom + 3.0))
    return Reading(Distance(distance, freedom, low, high), center, scale / jnp.sqrt(share))


def fitted_readings(engine: CompiledModel, names: tuple[str, ...]) -> JitOnce:
    """Make the program of readings at the mode of a pixel, and of their derivatives."""
    program = engine.single_program

    def of_pixel(
        data: Observations, z: Array, root: Array
    ) -> dict[str, tuple[Distance | Share, Array]]:
        def readings(z: Array) -> dict[str, Reading]:
            trace = program.trace(z, data)
            found = {n: standardize(trace[n]["fn"], trace[n]["value"]) for n in names}
            return {n: each for n, each in found.items() if each is not None}

        # Differences, since the program of derivatives takes ten times as long to compile: over so
        # many posterior sds, as linear as can be where single precision still tells it.
        step = 0.25
        around = jax.vmap(readings)(jnp.concatenate([z[None], z + step * root, z - step * root]))
        fitted = {}
        for name, each in around.items():
            standard, _, unit = jax.tree.map(lambda x: x[0], each)
            above, below = jnp.split(each.center[1:], 2)
            fitted[name] = standard, jnp.moveaxis((above - below) / (2.0 * step * unit), 0, -1)
        return fitted

    return batched(of_pixel)


# --- What noise after a fit does not do -----------------------------------------------------------


def residual_tail(
    scores: Float[np.ndarray, "pixel group view"],
    changes: Float[np.ndarray, "pixel group view size"],
    kernels: Sequence[np.ndarray],
    factor: Float[np.ndarray, " pixel"],
) -> Float[np.ndarray, " pixel"]:
    """Return the joint p-value of neighboring residuals, the largest, and all of them.

    `factor` is the true over the stated error of each pixel: where readings scatter less than
    stated, one that keeps to its statement is no outlier. NaN where there are too few readings.
    """
    known = np.isfinite(scores) & np.isfinite(changes).all(axis=-1)
    basis = _basis(np.where(known[..., None], changes, 0.0).astype(float))
    e = np.where(known, scores, 0.0)
    e = e - np.einsum("pgvi,pi->pgv", basis, np.einsum("pgvi,pgv->pi", basis, e))
    left = np.where(known, 1.0 - np.sum(basis**2, axis=-1), 0.0)
    count, freedom = known.sum(axis=(1, 2)), left.sum(axis=(1, 2))
    is_judged = (count >= LEAST_READINGS) & (freedom >= LEAST_FREEDOM)
    freedom = np.maximum(freedom, LEAST_FREEDOM)
    squares = np.maximum(np.sum(e**2, axis=(1, 2)), SMALLEST)
    together = special.gammaincc(0.5 * freedom, 0.5 * squares)
    # A residual of up to 3 is no outlier, however small the others are.
    is_outside = np.abs(e) * np.minimum(factor, 1.0)[:, None, None] > 3.0
    shares = np.where(is_outside, e**2 / np.maximum(left, 0.05), 0.0).max(axis=(1, 2))
    largest = special.betaincc(0.5, 0.5 * (freedom - 1.0), np.minimum(shares / squares, 1.0))
    tails = [together, np.where(shares > 0.0, count * largest, 1.0)]
    if kernels:
        # Where the noise is overstated, structure below it is no conflict.
        is_overstated = 1.0 - together < 0.1
        neighbors = [_neighbor_tail(e, known, basis, freedom, kernel) for kernel in kernels]
        least = len(kernels) * np.min(neighbors, axis=0)
        tails.append(np.where(is_overstated, 1.0, least))
    p_value = np.minimum(1.0, len(tails) * np.min(tails, axis=0))
    return np.where(is_judged, p_value, np.nan)


def _basis(changes: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the space of fitted readings, padded with zeros."""
    flat = changes.reshape(len(changes), -1, changes.shape[-1])
    shares, axes = np.linalg.eigh(np.swapaxes(flat, 1, 2) @ flat)
    # Directions of which the readings say a tenth of what is known after the fit.
    scales = np.where(shares > 0.1, 1.0 / np.sqrt(np.maximum(shares, 0.1)), 0.0)
    return (flat @ (axes * scales[:, None])).reshape(changes.shape)


def direction_kernels(geometry: Geometry) -> list[Float[np.ndarray, "view view"]]:
    """Return kernels of the distance between directions, for scales that connect views."""
    first = [np.asarray(x, float).reshape(-1, np.shape(x)[-1])[0] for x in geometry[:4]]
    both = unit_vectors(np.stack(first, axis=-1).reshape(-1, 2, 2))  # of the viewer and the light
    apart = np.sum((both[:, None] - both) ** 2, axis=(-2, -1))
    np.fill_diagonal(apart, np.inf)
    kernels = [np.exp(-0.5 * apart / math.radians(scale) ** 2) for scale in ANGLE_SCALES]
    return [kernel for kernel in kernels if kernel.max() > 0.01]  # others have no neighbors


def _neighbor_tail(
    e: np.ndarray, known: np.ndarray, basis: np.ndarray, freedom: np.ndarray, kernel: np.ndarray
) -> np.ndarray:
    """Return the tail probability of Moran's I; one if it is not far above its mean."""
    squares = np.maximum(np.sum(e**2, axis=(1, 2)), SMALLEST)
    index = np.sum((e @ kernel) * e, axis=(1, 2)) / squares
    # Of M K and its square the traces, which give the mean and the variance.
    near = (kernel @ basis) * known[..., None]
    inner = np.einsum("pgvi,pgvj->pij", basis, near)
    first, weights = -np.trace(inner, axis1=1, axis2=2), known.astype(float)
    second = np.sum((weights @ kernel**2) * weights, axis=(1, 2))
    second += np.sum(inner**2, axis=(1, 2)) - 2.0 * np.sum(near**2, axis=(1, 2, 3))
    variance = 2.0 * (second - first**2 / freedom) / (freedom * (freedom + 2.0))
    # Of a Moran's I within 1.8 sds of its mean the tail is not computed and counts as one.
    likely = np.flatnonzero(index > first / freedom + 1.8 * np.sqrt(np.maximum(variance, 0.0)))
    tail = np.ones(len(e))
    if likely.size:
        forms = _forms(known[likely], basis[likely], kernel, index[likely])
        tail[likely] = _positive_share(np.linalg.eigvalsh(forms))
    return tail


def _forms(
    known: np.ndarray, basis: np.ndarray, kernel: np.ndarray, index: np.ndarray
) -> Float[np.ndarray, "pixel reading reading"]:
    """Return matrices whose quadratic forms are positive where Moran's I is larger."""
    pixels, groups, views = known.shape
    unit, flat = np.eye(groups * views), known.reshape(pixels, -1)
    basis = basis.reshape(pixels, groups * views, -1)
    form = np.kron(np.eye(groups), kernel) - index[:, None, None] * unit
    form = form * flat[:, None] * flat[..., None]
    projection = unit - basis @ np.swapaxes(basis, 1, 2)
    return projection @ form @ projection


def _positive_share(weights: Float[np.ndarray, "pixel term"]) -> np.ndarray:
    """Return the probability that a weighted sum of chi-squared numbers is positive."""
    # The saddlepoint s, where the slope of K(s) = -1/2 sum log(1 - 2 s w) vanishes, is above 0.
    low, high = np.zeros(len(weights)), 0.5 / np.maximum(weights.max(axis=1), SMALLEST)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        slope = np.sum(weights / (1.0 - 2.0 * middle[:, None] * weights), axis=1)
        low, high = np.where(slope > 0.0, low, middle), np.where(slope > 0.0, middle, high)
    growth = 1.0 - 2.0 * low[:, None] * weights
    width = low * np.sqrt(2.0 * np.sum((weights / growth) ** 2, axis=1))
    root = np.sqrt(np.maximum(np.sum(np.log(growth), axis=1), SMALLEST))
    density = np.exp(-0.5 * root**2) / math.sqrt(2.0 * math.pi)
    return np.clip(special.ndtr(-root) + density * (1.0 / width - 1.0 / root), 0.0, 1.0)
