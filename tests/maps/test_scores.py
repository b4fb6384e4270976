"""Normal scores of a prior: there and back, slopes, tails, and what they do to a long tail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st

from polar_bayes.inference.smc import (
    FLATTEST,
    KNOTS,
    NormalScoreTransform,
    fit_normal_scores,
    inverse_of_pixels,
)

RANDOM = np.random.default_rng(0)
DRAWS = np.stack(
    [
        np.log(np.abs(RANDOM.normal(size=4096))),  # of a half-normal roughness: a long tail
        RANDOM.normal(3.0, 1e-3, 4096),
        RANDOM.logistic(size=4096),
    ],
    axis=1,
)


SCORES = fit_normal_scores(jnp.asarray(DRAWS))


def test_the_prior_has_normal_scores() -> None:
    fresh = np.random.default_rng(1)
    z = np.stack(
        [np.log(np.abs(fresh.normal(size=4096))), fresh.normal(3.0, 1e-3, 4096),
         fresh.logistic(size=4096)], axis=1,
    )  # fmt: skip
    u = np.asarray(SCORES.forward(jnp.asarray(z)))
    # Both samples are finite: the statistic of two of 4096 is below 0.043 in 999 of 1000 cases.
    limit = scipy.stats.kstwobign.isf(1e-3) * np.sqrt(2.0 / 4096)
    for coordinate in u.T:
        assert scipy.stats.kstest(coordinate, "norm").statistic < limit
    assert abs(scipy.stats.kurtosis(z[:, 0])) > 2.0
    # The standard error of a normal kurtosis is sqrt(24 / 4096) = 0.08; ends are linear.
    assert np.abs(scipy.stats.kurtosis(u)).max() < 0.5


@settings(deadline=None)  # the first one compiles
@given(st.lists(st.floats(-30.0, 30.0), min_size=3, max_size=3))
def test_there_and_back(u: list[float]) -> None:
    z, _ = SCORES.inverse(jnp.asarray(u))
    # A coordinate around 3 with a width of 1e-3 loses four digits of sixteen.
    assert np.asarray(SCORES.forward(z)) == pytest.approx(u, abs=1e-9)


def test_the_volume_is_that_of_the_derivative() -> None:
    for u in np.random.default_rng(2).normal(size=(20, 3)) * 2.0:
        _, log_volume = SCORES.inverse(jnp.asarray(u))
        slopes = jax.jacfwd(lambda u: SCORES.inverse(u)[0])(jnp.asarray(u))
        assert float(jnp.linalg.slogdet(slopes)[1]) == pytest.approx(float(log_volume))


@pytest.mark.thorough
def test_many_pixels_are_placed_as_each_alone() -> None:
    random = np.random.default_rng(3)
    pixels = [fit_normal_scores(jnp.asarray(random.gumbel(size=(2000, 3)) * s)) for s in (1.0, 5.0)]
    together = NormalScoreTransform(np.stack([np.asarray(one.values) for one in pixels]))
    u = random.normal(size=(2, 50, 3)) * 3.0
    alone = np.stack(
        [np.asarray(one.inverse(jnp.asarray(x))[0]) for one, x in zip(pixels, u, strict=True)]
    )
    assert inverse_of_pixels(together, u) == pytest.approx(alone, rel=1e-12)


@pytest.mark.thorough
def test_a_coordinate_that_repeats_itself_keeps_an_inverse() -> None:
    """Half of the draws are one number, as those of a prior with an atom would be."""
    z = np.where(np.arange(2000) % 2, 1.0, RANDOM.normal(size=2000))[:, None]
    found = fit_normal_scores(jnp.asarray(z))
    steps = np.diff(np.asarray(found.values)[0])
    assert (steps >= 0.9 * FLATTEST * steps.mean()).all()
    u = jnp.asarray(KNOTS, float)[:, None]
    assert np.asarray(found.forward(found.inverse(u)[0])) == pytest.approx(np.asarray(u), abs=1e-6)


@pytest.mark.thorough
@each("dtype", [np.float32, np.float64])
def test_knots_are_at_the_quantiles_of_the_draws(dtype: type) -> None:
    draws = DRAWS.astype(dtype)
    values = np.asarray(jax.jit(fit_normal_scores)(draws).values)
    assert values.dtype == dtype
    expected = np.quantile(draws.astype(float), scipy.stats.norm.cdf(KNOTS), axis=0).T
    # Sums of steps: one rounding for each knot.
    rounding = len(KNOTS) * np.finfo(dtype).eps * np.abs(expected).max()
    np.testing.assert_allclose(values, expected, rtol=0.0, atol=rounding)
