"""The test of uniform ranks: its false alarms, and what it finds."""

import numpy as np
import pytest
from cases import each
from scipy import stats

from polar_bayes.calibration.scores import uniformity


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
    if is_low is not None:
        assert (found.mean > 0.5) == is_low
    if is_narrow is not None:
        assert (found.spread > 1.0) == is_narrow


@pytest.mark.thorough
def test_a_lump_that_keeps_mean_and_spread_is_found() -> None:
    """Moments alone would not see it."""
    random = np.random.default_rng(2)
    sample = random.random(2000)
    lump = np.abs(sample - 0.2) < 0.05
    sample[lump] = 0.2 + 0.01 * random.random(lump.sum())
    assert uniformity(sample).p_value < 0.001


@pytest.mark.thorough
def test_numbers_at_both_ends_are_counted() -> None:
    assert uniformity(np.zeros(50)).p_value == pytest.approx(1e-4)
    assert uniformity(np.ones(50)).p_value == pytest.approx(1e-4)
    assert uniformity((np.arange(50) + 0.5) / 50).p_value > 0.9
