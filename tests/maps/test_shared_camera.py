"""What the pixels of a camera's image share."""

import jax
import numpy as np
import pytest
from map_coverage import SHARED, camera_image
from scipy import stats

import polar_bayes as pb
from polar_bayes.maps.fit_map import estimate_plan, plan_map
from polar_bayes.physics.input_quantities import LightZenith

LAMP = "light_zenith_offset"

pytestmark = pytest.mark.thorough


def test_an_image_of_a_camera_shares_its_polarizer_and_its_lamp() -> None:
    assert pb.setups.SETUPS["camera"].shared == ("dolp_gain", LAMP)
    truth = {"dolp_gain": 0.93, LAMP: -1.5}
    drawn = {name: np.asarray(x) for name, x in truth.items()}
    drawn["roughness"] = np.full((24, 24), 0.2)
    protocol = pb.simulation.Protocol(views=12, wavelengths=(), largest_view_zenith=75.0)
    scene = pb.setups.SETUPS["camera"].scene.known_to((LightZenith(),))
    asked = {"scene": scene, "links": pb.setups.SETUPS["camera"].links, "protocol": protocol}
    image = pb.simulate("plastic", **asked, parameters=drawn, seed=1)
    maps = pb.fit_pixels(image, scene="camera")
    rows = pb.maps.shared_parameters(maps)
    width = 4.0 / 1.96  # four sds, of two: once in 8,000 right models
    for name, true in truth.items():
        row = rows.loc[name]
        assert row["q50"] - width * (row["q50"] - row["q2.5"]) < true, name
        assert row["q50"] + width * (row["q97.5"] - row["q50"]) > true, name
    assert LAMP not in pb.maps.setup_shares(maps)


def test_an_exposure_that_pixels_know_is_found_beside_noise_that_they_do_not() -> None:
    image = camera_image(0.93)
    asked = plan_map(image, "per_material", None, None, None, None, None, 0, "double", SHARED)
    found = {each.name: each for each in estimate_plan(asked, image).shared}
    for name, truth in {"stokes_scale": 0.01, "intensity_scale": 0.01, "dolp_gain": 0.93}.items():
        tails = stats.norm.cdf([-4.0, 4.0])  # three numbers: once in 5,000 right models
        with jax.enable_x64(True):
            low, high = found[name].quantiles(asked.request.priors[name], tails)
        assert low < truth < high, name
    assert found["exposure"].sd < 0.01
