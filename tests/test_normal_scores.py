"""Priors in their normal score: against fifty digits, and far out in both tails."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.special
import scipy.stats
from cases import each
from numpyro import distributions as dist
from numpyro.distributions import biject_to

from polar_bayes.priors import (
    BEND,
    PRIORS,
    Beta,
    HalfNormal,
    NormalScoreToHalfNormal,
    log_odds,
    score_of_log_odds,
)

SCALE = 0.01
SCORES = (-37.0, -20.0, -9.0, -5.0, -1.0, -1e-3, 0.0, 1e-3, 1.0, 5.0, 9.0, 20.0, 36.0)
REACH = {np.float64: 38.0, np.float32: 12.5}
"""Scores whose tails are numbers in a precision; those beyond are far out."""

FAR = (-1e3, -60.0, -39.0, 38.0, 39.0, 60.0, 1e3)


def odds_in_digits(z: float) -> mpmath.mpf:
    """Log odds of a score."""
    exact = mpmath.mpf(z)
    return exact * mpmath.sqrt(exact**2 + mpmath.mpf(BEND)) / 2


def score_in_digits(odds: mpmath.mpf) -> mpmath.mpf:
    bend = mpmath.mpf(BEND)
    root = mpmath.sqrt(bend**2 + 16 * odds**2)
    return 2 * odds / mpmath.sqrt((bend + root) / 2)


def value_in_digits(z: mpmath.mpf) -> mpmath.mpf:
    """The half-normal value of a score."""
    return score_in_digits(mpmath.log1p(2 * mpmath.exp(odds_in_digits(z))))


def in_digits(z: float) -> tuple[mpmath.mpf, mpmath.mpf]:
    """The half-normal value of a score and its slope, to fifty digits."""
    with mpmath.workdps(600):  # a step of 1e-200 takes 200 of them
        step = mpmath.mpf(10) ** -200
        value = value_in_digits(mpmath.mpf(z))
        return value, (value_in_digits(mpmath.mpf(z) + step) - value) / step


@each("dtype", [np.float64, np.float32])
def test_values_and_slopes_agree_with_fifty_digits(dtype: type) -> None:
    """The error of a score is that of its rounding, z dz relative in its value."""
    scores = np.asarray([z for z in SCORES if abs(z) < REACH[dtype]], dtype)
    value_and_slope = jax.jit(jax.vmap(jax.value_and_grad(NormalScoreToHalfNormal(1.0))))
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
        slope, move = jax.grad(score_density), NormalScoreToHalfNormal(1.0)
        return score_density(z), slope(z), jax.grad(slope)(z), move(z), move.inv(move(z))

    found = np.asarray(jax.jit(jax.vmap(everything))(scores))
    assert np.isfinite(found[:3]).all()
    for z, density, value, again in zip(map(float, scores), *found[[0, 3, 4]], strict=True):
        rounding = 40.0 * float(np.finfo(dtype).eps) * (1.0 + z**2)
        exact, slope = in_digits(z)
        wanted = mpmath.log(2 / mpmath.pi) / 2 - exact**2 / 2 + mpmath.log(slope)
        assert density == pytest.approx(float(wanted), abs=rounding), z
        if value > np.finfo(dtype).tiny:
            assert again == pytest.approx(z, abs=40.0 * rounding / (1.0 + abs(z))), z


def test_log_odds_are_those_of_a_normal_score() -> None:
    """To .0006 of a share, and to a twentieth of themselves in the tails."""
    z = np.linspace(-10.0, 10.0, 2001)
    odds = np.asarray(log_odds(z))
    assert np.abs(scipy.special.expit(odds) - scipy.stats.norm.cdf(z)).max() < 6e-4
    exact = scipy.stats.norm.logcdf(z) - scipy.stats.norm.logsf(z)
    assert np.allclose(odds, exact, rtol=0.05, atol=1e-12)
    far = np.asarray([-1e12, -1e5, -1e-30, 0.0, 1e-30, 1e5, 1e12])
    assert np.allclose(score_of_log_odds(log_odds(far)), far, rtol=1e-14)


@each("prior", [HalfNormal(SCALE), Beta(1.0, 3.0), Beta(10.0, 1.0), Beta(1.0, 1.0)], quick=2)
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
    first, second = prior.concentration1, prior.concentration0
    below = -mpmath.log1p(mpmath.exp(-odds_in_digits(z)))  # logs of the shares below and above
    above = -mpmath.log1p(mpmath.exp(odds_in_digits(z)))
    return -mpmath.expm1(above / second) if first == 1.0 else mpmath.exp(below / first)


def normal_in_digits(z: float) -> float:
    """Log density of a score: that of the share, uniform, by the score."""
    with mpmath.workdps(600):
        step, odds = mpmath.mpf(10) ** -200, odds_in_digits(z)
        slope = (odds_in_digits(mpmath.mpf(z) + step) - odds) / step
        share = -mpmath.log1p(mpmath.exp(-odds)) - mpmath.log1p(mpmath.exp(odds))
        return float(share + mpmath.log(slope))


@each("dtype", [np.float64, np.float32], quick=1)
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
        with mpmath.workdps(50):
            exact = power_in_digits(z, prior)
        clipped = min(max(exact, 2.0 * float(number.tiny) ** 0.5), 1.0 - float(number.eps))
        # A rounded score moves the log of its tail by z dz, and an inverse cannot undo a clip.
        allowed = 30.0 * float(number.eps) * max(1.0, z**2)
        assert value == pytest.approx(float(clipped), rel=allowed), z
        left = min(exact, 1 - exact)
        if clipped == exact and left > 1e3 * float(number.eps):
            rounding = 300.0 * float(number.eps) * (1.0 + z**2) / float(left)
            assert density == pytest.approx(normal_in_digits(z), abs=rounding), z
            assert again == pytest.approx(z, abs=rounding), z


def test_other_shapes_have_the_support_of_numpyro() -> None:
    assert Beta(2.0, 2.0).support == dist.Beta(2.0, 2.0).support
    assert Beta(1.0, 3.0).support != Beta(1.0, 2.0).support


@pytest.mark.thorough
def test_the_table_samples_leakage_so() -> None:
    assert PRIORS["leakage"].support.eq(HalfNormal(SCALE).support)
    assert not PRIORS["leakage"].support.eq(HalfNormal(0.02).support)
    assert PRIORS["leakage"].support(jnp.array([0.0, 1e-9, 1.0])).tolist() == [False, True, True]
