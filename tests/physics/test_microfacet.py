"""Distributions of slopes: every one obeys the same laws."""

import jax.numpy as jnp
import numpy as np
from cases import each

from polar_bayes.physics.microfacet import GGX, Beckmann

DISTRIBUTIONS = each("distribution", [Beckmann(), GGX()], ids=["Beckmann", "GGX"])
NODES, WEIGHTS = np.polynomial.legendre.leggauss(400)
SHARE, WEIGHT = 0.5 * (NODES + 1.0), 0.5 * WEIGHTS


@DISTRIBUTIONS
@each("roughness", [0.01, 0.1, 0.5, 1.5])
def test_facets_cover_the_surface(distribution: Beckmann | GGX, roughness: float) -> None:
    """The integral of D cos(m) over the hemisphere is one."""
    angle = 0.5 * np.pi * SHARE**2
    density = distribution.density(np.tan(angle) ** 2, roughness)
    measure = 2.0 * np.pi * np.sin(angle) * np.cos(angle) * np.pi * SHARE * WEIGHT
    np.testing.assert_allclose(np.sum(density * measure), 1.0, rtol=1e-5)


@DISTRIBUTIONS
def test_sampled_slopes_follow_the_density(distribution: Beckmann | GGX) -> None:
    """The share of facets with slopes in a box, by sampling and by the density."""
    roughness, limit, lower, upper = 0.3, 0.4, -0.1, 0.6
    y, weight_y = distribution.across(jnp.asarray(limit), roughness, SHARE[:, None])
    x, weight_x = distribution.along(jnp.asarray(lower), jnp.asarray(upper), y, roughness, SHARE)
    assert lower < x.min() < x.max() < upper
    sampled = np.sum(weight_y * weight_x * WEIGHT[:, None] * WEIGHT)
    x, y = lower + (upper - lower) * SHARE, limit * SHARE[:, None]
    slope = x**2 + y**2
    # cos(m) dm = cos^4 dx dy
    density = distribution.density(slope, roughness) / (1.0 + slope) ** 2
    box = 2.0 * np.sum(density * WEIGHT * WEIGHT[:, None]) * limit * (upper - lower)
    np.testing.assert_allclose(sampled, box, rtol=1e-6)


@DISTRIBUTIONS
def test_shadowing_keeps_the_projected_area(distribution: Beckmann | GGX) -> None:
    """The seen area of facets is that of the plane: sum of D (v.m)+ = cos / G1.

    Beckmann's G1 is a rational fit, within .6 % of the exact one; GGX's is exact.
    """
    roughness = 0.3
    y, weight_y = distribution.across(jnp.asarray(1e6), roughness, SHARE[:, None])
    for zenith in (0.0, 40.0, 70.0, 85.0):
        tangent = np.tan(np.deg2rad(zenith))
        lower = jnp.asarray(-min(1e6, 1.0 / max(tangent, 1e-9)))
        x, weight_x = distribution.along(lower, jnp.asarray(1e6), y, roughness, SHARE)
        area = np.sum(weight_y * weight_x * WEIGHT[:, None] * WEIGHT * (1.0 + tangent * x))
        found = area * distribution.shadowing(tangent**2, roughness)
        bound = 6e-3 if isinstance(distribution, Beckmann) else 1e-5
        np.testing.assert_allclose(found, 1.0, atol=bound)


@each("dtype", [np.float64, np.float32])
def test_beckmann_never_underflows(dtype: type) -> None:
    density = Beckmann().density(dtype(10.0), dtype(0.001))
    assert 0.0 < density < 1e-20
