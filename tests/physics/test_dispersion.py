"""Laws of dispersion: against tabulated glasses, and as one index per wavelength."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from optics import directions, predict

from polar_bayes.physics.dispersion import AbstractDispersion, Cauchy, Sellmeier
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.subsurface import Depolarizer
from polar_bayes.physics.surface import RoughSurface

# Schott's data sheet of N-BK7, and Malitson 1965 for fused silica.
BK7 = Sellmeier((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653))
SILICA = Sellmeier((0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2))
COLORS = jnp.array([[450.0], [550.0], [650.0]])
VIEWS = directions([20.0, 55.0, 80.0], 180.0, 50.0, wavelength=COLORS)
MATERIAL = {
    "roughness": 0.2,
    "subsurface_fraction": 0.4,
    "absorption": 0.3,
    "cauchy_a": 1.48,
    "cauchy_b": 0.0052,
    "sellmeier_strength": 1.2,
    "sellmeier_resonance": 0.011,
}
PARTS = (RoughSurface(), Depolarizer(), StokesMixing())


@each(
    ("glass", "wavelength", "index"),
    [
        (BK7, 587.5618, 1.51680),
        (BK7, 486.1327, 1.52238),
        (BK7, 656.2725, 1.51432),
        (SILICA, 587.5618, 1.45846),
        (SILICA, 486.1327, 1.46313),
        (SILICA, 656.2725, 1.45637),
    ],
)
def test_sellmeier_agrees_with_the_tables(glass: Sellmeier, wavelength: float, index: float):
    """Five digits after the point are listed."""
    assert glass.index({}, jnp.asarray(wavelength)) == pytest.approx(index, abs=5.5e-6)


@pytest.mark.thorough
@each("law", [Cauchy(), Sellmeier()], ids=["Cauchy", "Sellmeier"])
def test_a_law_is_one_index_for_each_wavelength(law: AbstractDispersion) -> None:
    index = law.index({k: jnp.asarray(v) for k, v in MATERIAL.items()}, COLORS)[:, 0]
    assert np.all(np.diff(index) < 0.0)
    found = predict(Scene(*PARTS, dispersion=law), MATERIAL, VIEWS)
    free = predict(Scene(*PARTS), {**MATERIAL, "refractive_index": index}, VIEWS)
    for reading, value in found.items():
        assert value.shape == (3, 3)
        np.testing.assert_allclose(value, free[reading], rtol=1e-14)
