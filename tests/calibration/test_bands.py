"""Bands of ranks: how often a uniform sample leaves them."""

import numpy as np
from cases import each
from scipy import stats

from polar_bayes.calibration.scores import MAX_POINTS, ecdf_band, histogram_band, uniformity


@each("count", [20, 300, 700])
@each("level", [0.05, 0.01])
def test_a_curve_leaves_its_band_exactly_where_the_test_fails(count: int, level: float) -> None:
    random, band = np.random.default_rng(count), ecdf_band(count, level)
    points = min(count, MAX_POINTS)
    outside, fails = [], []
    for at in range(400):
        sample = random.beta(*((1.0, 1.0) if at < 300 else (0.8, 0.8)), size=count)
        below = np.searchsorted(np.sort(sample), np.arange(points + 1) / points) / count
        away = below - np.arange(points + 1) / points
        inside = (band.lower - 1e-9 <= away) & (away <= band.upper + 1e-9)
        outside.append(not inside[:-1].all())
        fails.append(uniformity(sample).p_value < level)
    assert outside == fails
    assert 0 < sum(fails[300:])
    # One run in 10,000 has more false alarms than this by chance.
    assert sum(fails[:300]) <= stats.binom.ppf(0.9999, 300, level)


def test_bars_of_a_uniform_histogram_stay_inside() -> None:
    random, count, bins = np.random.default_rng(0), 400, 20
    low, high = histogram_band(count, bins)
    alarms = 0
    for _ in range(1000):
        bars = np.histogram(random.random(count), bins, (0.0, 1.0), density=True)[0]
        alarms += bool((bars < low - 1e-9).any() or (bars > high + 1e-9).any())
    assert 0 < alarms <= stats.binom.ppf(0.9999, 1000, 0.05)
