"""Priors in their normal score: against fifty digits, and far out in both tails."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from cases import each
from numpyro import distributions as dist
from numpyro.distributions import biject_to

from polar_bayes.priors import (
    PRIORS,
    Beta,
    HalfNormal,
    half_normal_of_score,
    score_of_half_normal,
)

SCALE = 0.01
SCORES = (-37.0, -20.0, -9.0, -5.0, -1.0, -1e-3, 0.0, 1e-3, 1.0, 5.0, 9.0, 20.0, 36.0)
REACH = {np.float64: 38.0, np.float32: 12.5}
"""Scores whose tails are numbers in a precision; those beyond are far out."""

FAR = (-1e3, -60.0, -39.0, 38.0, 39.0, 60.0, 1e3)


def value_in_digits(z: float) -> mpmath.mpf:
    """The half-normal value x with 1 - Phi(x) = (1 - Phi(z)) / 2, to fifty digits."""
    with mpmath.workdps(50):
        wanted = mpmath.erfc(mpmath.mpf(z) / mpmath.sqrt(2)) / 2
        low, high = mpmath.mpf(0), mpmath.mpf(50)
        for _ in range(250):  # halvings, to fifty digits of 1e-19
            middle = (low + high) / 2
            above = mpmath.erfc(middle / mpmath.sqrt(2)) > wanted
            low, high = (middle, high) if above else (low, middle)
        return high


def in_digits(z: float) -> tuple[mpmath.mpf, mpmath.mpf]:
    """The half-normal value of a score and its slope."""
    if z > -9.0:
        value = value_in_digits(z)
    else:  # the value is its tail probability, to all digits
        value = mpmath.sqrt(mpmath.pi / 2) * mpmath.ncdf(z)
    return value, mpmath.exp((value**2 - mpmath.mpf(z) ** 2) / 2) / 2


@each("dtype", [np.float64, np.float32])
def test_values_and_slopes_agree_with_fifty_digits(dtype: type) -> None:
    """The error of a score is that of its rounding, z dz relative in its value."""
    scores = np.asarray([z for z in SCORES if abs(z) < REACH[dtype]], dtype)
    value_and_slope = jax.jit(jax.vmap(jax.value_and_grad(half_normal_of_score)))
    for z, *found in zip(map(float, scores), *value_and_slope(scores), strict=True):
        allowed = 30.0 * float(np.finfo(dtype).eps) * max(1.0, z**2)
        for ours, exact in zip(map(float, found), map(float, in_digits(z)), strict=True):
            assert ours == pytest.approx(exact, rel=allowed), z


def score_density(z: jax.Array) -> jax.Array:
    """Log density of the score of a half-normal value."""
    move = biject_to(HalfNormal(SCALE).support)
    value = move(z)  # may be zero, of which NumPyro's own density warns
    own = 0.5 * jnp.log(2.0 / jnp.pi) - jnp.log(SCALE) - 0.5 * (value / SCALE) ** 2
    return own + move.log_abs_det_jacobian(z, value)


@each("dtype", [np.float64, np.float32])
def test_what_is_far_out_is_finite_and_comes_back(dtype: type) -> None:
    """Value, gradient and Hessian of the density of a score; where the value is not yet zero."""
    scores = np.asarray([*SCORES, *FAR], dtype)

    def everything(z: jax.Array) -> tuple[jax.Array, ...]:
        slope, value = jax.grad(score_density), half_normal_of_score(z)
        return score_density(z), slope(z), jax.grad(slope)(z), value, score_of_half_normal(value)

    found = np.asarray(jax.jit(jax.vmap(everything))(scores))
    assert np.isfinite(found[:3]).all()
    for z, density, value, again in zip(map(float, scores), *found[[0, 3, 4]], strict=True):
        rounding = 40.0 * float(np.finfo(dtype).eps) * (1.0 + z**2)
        assert density == pytest.approx(-0.5 * np.log(2.0 * np.pi) - 0.5 * z**2, abs=rounding), z
        if value > np.finfo(dtype).tiny:
            assert again == pytest.approx(z, abs=40.0 * rounding / (1.0 + abs(z))), z


@each("prior", [HalfNormal(SCALE), Beta(1.0, 3.0), Beta(10.0, 1.0), Beta(1.0, 1.0)])
def test_scores_of_draws_are_standard_normal(prior: dist.Distribution) -> None:
    """Mean, variance and every tenth of 20,000, within 4 standard errors."""
    inverse = biject_to(prior.support).inv
    scores = np.asarray(
        jax.jit(lambda key: inverse(prior.sample(key, (20_000,))))(jax.random.key(3))
    )
    assert abs(scores.mean()) < 4.0 / 20_000**0.5
    assert abs(scores.var() - 1.0) < 4.0 * (2.0 / 20_000) ** 0.5
    shares = np.arange(0.1, 0.95, 0.1)
    below = [(scores < dist.Normal().icdf(share)).mean() for share in shares]
    assert (np.abs(below - shares) < 4.0 * np.sqrt(shares * (1 - shares) / 20_000)).all()


def power_in_digits(z: float, prior: Beta) -> mpmath.mpf:
    """The value of a score under Beta(1, p) or Beta(p, 1), to fifty digits."""
    with mpmath.workdps(50):
        first, second = prior.concentration1, prior.concentration0
        if first == 1.0:
            return -mpmath.expm1(mpmath.log1p(-mpmath.ncdf(mpmath.mpf(z))) / second)
        return mpmath.ncdf(mpmath.mpf(z)) ** (1 / mpmath.mpf(first))


@each("dtype", [np.float64, np.float32])
@each("prior", [Beta(1.0, 3.0), Beta(10.0, 1.0), Beta(1.0, 1.0)])
def test_a_beta_with_a_shape_of_one(prior: Beta, dtype: type) -> None:
    """Its value, a finite density everywhere, and the standard normal one where values have it."""
    move, number = biject_to(prior.support), np.finfo(dtype)
    scores = np.asarray([*SCORES, *FAR], dtype)

    def log_density(z: jax.Array) -> jax.Array:
        value = move(z)
        return prior.log_prob(value) + move.log_abs_det_jacobian(z, value)

    def everything(z: jax.Array) -> tuple[jax.Array, ...]:
        slope = jax.grad(log_density)
        return move(z), move.inv(move(z)), log_density(z), slope(z), jax.grad(slope)(z)

    values, back, *found = map(np.asarray, jax.jit(jax.vmap(everything))(scores))
    assert np.isfinite(found).all()
    for z, value, again, density in zip(map(float, scores), values, back, found[0], strict=True):
        exact = power_in_digits(z, prior)
        clipped = min(max(exact, 2.0 * float(number.tiny) ** 0.5), 1.0 - float(number.eps))
        # A rounded score moves the log of its tail by z dz, and an inverse cannot undo a clip.
        allowed = 30.0 * float(number.eps) * max(1.0, z**2)
        assert value == pytest.approx(float(clipped), rel=allowed), z
        left = min(exact, 1 - exact)
        if clipped == exact and left > 1e3 * float(number.eps):
            normal = -0.5 * np.log(2.0 * np.pi) - 0.5 * z**2
            rounding = 300.0 * float(number.eps) * (1.0 + z**2) / float(left)
            assert density == pytest.approx(normal, abs=rounding), z
            assert again == pytest.approx(z, abs=rounding), z


def test_other_shapes_have_the_support_of_numpyro() -> None:
    assert Beta(2.0, 2.0).support == dist.Beta(2.0, 2.0).support
    assert Beta(1.0, 3.0).support != Beta(1.0, 2.0).support


@pytest.mark.thorough
def test_the_table_samples_leakage_so() -> None:
    assert PRIORS["leakage"].support.eq(HalfNormal(SCALE).support)
    assert not PRIORS["leakage"].support.eq(HalfNormal(0.02).support)
    assert PRIORS["leakage"].support(jnp.array([0.0, 1e-9, 1.0])).tolist() == [False, True, True]
