"""Roughness by direction: its limits, its symmetries, and brute force over all slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vector_optics as twin
from cases import each
from optics import DISTRIBUTIONS, GROOVED, directions, stokes_of

from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import Disc, PointSource, UniformSky
from polar_bayes.physics.microfacet import GGX, HeightCorrelatedShadowing, IsotropicSlopes
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.subsurface import Lambertian
from polar_bayes.physics.surface import RoughSurface


def scene(source: object, slopes: object, distribution: object = None) -> Scene:
    """Surface and body, so that the way out is seen, too."""
    surface = RoughSurface(distribution or GGX(), source, slopes=slopes)
    return Scene(surface, Lambertian(0.5), StokesMixing())


SOURCES = each(
    "source", [PointSource(), Disc(20.0), UniformSky()], ids=["point", "disc", "sky"], quick=1
)


def seen(turn: float = 0.0, sign: float = 1.0) -> Geometry:
    """The views turned about the normal, or mirrored at the plane of azimuth 0."""
    view_azimuth, light_azimuth = np.array([[0.0, 20, -70, 160], [180.0, 230, 100, 10]])
    zeniths = [0.0, 30.0, 60.0, 80.0], [10.0, 40.0, 60.0, 80.0]
    return directions(
        zeniths[0], sign * view_azimuth + turn, zeniths[1], sign * light_azimuth + turn
    )


def material(along: float, across: float, turn: float = 0.0) -> dict[str, float]:
    return {
        "roughness": along,
        "roughness_across": across,
        "roughness_azimuth": turn,
        "refractive_index": 1.5,
        "subsurface_fraction": 0.3,
    }


@pytest.mark.thorough
@each(
    ("source", "name"),
    [(PointSource(), "Beckmann"), (Disc(20.0), "GGX"), (UniformSky(), "GGX")],
    ids=["point", "disc", "sky"],
)
def test_equal_roughnesses_are_isotropic(source: object, name: str) -> None:
    """Averages take other facets in the grooves' frame, each within its error."""
    same = material(0.3, 0.3, 37.0)
    both, one = (
        stokes_of(scene(source, slopes, DISTRIBUTIONS[name]), same, seen())
        for slopes in (GROOVED, IsotropicSlopes())
    )
    np.testing.assert_allclose(both[:, 0], one[:, 0], rtol=3e-3)
    np.testing.assert_allclose(both[:, 1:] / one[:, :1], one[:, 1:] / one[:, :1], atol=3e-3)


@SOURCES
def test_turned_grooves_have_the_other_roughness_and_mirrored_ones_the_other_sign_of_u(source):
    found = scene(source, GROOVED)
    here = stokes_of(found, material(0.4, 0.15, 25.0), seen())
    turned = stokes_of(found, material(0.15, 0.4, 115.0), seen())
    np.testing.assert_allclose(turned, here, rtol=1e-11, atol=1e-14)
    image = stokes_of(found, material(0.4, 0.15, -25.0), seen(sign=-1.0))
    np.testing.assert_allclose(image, here * np.array([1.0, 1.0, -1.0]), rtol=1e-11, atol=1e-14)
    assert np.max(np.abs(here[:, 2] / here[:, 0])) > 0.01


GROOVES = [(0.3, 0.1, 20.0), (0.1, 0.4, -50.0), (0.5, 0.05, 90.0)]
"""Roughness along, across, and its azimuth; the last are ten times as steep."""


@pytest.mark.thorough
@each("name", DISTRIBUTIONS)
def test_sky_and_way_out_agree_with_brute_force(name: str) -> None:
    """360,000 facets by vectors, to 1e-5, against 30 x 30; and what the default costs."""
    rows = np.array([(*grooves, view) for grooves in GROOVES for view in (20.0, 60.0, 82.0)])
    along, across, turn, view = (jnp.asarray(column)[:, None] for column in rows.T)
    geometry = Geometry(view, jnp.full_like(view, 30.0), view, jnp.zeros_like(view))
    parameters = {"roughness": along, "roughness_across": across, "roughness_azimuth": turn}
    stack = Stack(jnp.array([1.5]))
    skies, exits = [], []
    for row in rows:
        population = twin.Population(name, *row[:3], steps=600)
        skies.append(population.sky(row[3], 30.0, 1.5, correlated=True))
        exits.append(population.way_out(row[3], 30.0, 1.5))
    stated = 3e-3 if name == "GGX" else 1e-3
    for quadrature, bright, polarized in (
        (FacetQuadrature(30, 30), 2e-5, 5e-6),
        (FacetQuadrature(), 2.0 * stated, stated),
    ):
        surface = RoughSurface(
            DISTRIBUTIONS[name], UniformSky(), quadrature, GROOVED, HeightCorrelatedShadowing()
        )
        mirrored, leaving = jax.jit(
            lambda p, surface=surface: (
                surface.light(p, geometry, stack),
                surface.exit(p, geometry, stack),
            )
        )(parameters)
        for light, truth in ((mirrored, np.array(skies)), (leaving, np.array(exits))):
            total, q, u = (truth[:, i : i + 1] for i in range(3))
            assert np.all(np.abs(light.intensity / total - 1.0) <= bright)
            assert np.all(np.abs(light.q - q / total) <= polarized)
            assert np.all(np.abs(light.u - u / total) <= polarized)


@pytest.mark.thorough
@each("name", DISTRIBUTIONS)
def test_the_default_serves_steep_grooves_from_any_side(name: str) -> None:
    """A slope ratio of 20, where nodes in the viewer's frame were off by .07 in q and u."""
    views = jnp.array([20.0, 40.0, 56.0, 70.0, 80.0])
    turns = jnp.array([0.0, 15.0, 30.0, 60.0, 90.0])[:, None]
    geometry = Geometry(*jnp.broadcast_arrays(views, 0.0, views, 180.0))
    parameters = material(0.02, 0.4) | {"roughness_azimuth": turns}
    stack = Stack(jnp.array([1.5]))

    def light(quadrature: FacetQuadrature) -> list:
        surface = RoughSurface(DISTRIBUTIONS[name], UniformSky(), quadrature, GROOVED)
        return [
            surface.light(parameters, geometry, stack),
            surface.exit(parameters, geometry, stack),
        ]

    both = jax.jit(lambda: (light(FacetQuadrature()), light(FacetQuadrature(24, 24))))()
    stated = 3e-3 if name == "GGX" else 1e-3
    for found, truth in zip(*both, strict=True):
        np.testing.assert_allclose(found.q, truth.q, atol=stated)
        np.testing.assert_allclose(found.u, truth.u, atol=stated)
        np.testing.assert_allclose(found.intensity, truth.intensity, rtol=2.0 * stated)


@each("name", DISTRIBUTIONS)
@each("slopes", [IsotropicSlopes(), GROOVED], ids=["isotropic", "grooves"], quick=1)
def test_facets_of_a_smooth_surface_sum_to_one(name: str, slopes: object) -> None:
    """Under a sky a surface as smooth as can be is a mirror; nodes of GGX were .0015 short."""
    views = jnp.array([0.0, 30.0, 56.0, 80.0])
    geometry = Geometry(*jnp.broadcast_arrays(views, 20.0, views, 200.0))
    found = RoughSurface(DISTRIBUTIONS[name], UniformSky(), slopes=slopes)
    stack = Stack(jnp.array([1.5]))
    smooth = {key: jnp.asarray(value) for key, value in material(0.0, 0.0).items()}
    light = jax.jit(found.light)(smooth, geometry, stack)
    cosine, square = jnp.cos(jnp.deg2rad(views)), jnp.sin(jnp.deg2rad(views)) ** 2
    bound = 2e-5 if name == "GGX" else 2e-4
    np.testing.assert_allclose(light.intensity, stack.reflection(cosine, square).mean, rtol=bound)
