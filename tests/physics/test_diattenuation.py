"""Interfaces as triples: the algebra must be that of s, p and x taken one by one."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optics import one_by_one

from polar_bayes.physics.boundary import Diattenuation

RUN = settings(deadline=None, max_examples=80, derandomize=True)
share = st.floats(-0.45, 0.45)
sine = st.floats(0.0, 1.0)
# Sums of three shares stay below .9 in s, p and x, so that a series converges.
triple = st.tuples(st.floats(0.0, 0.45), share, share)


def make(numbers: tuple[float, float, float], sin_squared: float) -> Diattenuation:
    return Diattenuation(*(jnp.asarray(x) for x in (*numbers, sin_squared)))


@given(first=triple, second=triple, b=sine)
@RUN
def test_one_after_the_other_is_a_product(first: tuple, second: tuple, b: float) -> None:
    one, two = make(first, b), make(second, b)
    expected = one_by_one(one) * one_by_one(two)
    np.testing.assert_allclose(one_by_one(one.times(two)), expected, atol=1e-15)


@given(first=triple, second=triple, b=sine, factor=st.floats(0.0, 2.0))
@RUN
def test_paths_add_and_filters_scale(first: tuple, second: tuple, b: float, factor: float) -> None:
    one, two = make(first, b), make(second, b)
    found = one_by_one(one.plus(two.scaled(jnp.asarray(factor))))
    expected = one_by_one(one) + factor * one_by_one(two)
    np.testing.assert_allclose(found, expected, atol=1e-15)


@given(trip=triple, b=sine)
@RUN
def test_all_round_trips_are_the_sum_of_the_series(trip: tuple, b: float) -> None:
    """Against the closed form and against 400 terms: .9^400 is below rounding."""
    single = one_by_one(make(trip, b))
    found = one_by_one(make(trip, b).repeated())
    np.testing.assert_allclose(found, 1.0 / (1.0 - single), rtol=1e-13)
    series = np.sum(single ** np.arange(400)[:, None], axis=0)
    np.testing.assert_allclose(found, series, rtol=1e-13)


@pytest.mark.thorough
@given(first=triple, second=triple)
@RUN
def test_contrast_and_shortfall_have_limits_at_normal_incidence(first, second) -> None:
    """They depend on B smoothly: over 1e-6 they change by about as much, times at most 1/.1^3."""
    here, there = (make(first, b).times(make(second, b)).repeated() for b in (0.0, 1e-6))
    for field in ("mean", "contrast", "shortfall"):
        np.testing.assert_allclose(getattr(here, field), getattr(there, field), atol=1e-4)
