"""Facets as a population: their density, shares of them that are hidden or seen, and sums."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vector_optics as twin
from cases import each
from optics import DISTRIBUTIONS, directions, light_of

from polar_bayes.physics.facets import FacetQuadrature, Microsurface, seen
from polar_bayes.physics.geometry import Geometry, mirror_facet
from polar_bayes.physics.illumination import UniformSky
from polar_bayes.physics.microfacet import (
    AbstractShadowing,
    AnisotropicSlopes,
    HeightCorrelatedShadowing,
    NoShadowing,
    SeparableShadowing,
    SlopeEllipse,
)
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.surface import RoughSurface

named = each("name", DISTRIBUTIONS)
GLOSSY = {"roughness": 0.4, "refractive_index": 1.5}


def surface(name: str, ellipse: SlopeEllipse) -> Microsurface:
    return Microsurface(DISTRIBUTIONS[name], SeparableShadowing(), FacetQuadrature(), ellipse)


def roughness(along: float, across: float) -> dict:
    return {"roughness": jnp.asarray(along), "roughness_across": jnp.asarray(across)}


@named
@each(("along", "across"), [(0.3, 0.3), (0.4, 0.1), (0.1, 1.0)])
def test_facets_cover_the_surface(name: str, along: float, across: float) -> None:
    """The integral of D cos(m) over the hemisphere is one, grooves or not."""
    node, weight = np.polynomial.legendre.leggauss(200)
    angle, turn = np.meshgrid(0.25 * np.pi * (node + 1.0), 1.2 * (np.arange(300) + 0.5))
    zenith = np.rad2deg(angle)
    geometry = directions(zenith, turn, zenith, turn)  # the mirror facet looks where both are
    ellipse = AnisotropicSlopes(35.0).ellipse(roughness(along, across), geometry)
    tilt = mirror_facet(geometry).tan_squared_tilt
    density = surface(name, ellipse).density(geometry, tilt)
    measure = np.sin(angle) * np.cos(angle) * 0.25 * np.pi * weight * 2.0 * np.pi / 300
    np.testing.assert_allclose(np.sum(density * measure), 1.0, rtol=1e-6)


@named
def test_density_of_grooves_agrees_with_vectors(name: str) -> None:
    """Between any two directions: the facet looks half-way. Beckmann's floor is far below 1e-30."""
    generator = np.random.default_rng(4)
    view = np.array([generator.uniform(0, 85, 50), generator.uniform(-180, 180, 50)])
    light = np.array([generator.uniform(0, 85, 50), generator.uniform(-180, 180, 50)])
    rays = np.array([[twin.ray(*v), twin.ray(*s)] for v, s in zip(view.T, light.T, strict=True)])
    half = rays.sum(axis=1)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    population = twin.Population(name, 0.4, 0.15, 35.0, steps=2)
    geometry = Geometry(*(jnp.asarray(x) for x in (*view, *light)))
    ellipse = AnisotropicSlopes(35.0).ellipse(roughness(0.4, 0.15), geometry)
    found = surface(name, ellipse).density(geometry, mirror_facet(geometry).tan_squared_tilt)
    np.testing.assert_allclose(found, population.density(half), rtol=1e-9, atol=1e-30)


@named
def test_visible_shares_of_grooves_agree_with_vectors(name: str) -> None:
    """A direction meets the roughness of its own azimuth."""
    generator = np.random.default_rng(5)
    zenith, azimuth = generator.uniform(0, 89, 60), generator.uniform(-180, 180, 60)
    rays = np.array([twin.ray(*pair) for pair in zip(zenith, azimuth, strict=True)])
    population = twin.Population(name, 0.6, 0.1, 35.0, steps=2)
    viewer = directions(50.0, -20.0, 0.0)
    ellipse = AnisotropicSlopes(35.0).ellipse(roughness(0.6, 0.1), viewer)
    turn = np.deg2rad(azimuth + 20.0)
    tangent = np.tan(np.deg2rad(zenith))
    found = surface(name, ellipse).visible(tangent * np.cos(turn), tangent * np.sin(turn))
    np.testing.assert_allclose(found, population.visible(rays), rtol=1e-12)


@each("side", [1.0, -1.0], quick=1)
@each("zenith", [80.0, 0.0, 30.0], quick=1)
def test_no_facet_turns_its_back(zenith: float, side: float) -> None:
    view = jnp.array([side * zenith])
    ellipse = SlopeEllipse(jnp.array([0.5]), jnp.array([0.5]), None)
    facets = surface("Beckmann", ellipse).sample(Geometry(view, view, view, view), seen)
    assert facets.weight.shape == (30, 1)
    assert np.all(facets.weight > 0.0)
    np.testing.assert_allclose(facets.cos_incidence**2 + facets.sin_squared, 1.0, rtol=1e-13)


@pytest.mark.thorough
@named
def test_both_sides_of_the_normal_are_alike(name: str) -> None:
    """Light reflected under a sky, and light on its way out."""
    angles = np.array([5.0, 25, 40, 50, 57, 65, 75, 80, 85, 89])
    rough, index = (x.reshape(-1, 1) for x in np.meshgrid([0.02, 0.05, 0.1, 0.3], [1.3, 1.5]))
    material, stack = {"roughness": jnp.asarray(rough)}, Stack(jnp.asarray(index))
    sky = RoughSurface(DISTRIBUTIONS[name], UniformSky())

    @jax.jit
    def polarization(views: Geometry) -> tuple:
        return sky.light(material, views, stack).q, sky.exit(material, views, stack).q

    left, right = (polarization(directions(side * angles, 180.0, angles)) for side in (1.0, -1.0))
    np.testing.assert_allclose(left, right, atol=1e-12)


# --- shadowing and masking: exact values are among the hard cases ---------------------------------


@pytest.mark.thorough
@named
def test_the_rules_order_the_brightness_of_a_surface_and_leave_its_polarization(name: str) -> None:
    zeniths, azimuths = [10.0, 60.0, 85.0], [180.0, 150.0, 180.0]
    views = directions(zeniths, azimuths, [10.0, 50.0, 85.0])
    rules = (SeparableShadowing(), HeightCorrelatedShadowing(), NoShadowing())
    light = [
        light_of(Scene(RoughSurface(DISTRIBUTIONS[name], shadowing=rule)), GLOSSY, views)
        for rule in rules
    ]
    separable, correlated, nothing = (one.intensity for one in light)
    assert np.all(separable <= correlated)
    assert np.all(correlated <= nothing)
    assert separable[2] < 0.9 * correlated[2] < 0.9 * nothing[2]
    for one in light[1:]:
        np.testing.assert_allclose(one.q, light[0].q, rtol=1e-14)


def test_a_rule_of_your_own_serves_every_source() -> None:
    class HalfHidden(AbstractShadowing):
        def both(self, view, light):
            return 0.5 * jnp.ones_like(view * light)

    half, whole = (
        Scene(RoughSurface(shadowing=rule)).light(GLOSSY, directions(40.0, 180.0, 40.0)).intensity
        for rule in (HalfHidden(), NoShadowing())
    )
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-15)
