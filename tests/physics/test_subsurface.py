"""Bodies: how bright they are, what polarization they keep, and what the interface turns back."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from optics import REFERENCE, directions, light_of, read

from polar_bayes.physics.coat import ClearCoat
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.stokes import Light
from polar_bayes.physics.subsurface import (
    Depolarizer,
    Lambertian,
    Unpolarized,
    body_loss,
    half_space_loss,
)
from polar_bayes.physics.surface import Interface, InternalReflection, SmoothSurface

VIEWS = directions([0.0, 30.0, 60.0, 85.0], 0.0, 20.0, 180.0)
PLANE = Interface(SmoothSurface(), Stack(jnp.array([1.5])))


def depolarized(absorption: float | np.ndarray, **settings: object) -> Light:
    """Light from a depolarizer under a plane."""
    material = {"absorption": jnp.atleast_1d(absorption), "refractive_index": jnp.array([1.5])}
    return Depolarizer(**settings).light(material, VIEWS, PLANE)


def test_lambertian_body_agrees_with_the_renderer() -> None:
    """The renderer's body has a smooth way out. It stores n in single precision: 6e-8."""
    plastic = np.load(REFERENCE / "pplastic.npz")["data"]
    n, view, light, azimuth = plastic[:, [1, 3, 4, 5]].T
    interface = Interface(SmoothSurface(), Stack(jnp.asarray(n)))
    found, bare = (
        kind(albedo=1.0).light({}, directions(view, 0.0, light, azimuth), interface)
        for kind in (Lambertian, Unpolarized)
    )
    np.testing.assert_allclose(found.intensity, plastic[:, 10], rtol=1e-6)
    np.testing.assert_allclose(found.intensity * found.q, plastic[:, 11], rtol=1e-5, atol=1e-9)
    np.testing.assert_array_equal(found.u, 0.0)
    np.testing.assert_allclose(bare.intensity, found.intensity, rtol=1e-15)
    np.testing.assert_array_equal(bare.q, 0.0)


def test_a_white_depolarizer_returns_what_enters() -> None:
    """Without absorption all that enters leaves, nearly as from a diffuser, and rho is 0."""
    found, lambertian = depolarized(0.0), Lambertian(albedo=1.0).light({}, VIEWS, PLANE)
    # What absorption at its floor, 1e-4, still takes away, and where the light goes.
    np.testing.assert_allclose(found.intensity, lambertian.intensity, rtol=0.06)
    assert np.all(np.abs(found.q) < 0.06 * np.abs(lambertian.q) + 1e-12)


def test_a_black_depolarizer_keeps_the_polarization_of_the_exit() -> None:
    black = depolarized(1e8)
    np.testing.assert_allclose(black.q, PLANE.exit({}, VIEWS).q, rtol=1e-7)
    assert np.all(black.intensity < 1e-8)


@pytest.mark.thorough
def test_darker_bodies_are_more_polarized() -> None:
    """Umov's effect, for every absorption that the prior allows."""
    found = depolarized(jnp.geomspace(1e-3, 20.0, 40)[:, None])
    assert np.all(np.diff(found.intensity, axis=0) < 0.0)
    assert np.all(np.diff(np.abs(found.q[:, 1:]), axis=0) > 0.0)


def test_half_space_agrees_with_the_closed_form_of_the_table() -> None:
    """Eight digits of the same closed form, with an interface by Saunderson's sum."""
    n, anisotropy, albedo, _, _, _, behind = read("iad_semiinfinite_albedo.csv")[:7]
    reduced = albedo * (1.0 - anisotropy) / (1.0 - albedo * anisotropy)
    stack = Stack(jnp.asarray(n))
    loss = body_loss((1.0 - reduced) / reduced, stack.escape())
    np.testing.assert_allclose(1.0 - stack.hemispherical_transmission() * loss, behind, rtol=1e-7)


@pytest.mark.thorough
def test_half_space_is_near_adding_doubling() -> None:
    """Without an interface: the spherical albedo within .002 of the exact one."""
    table = read("iad_semiinfinite_albedo.csv")
    _, anisotropy, albedo, _, spherical = table[:5, table[0] == 1.0]
    reduced = albedo * (1.0 - anisotropy) / (1.0 - albedo * anisotropy)
    found = 1.0 - half_space_loss((1.0 - reduced) / reduced)
    np.testing.assert_allclose(found, spherical, atol=2.1e-3)


# --- light that the interface turns back ----------------------------------------------------------


@each("coat", [None, ClearCoat(1.3, 0.0), ClearCoat(1.9, 0.0)], ids=str)
def test_a_white_body_returns_all_that_enters(coat: ClearCoat | None) -> None:
    """Reflected and returned light together are the light, whatever clear coat there is.

    The body's light is alike in all directions inside, so that its share is T+(l).
    """
    node, weight = np.polynomial.legendre.leggauss(120)
    cosine = (0.5 * (node + 1.0)) ** 2
    measure = 2.0 * np.pi * cosine * 0.5 * (node + 1.0) * weight
    geometry = directions(np.rad2deg(np.arccos(cosine)), 180.0, 65.0)
    white = Lambertian(1.0, InternalReflection())
    scene = Scene(SmoothSurface(), white, StokesMixing(), coat=coat)
    below = light_of(scene, {"refractive_index": 1.5, "subsurface_fraction": 1.0}, geometry)
    returned = np.sum(below.intensity * measure) / np.cos(np.deg2rad(65.0))
    mirror = directions(65.0, 180.0, 65.0)
    above = light_of(Scene(SmoothSurface(), coat=coat), {"refractive_index": 1.5}, mirror)
    np.testing.assert_allclose(returned + above.intensity[0], 1.0, atol=1e-8)


def test_without_it_a_depolarizer_keeps_what_a_half_space_loses() -> None:
    once, all_trips = depolarized(0.3, internal_reflection=None), depolarized(0.3)
    lost = half_space_loss(jnp.array([0.3]))
    np.testing.assert_allclose(once.q, lost * PLANE.exit({}, VIEWS).q, rtol=1e-14)
    # Light that is turned back is scattered again: brighter and less polarized.
    assert np.all(all_trips.intensity > once.intensity)
