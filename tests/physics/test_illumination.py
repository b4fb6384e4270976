"""Points, discs and skies against a renderer and against brute force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from optics import REFERENCE, directions, light_of, mirrored_at, read, stokes_of

from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import Disc, PointSource, SunAndSky, UniformSky
from polar_bayes.physics.microfacet import GGX, Beckmann
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.subsurface import TurbidMedium
from polar_bayes.physics.surface import (
    AbstractExit,
    RoughExit,
    RoughPassage,
    RoughSurface,
    SmoothSurface,
)

PLASTIC = np.load(REFERENCE / "pplastic.npz")["data"]
UNIFORM_SKY = read("mitsuba_uniform_sky.csv").T
DISC_SOURCE = read("mitsuba_disc_source.csv").T
DISTRIBUTIONS = each(
    ("code", "distribution"), [(0, Beckmann()), (1, GGX())], ids=["Beckmann", "GGX"]
)


@DISTRIBUTIONS
def test_point_source_agrees_with_the_renderer(code: int, distribution: Beckmann | GGX) -> None:
    """1e-6 of the peak allows for the renderer's index in single precision (6e-8 of n)."""
    rows = PLASTIC[PLASTIC[:, 0] == code]
    n, roughness, view, light, azimuth = rows[:, 1:6].T
    geometry = Geometry(*(x[:, None] for x in (view, 0.0 * view, light, azimuth)))
    material = {"roughness": roughness, "refractive_index": n}
    stokes = np.asarray(stokes_of(Scene(RoughSurface(distribution)), material, geometry))[:, 0]
    for pair in np.unique(rows[:, 1:3], axis=0):
        chosen = np.all(rows[:, 1:3] == pair, axis=1)
        gap = np.abs(stokes[chosen] - rows[chosen, 6:9])
        assert np.max(gap) <= 1e-6 * np.max(rows[chosen, 6])
    # In intensity the agreement is relative, down to 1e-20 of the peak.
    lit = rows[:, 6] > 1e-20 * np.max(rows[:, 6])
    np.testing.assert_allclose(stokes[lit, 0], rows[lit, 6], rtol=5e-6)


@DISTRIBUTIONS
def test_uniform_sky_agrees_with_the_renderer(code: int, distribution: Beckmann | GGX) -> None:
    """The table, of 160 x 160 facets, is good to 2.2e-5; the default of 30 facets to 4e-4."""
    rows = UNIFORM_SKY[UNIFORM_SKY[:, 0] == code]
    material = {"roughness": rows[:, 2], "refractive_index": rows[:, 1]}
    polarization = rows[:, 5] / rows[:, 4]
    for quadrature, bound, bound_intensity in (
        (FacetQuadrature(), 4e-4, 1e-3),
        (FacetQuadrature(20, 20), 3e-5, 4e-5),
    ):
        surface = RoughSurface(distribution, UniformSky(), quadrature)
        light = light_of(Scene(surface), material, mirrored_at(rows[:, 3]))
        np.testing.assert_allclose(light.q[:, 0], polarization, atol=bound)
        np.testing.assert_allclose(light.intensity[:, 0], rows[:, 4], rtol=bound_intensity)


@DISTRIBUTIONS
@each("half_width", [1.0, 5.0, 15.0])
def test_disc_agrees_with_the_renderer(code, distribution, half_width) -> None:
    """Where the disc is above the horizon and not far wider than the slopes of the surface.

    The table is in single precision and loses light beyond: see the brute-force test below.
    """
    chosen = (DISC_SOURCE[:, 0] == code) & (DISC_SOURCE[:, 4] == half_width)
    rows = DISC_SOURCE[chosen & (DISC_SOURCE[:, 3] <= 60.0)]
    material = {"roughness": rows[:, 2], "refractive_index": rows[:, 1]}
    surface = RoughSurface(distribution, Disc(half_width))
    light = light_of(Scene(surface), material, mirrored_at(rows[:, 3]))
    np.testing.assert_allclose(light.q[:, 0], rows[:, 6] / rows[:, 5], atol=3e-4)
    np.testing.assert_allclose(light.intensity[:, 0], rows[:, 5], rtol=1e-3)


@pytest.mark.thorough
@each(("zenith", "half_width"), [(60.0, 5.0), (85.0, 15.0), (30.0, 15.0)])
def test_disc_agrees_with_brute_force(zenith: float, half_width: float) -> None:
    """A sum of point sources over the disc, 600 x 600 directions, cut at the horizon."""
    steps = 600
    angle = np.deg2rad(half_width) * (np.arange(steps) + 0.5)[:, None] / steps
    turn = np.pi * (np.arange(steps) + 0.5) / steps
    solid_angle = (2.0 * np.pi * np.deg2rad(half_width) / steps**2) * np.sin(angle)
    sine, cosine = np.sin(np.deg2rad(zenith)), np.cos(np.deg2rad(zenith))
    z = np.cos(angle) * cosine + np.sin(angle) * np.cos(turn) * sine
    x = -np.cos(angle) * sine + np.sin(angle) * np.cos(turn) * cosine
    y = np.sin(angle) * np.sin(turn)
    above = z > 1e-6
    directions = {
        "light_zenith": np.rad2deg(np.arccos(z[above])),
        "light_azimuth": np.rad2deg(np.arctan2(y, x)[above]),
    }
    geometry = Geometry.from_degrees(view_zenith=zenith, view_azimuth=0.0, **directions)
    material = {"roughness": 0.05, "refractive_index": 1.5}
    points = stokes_of(Scene(RoughSurface(Beckmann(), PointSource())), material, geometry)
    weight = (solid_angle + 0.0 * z)[above][:, None]
    total = np.sum(points * weight, axis=0)
    surface = RoughSurface(Beckmann(), Disc(half_width), FacetQuadrature(30, 30))
    found = stokes_of(Scene(surface), material, mirrored_at(np.array([zenith])))[0, 0]
    np.testing.assert_allclose(found[0], total[0], rtol=3e-4)
    np.testing.assert_allclose(found[1] / found[0], total[1] / total[0], atol=1e-4)


@pytest.mark.thorough
def test_light_entering_agrees_with_the_renderer() -> None:
    """The body's brightness through a smooth interface, albedo 1, divided by the way out.

    2e-5 to 87 degrees is the tables' own step in angle; at 89 they are 2.5e-4 off.
    """
    for source, rows, brightness in (
        (UniformSky(), UNIFORM_SKY, 7),
        *((Disc(w), DISC_SOURCE[DISC_SOURCE[:, 4] == w], 8) for w in (1.0, 5.0)),
    ):
        rows = rows[rows[:, 3] <= 82.5]
        n, geometry = jnp.asarray(rows[:, 1:2]), mirrored_at(rows[:, 3])
        entering = source.entering(Stack(n), geometry, {})
        leaving = SmoothSurface().exit({}, geometry, Stack(n))
        found = (entering.intensity * leaving.intensity)[:, 0] / np.pi
        np.testing.assert_allclose(found, rows[:, brightness], rtol=2e-5)
        polarization = rows[:, brightness + 1] / rows[:, brightness]
        np.testing.assert_allclose(leaving.q[:, 0], polarization, atol=1e-6)


def test_a_small_disc_is_a_point() -> None:
    """Per solid angle, for a surface rougher than the disc is wide."""
    material = {"roughness": 0.2, "refractive_index": 1.5}
    geometry = mirrored_at(np.array([20.0, 50.0, 70.0]))
    point = stokes_of(Scene(RoughSurface(Beckmann(), PointSource())), material, geometry)
    disc = stokes_of(Scene(RoughSurface(Beckmann(), Disc(0.1))), material, geometry)
    solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.deg2rad(0.1)))
    # The source's radiance is spread over its solid angle, so irradiance is cosine-weighted.
    np.testing.assert_allclose(disc / solid_angle, point, rtol=1e-4, atol=1e-9)


@each("way_out", [RoughExit(), RoughPassage()], quick=1)
def test_sun_and_sky_light_surface_and_body_together(way_out: AbstractExit) -> None:
    """Stokes vectors of both, of a body that asks where its light comes from."""
    views = directions([0.0, 50.0, 80.0], 180.0, 40.0, 20.0)
    material = {"roughness": 0.2, "subsurface_fraction": 0.4, "refractive_index": 1.5}
    material |= {"absorption": 0.3, "sky_radiance": 0.07}
    scenes = [
        Scene(
            RoughSurface(GGX(), light, FacetQuadrature(3, 2), way_out=way_out),
            TurbidMedium(0.5),
            StokesMixing(),
        )
        for light in (PointSource(), UniformSky(), SunAndSky("sky_radiance"))
    ]
    sun, sky, both = jax.jit(lambda given: [each.stokes(given, views) for each in scenes])(material)
    np.testing.assert_allclose(both, sun + 0.07 * sky, rtol=1e-12)
