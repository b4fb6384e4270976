"""Bodies: how bright they are and how much polarization they keep."""

import jax.numpy as jnp
import numpy as np
import pytest

from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.subsurface import (
    Depolarizer,
    Lambertian,
    Unpolarized,
    body_loss,
    half_space_loss,
)
from polar_bayes.physics.surface import AbstractSurface, Interface, SmoothSurface

GEOMETRY = Geometry(
    *(jnp.asarray(x) for x in ([0.0, 30.0, 60.0, 85.0], [0.0] * 4, [20.0] * 4, [180.0] * 4))
)
MATERIAL = {
    "roughness": jnp.array([0.2]),
    "absorption": jnp.array([0.3]),
    "refractive_index": jnp.array([1.5]),
}


def under(surface: AbstractSurface) -> Interface:
    return Interface(surface, Stack(MATERIAL["refractive_index"]))


def test_lambertian_body_agrees_with_the_renderer(plastic: np.ndarray) -> None:
    """The renderer's body has a smooth way out. It stores n in single precision: 6e-8."""
    n, view, light, azimuth = plastic[:, [1, 3, 4, 5]].T
    geometry = Geometry(*(jnp.asarray(x) for x in (view, 0.0 * view, light, azimuth)))
    interface = Interface(SmoothSurface(), Stack(jnp.asarray(n)))
    found = Lambertian(albedo=1.0).light({}, geometry, interface)
    np.testing.assert_allclose(found.intensity, plastic[:, 10], rtol=1e-6)
    np.testing.assert_allclose(found.intensity * found.q, plastic[:, 11], rtol=1e-5, atol=1e-9)
    np.testing.assert_array_equal(found.u, 0.0)
    bare = Unpolarized(albedo=1.0).light({}, geometry, interface)
    np.testing.assert_allclose(bare.intensity, found.intensity, rtol=1e-15)
    np.testing.assert_array_equal(bare.q, 0.0)


def test_a_white_depolarizer_returns_what_enters() -> None:
    """Without absorption all that enters leaves, nearly as from a diffuser, and rho is 0."""
    white = {**MATERIAL, "absorption": jnp.array([0.0])}
    found = Depolarizer().light(white, GEOMETRY, under(SmoothSurface()))
    lambertian = Lambertian(albedo=1.0).light(white, GEOMETRY, under(SmoothSurface()))
    # What absorption at its floor, 1e-4, still takes away, and where the light goes.
    np.testing.assert_allclose(found.intensity, lambertian.intensity, rtol=0.06)
    assert np.all(np.abs(found.q) < 0.06 * np.abs(lambertian.q) + 1e-12)


def test_a_black_depolarizer_keeps_the_polarization_of_the_exit() -> None:
    black = {**MATERIAL, "absorption": jnp.array([1e8])}
    found = Depolarizer().light(black, GEOMETRY, under(SmoothSurface()))
    np.testing.assert_allclose(found.q, under(SmoothSurface()).exit(black, GEOMETRY).q, rtol=1e-7)
    assert np.all(found.intensity < 1e-8)


@pytest.mark.thorough
def test_darker_bodies_are_more_polarized() -> None:
    """Umov's effect, for every absorption that the prior allows."""
    absorption = jnp.geomspace(1e-3, 20.0, 40)[:, None]
    found = Depolarizer().light(
        {**MATERIAL, "absorption": absorption}, GEOMETRY, under(SmoothSurface())
    )
    assert np.all(np.diff(found.intensity, axis=0) < 0.0)
    assert np.all(np.diff(np.abs(found.q[:, 1:]), axis=0) > 0.0)


def test_half_space_agrees_with_the_closed_form_of_the_table(half_space: np.ndarray) -> None:
    """Eight digits of the same closed form, with an interface by Saunderson's sum."""
    n, anisotropy, albedo = half_space[:, :3].T
    reduced = albedo * (1.0 - anisotropy) / (1.0 - albedo * anisotropy)
    absorption = (1.0 - reduced) / reduced
    stack = Stack(jnp.asarray(n))
    entering = stack.hemispherical_transmission()
    behind = 1.0 - entering * body_loss(absorption, stack.escape())
    np.testing.assert_allclose(behind, half_space[:, 6], rtol=1e-7)


@pytest.mark.thorough
def test_half_space_is_near_adding_doubling(half_space: np.ndarray) -> None:
    """Without an interface: the spherical albedo within .002 of the exact one."""
    bare = half_space[half_space[:, 0] == 1.0]
    reduced = bare[:, 2] * (1.0 - bare[:, 1]) / (1.0 - bare[:, 2] * bare[:, 1])
    found = 1.0 - half_space_loss((1.0 - reduced) / reduced)
    np.testing.assert_allclose(found, bare[:, 4], atol=2.1e-3)
