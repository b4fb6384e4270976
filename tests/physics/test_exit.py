"""The way out of the body: through a plane, through facets, and the one as the other's limit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from textbook import mirror_and_body

from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.microfacet import AnisotropicSlopes
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Layer, Stack
from polar_bayes.physics.subsurface import Lambertian
from polar_bayes.physics.surface import RoughExit, RoughSurface, SmoothExit, SmoothSurface

ZENITHS = jnp.array([0.0, 30.0, 60.0, 80.0])
VIEWS = Geometry(ZENITHS, jnp.full(4, 20.0), ZENITHS, jnp.full(4, 200.0))
MATERIAL = {"roughness": jnp.array([0.3]), "roughness_across": jnp.array([0.1])}
BARE = Stack(jnp.array([1.5]))
COATED = Stack(jnp.array([1.5]), (Layer(jnp.array([1.4]), jnp.array([0.2])),))
stacks = each("stack", [BARE, COATED], ids=["bare", "coated"])


def test_through_a_plane_it_is_fresnels_law() -> None:
    leaving = SmoothSurface().exit(MATERIAL, VIEWS, BARE)
    s, p, _ = mirror_and_body(np.array(1.5), np.deg2rad(ZENITHS))
    np.testing.assert_allclose(leaving.intensity, 1.0 - 0.5 * (s + p), rtol=1e-13)
    np.testing.assert_allclose(leaving.q, -(s - p) / (2.0 - s - p), rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(leaving.u, 0.0)


@pytest.mark.thorough
@stacks
def test_a_smooth_way_out_of_a_rough_surface_is_that_of_a_plane(stack: Stack) -> None:
    plane = SmoothSurface().exit(MATERIAL, VIEWS, stack)
    for slopes in (RoughSurface().slopes, AnisotropicSlopes(30.0)):
        rough = RoughSurface(slopes=slopes, way_out=SmoothExit()).exit(MATERIAL, VIEWS, stack)
        jax.tree.map(np.testing.assert_array_equal, rough, plane)


@pytest.mark.thorough
@stacks
def test_a_rough_way_out_tends_to_the_plane(stack: Stack) -> None:
    """Its difference falls with the square of the roughness."""
    plane = SmoothSurface().exit(MATERIAL, VIEWS, stack)
    gaps = []
    for roughness in (0.02, 0.01):
        smoother = {name: jnp.array([roughness]) for name in MATERIAL}
        leaving = RoughSurface().exit(smoother, VIEWS, stack)
        gaps.append(np.abs(leaving.q - plane.q)[1:])
    np.testing.assert_allclose(gaps[0], 4.0 * gaps[1], rtol=0.05)
    assert np.max(gaps[1]) < 3e-4


@stacks
@each("way_out", [RoughExit(), SmoothExit()], ids=["rough", "smooth"])
def test_no_more_leaves_than_there_is_and_it_is_polarized_along_the_plane(
    way_out: object, stack: Stack
) -> None:
    leaving = RoughSurface(way_out=way_out).exit(MATERIAL, VIEWS, stack)
    assert np.all(leaving.intensity > 0.0)
    assert np.all(leaving.intensity < 1.0)
    assert np.all(leaving.q[1:] < 0.0)
    assert np.all(np.hypot(leaving.q, leaving.u) < 1.0)
    np.testing.assert_allclose(leaving.q[0], 0.0, atol=1e-3)


def test_grooves_polarize_even_towards_the_normal() -> None:
    """More than an isotropic surface can; the axis follows the grooves."""
    for turn, sign in ((20.0, 1.0), (110.0, -1.0)):
        surface = RoughSurface(slopes=AnisotropicSlopes(turn))
        leaving = surface.exit({**MATERIAL, "roughness": jnp.array([0.5])}, VIEWS, BARE)
        assert sign * leaving.q[0] < -3e-3
        np.testing.assert_allclose(leaving.u[0], 0.0, atol=1e-12)


def test_a_scene_takes_its_way_out_from_the_surface() -> None:
    parameters = {"roughness": 0.4, "subsurface_fraction": 1.0, "refractive_index": 1.5}
    plane, smooth, rough = (
        Scene(surface, Lambertian(), StokesMixing()).light(parameters, VIEWS)
        for surface in (SmoothSurface(), RoughSurface(way_out=SmoothExit()), RoughSurface())
    )
    np.testing.assert_allclose(smooth.q, plane.q, rtol=1e-12, atol=1e-16)
    assert np.all(np.abs(rough.q[1:]) < np.abs(smooth.q[1:]))


@pytest.mark.thorough
def test_only_the_rough_way_out_has_something_simpler() -> None:
    assert RoughExit().simpler() == (SmoothExit(),)
    assert SmoothExit().simpler() == ()
