"""Distances from a reference against what normal distributions say of them."""

import numpy as np
from cases import each
from scipy import stats

from polar_bayes.benchmark.reference import distances

SHARE = (np.arange(20000) + 0.5) / 20000
STANDARD = stats.norm.ppf(SHARE)


def test_a_shift_and_a_stretch_are_measured_in_sds_of_the_reference():
    reference = np.stack([5.0 + 2.0 * STANDARD, -3.0 + 0.1 * STANDARD])
    shifted = np.stack([5.5 + 2.0 * STANDARD, -3.0 + 0.15 * STANDARD])
    found = distances(shifted, reference)
    end = stats.norm.ppf(0.975)
    np.testing.assert_allclose(found["mean_error"], [0.25, 0.0], atol=1e-3)
    np.testing.assert_allclose(found["sd_error"], [0.0, 0.5], atol=1e-3)
    np.testing.assert_allclose(found["low_error"], [0.25, -0.5 * end], atol=2e-3)
    np.testing.assert_allclose(found["high_error"], [0.25, 0.5 * end], atol=2e-3)
    # A stretched normal moves by |z|/2 on average.
    np.testing.assert_allclose(found["wasserstein"], [0.25, 0.5 * np.sqrt(2 / np.pi)], atol=2e-3)


@each("bad", [np.nan, np.inf])
def test_a_draw_that_is_no_number_is_infinitely_far_and_spoils_no_other(bad):
    draws = np.stack([STANDARD, STANDARD])
    draws[0, 7] = bad
    found = distances(draws, np.stack([STANDARD, STANDARD]))
    for error in found.values():
        assert np.isposinf(error[0])
        assert abs(error[1]) < 1e-12
