"""Ranks and scores against what is known of them."""

import numpy as np
import pytest
from scipy import stats

from polar_bayes.calibration.scores import PitCrps, crps, randomized_pit
from polar_bayes.numerics.psis import summarize


def even(fits: int, draws: int) -> np.ndarray:
    return np.full((fits, draws), 1.0 / draws)


@pytest.mark.parametrize(
    "make",
    [
        lambda random: random.normal(size=(4000, 20)),
        lambda random: random.normal(size=(4000, 3)),
        # Ties are shared evenly.
        lambda random: random.integers(0, 3, size=(4000, 20)).astype(float),
    ],
)
def test_the_truth_among_draws_of_its_own_distribution_is_uniform(make) -> None:
    random = np.random.default_rng(0)
    values = make(random)
    weights = even(4000, values.shape[1] - 1)
    pit = randomized_pit(values[:, 1:], weights, values[:, 0], random.random(4000))
    assert stats.kstest(pit, "uniform").pvalue > 1e-3


@pytest.mark.thorough
def test_few_effective_draws_do_not_look_like_a_narrow_posterior() -> None:
    """Weighted draws of a normal distribution, from one that is wider: some 40 effective ones."""
    random = np.random.default_rng(2)
    values = random.normal(size=4000)
    draws = 2.5 * random.standard_t(4, size=(4000, 120))
    weights = stats.norm.pdf(draws) / stats.t(4).pdf(draws / 2.5)
    weights /= weights.sum(axis=-1, keepdims=True)
    pit = randomized_pit(draws, weights, values, random.random(4000))
    low, high = summarize(draws, weights, (0.025, 0.975), random=True)[2]
    held = np.mean((low <= values) & (values <= high))
    # Four standard errors each.
    assert abs(np.sqrt(12.0) * pit.std() - 1.0) < 4.0 / np.sqrt(5.0 * 4000)
    assert abs(held - 0.95) < 4.0 * np.sqrt(0.95 * 0.05 / 4000)


def test_weights_count_as_repeated_draws() -> None:
    draws, weights = np.array([[0.0, 1.0, 2.0]]), np.array([[0.5, 0.25, 0.25]])
    repeated = np.array([[0.0, 0.0, 1.0, 2.0]])
    truth, chance = np.array([1.5]), np.array([0.0])
    effective = 1.0 / np.sum(weights**2)
    told = randomized_pit(draws, weights, truth, chance) * (effective + 1.0) / effective
    assert told == pytest.approx(randomized_pit(repeated, even(1, 4), truth, chance) * 5 / 4)
    assert crps(draws, weights, truth) == pytest.approx(crps(repeated, even(1, 4), truth))


def test_the_score_of_a_normal_distribution_is_that_of_its_formula() -> None:
    """Gneiting & Raftery (2007), below eq. 21."""
    draws = stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)
    for truth in (-2.0, 0.0, 0.7):
        expected = truth * (2.0 * stats.norm.cdf(truth) - 1.0) + 2.0 * stats.norm.pdf(truth)
        expected -= 1.0 / np.sqrt(np.pi)
        found = crps(draws[None], even(1, 20_000), np.array([truth]))
        assert found == pytest.approx(expected, abs=1e-4)  # of the draws' ends


def test_each_fit_has_the_same_chance_whoever_takes_it_down() -> None:
    random = np.random.default_rng(3)
    truth = {"roughness": random.random((6, 2))}
    draws = {"roughness": random.random((6, 30, 2))}
    whole, parts = (PitCrps(truth, np.arange(6), 5) for _ in range(2))
    whole.describe(np.arange(6), draws, even(6, 30))
    for some in (np.array([4, 1]), np.array([0, 5, 3])):
        parts.describe(some, {"roughness": draws["roughness"][some]}, even(len(some), 30))
    assert np.isnan(parts.pit["roughness"][2]).all()
    told = [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(whole.pit["roughness"][told], parts.pit["roughness"][told])
    np.testing.assert_array_equal(whole.crps["roughness"][told], parts.crps["roughness"][told])


@pytest.mark.thorough
def test_the_chance_of_a_fit_follows_its_number() -> None:
    truth = {"roughness": np.arange(6.0), "absorption": np.zeros((6, 2))}
    draws = {"roughness": np.zeros((6, 30)), "absorption": np.zeros((6, 30, 2))}
    whole = PitCrps(truth, np.arange(6), 5)
    whole.describe(np.arange(6), draws, even(6, 30))
    last = PitCrps({name: x[4:] for name, x in truth.items()}, np.array([4, 5]), 5)
    last.describe(np.arange(2), {name: x[4:] for name, x in draws.items()}, even(2, 30))
    for name in truth:
        np.testing.assert_array_equal(last.pit[name], whole.pit[name][4:])
