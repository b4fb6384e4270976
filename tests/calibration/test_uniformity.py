"""The tests of ranks, coverage and spread: their false alarms, and what they find."""

import numpy as np
import pytest
from cases import each
from scipy import stats
from synthetic_calibrations import NAMES, make_calibration
from synthetic_results import replace

from polar_bayes.calibration.scores import is_calibrated, spread_of_scores, uniformity
from polar_bayes.calibration.verdict import calibration_table, calibration_verdict


@each("count", [50, 300, 1000])
def test_false_alarms_are_as_many_as_the_level_says(count: int) -> None:
    random = np.random.default_rng(count)
    p_values = np.array([uniformity(random.random(count)).p_value for _ in range(600)])
    for level in (0.05, 0.2, 0.5):
        alarms = int(np.sum(p_values <= level))
        # Ties make the test a little strict; one run in 10,000 strays further than this by chance.
        assert stats.binom.ppf(0.0001, 600, 0.9 * level) <= alarms
        assert alarms <= stats.binom.ppf(0.9999, 600, level)


@each(
    ("shape", "is_low", "is_narrow"),
    [((0.8, 1.2), False, None), ((1.2, 0.8), True, None), ((0.8, 0.8), None, True)],
)
def test_what_is_not_uniform_is_found_and_told(shape, is_low, is_narrow) -> None:
    found = uniformity(np.random.default_rng(1).beta(*shape, size=2000))
    assert found.p_value < 0.001
    assert is_low is None or (found.mean > 0.5) == is_low
    assert is_narrow is None or (found.spread > 1.0) == is_narrow


@pytest.mark.thorough
def test_a_lump_that_keeps_mean_and_spread_and_numbers_at_an_end_are_found() -> None:
    """Moments alone would not see the lump."""
    random = np.random.default_rng(2)
    sample = random.random(2000)
    lump = np.abs(sample - 0.2) < 0.05
    sample[lump] = 0.2 + 0.01 * random.random(lump.sum())
    assert uniformity(sample).p_value < 0.001
    for end in (np.zeros(50), np.ones(50)):
        assert uniformity(end).p_value == pytest.approx(1e-4)
    assert uniformity((np.arange(50) + 0.5) / 50).p_value > 0.9


def alarms(count: int, seeds: range) -> int:
    """How many calibrations of right posteriors are called wrong."""
    tables = (calibration_table(make_calibration(count=count, seed=seed)) for seed in seeds)
    return sum(not is_calibrated(table) for table in tables)


def test_a_right_posterior_is_called_wrong_in_one_of_twenty_calibrations_at_most() -> None:
    # Tests of one parameter overlap and counts are whole numbers, so alarms are fewer than 5%. Of
    # 60 calibrations at 5%, more than 9 are called wrong by chance in one of 1000 runs.
    assert alarms(100, range(60)) <= 9


@pytest.mark.thorough
def test_the_rate_of_false_alarms_is_that_which_is_stated() -> None:
    found = alarms(200, range(1000, 1600))
    assert stats.binom.ppf(0.001, 600, 0.01) <= found <= stats.binom.ppf(0.999, 600, 0.05)


def test_the_spread_of_skewed_and_heavy_tailed_posteriors_is_one() -> None:
    """Scores of ranks are normal, whatever the posterior: its tails cause no false alarm."""
    random = np.random.default_rng(3)
    p_values = []
    for _ in range(400):
        truths = stats.t(3).rvs(200, random_state=random)
        p_values.append(spread_of_scores(stats.t(3).cdf(truths))[0])
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3


def test_intervals_that_are_a_little_short_are_named_with_their_coverage() -> None:
    """Ranks alone, at half the level, do not see what shows in the tails."""
    tree = make_calibration(count=4000, narrow={NAMES[0]: 0.93})
    first, second = calibration_verdict(tree)[:2]
    assert first.startswith(
        "Not calibrated: the ranks, coverage and spread of 3 parameters in 4000"
    )
    assert second.startswith(f"{NAMES[0]}: ")
    assert "50%, 80%, 95% intervals hold 47.0%, 76.4%, 93.1% of the truths (p = 3e-08)" in second
    assert "; the truths scatter 1.0" in second


def test_tails_that_are_cut_are_found_by_coverage() -> None:
    """1000 ranks of which 74 lie outside of the 95% interval, the middle even: p = .001."""
    tree, name = make_calibration(count=1000), NAMES[0]
    tails, middle = np.linspace(0.0005, 0.0245, 37), np.linspace(0.0255, 0.9745, 926)
    pit = np.random.default_rng(4).permutation(np.concatenate([tails, middle, 1.0 - tails]))
    marginals = tree["marginals"].to_dataset()
    truth = marginals[name] + stats.norm.ppf(pit) * marginals[f"{name}_sd"]
    replace(tree, "truth", name, truth)
    replace(tree, "prior_sbc", name, pit)
    row = calibration_table(tree).loc[name]
    assert row["held_95"] == 0.926
    assert row["p_held_95"] < 0.05 / 15
    assert not is_calibrated(calibration_table(tree))
    assert "95% intervals hold 92.6% of the truths (p = 0.001)" in calibration_verdict(tree)[1]
