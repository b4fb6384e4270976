"""Captures of known truth: what they hold, that the seed decides, and whose noise it is."""

import functools
import re

import jax
import numpy as np
import pytest
import scipy.stats
import xarray as xr
from cases import each
from numpyro import distributions as dist

from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError, FitError, PolarBayesError, SceneError
from polar_bayes.observation.data import observe
from polar_bayes.observation.links import (
    AbstractLink,
    BetaLink,
    LogitNormalLink,
    NormalLink,
    StokesLink,
    StudentTLink,
)
from polar_bayes.physics.instrument import DolpGain, Instrument
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.subsurface import Unpolarized
from polar_bayes.physics.surface import SmoothSurface
from polar_bayes.setups import SETUPS
from polar_bayes.simulation import NOISE, PRESETS, STATED_ERROR, Material, Protocol, simulate

PLATE = Scene(SmoothSurface(), Unpolarized(), StokesMixing())  # the quickest optics
MANY = Protocol(views=3000, wavelengths=())

default_capture = functools.cache(simulate)


# --- every material, every set-up -----------------------------------------------------------------


@each("setup", sorted(SETUPS, key="goniometer".__ne__), quick=1)
@each("name", sorted(PRESETS, key="leaf".__ne__), quick=1)
def test_every_preset_in_every_setup_is_a_valid_capture(setup, name):
    capture = simulate(name, scene=setup, seed=2)
    xr.testing.assert_identical(validate(capture), capture)
    assert capture.attrs == {"name": name, "setup": setup, "seed": 2}
    assert dict(capture.sizes) == {"view": 40, "wavelength": 3}
    for variable, link in SETUPS[setup].links.items():
        assert capture[variable].dims == ("view", "wavelength")
        assert (f"{variable}_error" in capture) is link.reads_errors
    assert ("saturated" in capture) is ("intensity" in capture)


def test_the_default_capture_follows_the_papers_protocol():
    capture = default_capture()
    assert float(capture["view_zenith"].max()) == 85.0
    assert len(np.unique(capture["view_azimuth"])) == 4
    np.testing.assert_array_equal(capture["wavelength"], [450.0, 550.0, 650.0])


@pytest.mark.thorough
def test_stated_errors_come_with_the_links_that_read_them():
    capture = simulate("glass", scene="goniometer")
    np.testing.assert_array_equal(capture["q_error"], np.full((40, 3), STATED_ERROR))


# --- seeds ----------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_capture():
    again = simulate()
    xr.testing.assert_identical(again, default_capture())


def test_another_seed_gives_other_noise_around_the_same_truth():
    first, second = default_capture(), simulate(seed=1)
    for name in ("dop", "intensity"):
        # Continuous noise repeats only where the sensor stopped.
        same = first[name].values == second[name].values
        assert not np.any(same & ~first["saturated"].values)
    for name in first:
        if str(name).startswith("true_") or name.endswith(("zenith", "azimuth")):
            xr.testing.assert_identical(first[name], second[name])


def test_a_capture_does_not_depend_on_the_precision_of_the_caller():
    with jax.enable_x64(False):
        again = simulate()
    xr.testing.assert_identical(again, default_capture())


# --- the sensor -----------------------------------------------------------------------------------


@each("name", ["leaf", "glass"])
def test_saturated_means_at_full_scale_and_nothing_else(name):
    capture = simulate(name, seed=3)
    full_scale = capture["intensity"].attrs["saturation_level"]
    assert float(capture["intensity"].max()) <= full_scale
    xr.testing.assert_equal(capture["saturated"], capture["intensity"] >= full_scale)
    if name == "glass":  # its mirror lobe is far brighter than the rest
        assert bool(capture["saturated"].any())


def test_the_bright_views_come_to_60_percent_of_full_scale():
    # The quantile of 120 noisy readings; noise of 1 to 5% moves a quantile by less than that.
    assert float(default_capture()["intensity"].quantile(0.9)) == pytest.approx(0.6, rel=0.05)


@pytest.mark.thorough
def test_a_stated_exposure_is_kept():
    arguments = {"scene": PLATE, "protocol": MANY, "links": {"intensity": StudentTLink()}}
    bright, dark = (
        simulate("glass", noise={"exposure": exposure, "intensity_scale": 1e-9}, **arguments)
        for exposure in (1.0, 0.5)
    )
    # Noise of 1e-9, some hundred of these at the very worst of 3000, on readings above 1e-3.
    assert float(bright["intensity"].min()) > 1e-3
    np.testing.assert_allclose(bright["intensity"] / dark["intensity"], 2.0, rtol=1e-3)


@pytest.mark.thorough
@each("seed", range(3))
def test_strong_noise_stays_possible(seed):
    stokes = simulate("leaf", scene="camera", noise={"stokes_scale": 0.5}, seed=seed)
    assert float((stokes["q"] ** 2 + stokes["u"] ** 2).max()) <= 1.0 + 1e-15
    links = {"dop": NormalLink(), "intensity": StudentTLink()}
    noise = {"normal_scale": 1.0, "intensity_scale": 1.0}
    other = simulate("leaf", scene=PLATE, links=links, noise=noise, seed=seed)
    assert 0.0 <= float(other["dop"].min()) <= float(other["dop"].max()) <= 1.0


# --- the truth ------------------------------------------------------------------------------------


def test_the_truth_of_the_preset_rides_along():
    capture, material = default_capture(), PRESETS["leaf"]
    assert float(capture["true_roughness"]) == material.roughness
    assert float(capture["true_subsurface_fraction"]) == material.subsurface_fraction
    np.testing.assert_array_equal(capture["true_absorption"], material.absorption)
    np.testing.assert_array_equal(capture["true_refractive_index"], material.refractive_index)
    assert capture["true_absorption"].dims == ("wavelength",)


@pytest.mark.thorough
def test_replaced_parameters_and_a_material_of_ones_own_ride_along_too():
    scene = Scene(SmoothSurface(), Unpolarized(), StokesMixing(), None, Instrument((DolpGain(),)))
    material = Material(0.1, 0.2, (0.3, 0.3, 0.3), (1.5, 1.5, 1.5))
    parameters = {"refractive_index": [1.6, 1.5, 1.4], "dolp_gain": 0.8}
    capture = simulate(material, scene=scene, parameters=parameters)
    np.testing.assert_array_equal(capture["true_refractive_index"], [1.6, 1.5, 1.4])
    assert float(capture["true_dolp_gain"]) == 0.8
    assert float(capture["true_subsurface_fraction"]) == 0.2
    assert "true_roughness" not in capture  # a smooth plate has none
    assert capture.attrs["name"] == "simulated"


@pytest.mark.thorough
def test_the_truth_of_an_angle_is_in_degrees():
    capture = simulate("glass", scene="goniometer")
    assert capture["true_angle_zero"].attrs["units"] == "degree"
    assert "true_discrepancy_weights" not in capture


# --- the noise ------------------------------------------------------------------------------------

# A correct simulator fails a Kolmogorov-Smirnov test at this level once in a thousand seeds.
FALSE_ALARM = 1e-3


def at_the_truth(capture, scene, link, name):
    """The distribution of a reading through the doors of a fit: capture, arrays, scene, link."""
    data = observe(capture)
    truth = {key: capture[f"true_{key}"].values for key in scene.parameters}
    noise = {key: np.asarray({**NOISE, "exposure": 1.0}[key]) for key in link.parameters}
    prediction = jax.jit(scene.predict)(truth, data.geometry)
    return data, link.distribution(name, prediction, data, noise)


def uniform(pit):
    assert scipy.stats.kstest(pit, "uniform").pvalue > FALSE_ALARM


def test_simulated_dop_scatters_as_the_beta_link_says():
    link = BetaLink()
    links = {"dop": link, "intensity": StudentTLink()}
    capture = simulate("glass", scene=PLATE, links=links, protocol=MANY, seed=11)
    data, found = at_the_truth(capture, PLATE, link, "dop")
    # Dim and grazing views are in, so that a wrong schedule would show.
    assert float(np.ptp(found.concentration)) > 50.0
    first, second = found.mean * found.concentration, (1 - found.mean) * found.concentration
    uniform(scipy.stats.beta.cdf(data.readings["dop"], first, second))


@pytest.mark.thorough
def test_simulated_intensity_scatters_as_the_student_t_link_says():
    link = StudentTLink()
    links, noise = {"intensity": link}, {"exposure": 1.0}
    capture = simulate("glass", scene=PLATE, links=links, protocol=MANY, noise=noise, seed=12)
    data, found = at_the_truth(capture, PLATE, link, "intensity")
    share = scipy.stats.t.cdf(data.readings["intensity"], 5.0, found.location, found.scale)
    # A stopped reading stands for the whole tail beyond its stop: spread it there evenly.
    spread = np.random.default_rng(13).uniform(size=share.size)
    share = np.where(data.saturated, share + (1.0 - share) * spread, share)
    share = np.where(data.readings["intensity"] == 0.0, share * spread, share)
    uniform(share)


@pytest.mark.thorough
@each("link", [StokesLink(), StokesLink(4.0, stated_errors=True), NormalLink()])
def test_simulated_stokes_parameters_scatter_as_their_link_says(link):
    capture = simulate("glass", scene=PLATE, links={"q": link}, protocol=MANY, seed=14)
    data, found = at_the_truth(capture, PLATE, link, "q")
    uniform(np.asarray(found.cdf(data.readings["q"])))


@pytest.mark.thorough
def test_simulated_dop_scatters_as_the_logit_normal_link_says():
    link = LogitNormalLink()
    capture = simulate("glass", scene=PLATE, links={"dop": link}, protocol=MANY, seed=15)
    data, found = at_the_truth(capture, PLATE, link, "dop")
    uniform(scipy.stats.norm.cdf(scipy.special.logit(data.readings["dop"]), *found_normal(found)))


def found_normal(transformed):
    return np.asarray(transformed.base_dist.loc), np.asarray(transformed.base_dist.scale)


# --- what is refused ------------------------------------------------------------------------------


class OwnLink(AbstractLink):
    """A link whose noise parameter no table knows."""

    observables = ("q",)
    parameters = ("own_scale",)

    def distribution(self, name, prediction, data, noise):
        return dist.Normal(prediction[name], noise["own_scale"])


ODD = Material(0.1, 1.5, (0.3, 0.3, 0.3), (1.5, 1.5, 1.5))
WRONG = [
    (CaptureError, {"preset": "leave"}, "preset='leave': no such material; give one of leaf"),
    (CaptureError, {"preset": 3}, "preset=3: no such material; give"),
    (SceneError, {"scene": "papper"}, "scene='papper': no such scene; give one of paper"),
    (SceneError, {"scene": 3}, "scene=3: no such scene; give"),
    (CaptureError, {"seed": -1}, "simulate: seed is -1; give an integer from 0"),
    (CaptureError, {"seed": 1.0}, "simulate: seed is 1.0; give"),
    (CaptureError, {"seed": True}, "simulate: seed is True; give"),
    (CaptureError, {"seed": 2**32}, "simulate: seed is 4294967296; give"),
    (CaptureError, {"preset": ODD}, "['subsurface_fraction']: 1.5 is outside"),
    (FitError, {"links": {}}, "simulate: links: that is no set of links; give a mapping"),
    (FitError, {"links": BetaLink()}, "simulate: links: that is no set of links; give"),
    (FitError, {"links": {"dop": StokesLink()}}, "does not describe dop; give a link"),
    (FitError, {"links": {"dop": "beta"}}, "links['dop']: 'beta' does not describe dop; give a li"),
    (
        FitError,
        {"links": {"q": OwnLink()}},
        "noise['own_scale']: it has no value; give noise={'own_",
    ),
    (CaptureError, {"links": {"u": StokesLink()}, "scene": PLATE}, "u: it has no meaning"),
]
PARAMETERS = [
    (SceneError, {"roughnes": 0.1}, ": the scene has no parameter roughnes; give any of roughness"),
    (CaptureError, {"roughness": -0.1}, "['roughness']: -0.1 is outside 0 <= value <= inf; give"),
    (CaptureError, {"absorption": [0.1, np.nan, 0.1]}, "['absorption']: nan is outside 0"),
    (CaptureError, {"refractive_index": 0.9}, "0.9 is outside 1 <= value"),
    (CaptureError, {"subsurface_fraction": 1.1}, "1.1 is outside 0 <= value"),
    (
        CaptureError,
        {"refractive_index": [1.4, 1.5]},
        "its shape is (2,); give one number, or one pe",
    ),
]
WRONG += [(kind, {"parameters": given}, message) for kind, given, message in PARAMETERS]
NOISES = [
    (
        FitError,
        {"intensity_scal": 0.1},
        ": no link reads intensity_scal; give any of concentration",
    ),
    (
        CaptureError,
        {"intensity_scale": 0.0},
        "['intensity_scale']: 0 is outside 0 < value <= inf; g",
    ),
    (CaptureError, {"exposure": np.inf}, "inf is outside 0 < value"),
]
WRONG += [(kind, {"noise": given}, message) for kind, given, message in NOISES]


@each(("kind", "arguments", "message"), WRONG)
def test_what_cannot_be_simulated_is_told_in_one_line(kind, arguments, message):
    with pytest.raises(kind, match=re.escape(message)) as caught:
        simulate(**arguments)
    assert isinstance(caught.value, PolarBayesError)
    assert "\n" not in str(caught.value)
    assert str(caught.value).count("; ") >= 1


def test_a_scene_parameter_without_a_known_value_is_asked_for():
    class OwnScene(Scene):
        @property
        def parameters(self):
            return ("refractive_index", "thickness")

    with pytest.raises(SceneError, match=r"no value for thickness; give parameters={'thickness'"):
        simulate("glass", scene=OwnScene(SmoothSurface()))
