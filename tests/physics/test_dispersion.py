"""Laws of dispersion: against tabulated glasses, and as one index per wavelength."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each

from polar_bayes.errors import SceneError
from polar_bayes.physics.dispersion import AbstractDispersion, Cauchy, Sellmeier
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.subsurface import Depolarizer
from polar_bayes.physics.surface import RoughSurface, SmoothSurface

# Schott's data sheet of N-BK7, and Malitson 1965 for fused silica.
BK7 = Sellmeier((1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653))
SILICA = Sellmeier((0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2))
COLORS = jnp.array([[450.0], [550.0], [650.0]])
VIEWS = Geometry.from_degrees(
    view_zenith=[20.0, 55.0, 80.0],
    view_azimuth=180.0,
    light_zenith=50.0,
    light_azimuth=0.0,
    wavelength=COLORS,
)
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
predict = jax.jit(Scene.predict, static_argnums=0)


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


def test_cauchy_is_near_a_glass_over_the_visible() -> None:
    """1.5046 + .0042/lambda^2 is what textbooks give for BK7."""
    colors = jnp.linspace(400.0, 700.0, 31)
    found = Cauchy(1.5046, 0.0042).index({}, colors)
    np.testing.assert_allclose(found, BK7.index({}, colors), atol=4e-4)


@pytest.mark.thorough
def test_cauchy_is_a_polynomial_in_the_inverse_square() -> None:
    found = Cauchy(1.45, 0.004, 1e-4).index({}, jnp.array([400.0, 500.0, 1000.0]))
    expected = [1.45 + 0.004 / x**2 + 1e-4 / x**4 for x in (0.4, 0.5, 1.0)]
    np.testing.assert_allclose(found, expected, rtol=1e-15)
    without = Cauchy(1.45, 0.004).index({}, jnp.array([400.0]))
    np.testing.assert_allclose(without, 1.45 + 0.004 / 0.16, rtol=1e-15)


@pytest.mark.thorough
def test_named_coefficients_are_read_from_the_parameters() -> None:
    named = Sellmeier(("b", 0.231792344, 1.01046945), (0.00600069867, "c", 103.560653))
    assert named.parameters == ("b", "c")
    values = {"b": jnp.asarray(1.03961212), "c": jnp.asarray(0.0200179144)}
    color = jnp.asarray(600.0)
    np.testing.assert_allclose(named.index(values, color), BK7.index({}, color), rtol=1e-15)
    assert Cauchy().parameters == ("cauchy_a", "cauchy_b")
    assert Cauchy("a", 0.0, "c").parameters == ("a", "c")


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


def test_the_index_is_no_parameter_of_a_scene_with_a_law() -> None:
    assert Scene(*PARTS, dispersion=Cauchy()).parameters == (
        "roughness",
        "subsurface_fraction",
        "absorption",
        "cauchy_a",
        "cauchy_b",
    )
    scene = Scene(SmoothSurface(), dispersion=Sellmeier(("b",), (0.01,)))
    assert scene.parameters == ("b",)


def test_a_law_needs_a_wavelength() -> None:
    scene = Scene(SmoothSurface(), dispersion=Cauchy())
    with pytest.raises(
        SceneError, match=r"dispersion: .* needs a wavelength, and there is none; g"
    ):
        scene.stokes(MATERIAL, VIEWS._replace(wavelength=None))


@each(
    ("make", "message"),
    [
        (lambda: Cauchy(a=0.9), "Cauchy: a: 0.9 is neither a number from 1 to 3"),
        (lambda: Cauchy(b="not a name"), "Cauchy: b: 'not a name' is neither"),
        (lambda: Cauchy(c=2.0), "Cauchy: c: 2.0 is neither a number from -1 to 1"),
        (lambda: Sellmeier((1.0, 0.2), (0.01,)), r"Sellmeier: .* do not pair; give two tuples of"),
        (lambda: Sellmeier((), ()), "Sellmeier: .* do not pair"),
        (lambda: Sellmeier(1.0, 0.01), "Sellmeier: .* do not pair"),
        (lambda: Sellmeier((-1.0,), (0.01,)), "Sellmeier: strengths: -1.0 is neither"),
        (lambda: Sellmeier((1.0,), (-0.01,)), "Sellmeier: resonances: -0.01 is neither"),
    ],
)
def test_laws_are_checked(make, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        make()
