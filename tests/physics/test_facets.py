"""The average over facets: what the dial of nodes buys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

from polar_bayes.physics.facets import FacetQuadrature, Microsurface, seen
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import UniformSky
from polar_bayes.physics.microfacet import GGX, Beckmann, SeparableShadowing, SlopeEllipse
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.surface import RoughSurface

ANGLES = np.array([5.0, 25, 40, 50, 57, 65, 75, 80, 85, 89])
ROUGHNESS, INDEX = (
    grid.ravel()[:, None] for grid in np.meshgrid([0.02, 0.05, 0.1, 0.3], [1.3, 1.5])
)
VIEWS = Geometry.from_degrees(
    view_zenith=ANGLES, view_azimuth=180.0, light_zenith=ANGLES, light_azimuth=0.0
)
MATERIAL = {"roughness": jnp.asarray(ROUGHNESS), "refractive_index": jnp.asarray(INDEX)}


def polarization(surface: RoughSurface, views: Geometry) -> np.ndarray:
    """Polarization of reflected light, and of light on its way out."""

    @jax.jit
    def both(material: dict) -> tuple:
        stack = Stack(material["refractive_index"])
        reflected = surface.light(material, views, stack)
        return reflected.q, surface.exit(material, views, stack).q

    return np.stack(both(MATERIAL))


@each("side", [1.0, -1.0], quick=1)
@each("zenith", [80.0, 0.0, 30.0], quick=1)
def test_no_facet_turns_its_back(zenith: float, side: float) -> None:
    view = jnp.array([side * zenith])
    ellipse = SlopeEllipse(jnp.array([0.5]), jnp.array([0.5]), None)
    surface = Microsurface(Beckmann(), SeparableShadowing(), FacetQuadrature(), ellipse)
    facets = surface.sample(Geometry(view, view, view, view), seen)
    assert facets.weight.shape == (30, 1)
    assert np.all(facets.weight > 0.0)
    np.testing.assert_allclose(facets.cos_incidence**2 + facets.sin_squared, 1.0, rtol=1e-13)


@pytest.mark.thorough
@each("distribution", [Beckmann(), GGX()], ids=["Beckmann", "GGX"])
def test_both_sides_of_the_normal_are_alike(distribution: Beckmann | GGX) -> None:
    surface = RoughSurface(distribution, UniformSky())
    left, right = (
        polarization(surface, VIEWS._replace(view_zenith=side * ANGLES)) for side in (1.0, -1.0)
    )
    np.testing.assert_allclose(left, right, atol=1e-12)
