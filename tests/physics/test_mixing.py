"""Mixtures of surface and body: their ends, signs, and darkness."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st

from polar_bayes.physics.mixing import DopMixing, StokesMixing
from polar_bayes.physics.stokes import Light, degree_of_linear_polarization

component = st.floats(-0.7, 0.7)


def light(intensity: float, q: float, u: float = 0.0) -> Light:
    return Light(*(jnp.array([x]) for x in (intensity, q, u)))


@given(q=component, u=component, body=component, fraction=st.floats(0.0, 1.0))
@settings(deadline=None, max_examples=60)
def test_the_papers_rule_mixes_degrees(q: float, u: float, body: float, fraction: float) -> None:
    mixture = DopMixing().mix(jnp.array([fraction]), light(1.0, q, u), light(1.0, body))
    expected = (1.0 - fraction) * np.hypot(q, u) + fraction * abs(body)
    dop = degree_of_linear_polarization(mixture.q, mixture.u)
    np.testing.assert_allclose(dop, expected, atol=5e-12)


@given(
    bright=st.floats(1e-6, 1e6),
    q=component,
    u=component,
    body=component,
    fraction=st.floats(0.0, 1.0),
)
@settings(deadline=None, max_examples=60)
def test_stokes_vectors_add(bright, q, u, body, fraction) -> None:
    mixture = StokesMixing().mix(jnp.array([fraction]), light(bright, q, u), light(1.0, body))
    total = (1.0 - fraction) * bright + fraction
    np.testing.assert_allclose(mixture.intensity, total, rtol=1e-14)
    sum_q = (1.0 - fraction) * bright * q + fraction * body
    np.testing.assert_allclose(mixture.q * total, sum_q, atol=1e-14 * (bright + 1.0))
    np.testing.assert_allclose(
        mixture.u * total, (1.0 - fraction) * bright * u, atol=1e-14 * (bright + 1.0)
    )


@pytest.mark.thorough
@each("dtype", [np.float64, np.float32])
@each("dark", [0.0, 1e-30, 1e-12])
def test_a_dark_surface_keeps_its_polarization(dark: float, dtype: type) -> None:
    """At fraction 0 the reading is the surface's, however dark, and has finite derivatives."""

    def reading(inputs: jax.Array) -> jax.Array:
        surface = Light(inputs[1:2], jnp.full(1, 0.6, dtype), jnp.zeros(1, dtype))
        body = Light(inputs[2:3], jnp.full(1, -0.2, dtype), jnp.zeros(1, dtype))
        return StokesMixing().mix(inputs[0:1], surface, body).q[0]

    inputs = jnp.array([0.0, dark, 0.05], dtype)
    assert reading(inputs) == pytest.approx(0.6, rel=1e-6)
    assert np.all(np.isfinite(jax.grad(reading)(inputs)))
    assert np.all(np.isfinite(jax.hessian(reading)(inputs)))
