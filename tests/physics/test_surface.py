"""Interfaces: limits, reciprocity, and the truth about rough ones."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import UniformSky
from polar_bayes.physics.microfacet import Beckmann
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.surface import RoughSurface

zenith = st.floats(0.0, 89.0)
azimuth = st.floats(0.0, 360.0)
POINT = RoughSurface(Beckmann())
MATERIAL = {"roughness": jnp.array([0.3]), "refractive_index": jnp.array([1.5])}
BARE = Stack(MATERIAL["refractive_index"])


def at(view: float, light: float, difference: float) -> Geometry:
    return Geometry(*(jnp.array([x]) for x in (view, 0.0, light, difference)))


@pytest.mark.thorough
def test_rough_exit_is_near_the_truth(height_field_exit: np.ndarray) -> None:
    """All orders of reflection in a height field change the polarization by up to .011."""
    roughness, zenith_ = height_field_exit[:, 1], height_field_exit[:, 2]
    truth = height_field_exit[:, 5] / height_field_exit[:, 4]
    views = Geometry(*(jnp.asarray(zenith_) for _ in range(4)))
    material = {**MATERIAL, "roughness": jnp.asarray(roughness)}
    found = RoughSurface(Beckmann()).exit(material, views, BARE).q
    bound = np.where(roughness == 0.1, 0.0027, 0.0112)
    assert np.all(np.abs(found - truth) <= bound)


@pytest.mark.thorough
def test_rough_reflection_is_near_the_truth(height_field_sky: np.ndarray) -> None:
    """All orders of reflection in a height field change the polarization by up to .015."""
    rows = height_field_sky[height_field_sky[:, 3] == 0]
    bound = np.where(rows[:, 1] == 0.1, 0.0036, 0.0155)
    views = Geometry(*(jnp.asarray(rows[:, 2]) for _ in range(4)))
    material = {**MATERIAL, "roughness": jnp.asarray(rows[:, 1])}
    light = RoughSurface(Beckmann(), UniformSky()).light(material, views, BARE)
    assert np.all(np.abs(light.q - rows[:, 5] / rows[:, 4]) <= bound)
