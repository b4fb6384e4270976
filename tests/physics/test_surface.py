"""Interfaces: limits, reciprocity, and the truth about rough ones."""

import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st

from polar_bayes.errors import SceneError
from polar_bayes.physics.geometry import Geometry
from polar_bayes.physics.illumination import UniformSky
from polar_bayes.physics.microfacet import GGX, Beckmann
from polar_bayes.physics.stack import Stack
from polar_bayes.physics.surface import RoughSurface, SmoothSurface

zenith = st.floats(0.0, 89.0)
azimuth = st.floats(0.0, 360.0)
POINT = RoughSurface(Beckmann())
MATERIAL = {"roughness": jnp.array([0.3]), "refractive_index": jnp.array([1.5])}
BARE = Stack(MATERIAL["refractive_index"])


def at(view: float, light: float, difference: float) -> Geometry:
    return Geometry(*(jnp.array([x]) for x in (view, 0.0, light, difference)))


@pytest.mark.thorough
@given(view=zenith, light=zenith, difference=azimuth)
@settings(deadline=None, max_examples=40)
def test_viewer_and_light_may_change_places(view: float, light: float, difference: float) -> None:
    """Helmholtz: brightness per irradiance on the plane is symmetric, and so is polarization."""
    there = POINT.light(MATERIAL, at(view, light, difference), BARE)
    back = POINT.light(MATERIAL, at(light, view, -difference), BARE)
    cosines = np.cos(np.deg2rad(light)) / np.cos(np.deg2rad(view))
    np.testing.assert_allclose(there.intensity, back.intensity * cosines, rtol=1e-9)
    np.testing.assert_allclose(
        np.hypot(there.q, there.u), np.hypot(back.q, back.u), rtol=1e-9, atol=1e-12
    )


@given(view=zenith, light=zenith, difference=azimuth)
@settings(deadline=None, max_examples=40)
def test_the_other_side_of_the_plane_is_a_mirror_image(
    view: float, light: float, difference: float
) -> None:
    left = POINT.light(MATERIAL, at(view, light, difference), BARE)
    right = POINT.light(MATERIAL, at(view, light, -difference), BARE)
    np.testing.assert_allclose(left.q, right.q, atol=1e-12)
    np.testing.assert_allclose(left.u, -right.u, atol=1e-12)


@pytest.mark.thorough
@each("distribution", [Beckmann(), GGX()])
def test_roughness_does_not_change_what_one_facet_polarizes(
    distribution: Beckmann | GGX,
) -> None:
    geometry = at(40.0, 60.0, 150.0)
    rough, smooth = (
        RoughSurface(distribution).light({**MATERIAL, "roughness": jnp.array([r])}, geometry, BARE)
        for r in (0.5, 0.01)
    )
    mirror = SmoothSurface().light(MATERIAL, geometry, BARE)
    for light in (rough, smooth):
        np.testing.assert_allclose(light.q, mirror.q, rtol=1e-14)
        np.testing.assert_allclose(light.u, mirror.u, rtol=1e-14)


@pytest.mark.thorough
@each("distribution", [Beckmann(), GGX()])
def test_a_smooth_exit_is_the_limit_of_a_rough_one(distribution: Beckmann | GGX) -> None:
    """GGX keeps a tail of steep facets at any roughness: its limit is reached more slowly."""
    views = Geometry(*(jnp.array([0.0, 30.0, 60.0, 80.0]) for _ in range(4)))
    nearly = {**MATERIAL, "roughness": jnp.array([1e-4])}
    rough = RoughSurface(distribution).exit(nearly, views, BARE)
    smooth = SmoothSurface().exit(MATERIAL, views, BARE)
    bound = 1e-4 if isinstance(distribution, GGX) else 1e-6
    np.testing.assert_allclose(rough.q, smooth.q, atol=bound)
    np.testing.assert_allclose(rough.intensity, smooth.intensity, rtol=10 * bound)


@pytest.mark.thorough
def test_intensity_of_a_highlight_grows_as_the_inverse_square_of_roughness() -> None:
    geometry = at(30.0, 30.0, 180.0)
    narrow, wide = (
        POINT.light({**MATERIAL, "roughness": jnp.array([r])}, geometry, BARE) for r in (1e-4, 1e-3)
    )
    np.testing.assert_allclose(narrow.intensity, 100.0 * wide.intensity, rtol=1e-9)


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


@each(
    ("part", "hint"),
    [
        ({"distribution": UniformSky()}, r"Beckmann\(\) or GGX\(\)"),
        ({"illumination": GGX()}, r"PointSource\(\), Disc\(5.0\) or UniformSky\(\)"),
        ({"quadrature": 32}, r"FacetQuadrature\(along=6, across=5\)"),
        ({"slopes": 0.1}, r"IsotropicSlopes\(\) or AnisotropicSlopes\(azimuth=0.0\)"),
        ({"shadowing": None}, r"SeparableShadowing\(\), NoShadowing\(\)"),
        ({"way_out": "rough"}, r"RoughExit\(\) or SmoothExit\(\)"),
    ],
)
def test_parts_are_checked(part: dict, hint: str) -> None:
    name = next(iter(part))
    with pytest.raises(SceneError, match=rf"RoughSurface: {name}: .* is no such part; give {hint}"):
        RoughSurface(**part)


def test_a_smooth_surface_takes_a_beam_only() -> None:
    with pytest.raises(SceneError, match=r"SmoothSurface: beam: UniformSky\(\) is no such part; g"):
        SmoothSurface(UniformSky())
