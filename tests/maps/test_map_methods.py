"""Maps by other ways than one mode: weighted draws of mixtures and chains in every pixel."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from cases import each
from plate_images import ASKED, NAMES, NOISE, VIEWS, on_a_grid, planned, plate_image
from toy_models import BEND, bent, squared

import polar_bayes as pb
from polar_bayes.inference.batch_modes import find_conditional_modes
from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.methods import importance
from polar_bayes.methods.method import AbstractMethod
from polar_bayes.reporting.text import METHODS_USED


@pytest.fixture(scope="module")
def image() -> xr.Dataset:
    return plate_image(3, 4, seed=6)


class OneByOne(pb.methods.Importance):
    """A method with the same settings that fits one pixel after another."""

    run_batch = AbstractMethod.run_batch


def assert_as_on_a_grid(maps: xr.Dataset, image: xr.Dataset) -> None:
    """Eight standard normals, in pairs: the largest is above 4.5 in one of ten thousand cases."""
    assert (maps["status"] == Status.GOOD).all()
    for y, x in np.ndindex(maps["status"].shape):
        truth = on_a_grid(image["q"].values[y, x], NOISE, VIEWS)
        for name in NAMES:
            mean, sd, _ = truth[name]
            error = sd / np.sqrt(maps["ess"].values[y, x])
            assert abs(maps[name].values[y, x] - mean) < 4.5 * error


@pytest.mark.thorough
@each("kind", [OneByOne, pb.methods.Importance])
def test_importance_sampling_makes_a_map(image: xr.Dataset, kind: type) -> None:
    method = kind(draws=1024)
    some = image.isel(y=[0, 1], x=[0, 1])
    maps = pb.fit_pixels(some, method=method, **ASKED)
    assert (maps["method"] == MethodUsed.IMPORTANCE).all()
    assert (maps["pareto_k"] <= 0.7).all()
    assert_as_on_a_grid(maps, some)
    # A pixel's answer does not depend on the others.
    alone = pb.fit_pixels(some.isel(y=[0], x=[0]), method=method, **ASKED)
    assert (alone[NAMES[0]].values == maps[NAMES[0]].values[:1, :1]).all()


@pytest.mark.thorough
def test_a_pixel_without_a_mode_is_searched_by_the_method_of_one_capture(image, monkeypatch):
    one = image.isel(y=[0], x=[0])
    monkeypatch.setattr(importance, "find_all_modes", lambda *_: (np.zeros(0, int), None))
    assert_as_on_a_grid(pb.fit_pixels(one, method=pb.methods.Importance(draws=1024), **ASKED), one)


def test_modes_given_one_coordinate_are_found_around_a_bend(image: xr.Dataset) -> None:
    one = image.isel(y=[0], x=[0])
    plan = planned(one, model=bent)
    at = {name: int(index) for name, index in plan.engine.program.positions.items()}
    z, fixed = np.zeros((3, 3)), np.full(3, at["place"])
    z[:, at["place"]] = place = np.array([-2.0, 0.5, 3.0])
    batch = plan.batch(one).subset(np.zeros(3, int))
    found, value, _ = find_conditional_modes(batch, z, fixed)
    along = place / (1.0 + BEND**2)
    expected = {"along": along, "across": along**2, "place": place}
    for name, truth in expected.items():
        np.testing.assert_allclose(found[:, at[name]], truth, atol=1e-6)
    # What is left of the potential, beside a constant, is that of the two others.
    height = 0.5 * (along**2 + ((place - along) / BEND) ** 2)
    np.testing.assert_allclose(np.diff(value), np.diff(height), rtol=1e-6)


def test_a_second_mode_that_another_start_finds_is_not_left_out(image: xr.Dataset) -> None:
    """Roots of either sign: half of the posterior has each, and normal draws at one look good."""
    positive = image.assign(q=xr.full_like(image["q"], 0.36)).isel(y=[0], x=slice(3))
    asked = ASKED | {"model": squared}
    one = pb.fit_pixels(positive, **asked)
    assert (one["method"] == MethodUsed.IMPORTANCE).all()
    maps = pb.fit_pixels(positive, method=pb.methods.CorrectedLaplace(starts=4), **asked)
    assert (maps["status"] == Status.GOOD).all()
    for x in range(3):
        error = 0.6 / np.sqrt(float(maps["ess"][0, x]))
        assert abs(float(maps["root"][0, x])) < 4.5 * error
        low, high = maps["root_quantile"][[0, -1], 0, x]
        assert float(low) < -0.5 < 0.5 < float(high)


@pytest.mark.thorough
def test_the_map_says_how_it_was_made(image: xr.Dataset, tmp_path: Path) -> None:
    weighted = pb.fit_pixels(image, method="importance", **ASKED)
    assert json.loads(weighted.attrs[PROVENANCE])["method"] == "importance"
    page = pb.report(weighted, tmp_path / "report").read_text()
    assert "importance sampling from mixtures at all modes" in page
    assert len(METHODS_USED) == len(MethodUsed)  # each has a color
    assert "all by weighted draws of normal approximations" in page
