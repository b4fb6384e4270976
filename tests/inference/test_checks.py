"""Checks that fits and maps share: their rates under a right model, and which tails count."""

import numpy as np
import pytest
from cases import each
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from polar_bayes.inference.checks import (
    CAUTION,
    MASS_AT_BOUND,
    PROBLEM,
    level,
    prior_conflict,
    share_at,
    tail_scores,
)

ENDS = np.array([-1.0, 1.0, 0.0, -1.0, 0.0])


@each("end", [ENDS, np.zeros(4), -np.ones(3), np.array([1.0])])
def test_a_right_model_is_in_conflict_no_more_often_than_stated(end) -> None:
    """Medians are uniform in their priors where the readings decide; 5 sds of the binomial."""
    below = np.random.default_rng(0).uniform(size=(100_000, end.size))
    p_values = prior_conflict(below, end)
    for rate in (PROBLEM, CAUTION, 0.1):
        most = rate + 5.0 * np.sqrt(rate * (1.0 - rate) / len(below))
        assert np.mean(p_values < rate) <= most
        # One parameter alone has twice the same tail, which doubling counts twice.
        assert np.mean(p_values < rate) >= 0.5 * rate - (most - rate)


@given(st.floats(1e-300, 1.0), st.floats(0.0, 1.0))
def test_the_absent_end_is_no_tail(near: float, other: float) -> None:
    """However far towards absent, only the other parameter is judged."""
    tails, scores = tail_scores(np.array([min(near, 0.5), other]), np.array([-1.0, 0.0]))
    assert scores[0] == 0.0
    assert tails[0] >= 0.5
    assert prior_conflict(np.array([min(near, 0.5), 0.5]), np.array([-1.0, 0.0])) == 1.0


def test_a_tail_away_from_absent_is_that_of_the_prior() -> None:
    tails, scores = tail_scores(np.array([0.999, 0.001, 0.999]), np.array([-1.0, 1.0, 0.0]))
    np.testing.assert_allclose(tails, [0.001, 0.001, 0.002])
    np.testing.assert_allclose(scores, stats.norm.isf([0.001, 0.001, 0.001]))


@each("below", [0.0, 1.0])
def test_a_prior_that_excludes_the_median_is_a_conflict_and_finite(below) -> None:
    p_value = prior_conflict(np.array([below, 0.5]), np.zeros(2))
    assert 0.0 <= p_value < 1e-100


@pytest.mark.parametrize(
    ("p_value", "name"),
    [(0.5, "passed"), (0.01, "caution"), (0.003, "problem"), (np.nan, "not computed")],
)
def test_levels(p_value: float, name: str) -> None:
    assert level(p_value) == name


@each(
    ("density", "is_against"),
    [(stats.uniform, False), (stats.truncnorm(-1.0, np.inf), False), (stats.halfnorm, True)],
    ids=["as wide as its prior", "one sd from its peak", "at its peak"],
)
def test_a_density_lies_against_a_bound_that_cuts_off_its_peak(density, is_against) -> None:
    draws = density.ppf((np.arange(100_000) + 0.5) / 100_000)
    assert (share_at(draws.min(), draws) >= MASS_AT_BOUND) == is_against
