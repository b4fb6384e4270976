"""Calibration of lines and plates, whose fits take no time: right methods pass, broken do not."""

import re
import sys

import numpy as np
import numpyro.distributions as dist
import pytest
import xarray as xr
from cases import each
from numpyro import handlers
from plates import KNOWN, LINKS, ON_PLATE, PLATE, plate_capture
from synthetic_calibrations import assert_held_as_stated
from toy_models import line

import polar_bayes as pb
from polar_bayes import progress
from polar_bayes.calibration.calibrate import Forecast, make_plan
from polar_bayes.calibration.runner import fit_block
from polar_bayes.inference.request import resolve
from polar_bayes.models.per_material import per_material

ASKED = KNOWN | {"method": "importance"}
OF_LINES = ON_PLATE | {"model": line, "method": "laplace"}
"""A model that compiles in a moment, whose posterior is normal."""

COUNT = 600


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return plate_capture(np.array([30.0, 36.0, 42.0, 68.0, 74.0, 80.0]), 0.03, seed=0)


@pytest.fixture(scope="module")
def corrected(capture: xr.Dataset) -> xr.DataTree:
    return pb.calibrate(capture, simulations=COUNT, **OF_LINES)


def test_what_is_right_passes(corrected: xr.DataTree) -> None:
    assert_passes(corrected)


@pytest.mark.thorough
@each("method", ["importance", "corrected-laplace", "nuts"])
def test_every_right_method_passes(method: str, capture: xr.Dataset) -> None:
    assert_passes(pb.calibrate(capture, simulations=COUNT, **ASKED | {"method": method}))


def assert_passes(calibration: xr.DataTree) -> None:
    """At a rate of false alarms of 5%, with a fixed seed."""
    table = pb.summary(calibration)
    assert pb.calibration.is_calibrated(table)
    assert pb.verdict(calibration).sentences[0].startswith("Calibrated: ")
    assert_held_as_stated(table, COUNT)
    assert (table["failed"] <= 3).all()  # chains that did not mix say so, and count as misses


TOO_SURE = {"model": handlers.condition(per_material, data={"stokes_error_factor": 2.0})}
HEAVY = {"q": pb.links.StokesLink(stated_errors=True, degrees_of_freedom=2.1)}
BROKEN = {
    "prior": ({"priors": {"refractive_index": dist.Uniform(1.2, 2.0)}}, "refractive_index"),
    "noise": (TOO_SURE, "subsurface_fraction"),
    "link": ({"links": HEAVY}, "subsurface_fraction"),
}


@pytest.mark.thorough
@each("broken", BROKEN)
def test_what_is_broken_on_purpose_is_caught(capture: xr.Dataset, broken: str) -> None:
    truth, parameter = BROKEN[broken]
    calibration = pb.calibrate(capture, simulations=COUNT, truth=truth, **ASKED)
    table = pb.summary(calibration)
    assert not pb.calibration.is_calibrated(table)
    assert table.loc[parameter, "p_value"] < 0.025
    verdict = pb.verdict(calibration).sentences
    assert verdict[0].startswith("Not calibrated: ")
    assert any(line.startswith(f"{parameter}: ") for line in verdict[1:])
    if broken == "noise":  # which readings see, too
        readings = pb.calibration.calibration_readings(calibration)
        assert (readings["p_value"] < 1e-3).all()
        assert (readings["rank_spread"] > 1.1).all()


def test_the_tree_holds_every_fit(corrected: xr.DataTree) -> None:
    ranked = {"predictive_pit", "loo_pit", "readings"}
    assert set(corrected.children) == {"prior_sbc", "truth", "marginals", "fits"} | ranked
    assert dict(corrected["prior_sbc"].sizes) == {"simulation": COUNT}
    fits = corrected["fits"].to_dataset()
    assert set(fits.data_vars) >= {"status", "method", "pareto_k", "ess", "steps"}
    pit = corrected["prior_sbc"]["slope"]
    assert float(pit.min()) > 0.0
    assert float(pit.max()) < 1.0


def test_readings_of_a_right_model_pass(corrected: xr.DataTree) -> None:
    table = pb.calibration.calibration_readings(corrected)
    assert list(table.index) == ["q, fresh", "q, left out"]
    assert pb.calibration.is_calibrated(table)
    said = " ".join(pb.verdict(corrected).sentences)
    assert "Readings (q; fresh ones and ones left out) pass" in said
    views = corrected["readings"]["q_view"].to_numpy()
    assert np.bincount(views, minlength=6).min() > 60  # all six, equally likely


@pytest.mark.thorough
def test_simulations_are_the_same_whatever_is_off_and_however_many_there_are(capture, corrected):
    bare = pb.calibrate(capture, simulations=64, readings=False, **OF_LINES)
    assert set(bare.children) == {"prior_sbc", "truth", "marginals", "fits"}
    assert not any("eadings" in line for line in pb.verdict(bare).sentences)
    for name in bare.children:
        some = corrected[name].to_dataset().isel(simulation=slice(64))
        xr.testing.assert_identical(bare[name].to_dataset(), some)


def test_mistakes_are_told(capture: xr.Dataset) -> None:
    for asked, said in (
        ({"simulations": 5}, "simulations is 5; give 20 or more"),
        ({"method": "point"}, "point gives no draws of many captures"),
        ({"method": "hmc"}, "no such method; give one of laplace, importance, "),
        ({"truth": {"seed": 1}}, "seed cannot differ"),
    ):
        with pytest.raises(pb.FitError, match=said):
            pb.calibrate(capture, **ASKED | asked)
    with pytest.raises(pb.FitError, match="it holds no fit; give the tree"):
        pb.summary(xr.DataTree())


def test_a_long_calibration_says_how_long_and_what_a_faster_method_makes_of_it(
    capture, capsys, monkeypatch
):
    monkeypatch.setattr(progress, "_write_line", [lambda text: sys.stderr.write(f"{text}\n")])
    asked = OF_LINES["model"], PLATE, None, LINKS, 90.0, 0, "double"
    plan = make_plan(resolve(capture, *asked), None, pb.methods.Laplace(), False)
    # More simulations than one block holds.
    blocks = [fit_block(plan, np.arange(*ends)) for ends in ((0, 4), (4, 8), (8, plan.block + 8))]
    brief, long = Forecast(plan, long=1e9), Forecast(plan, long=0.0)
    for block in blocks:
        brief.see(block, left=88)
        long.see(block, left=88)
    assert brief.sentence == ""
    assert capsys.readouterr().err.splitlines() == [long.sentence]
    said = (
        r"88 more fits by laplace take about \d+ min, by importance about [\d.]+ min; both trust "
    )
    assert re.fullmatch(
        said + rf"\d+ of {plan.block + 8}, whose means differ by at most [\d.]+ sd", long.sentence
    )
