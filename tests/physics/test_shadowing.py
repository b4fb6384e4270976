"""Shadowing and masking: bounds, order, and the case in which one direction sees everything."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from hypothesis import settings
from hypothesis import strategies as st

from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.microfacet import (
    GGX,
    AbstractShadowing,
    Beckmann,
    HeightCorrelatedShadowing,
    NoShadowing,
    SeparableShadowing,
)
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.surface import RoughSurface

RUN = settings(deadline=None, max_examples=80, derandomize=True)
share = st.floats(1e-6, 1.0)
RULES = (SeparableShadowing(), HeightCorrelatedShadowing(), NoShadowing())


@pytest.mark.thorough
@each("distribution", [Beckmann(), GGX()], ids=["Beckmann", "GGX"])
def test_the_rules_order_the_brightness_of_a_surface_and_leave_its_polarization(
    distribution: Beckmann | GGX,
) -> None:
    views = Geometry.from_degrees(
        view_zenith=[10.0, 60.0, 85.0],
        view_azimuth=[180.0, 150.0, 180.0],
        light_zenith=[10.0, 50.0, 85.0],
        light_azimuth=0.0,
    )
    material = {"roughness": 0.4, "refractive_index": 1.5}
    light = [
        Scene(RoughSurface(distribution, shadowing=rule)).light(material, views) for rule in RULES
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

    views = Geometry.from_degrees(
        view_zenith=40.0, view_azimuth=180.0, light_zenith=40.0, light_azimuth=0.0
    )
    material = {"roughness": 0.4, "refractive_index": 1.5}
    half, whole = (
        Scene(RoughSurface(shadowing=rule)).light(material, views).intensity
        for rule in (HalfHidden(), NoShadowing())
    )
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-15)
