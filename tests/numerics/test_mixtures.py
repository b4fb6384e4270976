"""Mixtures of Student t distributions: their densities, and fits to weighted draws."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from polar_bayes.numerics.mixtures import (
    DEGREES_OF_FREEDOM,
    draw_mixture,
    fit_mixture,
    log_density,
    moments,
)
from polar_bayes.numerics.psis import smooth, weighted_ess

FAR, WIDTH = 2.0, 0.02


@functools.partial(jax.jit, static_argnums=(1, 2))
def fitted(z: jax.Array, components: int, count: int) -> tuple:
    """A mixture of some components fitted to draws of equal weight, and draws of its own."""
    weights = jnp.full(len(z), 1.0 / len(z))
    mixture = fit_mixture(z, weights, components, jax.random.key(0))
    drawn = draw_mixture(mixture, count, jax.random.key(1))
    return mixture, drawn, log_density(mixture, drawn)


def log_posterior(z: np.ndarray) -> np.ndarray:
    """Readings that know how far x is from 0, and not on which side; y is free."""
    return -0.5 * ((np.abs(z[:, 0]) - FAR) / WIDTH) ** 2 - 0.5 * z[:, 1] ** 2


def test_weighted_draws_of_a_fitted_mixture_are_the_posterior() -> None:
    random, count = np.random.default_rng(0), 4096
    z = random.normal([0.0, 0.0], [WIDTH, 1.0], (2048, 2))
    z[:, 0] += FAR * random.choice([-1.0, 1.0], 2048)
    _, drawn, told = fitted(z, 4, count)
    x, y = np.asarray(drawn).T
    weights, pareto_k = smooth((log_posterior(np.asarray(drawn)) - np.asarray(told))[None])
    assert pareto_k[0] < 0.7
    worth = weighted_ess(weights)[0]
    assert worth >= 400.0
    # Four Monte Carlo errors each: three comparisons fail by chance twice in ten thousand.
    assert abs(weights[0] @ (x > 0.0) - 0.5) < 4.0 * 0.5 / np.sqrt(worth)
    assert abs(weights[0] @ y) < 4.0 / np.sqrt(worth)
    assert abs(weights[0] @ y**2 - 1.0) < 4.0 * np.sqrt(2.0 / worth)


def test_the_density_of_a_mixture_is_that_of_its_parts() -> None:
    random = np.random.default_rng(0)
    z = random.normal(size=(400, 2)) @ np.array([[1.0, 0.4], [0.0, 0.2]]) + np.array([3.0, -5.0])
    mixture, drawn, told = fitted(z, 3, 256)
    center, half = np.asarray(mixture.center), np.asarray(mixture.half)
    expected = np.zeros(256)
    for log_share, mean, scale in zip(*(np.asarray(x) for x in mixture[2:]), strict=True):
        root = half @ scale
        part = scipy.stats.multivariate_t(center + half @ mean, root @ root.T, DEGREES_OF_FREEDOM)
        expected += np.exp(log_share) * part.pdf(np.asarray(drawn))
    difference = np.asarray(told) - np.log(expected)
    assert np.exp(np.asarray(mixture.log_share)).sum() == pytest.approx(1.0)
    assert np.ptp(difference) < 1e-9  # up to a constant


def test_spread_is_mean_and_covariance_of_weighted_draws() -> None:
    random = np.random.default_rng(1)
    z, weights = random.normal(size=(50, 3)) * [1.0, 1e-3, 1e3], random.dirichlet(np.ones(50))
    center, half = (np.asarray(x) for x in moments(jnp.asarray(z), jnp.asarray(weights)))
    assert center == pytest.approx(np.average(z, axis=0, weights=weights))
    covariance = np.cov(z.T, aweights=weights, ddof=0)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert np.abs(half @ half.T - covariance).max() < 2e-6 * scale.max()
    assert np.abs((half @ half.T - covariance) / scale).max() < 2e-6  # what the lift adds
