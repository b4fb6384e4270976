"""Images of known truth: one value per pixel where it is given, one for all where it is not."""

import doctest
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
import xarray as xr
from cases import each

import polar_bayes as pb
from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError
from polar_bayes.observation.links import BetaLink, NormalLink, StokesLink, StudentTLink
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.subsurface import Unpolarized
from polar_bayes.physics.surface import SmoothSurface
from polar_bayes.setups import SETUPS
from polar_bayes.simulation import NEUTRAL, NOISE, PRESETS, Protocol, simulate

PLATE = Scene(SmoothSurface(), Unpolarized(), StokesMixing())  # the quickest optics
GRAY = Protocol(views=5, wavelengths=())
COLORED = Protocol(views=5, wavelengths=(450.0, 650.0))
LINKS = {"dop": BetaLink(), "intensity": StudentTLink()}
ROWS, COLUMNS = 2, 4
INDEX = np.linspace(1.3, 1.7, ROWS * COLUMNS).reshape(ROWS, COLUMNS)
FRACTION = np.linspace(0.6, 0.1, ROWS * COLUMNS).reshape(ROWS, COLUMNS)
LIGHT = np.geomspace(0.05, 2.0, ROWS * COLUMNS).reshape(ROWS, COLUMNS)


# Every shape of an array compiles operations of its own: that is what these tests cost.
pytestmark = pytest.mark.usefixtures("compiled_in_haste")


# --- dims and truth -------------------------------------------------------------------------------


ONE_VALUE = [
    ({"subsurface_fraction": FRACTION}, {"concentration_scale": 200.0 * LIGHT}),
    ({"refractive_index": INDEX}, {}),
    ({}, {"exposure": LIGHT}),
    ({"refractive_index": INDEX.tolist(), "subsurface_fraction": 0.2}, {"exposure": LIGHT}),
]


@each("protocol", [COLORED, GRAY], quick=1)
@each(("parameters", "noise"), ONE_VALUE, quick=1)
def test_a_value_for_each_pixel_makes_an_image(protocol, parameters, noise):
    capture = simulate("glass", scene=PLATE, protocol=protocol, parameters=parameters, noise=noise)
    xr.testing.assert_identical(validate(capture), capture)
    color = {"wavelength": 2} if protocol.wavelengths else {}
    assert dict(capture.sizes) == {"y": ROWS, "x": COLUMNS, "view": 5, **color}
    for name in ("dop", "intensity", "saturated"):
        assert capture[name].dims == ("y", "x", "view", *color)
    for name in ("view_zenith", "view_azimuth", "light_zenith", "light_azimuth"):
        assert capture[name].dims == ("view",)
    for name in PLATE.parameters:
        truth = capture[f"true_{name}"]
        if np.ndim(parameters.get(name, 0.0)) == 2:
            assert truth.dims == ("y", "x")
            np.testing.assert_array_equal(truth, parameters[name])
        elif name == "refractive_index":  # of the preset
            assert truth.dims == tuple(color)
        else:
            assert truth.dims == ()


@pytest.mark.thorough
def test_stated_errors_are_there_for_every_pixel():
    links = {"q": StokesLink(stated_errors=True)}
    capture = simulate(
        "glass", scene=PLATE, links=links, protocol=GRAY, parameters={"refractive_index": INDEX}
    )
    assert capture["q_error"].dims == ("y", "x", "view")


# --- every pixel is a capture of its own ----------------------------------------------------------

TERMS = {
    "paper": {"roughness": 0.05 + 0.2 * FRACTION, "subsurface_fraction": FRACTION},
    "camera": {"refractive_index": INDEX, "dolp_gain": 1.0 - 0.5 * FRACTION},
    "goniometer": {
        "refractive_index": INDEX,
        "angle_zero": 2.0 * FRACTION,
        "leakage": 0.05 * FRACTION,
        "discrepancy_amplitude": 0.1 * FRACTION,
    },
}


@pytest.mark.thorough
@each("setup", TERMS)
def test_a_pixel_is_predicted_from_its_own_truth(setup):
    scene = SETUPS[setup].scene
    weights = {"discrepancy_weights": np.array([1.0, -1.0, 0.5])}
    weights = {name: x for name, x in weights.items() if name in scene.parameters}
    capture = simulate(
        "leaf",
        scene=scene,
        links={"q": NormalLink(), "intensity": StudentTLink()},
        noise={"normal_scale": 1e-12, "intensity_scale": 1e-12, "exposure": LIGHT},
        protocol=COLORED,
        parameters={**TERMS[setup], **weights},
    )
    colors = np.array(COLORED.wavelengths)
    geometry = pb.Geometry.from_degrees(**COLORED.angles(), wavelength=colors[:, None])
    shared = {**PRESETS["leaf"].at(colors), **NEUTRAL, **weights}
    shared = {name: shared[name] for name in scene.parameters if name not in TERMS[setup]}

    def predict(own):
        readings = scene.predict({**shared, **own}, geometry)
        return {name: jnp.broadcast_to(reading, (2, 5)) for name, reading in readings.items()}

    pixels = {name: image.ravel() for name, image in TERMS[setup].items()}
    pixels = jax.jit(jax.vmap(predict))(pixels)
    lit = LIGHT.reshape(-1, 1, 1) * pixels["intensity"]
    for name, value in (("q", pixels["q"]), ("intensity", np.minimum(lit, 1.0))):
        recorded = capture[name].transpose("y", "x", "wavelength", "view").values
        recorded = recorded.reshape(INDEX.size, 2, 5)
        # Noise of 1e-12: Student's t exceeds some hundred of these once in 1e8 readings.
        np.testing.assert_allclose(recorded - value, 0.0, atol=1e-9)


# Three tests look at many draws of two kinds of pixel; arrays of one shape compile once.
COUNT = 2000


def columns(left, right):
    return np.repeat([[left, right]], COUNT, axis=0)


class Repeated(Protocol):
    """A few directions, again and again: many draws of one capture."""

    def angles(self):
        return {name: np.tile(angle, self.views // 5) for name, angle in GRAY.angles().items()}


@pytest.mark.thorough
def test_a_pixel_scatters_like_a_capture_of_its_truth():
    given = {"scene": PLATE, "links": LINKS, "noise": {"exposure": 0.7}}
    truth = {"refractive_index": columns(1.35, 1.65)}
    image = simulate("glass", protocol=GRAY, parameters=truth, seed=1, **given)
    many = Repeated(views=5 * COUNT, wavelengths=())
    for x, index in enumerate((1.35, 1.65)):
        own = {"refractive_index": index}
        alone = simulate("glass", protocol=many, parameters=own, seed=2, **given)
        for name in ("dop", "intensity"):
            one, other = image[name][:, x].values, alone[name].values.reshape(COUNT, 5)
            if name == "dop":  # nor do two pixels share their noise, unless they lie at a margin
                inside = [view[(view > 1e-4) & (view < 1.0 - 1e-4)] for view in one.T]
                assert all(np.unique(view).size == view.size > 0.9 * COUNT for view in inside)
            center = other.mean(axis=0)
            for power in (1, 2):  # where readings lie and how far they scatter
                draws = [(sample - center) ** power for sample in (one, other)]
                apart = np.abs(draws[0].mean(axis=0) - draws[1].mean(axis=0))
                error = np.sqrt(sum(sample.var(axis=0) for sample in draws) / COUNT)
                assert np.all(apart < 4.0 * error), (name, index, power)


# --- light and shadow -----------------------------------------------------------------------------


@pytest.mark.thorough
def test_one_exposure_serves_the_whole_image():
    given = {"scene": PLATE, "protocol": GRAY, "links": LINKS}
    given["parameters"] = {"refractive_index": INDEX, "subsurface_fraction": FRACTION}
    noise = {"intensity_scale": 1e-12}
    capture = simulate("glass", noise=noise, **given)
    # The brightest tenth may be cut off at full scale; the quantile below it is not.
    assert float(capture["intensity"].quantile(0.9)) == pytest.approx(0.6, rel=1e-9)
    known = simulate("glass", noise={**noise, "exposure": 1e-3}, **given)
    ratio = (capture["intensity"] / known["intensity"]).where(~capture["saturated"])
    np.testing.assert_allclose(ratio.min(), ratio.max(), rtol=1e-6)


@pytest.mark.thorough
def test_a_shadow_is_noisier_in_dop():
    noise = {"exposure": columns(1.0, 0.02), "concentration_scale": 3000.0}
    capture = simulate("glass", scene=PLATE, links=LINKS, protocol=GRAY, noise=noise, seed=4)
    lit, dark = (capture["dop"].isel(x=x) for x in (0, 1))
    # 1/50 of the brightness is 1/19 of the concentration, beside the least one of 5.
    assert np.all(dark.std("y") > 2.0 * lit.std("y"))
    assert np.all(capture["intensity"].isel(x=1).mean("y") < 0.1)


@pytest.mark.thorough
def test_a_highlight_is_saturated_and_said_to_be():
    light = np.full((ROWS, COLUMNS), 0.1)
    light[1, 2] = 1e3
    capture = simulate("glass", scene=PLATE, protocol=COLORED, noise={"exposure": light}, seed=5)
    full_scale = capture["intensity"].attrs["saturation_level"]
    xr.testing.assert_equal(capture["saturated"], capture["intensity"] >= full_scale)
    assert bool(capture["saturated"][1, 2].all())
    assert int(capture["saturated"].sum()) == capture["saturated"][1, 2].size


@pytest.mark.thorough
def test_noise_may_differ_from_pixel_to_pixel():
    given = {"scene": PLATE, "links": {"q": NormalLink()}, "protocol": GRAY}
    scales = (0.005, 0.02)  # none reaches the ends of q
    capture = simulate("glass", noise={"normal_scale": columns(*scales)}, seed=6, **given)
    center = simulate("glass", noise={"normal_scale": 1e-12}, **given)["q"]
    for x, scale in enumerate(scales):
        score = (capture["q"].isel(x=x) - center) / scale
        # A correct simulator fails a Kolmogorov-Smirnov test at this level once in 1000 seeds.
        assert scipy.stats.kstest(score.values.ravel(), "norm").pvalue > 1e-3


# --- seeds ----------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_image():
    given = {"scene": PLATE, "protocol": COLORED, "noise": {"exposure": LIGHT}}
    first, again, other = (simulate("leaf", seed=seed, **given) for seed in (3, 3, 4))
    xr.testing.assert_identical(again, first)
    assert not np.any((other["dop"] == first["dop"]).values)


# --- what is refused ------------------------------------------------------------------------------

HOLED = INDEX.copy()
HOLED[1, 2] = np.nan


NO_IMAGE = {
    "two shapes": (
        {"refractive_index": INDEX, "subsurface_fraction": FRACTION.T},
        "parameters['refractive_index']: its shape is (2, 4) and that of "
        "parameters['subsurface_fraction'] is (4, 2); give images (y, x) of one shape",
    ),
    "of noise, too": (
        {"refractive_index": INDEX, "exposure": LIGHT[:1]},
        "noise['exposure']: its shape is (1, 4) and that of parameters['refractive_index'] is (2, ",
    ),
    "of noise alone": (
        {"exposure": LIGHT, "concentration_scale": np.full((1, 1), 9.0)},
        "noise['exposure']: its shape is (2, 4) and that of noise['concentration_scale'] is (1, 1)",
    ),
    "one axis more": (
        {"refractive_index": INDEX[..., None]},
        "parameters['refractive_index']: its shape is (2, 4, 1); give one number, or one "
        "per wavelength (2), or an image (y, x)",
    ),
    "a row": ({"refractive_index": INDEX[0]}, "its shape is (4,); give one number, or one per wav"),
    "nothing": ({"refractive_index": np.ones((0, 4))}, "its shape is (0, 4); give one number"),
    "a row of noise": (
        {"exposure": LIGHT[0]},
        "noise['exposure']: its shape is (4,); give one number, or an image (y, x)",
    ),
    "more of noise": ({"exposure": LIGHT[..., None]}, "its shape is (2, 4, 1); give one number, o"),
    "ragged": (
        {"refractive_index": [[1.4, 1.5], [1.6]]},
        "parameters['refractive_index']: it is no array of numbers; give a number, or rows",
    ),
    "text": ({"exposure": "bright"}, "noise['exposure']: it is no array of numbers; give"),
    "a hole": ({"refractive_index": HOLED}, "nan is outside 1 <= value <= inf; give"),
    "below air": ({"refractive_index": INDEX - 0.5}, "0.8 is outside 1 <= value <= inf; give"),
    "dark": ({"exposure": LIGHT - LIGHT[1, 1]}, "is outside 0 < value <= inf; give"),
    "a hole in noise": ({"exposure": HOLED}, "noise['exposure']: nan is outside 0 < value <= inf"),
}


@each("wrong", NO_IMAGE)
def test_what_is_no_image_is_told_in_one_line(wrong):
    asked, message = NO_IMAGE[wrong]
    noise = {name: value for name, value in asked.items() if name in NOISE or name == "exposure"}
    parameters = {name: value for name, value in asked.items() if name not in noise}
    with pytest.raises(CaptureError, match=f"^simulate: .*{re.escape(message)}") as caught:
        simulate("leaf", scene=PLATE, protocol=COLORED, parameters=parameters, noise=noise)
    assert "\n" not in str(caught.value)


OTHER = [
    ({"parameters": {"refractive_index": [1.4, 1.5]}}, r"give one number, or an image \(y, x\)$"),
    (
        {"scene": "goniometer", "parameters": {"discrepancy_weights": np.zeros((ROWS, COLUMNS))}},
        r"its shape is \(2, 4\); give one number for each",
    ),
    ({"noise": {"normal_scale": NOISE["normal_scale"] * LIGHT}}, "no link reads normal_scale"),
]


@pytest.mark.thorough
@each(("asked", "message"), OTHER)
def test_without_color_of_a_basis_and_of_noise_that_no_link_reads(asked, message):
    with pytest.raises(pb.PolarBayesError, match=message):
        simulate("leaf", **{"scene": PLATE, "protocol": GRAY} | asked)


# --- what the documentation shows -----------------------------------------------------------------


def test_the_example_of_the_docstring_runs():
    (example,) = doctest.DocTestFinder().find(simulate, globs={"np": np, "pb": pb})
    assert example.examples
    outcome = doctest.DocTestRunner().run(example)
    assert outcome.failed == 0
