"""Ranks of readings against exact ones, and what cannot be ranked."""

import jax
import numpy as np
import numpyro
import pytest
import xarray as xr
from numpyro import distributions as dist
from plates import plate_capture
from scipy import stats
from synthetic_calibrations import make_calibration

import polar_bayes as pb
from polar_bayes.calibration.predictive import (
    PredictivePit,
    _choose,
    unranked_reason,
)
from polar_bayes.calibration.runner import draw_captures
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem_batch import problem_batch
from polar_bayes.inference.program import compile_program
from polar_bayes.observation.data import observe

NOISE, FITS = 0.1, 300


def shifted(data):
    """One unknown level that every view reads with the same noise."""
    level = numpyro.sample("level", dist.Normal(0.0, 0.3))
    with numpyro.plate("view", data.shape[-1]):
        likelihood = dist.Normal(level, NOISE).mask(data.valid)
        numpyro.sample("q", likelihood, obs=data.readings["q"])


@pytest.fixture(scope="module")
def read():
    """Exact draws of the posterior of every fit, and what stands where among them."""
    capture = plate_capture(np.linspace(30.0, 70.0, 5), 0.03, seed=0)
    valid = xr.DataArray([True, True, False, True, True], dims="view")
    data = observe(capture.assign(valid=valid))
    program, numbers = compile_program(shifted, data), np.arange(FITS)
    engine = CompiledModel(lambda: shifted, program, data, "double")
    drawn = draw_captures(program, data, numbers, jax.random.key(3), replicate=True)
    again = drawn.replicated
    batch = problem_batch(engine, drawn.captures, numbers, seed=4)
    readings = PredictivePit(batch, again, numbers)
    q = np.asarray(drawn.captures.batched.readings["q"])[:, valid.to_numpy()]
    variance = 1.0 / (1.0 / 0.3**2 + q.shape[1] / NOISE**2)
    mean = variance * q.sum(axis=1) / NOISE**2
    random = np.random.default_rng(5)
    draws = mean[:, None] + np.sqrt(variance) * random.standard_normal((FITS, 1000))
    readings.describe(numbers, {"level": draws}, np.full(draws.shape, 1e-3))
    return readings, drawn, again, mean, variance


def test_they_stand_where_the_exact_prediction_has_them(read) -> None:
    """Within what 128 draws can tell: 0.044 at the middle of each, less at its ends."""
    readings, drawn, again, mean, variance = read
    place = readings.entry["q"]
    rows = np.arange(FITS)
    fresh = again["q"][rows, place]
    exact = stats.norm.cdf(fresh, mean, np.sqrt(variance + NOISE**2))
    left = np.asarray(drawn.captures.batched.readings["q"])[rows, place]
    precision = 1.0 / variance - 1.0 / NOISE**2
    without = (mean / variance - left / NOISE**2) / precision
    exact_left = stats.norm.cdf(left, without, np.sqrt(1.0 / precision + NOISE**2))
    for found, expected in ((readings.fresh["q"], exact), (readings.left_out["q"], exact_left)):
        away = found - expected
        assert np.sqrt(np.mean(away**2)) < 0.05
        assert abs(away.mean()) < 3.9 * away.std() / np.sqrt(FITS)
        assert stats.kstest(found, "uniform").pvalue > 1e-3
    assert np.mean(readings.left_out_k["q"] > 0.7) < 0.1


def test_masked_entries_are_never_chosen(read) -> None:
    assert set(read[0].entry["q"]) == {0, 1, 3, 4}
    valid = np.array([[False, True, True], [False, False, False]])
    for chance in (0.0, 0.49, 0.5, 0.999999):
        found = _choose(valid, np.full(2, chance))
        assert found.tolist() == [1 if chance < 0.5 else 2, -1]


@pytest.mark.thorough
def test_a_model_whose_draws_do_not_say_all_is_told() -> None:
    """Of a pooled parameter the draws hold the value, not the coordinate that makes it."""

    def pooled(data):
        place = numpyro.sample("place", dist.Normal(0.0, 1.0), infer={"auxiliary": True})
        level = numpyro.deterministic("level", 0.3 * place)
        with numpyro.plate("view", data.shape[-1]):
            numpyro.sample("q", dist.Normal(level, NOISE), obs=data.readings["q"])

    data = observe(plate_capture(np.linspace(30.0, 70.0, 5), 0.03, seed=0))
    given = {"level": ()}
    program = compile_program(pooled, data)
    assert "draws do not hold place" in unranked_reason(program, program, data, given)
    plain = compile_program(shifted, data)
    assert unranked_reason(plain, plain, data, given) == ""


@pytest.mark.thorough
def test_readings_are_judged_by_themselves() -> None:
    good, bad = make_calibration(readings={}), make_calibration(readings={"dop": 0.7})
    for tree in (good, bad):
        table = pb.calibration.calibration_readings(tree)
        assert list(table.index) == [
            "dop, fresh", "dop, left out", "intensity, fresh", "intensity, left out"
        ]  # fmt: skip
        assert (
            pb.verdict(tree)
            .sentences[0]
            .startswith("Calibrated: the ranks, coverage and spread of 3")
        )
        assert pb.calibration.is_calibrated(pb.summary(tree))
    said = pb.verdict(good).sentences
    assert (
        "Readings (dop, intensity; fresh ones and ones left out) pass a separate joint test"
        in said[1]
    )
    said = pb.verdict(bad).sentences
    assert " fail a separate joint test that a right model fails 5%" in said[1]
    assert "dop, fresh: predictions are too narrow (p = 0.0001)." in said
    assert not any(line.startswith("intensity") and "too narrow" in line for line in said)
    assert any(line.startswith("dop, left out: in 40 of 400 fits the weights") for line in said)


def test_what_was_not_ranked_is_told() -> None:
    tree = make_calibration(readings=None)
    with pytest.raises(pb.FitError, match="no ranks of readings; give what polar_bayes"):
        pb.calibration.calibration_readings(tree)
    assert not any("eadings" in line for line in pb.verdict(tree).sentences)
    why = make_calibration(readings=None, why_not_ranked="draws do not hold place")
    assert pb.verdict(why).sentences[-1] == "Readings were not ranked: draws do not hold place."
