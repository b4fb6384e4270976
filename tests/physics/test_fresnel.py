"""Fresnel's laws against a transfer-matrix code, and the laws they obey."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from cases import each
from hard_cases.multiprecision import hemispherical_reflection
from optics import incidence, read

from polar_bayes.physics.stack import Stack


def shared(law: Callable, degrees: np.ndarray, n: np.ndarray) -> tuple:
    """Mean of s and p, and half their difference."""
    power = law(Stack(jnp.asarray(n)), *incidence(degrees))
    return power.mean, power.contrast * power.sin_squared


def test_reflection_agrees_with_the_transfer_matrix() -> None:
    """The table gives ten digits: 1e-9 of the value is its rounding."""
    n, theta, s, p, dolp = read("fresnel_smooth_curves.csv")[:5]
    mean, difference = shared(Stack.reflection, theta, n)
    np.testing.assert_allclose(mean + difference, s, rtol=1e-9)
    # p vanishes at Brewster's angle and is a difference there.
    np.testing.assert_allclose(mean - difference, p, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(difference / mean, dolp, rtol=1e-9, atol=1e-12)


def test_exit_agrees_with_the_transfer_matrix() -> None:
    """The table's polarization at exit is a difference of ten-digit numbers near the normal."""
    n, theta, _, _, _, _, s, p, dolp, stable = read("fresnel_smooth_curves.csv")[:10]
    mean, difference = shared(Stack.transmission, theta, n)
    np.testing.assert_allclose(mean, (s + p) / 2, rtol=1e-9)
    np.testing.assert_allclose(-difference / mean, dolp, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(-difference / mean, stable, rtol=1e-9, atol=1e-15)


@pytest.mark.thorough
@each("n", [1.000001, 1.0001, 1.01, 1.2, 1.5, 2.0, 3.0])
def test_hemisphere_with_slope_and_curvature(n: float) -> None:
    """Escape against the closed form in 40 digits, with both derivatives.

    The least step, 8 eps, moves the value by a sixth of itself and the slope by the curvature, 12
    at most, times half of it. A derivative that moves the nodes divides roundings by the step.
    """
    eps, step = np.finfo(float).eps, (n - 1.0) * (n + 1.0)
    escape = jax.jit(lambda index: Stack(index).escape())
    found = escape(n), jax.jit(jax.grad(escape))(n), jax.jit(jax.grad(jax.grad(escape)))(n)
    bounds = 8.0 * eps, 100.0 * eps, 100.0 * eps * (1.0 + 1.0 / step)
    with mp.workdps(40):
        for order, (value, bound) in enumerate(zip(found, bounds, strict=True)):
            truth = mp.diff(lambda x: (1 - hemispherical_reflection(x)) / x**2, mp.mpf(n), order)
            assert float(value) == pytest.approx(float(truth), abs=bound)
