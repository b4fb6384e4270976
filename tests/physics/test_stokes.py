"""Stokes vectors and what is read from them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

from polar_bayes.physics.stokes import (
    TIP,
    Light,
    angle_of_linear_polarization,
    degree_of_linear_polarization,
    to_stokes,
)


def test_stokes_vector_stands_on_the_last_axis() -> None:
    light = Light(jnp.array([[2.0], [4.0]]), jnp.array([0.5, -0.25, 0.0]), jnp.array([0.1]))
    stokes = to_stokes(light)
    assert stokes.shape == (2, 3, 3)
    np.testing.assert_allclose(stokes[1, 1], [4.0, -1.0, 0.4])


@each("dtype", [np.float64, np.float32])
def test_unpolarized_light_has_finite_derivatives(dtype: type) -> None:
    zero = jnp.zeros(2, dtype)

    def length(x: jax.Array) -> jax.Array:
        return degree_of_linear_polarization(x[0], x[1])

    assert length(zero) == pytest.approx(TIP, rel=1e-6)
    np.testing.assert_array_equal(jax.jit(jax.grad(length))(zero), 0.0)
    np.testing.assert_allclose(jax.jit(jax.hessian(length))(zero), np.eye(2) / TIP, rtol=1e-5)
    np.testing.assert_allclose(length(jnp.array([3e-7, 4e-7], dtype)), 5e-7, rtol=1e-6)


@each(
    ("q", "u", "angle"),
    [(0.3, 0.0, 0.0), (0.0, 0.3, 45.0), (-0.3, 0.0, 90.0), (0.0, -0.3, -45.0), (0.0, 0.0, 0.0)],
)
def test_angle_is_measured_from_s(q: float, u: float, angle: float) -> None:
    assert angle_of_linear_polarization(q, u) == pytest.approx(angle)


@pytest.mark.thorough
def test_angle_of_unpolarized_light_has_a_finite_gradient() -> None:
    gradient = jax.grad(angle_of_linear_polarization, (0, 1))(0.0, 0.0)
    assert np.all(np.isfinite(gradient))
