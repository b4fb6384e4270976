"""The uncertainty budget: what it adds is what other fits say, and it names what to know better."""

import dataclasses

import numpy as np
import pytest
import xarray as xr
from cases import each
from plates import LINKS, PLATE, plate_capture

import polar_bayes as pb
from polar_bayes.capture.input_quantities import (
    AmbientLight,
    AnalyzerRoll,
    LightAzimuth,
    LightZenith,
    PolarizationGain,
    SampleLean,
    ToneCurve,
    ViewZenithScale,
)
from polar_bayes.diagnostics.budget import budget_sentences, variance_shares
from polar_bayes.diagnostics.view import view_of
from polar_bayes.reporting.text import setup_beside_views
from polar_bayes.setups import SETUPS, Setup

KNOWN = (SampleLean(0.2), ViewZenithScale(0.002), PolarizationGain(0.01), ToneCurve(0.01))
ASKED = {"method": pb.methods.Laplace(draws=500), "seed": 5}


def setup(*known: pb.input_quantities.AbstractInputQuantity) -> Setup:
    return Setup(PLATE, LINKS, known=known)


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 75.0, 12), 0.01, seed=2)


@pytest.fixture(scope="module")
def fit(capture: xr.Dataset) -> xr.DataTree:
    return pb.fit(capture, scene=setup(*KNOWN), **ASKED)


@pytest.mark.parametrize(
    "quantity",
    [
        pytest.param(x, id=x.name, marks=[pytest.mark.thorough] if x in KNOWN[2:] else [])
        for x in KNOWN
    ],
)
def test_a_contribution_is_the_change_that_other_fits_give(
    fit: xr.DataTree, capture: xr.Dataset, quantity: pb.input_quantities.AbstractInputQuantity
) -> None:
    """With the same random numbers: draws of either fit have the same errors."""
    table, u = pb.budget(fit), quantity.standard_uncertainty
    ends = [
        pb.summary(pb.fit(quantity.shifted(capture, x), scene=setup(), **ASKED))["mean"]
        for x in (-0.1 * u, 0.1 * u)
    ]
    expected = (ends[1] - ends[0])[table.index] / 0.2
    # Laplace draws stand for the posterior: its skewness moves means that the modes do not follow.
    np.testing.assert_allclose(table[quantity.name] / table["sd"], expected / table["sd"], atol=0.1)
    errors = [row[quantity.name] for row in table.attrs["mcse"].values()]
    assert np.max(errors / table["sd"]) < 0.05


def test_parts_add_in_squares(fit: xr.DataTree) -> None:
    table = pb.budget(fit)
    np.testing.assert_allclose(np.hypot(table["noise"], table["prior"]), table["sd"])
    assert (table["combined"] > table["sd"]).all()
    shares = variance_shares(table).drop(columns=["sd", "combined"])
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)


def test_what_is_known_better_contributes_less(fit: xr.DataTree) -> None:
    stated, better = pb.budget(fit), pb.budget(fit, known={"polarization_gain": 0.001})
    ratio = better["polarization_gain"] / stated["polarization_gain"]
    np.testing.assert_allclose(ratio, 0.1)
    same = ["sd", "sample_lean", "tone_curve"]
    np.testing.assert_array_equal(stated[same], better[same])


def test_it_is_kept_in_a_file_and_the_verdict_notes_it(fit: xr.DataTree, tmp_path) -> None:
    pb.save(fit, tmp_path / "fit.nc")
    loaded = pb.load(tmp_path / "fit.nc")
    np.testing.assert_allclose(pb.budget(loaded), pb.budget(fit))
    (sentence,) = budget_sentences(loaded)
    assert sentence in pb.verdict(loaded).findings
    assert sentence.startswith("The intervals assume a set-up that is known perfectly. With what")
    assert "comes from the gain of polarization, known to 0.01; known to 0.005, it" in sentence


def test_a_capture_states_what_its_set_up_is_known_to(capture: xr.Dataset) -> None:
    better = capture.assign_attrs(sample_lean_uncertainty=0.05)
    found = pb.budget(pb.fit(better, scene=setup(*KNOWN), **ASKED)).attrs["known"]
    assert found == {each.name: each.standard_uncertainty for each in KNOWN} | {"sample_lean": 0.05}
    wrong = capture.assign_attrs(sample_lean_uncertainty="by eye")
    with pytest.raises(pb.FitError, match="SampleLean: standard_uncertainty: it is 'by eye'; give"):
        pb.fit(wrong, scene=setup(*KNOWN), **ASKED)


def test_views_are_weighed_against_the_set_up(fit: xr.DataTree) -> None:
    told, table = fit.copy(), pb.budget(fit)
    sd, combined = table.loc["refractive_index", ["sd", "combined"]]
    told["next_views"] = xr.Dataset(
        {
            "interval_width": (("step", "parameter"), [[3.92 * sd], [0.0]]),
            **{name: ("pick", [70.0]) for name in ("view_zenith", "light_zenith")},
            **{name: ("pick", [180.0]) for name in ("view_azimuth", "light_azimuth")},
        },
        coords={"parameter": ["refractive_index"]},
    )
    by_views = 1.0 - np.sqrt(1.0 - (sd / combined) ** 2)
    half = pb.budget(fit, known={"polarization_gain": 0.005}).loc["refractive_index", "combined"]
    (sentence,) = setup_beside_views(view_of(told))
    assert sentence == (
        "With what the set-up is known to, these views narrow the 95% interval of "
        f"refractive_index by {by_views:.0%}; the gain of polarization known to 0.005 instead of "
        f"0.01 narrows it by {1.0 - half / combined:.0%}."
    )
    assert setup_beside_views(view_of(fit)) == []


@each(
    "known, message",
    [
        (
            {"lamp": 1.0},
            "known: lamp: it is no input quantity of this fit; give some of sample_",
        ),
        ({"sample_lean": 0.0}, "known: sample_lean: it is 0.0; give a number above 0"),
        ({"sample_lean": "1"}, "known: sample_lean: it is '1'; give a number above 0"),
    ],
)
def test_what_cannot_be_known_is_refused(fit: xr.DataTree, known: dict, message: str) -> None:
    with pytest.raises(pb.FitError) as caught:
        pb.budget(fit, known=known)
    assert str(caught.value).startswith(message)


@each(
    "damage",
    [
        lambda group: group.assign_coords(statistic=["shift", "shift"]),
        lambda group: group.assign_coords(quantity=["sample_lean"] * 4),
        lambda group: group.assign(standard_uncertainty=0.0 * group["standard_uncertainty"]),
    ],
    ids=["statistic", "quantity", "uncertainty"],
)
def test_a_group_that_no_fit_wrote_is_refused(fit: xr.DataTree, damage) -> None:
    fit["input_shifts"] = xr.DataTree(damage(fit["input_shifts"].to_dataset()))
    with pytest.raises(pb.FitError, match="input_shifts: it states no input quantities; fit again"):
        pb.verdict(fit)


def test_a_set_up_that_states_nothing_has_no_budget(capture: xr.Dataset) -> None:
    silent = pb.fit(capture, scene=setup(), **ASKED)
    assert budget_sentences(silent) == ()
    with pytest.raises(pb.FitError, match="does not say what its set-up is known to; fit with a"):
        pb.budget(silent)
    with pytest.raises(pb.FitError, match=r"LightZenith: standard_uncertainty: it is -1\.0; give"):
        LightZenith(-1.0)


# --- What a quantity does to a capture ------------------------------------------------------------

PERFECT = xr.Dataset(
    {
        "view_zenith": ("view", [0.0, 30.0, 60.0]),
        "view_azimuth": ("view", [180.0, 180.0, 0.0]),
        "light_zenith": ("view", [40.0, 40.0, 40.0]),
        "light_azimuth": ("view", [0.0, 0.0, 0.0]),
        "q": ("view", [0.2, 0.6, -0.3]),
        "u": ("view", [0.0, 0.1, 0.2]),
        "intensity": ("view", [1.0, 0.5, 0.1]),
    }
)


def frames(capture: xr.Dataset, power: float) -> xr.Dataset:
    """Recorded by frames whose counts are a power of light."""
    total, found = capture["intensity"], {}
    for name in ("q", "u"):
        one, other = ((total * (1.0 + sign * capture[name])) ** power for sign in (1.0, -1.0))
        found[name] = (one - other) / (one + other)
    return capture.assign(found | {"intensity": total**power})


def turned(capture: xr.Dataset, degrees: float) -> xr.Dataset:
    stokes = (capture["q"] + 1j * capture["u"]) * np.exp(2j * np.radians(degrees))
    return capture.assign(q=stokes.real, u=stokes.imag)


RECORDED = {
    LightZenith(1.0): lambda true: true.assign(light_zenith=true["light_zenith"] - 0.1),
    LightAzimuth(1.0): lambda true: true.assign(light_azimuth=true["light_azimuth"] - 0.1),
    ViewZenithScale(1.0): lambda true: true.assign(view_zenith=true["view_zenith"] / 1.1),
    SampleLean(1.0): lambda true: true.assign(
        light_zenith=true["light_zenith"] - 0.1,
        view_zenith=true["view_zenith"] + [0.1, 0.1, -0.1],
    ),
    AnalyzerRoll(1.0): lambda true: turned(true, 0.1),
    PolarizationGain(1.0): lambda true: true.assign(q=1.1 * true["q"], u=1.1 * true["u"]),
    AmbientLight(1.0): lambda true: true.assign(
        q=true["q"] * true["intensity"] / (true["intensity"] - 0.1 / 1.1),
        u=true["u"] * true["intensity"] / (true["intensity"] - 0.1 / 1.1),
        intensity=true["intensity"] - 0.1 / 1.1,
    ),
    ToneCurve(1.0): lambda true: frames(true, 1.1),
}


@each("quantity, record", RECORDED.items(), ids=lambda each: getattr(each, "name", ""))
def test_a_shifted_capture_is_that_of_a_perfect_instrument(quantity, record) -> None:
    shifted = quantity.shifted(record(PERFECT), 0.1)
    xr.testing.assert_allclose(shifted, PERFECT, rtol=1e-12)
    xr.testing.assert_allclose(quantity.shifted(PERFECT, 0.0), PERFECT, rtol=1e-14)


def test_noise_beyond_full_polarization_stays() -> None:
    noisy = PERFECT.assign(q=("view", [1.02, -1.0, np.nan]))
    xr.testing.assert_identical(ToneCurve(1.0).shifted(noisy, 0.1)["q"], noisy["q"])


def test_every_quantity_is_in_a_set_up_and_in_this_test() -> None:
    stated = {type(known) for own in SETUPS.values() for known in own.known}
    assert stated == set(map(type, RECORDED))
    assert not AnalyzerRoll(0.3).acts_on(PERFECT.drop_vars("u"))
    assert all(dataclasses.replace(known) == known for known in RECORDED)
