"""Fresnel's laws against a transfer-matrix code, and the laws they obey."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from cases import each
from hard_cases.multiprecision import hemispherical_reflection
from hypothesis import given, settings
from hypothesis import strategies as st

from polar_bayes.physics.geometry import cos_degrees, sin_degrees
from polar_bayes.physics.stack import Stack

angle = st.floats(0.0, 89.99)
index = st.floats(1.0, 3.0)


def at(degrees: float | np.ndarray) -> tuple:
    return cos_degrees(jnp.asarray(degrees)), sin_degrees(jnp.asarray(degrees)) ** 2


def reflected(degrees: float | np.ndarray, n: float | np.ndarray) -> tuple:
    """Mean of s and p, and half their difference."""
    power = Stack(jnp.asarray(n)).reflection(*at(degrees))
    return power.mean, power.contrast * power.sin_squared


def transmitted(degrees: float | np.ndarray, n: float | np.ndarray) -> tuple:
    power = Stack(jnp.asarray(n)).transmission(*at(degrees))
    return power.mean, power.contrast * power.sin_squared


def test_reflection_agrees_with_the_transfer_matrix(fresnel_curves: np.ndarray) -> None:
    """The table gives ten digits: 1e-9 of the value is its rounding."""
    n, theta, s, p, dolp = fresnel_curves.T[:5]
    mean, difference = reflected(theta, n)
    np.testing.assert_allclose(mean + difference, s, rtol=1e-9)
    # p vanishes at Brewster's angle and is a difference there.
    np.testing.assert_allclose(mean - difference, p, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(difference / mean, dolp, rtol=1e-9, atol=1e-12)


def test_exit_agrees_with_the_transfer_matrix(fresnel_curves: np.ndarray) -> None:
    """The table's polarization at exit is a difference of ten-digit numbers near the normal."""
    n, theta = fresnel_curves.T[:2]
    s, p, dolp, stable = fresnel_curves.T[6:10]
    mean, difference = transmitted(theta, n)
    np.testing.assert_allclose(mean, (s + p) / 2, rtol=1e-9)
    np.testing.assert_allclose(-difference / mean, dolp, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(-difference / mean, stable, rtol=1e-9, atol=1e-15)


@given(theta=angle, n=index)
@settings(deadline=None, max_examples=50)
def test_no_light_is_lost(theta: float, n: float) -> None:
    mean, _ = reflected(theta, n)
    assert 0.0 <= mean <= 1.0
    assert mean + transmitted(theta, n)[0] == pytest.approx(1.0, abs=1e-13)


@pytest.mark.thorough
@given(theta=angle, n=index)
@settings(deadline=None, max_examples=50)
def test_exit_carries_the_opposite_of_reflection(theta: float, n: float) -> None:
    """T- = -R-: what one polarization reflects less, it transmits more."""
    assert -transmitted(theta, n)[1] == pytest.approx(float(reflected(theta, n)[1]), abs=1e-14)


@given(theta=angle, n=st.floats(1.01, 3.0))
@settings(deadline=None, max_examples=50)
def test_light_inside_meets_the_same_interface(theta: float, n: float) -> None:
    """The transmittance is the same both ways: exchange cosines and invert the index."""
    c = cos_degrees(theta)
    inside = jnp.sqrt((n - 1.0) * (n + 1.0) + c**2) / n
    forwards = 4.0 * n * c * inside / (c + n * inside) ** 2
    assert transmitted(theta, n)[0] == pytest.approx(
        float(0.5 * (forwards + 4.0 * n * c * inside / (n * c + inside) ** 2)), abs=1e-13
    )


@each("n", [1.0, 1.2, 1.333, 1.5, 2.0])
def test_no_p_light_at_the_brewster_angle(n: float) -> None:
    theta = np.rad2deg(np.arctan(n))
    power = Stack(jnp.asarray(n)).relative_reflection(*at(theta))
    polarization = power.contrast * power.sin_squared / power.mean
    assert polarization == pytest.approx(1.0, abs=1e-14)


@pytest.mark.thorough
def test_exit_at_grazing_is_polarized_by_the_index_alone() -> None:
    n = np.array([1.2, 1.5, 2.0])
    power = Stack(jnp.asarray(n)).transmission(jnp.full(3, 1e-12), jnp.ones(3))
    found = -power.contrast / power.mean
    np.testing.assert_allclose(found, (n**2 - 1) / (n**2 + 1), rtol=1e-11)


def test_without_an_index_step_nothing_is_reflected() -> None:
    assert reflected(50.0, 1.0) == (0.0, 0.0)
    mean, difference = transmitted(50.0, 1.0)
    assert mean == pytest.approx(1.0, abs=1e-15)
    assert difference == 0.0


def test_internal_reflection_of_common_indices() -> None:
    found = Stack(jnp.array([1.0, 1.33, 1.5, 1.7])).escape()
    np.testing.assert_allclose(1.0 - found, [0.0, 0.472, 0.596, 0.696], atol=5e-4)


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
