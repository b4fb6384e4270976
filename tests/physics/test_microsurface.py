"""Facets as a population: their density covers the surface, their shares are those of vectors."""

import jax.numpy as jnp
import numpy as np
import vector_optics as twin
from cases import each

from polar_bayes.physics.facets import FacetQuadrature, Microsurface
from polar_bayes.physics.geometry import Geometry, mirror_facet
from polar_bayes.physics.microfacet import (
    GGX,
    AnisotropicSlopes,
    Beckmann,
    SeparableShadowing,
    SlopeEllipse,
)

DISTRIBUTIONS = {"Beckmann": Beckmann(), "GGX": GGX()}
named = each("name", DISTRIBUTIONS)


def surface(
    name: str, ellipse: SlopeEllipse, quadrature: FacetQuadrature | None = None
) -> Microsurface:
    rule = quadrature or FacetQuadrature()
    return Microsurface(DISTRIBUTIONS[name], SeparableShadowing(), rule, ellipse)


def roughness(along: float, across: float) -> dict:
    return {"roughness": jnp.asarray(along), "roughness_across": jnp.asarray(across)}


def towards(rays: np.ndarray) -> Geometry:
    """Viewer and light in one direction, so that the mirror facet looks there."""
    zenith = jnp.rad2deg(jnp.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2]))
    azimuth = jnp.rad2deg(jnp.arctan2(rays[..., 1], rays[..., 0]))
    return Geometry(zenith, azimuth, zenith, azimuth)


@named
@each(("along", "across"), [(0.3, 0.3), (0.4, 0.1), (0.1, 1.0)])
def test_facets_cover_the_surface(name: str, along: float, across: float) -> None:
    """The integral of D cos(m) over the hemisphere is one, grooves or not."""
    node, weight = np.polynomial.legendre.leggauss(200)
    angle = 0.25 * np.pi * (node + 1.0)
    turn = 2.0 * np.pi * (np.arange(300) + 0.5) / 300
    angle, turn = np.meshgrid(angle, turn)
    rays = np.stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1
    )
    geometry = towards(rays)
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
    viewer = Geometry.from_degrees(
        view_zenith=50.0, view_azimuth=-20.0, light_zenith=0.0, light_azimuth=0.0
    )
    ellipse = AnisotropicSlopes(35.0).ellipse(roughness(0.6, 0.1), viewer)
    turn = np.deg2rad(azimuth + 20.0)
    tangent = np.tan(np.deg2rad(zenith))
    found = surface(name, ellipse).visible(tangent * np.cos(turn), tangent * np.sin(turn))
    np.testing.assert_allclose(found, population.visible(rays), rtol=1e-12)
