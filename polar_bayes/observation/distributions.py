"""Distributions that remain accurate where textbook formulas lose digits.

`MeanConcentrationBeta` is the Beta distribution by mean and concentration; its log density is
written as a divergence plus Stirling remainders, so that concentrations of 1e8 cancel nothing.
`StudentT` is drawn without rejection; `SensorStudentT` is it, censored at zero and at full scale.
"""

import functools
import math
from typing import override

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro.distributions import constraints
from numpyro.distributions.util import promote_shapes

TAIL_NODES, TAIL_POWERS = 24, 20
"""Numbers of nodes and powers for the tail of Student's t, to the last digit of double
precision."""


class MeanConcentrationBeta(dist.Distribution):
    r"""Beta distribution with mean $\mu$ and concentration $\kappa$.

    $$ \log p(x) = -\kappa D(\mu \| x) - \log x(1-x) + \tfrac12 \log \frac{\kappa\mu(1-\mu)}{2\pi}
       + r(\kappa) - r(\mu\kappa) - r((1-\mu)\kappa) $$

    with $D$ the divergence of two Bernoulli distributions and $r$ the remainder of Stirling's
    formula. It equals `numpyro.distributions.BetaProportion`, whose differences of log gamma
    lose all digits in single precision beyond concentrations of about 1e6.

    A reading at a margin $\epsilon$ from 0 or 1 is censored: its likelihood is the probability of
    the margin, since the density there is infinite for a mean that is near enough. With a = mu
    kappa and b = (1 - mu) kappa, by the substitution x = epsilon exp(-u / a),

    $$ P(x < \epsilon) = \frac{\epsilon \, p(\epsilon)}{a} \int_0^\infty e^{-u}
       \Big( \frac{1 - \epsilon e^{-u/a}}{1 - \epsilon} \Big)^{b-1} du $$

    by Gauss and Laguerre's quadrature. The logarithm is within .003 where epsilon kappa is at
    most 30.

    Args:
        mean: $\mu$, unit 1, range (0, 1).
        concentration: $\kappa$, unit 1, range > 0.
        margin: $\epsilon$, unit 1, range [0, 0.5), a Python number; zero censors nothing.
    """

    arg_constraints = {
        "mean_value": constraints.unit_interval,
        "concentration": constraints.positive,
    }
    support = constraints.unit_interval
    reparametrized_params = ["mean_value", "concentration"]
    pytree_aux_fields = ("margin",)

    def __init__(
        self,
        mean: Float[Array, "..."],
        concentration: Float[Array, "..."],
        margin: float = 0.0,
        *,
        validate_args: bool | None = None,
    ) -> None:
        self.margin = margin
        shape = jnp.broadcast_shapes(jnp.shape(mean), jnp.shape(concentration))
        self.mean_value, self.concentration = promote_shapes(mean, concentration, shape=shape)
        super().__init__(batch_shape=shape, validate_args=validate_args)

    @override
    def sample(self, key: Array, sample_shape: tuple[int, ...] = ()) -> Array:
        first = self.mean_value * self.concentration
        second = (1.0 - self.mean_value) * self.concentration
        drawn = dist.Beta(first, second).sample(key, sample_shape)
        return jnp.clip(drawn, self.margin, 1.0 - self.margin) if self.margin else drawn

    @override
    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        density = self._log_density(value)
        if not self.margin:
            return density
        is_low, is_high = value <= self.margin, value >= 1.0 - self.margin
        return jnp.where(is_low | is_high, density + self._log_width(is_high), density)

    def _log_width(self, is_high: Array) -> Array:
        """Return the log of the probability within the margin over the density at its end."""
        mean, other = self.mean_value, 1.0 - self.mean_value
        near = jnp.where(is_high, other, mean) * self.concentration
        far = jnp.where(is_high, mean, other) * self.concentration
        nodes, weights = (jnp.asarray(x, near.dtype) for x in _laguerre(8))
        rate = jnp.maximum(near, 1e-6)[..., None]  # at zero the derivative is not finite
        inside = jnp.log1p(-self.margin * jnp.exp(-nodes / rate))
        exponent = (far[..., None] - 1.0) * (inside - math.log1p(-self.margin))
        return math.log(self.margin) - jnp.log(near) + logsumexp(exponent, axis=-1, b=weights)

    def _log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        value, mean, concentration = jnp.broadcast_arrays(
            value, self.mean_value, self.concentration
        )
        # Stacked, the same few operations serve all: programs of a third of the size.
        shares, step = jnp.stack([mean, 1.0 - mean]), value - mean
        divergence = _excess(shares, jnp.stack([value, 1.0 - value]), jnp.stack([step, -step]))
        shapes = shares * concentration
        factor, rest = _stirling_remainder(jnp.stack([concentration, *shapes]))
        # One logarithm for four: in double precision they are what this density costs.
        factors = jnp.sqrt(concentration * shares[0] * shares[1]) * factor[0]
        constant = jnp.log(factors / (factor[1] * factor[2])) - 0.5 * math.log(2.0 * math.pi)
        constant += rest[0] - rest[1] - rest[2]
        excess = concentration * (divergence[0] + divergence[1])
        return constant - excess - jnp.log(value) - jnp.log1p(-value)

    @property
    @override
    def mean(self) -> Array:
        return jnp.broadcast_to(self.mean_value, self.batch_shape)

    @property
    @override
    def variance(self) -> Array:
        return self.mean_value * (1.0 - self.mean_value) / (1.0 + self.concentration)


@functools.cache
def _laguerre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of integrals from zero to infinity with weight exp(-u)."""
    return np.polynomial.laguerre.laggauss(count)


class StudentT(dist.StudentT):
    """Student's t, drawn by Bailey's polar method (1994, Mathematics of Computation 62, 779)."""

    @override
    def sample(self, key: Array, sample_shape: tuple[int, ...] = ()) -> Array:
        # NumPyro's own divides by a draw of chi-squared, whose rejection compiles for a second.
        shape = 2, *self.shape(sample_shape)
        share, turn = jax.random.uniform(key, shape, jnp.result_type(self.scale, 1.0))
        square = self.df * jnp.expm1(-2.0 / self.df * jnp.log1p(-share))
        return self.loc + self.scale * jnp.sqrt(square) * jnp.cos(2.0 * math.pi * turn)


class SensorStudentT(dist.Distribution):
    r"""Student's t noise, censored at zero and at full scale.

    The likelihood of a censored reading is the probability of a value beyond the limit.

    Args:
        degrees_of_freedom: $\nu$, unit 1, range > 0; a Python number.
        location: Noise-free intensity over full scale.
        scale: Noise over full scale, range > 0.
        saturated: True where the reading is censored at full scale.
        full_scale: Upper limit of the sensor, in the same unit; infinite where it has none.
    """

    arg_constraints = {"location": constraints.real, "scale": constraints.positive}
    support = constraints.nonnegative
    reparametrized_params = ["location", "scale"]
    pytree_data_fields = ("location", "scale", "saturated", "full_scale")
    pytree_aux_fields = ("degrees_of_freedom",)

    def __init__(
        self,
        degrees_of_freedom: float,
        location: Float[Array, "..."],
        scale: Float[Array, "..."],
        saturated: Array,
        full_scale: Float[Array, "..."],
        *,
        validate_args: bool | None = None,
    ) -> None:
        shape = jnp.broadcast_shapes(*map(jnp.shape, (location, scale, saturated, full_scale)))
        self.location, self.scale, self.saturated, self.full_scale = (
            jnp.broadcast_to(x, shape) for x in (location, scale, saturated, full_scale)
        )
        self.degrees_of_freedom = degrees_of_freedom
        super().__init__(batch_shape=shape, validate_args=validate_args)

    @override
    def sample(self, key: Array, sample_shape: tuple[int, ...] = ()) -> Array:
        noise = StudentT(self.degrees_of_freedom, self.location, self.scale)
        return jnp.clip(noise.sample(key, sample_shape), 0.0, self.full_scale)

    @override
    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        distance = (value - self.location) / self.scale
        inside = log_density(distance, self.degrees_of_freedom) - jnp.log(self.scale)
        beyond = jnp.where(self.saturated, distance, -distance)
        censored = log_survival(beyond, self.degrees_of_freedom)
        return jnp.where(self.saturated | (value <= 0.0), censored, inside)

    @property
    @override
    def mean(self) -> Array:
        """The noise-free reading, clipped to the limits of the sensor."""
        return jnp.clip(self.location, 0.0, self.full_scale)

    @property
    @override
    def variance(self) -> Array:
        """Variance of the noise, as if the sensor had no limits."""
        freedom = self.degrees_of_freedom
        return self.scale**2 * (freedom / (freedom - 2.0) if freedom > 2.0 else math.inf)


def log_density(distance: Float[Array, "..."], degrees_of_freedom: float) -> Float[Array, "..."]:
    """Return the log density of Student's t, in the precision of `distance`."""
    half = 0.5 * (degrees_of_freedom + 1.0)
    constant = math.lgamma(half) - math.lgamma(0.5 * degrees_of_freedom)
    constant -= 0.5 * math.log(math.pi * degrees_of_freedom)
    return constant - half * jnp.log1p(distance**2 / degrees_of_freedom)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def log_survival(distance: Float[Array, "..."], degrees_of_freedom: float) -> Float[Array, "..."]:
    """Return the log probability above `distance`, finite far into the tail."""
    dtype = jnp.result_type(float, distance)
    # With tan(angle) = sqrt(nu) / |t| the tail is an integral of sin(phi) ** (nu - 1) over phi up
    # to the angle: half ** nu, with half = tan(angle / 2), times something so smooth in half ** 2
    # that a short series gives its logarithm.
    away = jnp.abs(distance) / jnp.asarray(math.sqrt(degrees_of_freedom), dtype)
    half = 1.0 / (away + jnp.hypot(away, jnp.ones_like(away)))
    x = 2.0 * half * half - 1.0
    series = jnp.zeros_like(x)
    for coefficient in _tail_series(degrees_of_freedom):
        series = series * x + coefficient
    log_tail = degrees_of_freedom * jnp.log(half) + series
    return jnp.where(distance > 0.0, log_tail, jnp.log1p(-jnp.exp(log_tail)))


@log_survival.defjvp
def _log_survival_derivative(degrees_of_freedom, primals, tangents):
    (distance,), (step,) = primals, tangents
    value = log_survival(distance, degrees_of_freedom)
    return value, -jnp.exp(log_density(distance, degrees_of_freedom) - value) * step


@functools.cache
def _tail_series(degrees_of_freedom: float) -> tuple[float, ...]:
    """Return the log of tail / half ** nu, as a series in 2 half ** 2 - 1, highest power first."""
    power = degrees_of_freedom - 1.0
    nodes, weights = scipy.special.roots_jacobi(TAIL_NODES, 0.0, power)
    scale = 2.0**degrees_of_freedom * scipy.special.beta(0.5 * degrees_of_freedom, 0.5)

    def log_mean(x: np.ndarray) -> np.ndarray:
        half = np.sqrt(0.5 * (x + 1.0))
        angle = 2.0 * np.arctan(half)
        rise = np.sinc(angle[:, None] * 0.5 * (nodes + 1.0) / math.pi) ** power
        grown = np.where(half > 0.0, angle / np.where(half > 0.0, half, 1.0), 2.0)
        return degrees_of_freedom * np.log(grown) + np.log(rise @ (weights / scale))

    found = np.polynomial.Chebyshev.interpolate(log_mean, TAIL_POWERS)
    return tuple(float(x) for x in found.convert(kind=np.polynomial.Polynomial).coef[::-1])


def _excess(
    mean: Float[Array, "..."], value: Float[Array, "..."], step: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return `step - mean log(value / mean)`, half the divergence, for `step = value - mean`."""
    # The first-order terms cancel near the mean, hence the series; far from it the logarithm takes
    # the quotient itself, since `1 + step / mean` has lost its digits where that is nearly 0.
    # log(value / mean) = 2 artanh(slant), an odd series whose first term is known.
    slant = step / (value + mean)
    near = jnp.abs(slant) < 0.05
    small = jnp.where(near, slant, 0.0)
    square = small * small
    series = jnp.zeros_like(small)
    for power in range(13, 1, -2):  # 2 * 0.05 ** 15 / 15 is below double precision of step ** 2
        series = square * series + 2.0 / power
    series = small * (step - mean * square * series)
    quotient = jnp.where(near, 1.0, value / mean)
    return jnp.where(near, series, step - mean * jnp.log(quotient))


def _stirling_remainder(z: Float[Array, "..."]) -> tuple[Array, Array]:
    """`log(factor) + rest`: Stirling's `(z - 1/2) log z - z + log(2 pi) / 2`, for z > 0."""
    # Below 10 the recurrence of the gamma function moves the argument up by eight, so that only
    # logarithms are differentiated: polygamma functions take long to compile.
    large = z > 10.0
    small = jnp.where(large, 1.0, z)
    shifted = small + 8.0
    product = small + 1.0
    for step in range(2, 8):
        product = product * (small + step)
    moved = (small + 0.5) * jnp.log(shifted / small) - 8.0
    rest = _stirling_series(jnp.where(large, z, shifted))
    factor = jnp.where(large, 1.0, shifted**7 / product)
    return factor, jnp.where(large, rest, moved + rest)


def _stirling_series(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the remainder for z > 8: Bernoulli numbers over 2k(2k-1), to 2e-15."""
    inverse = 1.0 / z
    square = inverse * inverse
    coefficients = (1 / 12, -1 / 360, 1 / 1260, -1 / 1680, 1 / 1188, -691 / 360360, 1 / 156)
    series = jnp.zeros_like(inverse)
    for coefficient in reversed(coefficients):
        series = series * square + coefficient
    return inverse * series
