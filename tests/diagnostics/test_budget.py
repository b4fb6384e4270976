"""The uncertainty budget: what the set-up adds is what other fits say, and it names what helps."""

import re

import numpy as np
import numpyro
import pandas as pd
import pytest
import xarray as xr
from cases import each
from plates import LINKS, PLATE, plate_capture
from synthetic_results import edit_provenance, make_result, replace

import polar_bayes as pb
from polar_bayes.diagnostics.budget import _row, better_known, budget_sentences, variance_shares
from polar_bayes.diagnostics.view import view_of
from polar_bayes.inference.request import resolve
from polar_bayes.physics.input_quantities import (
    AmbientLight,
    AnalyzerRoll,
    SampleLean,
    ToneCurve,
    ViewZenithScale,
)
from polar_bayes.reporting.text import next_sentences
from polar_bayes.setups import Setup

KNOWN = {"sample_lean": 0.2, "view_zenith_scale": 0.002, "tone_curve": 0.02}
QUANTITIES = (SampleLean(), ViewZenithScale(), ToneCurve())
ASKED = {
    "method": pb.methods.Laplace(draws=2000),
    "seed": 5,
    "scene": Setup(PLATE, LINKS, known=QUANTITIES),
}
PERFECT = {**ASKED, "scene": Setup(PLATE, LINKS)}
pytestmark = pytest.mark.usefixtures("without_comparisons")


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 75.0, 12), 0.01, seed=2)


@pytest.fixture(scope="module")
def fit(capture: xr.Dataset) -> xr.DataTree:
    return pb.fit(capture, known=KNOWN, **ASKED)


@pytest.fixture(scope="module")
def perfect(capture: xr.Dataset) -> xr.DataTree:
    """The same readings in a set-up that is known perfectly."""
    return pb.fit(capture, **PERFECT)


def sds(fit: xr.DataTree) -> np.ndarray:
    return pb.summary(fit).loc[["subsurface_fraction", "refractive_index"], "sd"].to_numpy()


@each("change", [lambda x: x * 1e-200, lambda x: x.where(x["draw"] > 0, np.inf)])
@each("name", ["refractive_index", "sample_lean_offset"])
def test_draws_that_vanish_or_are_infinite_have_a_budget_and_a_verdict(fit, name, change):
    edited = replace(fit.copy(), "posterior", name, change(fit["posterior"].to_dataset()[name]))
    assert pb.budget(edited).shape == pb.budget(fit).shape
    assert pb.verdict(edited).not_checked is not None


# Of 2,000 draws a standard deviation has a relative standard error of 1.6%, a ratio of two 2.2%.
RELATIVE = 0.07


@pytest.mark.thorough  # `test_each_factor_of_a_normal_posterior...` has the closed form
def test_a_perfect_set_up_would_have_the_intervals_that_a_fit_of_it_has(fit, perfect) -> None:
    np.testing.assert_allclose(pb.budget(fit)["perfect"], sds(perfect), rtol=RELATIVE)
    assert (sds(fit) > 1.05 * sds(perfect)).any()


def test_what_is_known_better_does_what_weighted_draws_say(fit: xr.DataTree) -> None:
    """Draws weighted by the ratio of the priors, which keeps the information of most of them."""
    name, u, better = "tone_curve", KNOWN["tone_curve"], 0.01
    offset = fit["posterior"][f"{name}_offset"].to_numpy().ravel()
    weight = np.exp(-0.5 * offset**2 * (better**-2 - u**-2))
    assert weight.sum() ** 2 / (weight**2).sum() > 1000.0
    told = pb.budget(fit, known={name: better})["sd"]
    for parameter in ("subsurface_fraction", "refractive_index"):
        draws = fit["posterior"][parameter].to_numpy().ravel()
        found = float(np.cov(draws, aweights=weight)) ** 0.5
        assert found == pytest.approx(told[parameter], rel=RELATIVE)
    assert told["refractive_index"] < 0.95 * pb.budget(fit).loc["refractive_index", "sd"]


@pytest.mark.thorough
@each("better", [{"tone_curve": 0.004}, {"sample_lean": 0.5, "view_zenith_scale": 0.004}])
def test_what_is_known_better_or_worse_does_what_another_fit_says(fit, capture, better) -> None:
    again = pb.fit(capture, known={**KNOWN, **better}, **ASKED)
    np.testing.assert_allclose(pb.budget(fit, known=better)["sd"], sds(again), rtol=RELATIVE)
    np.testing.assert_allclose(
        pb.budget(again), pb.budget(fit, known=better), atol=0.1 * sds(fit).max()
    )


def test_contributions_add_in_squares(fit: xr.DataTree) -> None:
    table = pb.budget(fit)
    np.testing.assert_allclose(table["sd"], sds(fit), rtol=1e-3)  # of n - 1, and of n
    parts = table[["noise", "prior", *KNOWN]]
    np.testing.assert_allclose((parts**2).sum(axis=1), table["sd"] ** 2)
    shares = variance_shares(table)[list(parts)]
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    assert table.attrs["known"] == KNOWN


@each("name", list(KNOWN))
def test_what_is_known_twice_as_well_has_a_column(fit: xr.DataTree, name: str) -> None:
    told = pb.budget(fit, known={name: 0.5 * KNOWN[name]})["sd"]
    np.testing.assert_allclose(pb.budget(fit)[f"{name} halved"], told)


def test_each_factor_of_a_normal_posterior_contributes_its_precision() -> None:
    """One parameter, two input quantities and three weights of a smooth error."""
    rng, stated = np.random.default_rng(3), pd.Series({"angle_zero": 0.75, "leakage": 0.01})
    own = np.diag(np.array([0.4, *stated, 1.0, 1.0, 1.0]) ** -2.0)
    noise = rng.normal(size=(8, 6)) * [10.0, 2.0, 300.0, 1.0, 1.0, 1.0]
    noise = noise.T @ noise
    joint = np.linalg.inv(noise + own)
    parts, by_noise = joint[0] ** 2 * np.diag(own), joint[0] @ noise @ joint[0]
    found = _row(joint, by_noise / (by_noise + parts[0]), stated, stated)
    rest = [0, 3, 4, 5]
    perfect = np.linalg.inv((noise + own)[np.ix_(rest, rest)])[0, 0]
    halves = [np.diag(3.0 * np.diag(own) * (np.arange(6) == at)) for at in (1, 2)]
    halved = [np.linalg.inv(noise + own + more)[0, 0] for more in halves]
    expected = [joint[0, 0], perfect, by_noise, parts[0], parts[3:].sum(), *parts[1:3], *halved]
    np.testing.assert_allclose(np.square(found), expected, rtol=1e-6)


@each("factor", [1e-300, 1e-4, 0.1, 1.0, 3.0, 10.0, 1e6])
def test_a_quantity_that_readings_do_not_tell_may_be_known_to_anything(factor: float) -> None:
    """Half of the variance comes from it; draws tell its slope, and what readings add to it."""
    rng, stated, draws = np.random.default_rng(7), pd.Series({"light_zenith": 1.0}), 2000
    z = rng.normal(size=(2, draws))
    joint = np.cov(np.stack([0.5 * z[0] + 0.5 * z[1], z[1]]))
    sd, _, _, _, part, _ = _row(joint, 1.0, stated, factor * stated)
    # Its precision, in units of the prior's, is known to so much, and the slope to this factor.
    off, slack = 5.0 * np.sqrt(2.0 / draws), 1.0 + 5.0 / np.sqrt(draws)
    least = factor / np.sqrt(1.0 + off * factor**2)
    assert 0.5 * np.hypot(1.0, least) / slack < sd < 0.5 * np.hypot(1.0, factor) * slack
    assert 0.0 <= part < 0.5 * slack * max(factor, 1e-6)


def test_what_has_no_budget_is_told(capture, fit) -> None:
    for known, said in (
        ("light_zenith=0.2", "known: it is 'light_zenith=0.2'; give a mapping"),
        ({"sample_lean_offset": 0.2}, "it is no input quantity of this fit"),
    ):
        with pytest.raises(pb.FitError, match=said):
            pb.budget(fit, known=known)
    with pytest.raises(
        pb.FitError, match="no input quantity of this scene; give it as sample_lean"
    ):
        pb.fit(capture, known={"sample_lean_offset": 0.2}, **ASKED)
    with pytest.raises(pb.FitError, match="a point fit has no intervals"):
        pb.budget(pb.fit(capture, **ASKED | {"method": "point"}))


def test_a_discrepancy_has_a_column_of_its_own() -> None:
    result = make_result(wavelengths=(), views=12, draws=300, variables=("dop",), discrepancy=True)
    posterior = result["posterior"].to_dataset()
    weight = posterior["discrepancy_weights"][..., 0]
    posterior["roughness"] = 0.2 + 0.03 * weight + 1e-4 * posterior["roughness"]
    result["posterior"] = posterior.assign(angle_zero=posterior["absorption"])
    table = pb.budget(edit_provenance(result, known={"angle_zero": 0.75}))
    quantities = ["angle_zero", "angle_zero halved"]
    assert list(table)[2:] == ["noise", "prior", "model discrepancy", *quantities]
    assert table.loc["roughness", "model discrepancy"] == pytest.approx(0.03, rel=0.2)


def test_it_is_kept_in_a_file_and_the_verdict_names_what_to_know_better(fit, tmp_path) -> None:
    pb.save(fit, tmp_path / "fit.nc")
    loaded = pb.load(tmp_path / "fit.nc")
    np.testing.assert_allclose(pb.budget(loaded), pb.budget(fit))
    (sentence,) = budget_sentences(loaded)
    assert sentence in pb.verdict(loaded).findings
    assert sentence.startswith(
        "The uncertainty of the set-up makes standard uncertainties larger than"
    )
    what, sd = better_known(view_of(fit), pb.budget(fit).loc["refractive_index"])
    assert what == "exponent of the sensor's tone curve known to 0.01 instead of 0.02"
    table = pb.budget(fit, known={"tone_curve": 0.01})
    assert sd == table.loc["refractive_index", "sd"]


def test_a_capture_states_what_its_set_up_is_known_to(capture: xr.Dataset) -> None:
    def widths(known: dict[str, float] | None) -> dict[str, float]:
        request = resolve(better, *asked, known=known)
        return {name: float(request.priors[f"{name}_offset"].scale) for name in KNOWN}

    better = capture.assign_attrs(sample_lean_uncertainty=0.05)
    asked = ("per_material", ASKED["scene"], None, None, None, 0, "double")
    usual = {"view_zenith_scale": 0.005, "tone_curve": 0.01}
    assert widths(None) == pytest.approx(usual | {"sample_lean": 0.05})
    assert widths({"sample_lean": 0.1}) == pytest.approx(usual | {"sample_lean": 0.1})


def test_what_only_adds_is_known_to_its_standard_deviation(capture: xr.Dataset) -> None:
    setup = Setup(PLATE, LINKS, known=(AmbientLight(),))
    asked = ("per_material", setup, None, None, None, 0, "double")
    request = resolve(capture, *asked, known={"ambient_light": 0.01})
    assert "uncertainty of ambient_light (0.01)" in request.swapped
    prior = request.priors["ambient_light_offset"]
    np.testing.assert_allclose(np.sqrt(prior.variance), 0.01, rtol=1e-6)  # single precision
    assert type(prior) is type(pb.PRIORS["ambient_light_offset"])


def test_what_to_know_better_stands_beside_further_views(fit: xr.DataTree) -> None:
    told = fit.copy()
    told["next_views"] = xr.Dataset(
        {
            "interval_width": (("step", "parameter"), [[1.0, 1.0], [0.96, 0.5]]),
            "halved_width": (("quantity", "parameter"), [[0.6, 0.9], [0.5, 0.95]]),
            "uncertainty": ("quantity", [0.2, 0.02]),
            **{name: ("pick", [70.0]) for name in ("view_zenith", "light_zenith")},
            **{name: ("pick", [180.0]) for name in ("view_azimuth", "light_azimuth")},
        },
        coords={
            "parameter": ["refractive_index", "subsurface_fraction"],
            "quantity": ["sample_lean_offset", "tone_curve_offset"],
        },
    )
    views, better = next_sentences(view_of(told))
    assert views.startswith("Measure next at zenith 70, azimuth 180: ")
    assert better == (
        "Without further views, the exponent of the sensor's tone curve known to 0.01 instead of "
        "0.02 narrows the 95% interval of refractive_index by 50% (these views: 4%)."
    )
    assert len(next_sentences(view_of(fit))) == 1


@each(
    "known, message",
    [
        ({"lamp": 1.0}, "known: lamp: {}; give some of "),
        ({"sample_lean": 0.0}, "known: sample_lean: it is 0.0; give a number above 0"),
        ({"sample_lean": "1"}, "known: sample_lean: it is '1'; give a number above 0"),
        ({"sample_lean": True}, "known: sample_lean: it is True; give a number above 0"),
    ],
)
def test_what_cannot_be_known_is_refused(fit, capture, known: dict, message: str) -> None:
    doors = {
        "it is no input quantity of this fit": lambda: pb.budget(fit, known=known),
        "no input quantity of this scene": lambda: pb.fit(capture, known=known, **ASKED),
    }
    for what, door in doors.items():
        with pytest.raises(pb.FitError, match=f"^{re.escape(message.format(what))}"):
            door()
    with pytest.raises(
        pb.FitError, match="capture: sample_lean_uncertainty: it is 'by eye'; give a"
    ):
        pb.fit(capture.assign_attrs(sample_lean_uncertainty="by eye"), **ASKED)


@each(
    "name, hint",
    [
        ("roughness", "give some of light_zenith, "),
        ("dolp_gain", "state its prior, by priors={'dolp_gain': ...}"),
    ],
)
def test_what_is_no_error_of_the_set_up_keeps_its_prior(name: str, hint: str) -> None:
    capture = pb.simulate("plastic", scene="camera", seed=0)
    message = f"known: {name}: no input quantity of this scene; {hint}"
    with pytest.raises(pb.FitError, match=f"^{re.escape(message)}"):
        pb.fit(capture, known={name: 0.02})


def test_a_set_up_that_states_nothing_has_no_budget(capture) -> None:
    nothing = make_result(wavelengths=(), views=12, draws=300, variables=("dop",))
    assert budget_sentences(nothing) == ()
    with pytest.raises(pb.FitError, match="it has no input quantities of its set-up; fit with a"):
        pb.budget(nothing)
    with pytest.raises(pb.FitError, match="no input quantity of this scene; a scene's terms state"):
        pb.fit(capture, known={"sample_lean": 0.1}, **PERFECT)


@pytest.mark.thorough
def test_a_model_that_does_not_know_of_a_quantity_is_fitted_without(capture, perfect) -> None:
    def own(data, scene, priors, links):
        names = ("subsurface_fraction", "refractive_index")
        given = {name: numpyro.sample(name, priors[name]) for name in names}
        scale = numpyro.sample("stokes_error_factor", priors["stokes_error_factor"])
        prediction, noise = scene.predict(given, data.geometry), {"stokes_error_factor": scale}
        likelihood = links["q"].distribution("q", prediction, data, noise)
        with numpyro.plate("view", data.shape[-1]):
            numpyro.sample("q", likelihood, obs=data.readings["q"])

    found = pb.fit(capture, model=own, **ASKED)
    np.testing.assert_allclose(sds(found), sds(perfect), rtol=RELATIVE)


def test_a_quantity_that_changes_no_reading_is_left_out(capture: xr.Dataset) -> None:
    setup = Setup(PLATE, LINKS, known=(AnalyzerRoll(), ToneCurve()))
    request = resolve(capture, "per_material", setup, None, None, None, 0, "double")
    assert request.scene.instrument.terms == (ToneCurve(),)
