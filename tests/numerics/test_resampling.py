"""Choosing among weighted draws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

from polar_bayes.numerics.psis import (
    CHAINS,
    FEWEST,
    MOST,
    max_effective_size,
    resampled_chains,
    systematic_resample,
)


def test_each_draw_is_chosen_as_often_as_it_weighs():
    weights = np.array([0.1, 0.0, 0.6, 0.3])
    chosen = resampled_chains(weights, 400.0, np.random.default_rng(0))
    assert chosen.shape == (CHAINS, 100)
    counts = np.bincount(chosen.ravel(), minlength=4)
    # Systematic: no count is off by one draw or more.
    assert (np.abs(counts - 400 * weights) < 1.0).all()


@each(("worth", "each"), [(1.0, FEWEST), (8000.0, 2000), (1e9, MOST)])
def test_as_many_are_chosen_as_the_weighted_ones_are_worth(worth, each):
    weights = np.full(5000, 1 / 5000)
    assert resampled_chains(weights, worth, np.random.default_rng(0)).shape == (CHAINS, each)


def test_what_is_chosen_is_worth_half_at_best_and_has_a_limit():
    assert max_effective_size(0) == 0.0
    assert max_effective_size(1000) == pytest.approx(500.0)
    assert max_effective_size(10**9) == pytest.approx(CHAINS * MOST, rel=1e-3)


def test_chosen_draws_come_in_random_order():
    chosen = resampled_chains(np.full(1000, 1e-3), 1000.0, np.random.default_rng(0)).ravel()
    # The rank correlation of 1000 independent ones has sd 0.032.
    assert abs(np.corrcoef(chosen, np.arange(1000))[0, 1]) < 5 * 0.032


def test_a_compiled_program_chooses_the_same_draws():
    weights = np.array([0.5, 0.25, 0.25, 0.0])
    chosen = systematic_resample(weights, 128, 0.5)
    assert np.bincount(chosen, minlength=4).tolist() == [64, 32, 32, 0]
    equal = systematic_resample(np.full(4, 0.25), 128, 0.5)
    assert np.ptp(np.bincount(equal, minlength=4)) <= 1
    program = jax.jit(systematic_resample, static_argnums=1)
    np.testing.assert_array_equal(program(jnp.asarray(weights), 128, 0.5), chosen)
