"""Materials to simulate: plausible, and the same whatever the wavelengths asked for."""

import numpy as np
import pytest
from cases import each

from polar_bayes.errors import CaptureError
from polar_bayes.priors import PRIORS, RANGES
from polar_bayes.simulation import PRESETS, REFERENCE_WAVELENGTHS, Material, find_preset

EVERY_PRESET = each("name", PRESETS)


@EVERY_PRESET
def test_a_preset_is_found_by_its_name_and_inside_every_range(name):
    material = find_preset(name)
    assert material is PRESETS[name]
    for parameter, value in material.at(np.array(REFERENCE_WAVELENGTHS)).items():
        low, high = RANGES[parameter]
        assert np.all((value > low) & (value < high))
    index = material.at(np.array(REFERENCE_WAVELENGTHS))["refractive_index"]
    assert np.all(np.diff(index) < 0.0)  # as that of transparent bodies does


@pytest.mark.thorough
@EVERY_PRESET
def test_the_prior_does_not_rule_a_preset_out(name):
    # Within the middle 99.8% of the prior: a simulated capture must not be a surprise to a fit.
    for parameter, value in PRESETS[name].at(np.array(REFERENCE_WAVELENGTHS)).items():
        share = np.asarray(PRIORS[parameter].cdf(value))
        assert np.all((share > 1e-3) & (share < 1.0 - 1e-3)), parameter


def test_water_and_glass_have_the_published_index_in_the_green():
    # Water 1.3342 (Hale & Querry 1973) and BK7 1.5185 (Schott) at 550 nm, within the stated 0.002.
    for name, index in (("water", 1.3342), ("glass", 1.5185)):
        assert PRESETS[name].refractive_index[1] == pytest.approx(index, abs=0.002)


@pytest.mark.thorough
def test_a_leaf_absorbs_blue_and_red_and_a_fruit_leaves_red():
    blue, green, red = PRESETS["leaf"].absorption
    assert green < min(blue, red)
    assert np.all(np.diff(PRESETS["fruit"].absorption) < 0.0)


@pytest.mark.thorough
def test_colors_between_the_reference_wavelengths_are_interpolated_and_the_ends_continue():
    material = Material(0.1, 0.2, (1.0, 2.0, 4.0), (1.5, 1.4, 1.3))
    values = material.at(np.array([400.0, 500.0, 600.0, 900.0]))
    np.testing.assert_allclose(values["absorption"], [1.0, 1.5, 3.0, 4.0], rtol=1e-15)
    np.testing.assert_allclose(values["refractive_index"], [1.5, 1.45, 1.35, 1.3], rtol=1e-15)
    assert values["roughness"].shape == values["subsurface_fraction"].shape == ()


@each("name", ["leave", "", 3, None, ["leaf"]])
def test_an_unknown_name_is_answered_with_the_known_ones(name):
    with pytest.raises(CaptureError) as caught:
        find_preset(name)
    expected = f"no such material; give one of {', '.join(PRESETS)}"
    assert str(caught.value) == f"preset={name!r}: {expected}"
