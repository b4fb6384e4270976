"""The named scenes: what they read, and that their few facets are enough."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from optics import directions

from polar_bayes.physics.facets import FacetQuadrature
from polar_bayes.physics.scene import SCENES

ZENITHS = np.linspace(2.0, 85.0, 43)


@pytest.mark.thorough
@each("name", ["paper", "camera"])
def test_twenty_facets_are_as_good_as_four_hundred(name: str) -> None:
    """The errors stated in `scenes.py`: far below the noise of any reading."""
    scene = SCENES[name]
    fine = dataclasses.replace(
        scene,
        surface=dataclasses.replace(scene.surface, quadrature=FacetQuadrature(along=20, across=20)),
    )
    geometry = directions(ZENITHS, 150.0, 45.0)

    def predict(scene, roughness):
        parameters = {
            "roughness": roughness,
            "subsurface_fraction": 0.4,
            "absorption": 0.5,
            "refractive_index": jnp.array([1.35, 1.5, 1.65]),
            "dolp_gain": 1.0,
        }
        return scene.predict(parameters, geometry)

    for roughness in (0.03, 0.1, 0.2, 0.3, 0.5):
        few, many = (jax.jit(predict, static_argnums=0)(s, roughness) for s in (scene, fine))
        np.testing.assert_allclose(few["dop"], many["dop"], atol=0.0005)
        np.testing.assert_allclose(few["intensity"], many["intensity"], rtol=0.0015)
