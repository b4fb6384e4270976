"""Weights of draws: those of ArviZ, at the edges too; what weighted draws say, in closed form."""

import jax
import numpy as np
import pytest
from arviz_stats.base import array_stats
from cases import each
from scipy import stats

from polar_bayes.numerics.mixtures import normal_points, random_rotations
from polar_bayes.numerics.psis import smooth, summarize, weighted_ess


def theirs(log_ratios: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights that sum to one, and Pareto k; ArviZ takes minus the log ratios."""
    log_weights, k = array_stats.psislw(-log_ratios)
    weights = np.exp(log_weights - log_weights.max(axis=-1, keepdims=True))
    # A tail that no Pareto distribution fits has no k there, and infinite k here.
    return weights / weights.sum(axis=-1, keepdims=True), np.where(np.isnan(k), np.inf, k)


TAILS = {
    "light": lambda rng, shape: rng.normal(0.0, 0.3, shape),
    "normal": lambda rng, shape: rng.normal(0.0, 1.0, shape),
    "heavy": lambda rng, shape: rng.normal(0.0, 3.0, shape),
    "without a mean": lambda rng, shape: rng.standard_cauchy(shape),
    "bounded": lambda rng, shape: np.log(rng.uniform(0.5, 1.0, shape)),
    "of a narrow normal": lambda rng, shape: -1.5 * rng.normal(size=shape) ** 2,
    "of a wide normal": lambda rng, shape: 0.4 * rng.normal(size=shape) ** 2,
}


@each("count", [64, 128, 256, 1024])
@each("tail", TAILS)
def test_weights_are_those_of_arviz(tail: str, count: int) -> None:
    log_ratios = TAILS[tail](np.random.default_rng(count), (5, count)) + 300.0
    ours = smooth(log_ratios)
    weights, k = theirs(log_ratios)
    assert ours.weights == pytest.approx(weights, rel=1e-6, abs=1e-12)
    assert ours.pareto_k == pytest.approx(k, rel=1e-6, abs=1e-6)


def test_a_pixel_does_not_depend_on_its_neighbors() -> None:
    log_ratios = np.random.default_rng(0).normal(size=(6, 256)) * np.arange(6.0)[:, None]
    log_ratios[1] = -np.inf
    log_ratios[2, 10:] = -np.inf
    log_ratios[3, 5] = np.nan
    together = smooth(log_ratios)
    for number, row in enumerate(log_ratios):
        alone = smooth(row[None])
        assert alone.weights[0].tobytes() == together.weights[number].tobytes()
        assert alone.pareto_k[0].tobytes() == together.pareto_k[number].tobytes()


def test_draws_where_the_posterior_is_zero_weigh_nothing() -> None:
    rng = np.random.default_rng(3)
    log_ratios = rng.normal(size=(3, 256))
    log_ratios[0, ::7] = -np.inf
    log_ratios[1, 40:] = -np.inf  # fewer are left than the tail holds
    found = smooth(log_ratios)
    assert (found.weights[~np.isfinite(log_ratios)] == 0.0).all()
    assert found.weights.sum(axis=-1) == pytest.approx(1.0)
    assert np.isfinite(found.weights).all()
    # Tails that do not reach the zeros are those of ArviZ.
    weights, k = theirs(log_ratios[[0, 2]])
    assert found.weights[[0, 2]] == pytest.approx(weights, rel=1e-6, abs=1e-12)
    assert found.pareto_k[[0, 2]] == pytest.approx(k, rel=1e-6)


@each("nothing", [-np.inf, np.nan, np.inf])
def test_no_weights_where_no_ratio_is_finite(nothing: float) -> None:
    log_ratios = np.zeros((2, 128))
    log_ratios[0] = nothing
    log_ratios[1] = np.random.default_rng(4).normal(size=128)
    found = smooth(log_ratios)
    assert np.isnan(found.weights[0]).all()
    assert found.pareto_k[0] == np.inf
    assert found.weights[1].sum() == pytest.approx(1.0)
    assert np.isfinite(found.pareto_k[1])


@each("dtype", [np.float32, np.float64])
def test_an_exact_approximation_has_even_weights_and_no_tail(dtype: type) -> None:
    rng = np.random.default_rng(5)
    rounding = 0.2 * np.finfo(dtype).eps * rng.normal(size=(2, 256))
    log_ratios = np.array([[-7.0], [0.0]]) + rounding
    log_ratios = log_ratios.astype(dtype)
    found = smooth(log_ratios)
    assert (found.pareto_k == 0.0).all()
    assert found.weights == pytest.approx(1.0 / 256, rel=256 * float(np.finfo(dtype).eps))
    assert weighted_ess(found.weights) == pytest.approx(256.0)


@pytest.mark.thorough
def test_single_precision_ratios_give_the_same_weights() -> None:
    log_ratios = np.random.default_rng(6).normal(size=(4, 256))
    one, two = smooth(log_ratios), smooth(log_ratios.astype(np.float32))
    assert two.weights == pytest.approx(one.weights, rel=1e-5)
    assert two.pareto_k == pytest.approx(one.pareto_k, abs=1e-4)


# --- what weighted draws say ----------------------------------------------------------------------

LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)


def test_even_weights_give_the_mean_the_sd_and_the_quantiles_of_the_draws() -> None:
    draws = np.random.default_rng(7).gamma(2.0, size=(3, 200))
    mean, sd, quantiles = summarize(draws, np.full(draws.shape, 1.0 / 200), LEVELS)
    assert mean == pytest.approx(draws.mean(axis=-1))
    assert sd == pytest.approx(draws.std(axis=-1))
    # Each draw stands in the middle of its share: Hazen's rule.
    assert quantiles == pytest.approx(np.quantile(draws, LEVELS, axis=-1, method="hazen"))


@pytest.mark.thorough
def test_a_level_beyond_the_outermost_middle_is_the_outermost_draw() -> None:
    draws = np.array([[3.0, 1.0, 2.0]])
    _, _, quantiles = summarize(draws, np.full((1, 3), 1.0 / 3.0), (0.0, 0.1, 0.9, 1.0))
    assert quantiles[:, 0].tolist() == [1.0, 1.0, 3.0, 3.0]


@pytest.mark.thorough
def test_draws_without_weight_change_nothing() -> None:
    rng = np.random.default_rng(8)
    draws, weights = rng.normal(size=(2, 100)), rng.dirichlet(np.ones(100), 2)
    more = np.concatenate([draws, rng.normal(size=(2, 48)), [[-np.inf, np.inf]] * 2], axis=-1)
    told = summarize(more, np.concatenate([weights, np.zeros((2, 50))], axis=-1), LEVELS)
    plain = summarize(draws, weights, LEVELS)
    for one, two in zip(told[:2], plain[:2], strict=True):
        assert one == pytest.approx(two)
    # A draw of no weight stands somewhere on the line between two that have some.
    gap = np.max(np.diff(np.sort(draws), axis=-1))
    assert np.abs(told[2] - plain[2]).max() <= gap


@each(("center", "spread"), [(0.0, 0.5), (0.4, 0.7), (-0.3, 0.9)])
def test_weighted_draws_of_a_wide_normal_are_a_narrow_one(center: float, spread: float) -> None:
    draws = normal_points(4096, 1, seed=10).z.T
    log_ratios = stats.norm(center, spread).logpdf(draws) - stats.norm().logpdf(draws)
    found = smooth(log_ratios)
    assert found.pareto_k[0] < 0.1  # its ratios are bounded
    mean, sd, quantiles = summarize(draws, found.weights, LEVELS)
    # 4096 evenly spread points leave an error of some 1/4096 of the spread, not 1/64.
    assert mean[0] == pytest.approx(center, abs=2e-3)
    assert sd[0] == pytest.approx(spread, abs=4e-3)
    assert quantiles[:, 0] == pytest.approx(stats.norm(center, spread).ppf(LEVELS), abs=1e-2)
    # Kish's number in closed form: (sum w)^2 / sum w^2 of the two densities.
    grid = np.linspace(-8.0, 8.0, 4001)
    ratio = stats.norm(center, spread).pdf(grid) / stats.norm().pdf(grid)
    share = 1.0 / np.trapezoid(ratio**2 * stats.norm().pdf(grid), grid)
    assert weighted_ess(found.weights)[0] == pytest.approx(4096 * share, rel=0.02)


# --- the points -----------------------------------------------------------------------------------


@each("count", [64, 256, 1024])
@each("size", [1, 2, 4, 7])
def test_points_are_standard_normal(count: int, size: int) -> None:
    points = normal_points(count, size, seed=11).z
    assert points.shape == (count, size)
    assert np.isfinite(points).all()
    assert np.abs(points.mean(axis=0)).max() < 1e-14
    # Independent points would have covariances off by count**-0.5 (variances by 2**0.5 of that);
    # pairs of mirror images, as if there were half as many. Four such errors.
    covariance = points.T @ points / count
    assert np.abs(covariance - np.eye(size)).max() < 4.0 * 2.0 / count**0.5
    for column in points.T:
        assert stats.kstest(column, stats.norm.cdf).pvalue > 0.5  # spread more evenly than chance


@each("size", [1, 2, 5])
def test_turns_keep_lengths_and_favor_no_direction(size: int) -> None:
    keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(12), 4000)))
    found = random_rotations(keys, size)
    unit = np.broadcast_to(np.eye(size), found.shape)
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), unit, atol=1e-12)
    # Entries of a random direction have mean 0 and mean square 1 / size: 5 standard errors.
    assert np.abs(found.mean(axis=0)).max() < 5.0 / np.sqrt(4000.0 * size)
    assert np.abs((found**2).mean(axis=0) - 1.0 / size).max() < 5.0 * 0.5 / np.sqrt(4000.0)
    assert random_rotations(keys[7:8], size)[0].tobytes() == found[7].tobytes()


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled_in_haste")
def test_turns_do_not_depend_on_how_many_there_are_or_how_they_were_compiled() -> None:
    keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(15), 13)))
    in_haste = random_rotations(keys, 3)
    jax.config.update("jax_disable_most_optimizations", False)
    for count in (1, 2, 11):
        assert random_rotations(keys[:count], 3).tobytes() == in_haste[:count].tobytes()


@pytest.mark.thorough
def test_what_few_points_get_wrong_of_a_quantile_averages_out_over_pixels() -> None:
    """Without turns a half interval holds some percent less, or more, in all pixels alike."""
    size, pixels = 4, 2000
    points = normal_points(256, size, seed=13).z
    keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(14), pixels)))
    lengthwise = np.ones(size) / size**0.5
    draws = points @ (random_rotations(keys, size) @ lengthwise)[:, :, None]
    even = np.full((pixels, 256), 1.0 / 256)
    _, _, (low, high) = summarize(draws[..., 0], even, (0.25, 0.75))
    held = stats.norm.cdf(high) - stats.norm.cdf(low)
    error = held.std() / pixels**0.5
    assert abs(held.mean() - 0.5) < 4.0 * error + 1e-3  # interpolation between draws
    assert error < 1e-3
