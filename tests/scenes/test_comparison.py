"""The comparison of scenes, the stacked posterior, and what is said about them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpyro import distributions as dist
from plates import LINKS, PLATE, plate_capture

import polar_bayes as pb
from polar_bayes.scenes.candidates import scene_library
from polar_bayes.scenes.comparison import FitArguments, between_scenes, stacking_weights
from polar_bayes.scenes.sentences import SceneComparison
from polar_bayes.scenes.stacking import stack_fits
from polar_bayes.setups import SETUPS
from polar_bayes.simulation import Protocol

MIRROR = pb.Scene(pb.SmoothSurface())
SCENES = {"mirror": MIRROR, "with body": PLATE}


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 75.0, 14), 0.004, seed=2)


@pytest.fixture(scope="module")
def comparison(capture: xr.Dataset) -> SceneComparison:
    return pb.compare_scenes(capture, SCENES, links=LINKS)


def test_the_scene_of_the_data_predicts_best(comparison: SceneComparison) -> None:
    assert comparison.table.index[0] == "with body"
    assert comparison.table["weight"].sum() == pytest.approx(1.0)
    assert comparison.weights["with body"] > 0.5
    low, high = comparison.intervals.loc[("refractive_index", "with body"), ["q2.5", "q97.5"]]
    assert low < 1.5 < high
    assert ("subsurface_fraction", "mirror") not in comparison.intervals.index


def test_a_prior_is_used_by_the_scenes_that_read_it(capture: xr.Dataset) -> None:
    priors = {"subsurface_fraction": dist.Beta(1.0, 9.0)}
    arguments = FitArguments(capture, "per_material", priors, LINKS, None, 0, "double")
    among = arguments.among(SCENES.values())
    assert among.request(PLATE).priors["subsurface_fraction"] is priors["subsurface_fraction"]
    assert "subsurface_fraction" not in among.request(MIRROR).priors
    with pytest.raises(pb.FitError, match="roughness"):
        dataclasses.replace(among, priors={"roughness": dist.HalfNormal(0.1)}).request(PLATE)


def test_a_stacked_posterior_is_a_fit_with_draws_of_every_scene(
    comparison: SceneComparison, tmp_path: Path
) -> None:
    weights = {"mirror": 0.25, "with body": 0.75}
    stacked = stack_fits(comparison.fits, weights)
    n = stacked["posterior"]["refractive_index"]
    each = {
        name: np.isin(n, fit["posterior"]["refractive_index"]).mean()
        for name, fit in comparison.fits.items()
    }
    assert each["mirror"] == pytest.approx(0.25, abs=0.02)
    assert each["with body"] == pytest.approx(0.75, abs=0.02)
    assert set(stacked["posterior"].data_vars) == {"refractive_index", "stokes_error_factor"}
    assert pb.verdict(stacked).converged
    pb.save(stacked, tmp_path / "fit.nc")
    assert "posterior" in pb.load(tmp_path / "fit.nc", "fit").children
    assert pb.summary(stacked).loc["refractive_index", "sd"] > 0.0


def test_the_share_between_scenes_follows_the_law_of_total_variance(
    comparison: SceneComparison,
) -> None:
    weights = comparison.table["weight"] * 0.0 + 0.5
    share = between_scenes(comparison.intervals, weights)
    stacked = stack_fits(comparison.fits, {"mirror": 0.5, "with body": 0.5})
    total = float(stacked["posterior"]["refractive_index"].var())
    means = comparison.intervals.loc["refractive_index", "mean"]
    between = 0.25 * float(means.iloc[0] - means.iloc[1]) ** 2
    assert share["refractive_index"] == pytest.approx(between / total, rel=0.1)
    assert list(share.index) == ["refractive_index"]


def test_weights_favor_the_better_and_share_between_equals() -> None:
    noise = np.random.default_rng(0).normal(size=(40, 1))
    alike = stacking_weights(np.hstack([noise, noise]))
    assert alike == pytest.approx([0.5, 0.5])
    better = stacking_weights(np.hstack([noise, noise - 1.0]))
    assert better[0] > 0.99


def test_sentences_name_the_scenes_and_why_others_went(comparison: SceneComparison) -> None:
    said = " ".join(pb.scenes.scene_sentences(comparison))
    assert "with body" in said
    assert "2 scenes were fitted" in said
    assert list(pb.scenes.scene_table(comparison)["weight"]) == list(comparison.table["weight"])


def test_what_is_no_scene_is_refused(capture: xr.Dataset) -> None:
    with pytest.raises(pb.FitError, match="nothing to compare"):
        pb.compare_scenes(capture, {})
    with pytest.raises(pb.SceneError, match="is no scene"):
        pb.compare_scenes(capture, {"a": "goniometer"})  # type: ignore[dict-item]
    with pytest.raises(pb.FitError, match="no such method"):
        pb.fit(capture, scene="auto", method="none")
    with pytest.raises(pb.FitError, match="no width to compare"):
        pb.fit(capture, scene="auto", method="point")


@pytest.mark.thorough
def test_systematic_errors_do_not_stand_in_for_another_body() -> None:
    """A sample that leans by a degree, whose body is not that of its set-up.

    Beside the body of the set-up, systematic errors predicted better than the leaning normal, and
    the roughness was twelve sds off.
    """
    layout = Protocol(views=24, largest_view_zenith=80.0, wavelengths=())
    parts = ("rough surface", "unpolarized body", "", "leaning normal")
    capture = pb.simulate(
        "plastic",
        scene=scene_library(pb.simulate(scene="camera", protocol=layout)).scene(parts),
        links=SETUPS["camera"].links,
        protocol=layout,
        parameters={"roughness": 0.08, "subsurface_fraction": 0.72, "refractive_index": 1.5}
        | {"normal_tilt_x": -0.85, "normal_tilt_y": 0.45},
        seed=19,
    )
    comparison = pb.compare_scenes(capture.assign_attrs(setup="camera"))
    assert all("unpolarized body" in name for name in comparison.weights)
    assert all("leaning normal" in name for name in comparison.weights)
    best = comparison.intervals.xs(comparison.table.index[0], level="scene")
    assert best.loc["roughness", "q2.5"] < 0.08 < best.loc["roughness", "q97.5"]
