"""Brewster's angle by eye against the prior of a fit, from what its file states alone."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from plates import LINKS, PLATE, plates
from synthetic_results import edit_provenance, make_result

import polar_bayes as pb
from polar_bayes.inference.request import resolve
from polar_bayes.scenes import fit_request as fitting

BOUNDS = {"refractive_index": [1.2, 2.0]}
FAR, NEAR, MOVED = [3.0, 3.5, 4.2, 0.98], [1.9, 2.1, 2.3, 0.98], [3.0, 3.5, 4.2, 0.7]


@pytest.fixture
def result() -> xr.DataTree:
    return make_result(wavelengths=(), variables=("dop",), views=16)


def row(result: xr.DataTree, **changes):
    found = {"bounds": BOUNDS, "indices_by_eye": {"": FAR}, **changes}
    return pb.diagnostics.criticize(edit_provenance(result, **found)).loc["index"]


@each(
    ("changes", "level"),
    [
        ({}, "problem"),
        ({"indices_by_eye": {"": NEAR}}, "caution"),
        ({"indices_by_eye": {"": MOVED}}, "passed"),
        ({"indices_by_eye": {}}, "passed"),
        ({"indices_by_eye": None}, "passed"),
        ({"bounds": {"refractive_index": [1.0, None]}}, "passed"),
        ({"bounds": {"roughness": [0.0, 2.0]}}, "passed"),
        ({"fixed": {"refractive_index": 1.5}}, "passed"),
        ({"indices_by_eye": {"material a": NEAR, "material b": FAR}}, "problem"),
    ],
    ids=str,
)
def test_the_level_follows_from_range_and_bounds(result, changes, level) -> None:
    found = row(result, **changes)
    assert found["level"] == level
    assert bool(found["sentence"]) == (level != "passed")


def test_a_zero_of_the_angles_that_is_hardly_known_makes_it_a_caution(result) -> None:
    """An index of 3 is Brewster's angle at 71.6 degrees, one of 2 at 63.4."""
    prior = result["prior"].to_dataset()
    zeros = np.random.default_rng(0).normal(size=prior["exposure"].shape)
    for sd, level in ((0.75, "problem"), (6.0, "caution")):
        both = prior.assign(angle_zero=(("chain", "draw"), sd * zeros))
        assert row(result.assign({"prior": xr.DataTree(both)}))["level"] == level


def test_the_location_of_a_population_excludes_no_member(result) -> None:
    for group in ("posterior", "prior"):
        dataset = result[group].to_dataset()
        dataset["refractive_index_location"] = dataset["refractive_index"]
        result[group] = xr.DataTree(dataset)
    found = row(result, bounds={"refractive_index_location": [1.2, 2.0]})
    assert found["level"] == "caution"
    assert (
        "priors={'refractive_index_location': TruncatedNormal(3.5, 0.6, low=1)}"
        in (found["sentence"])
    )


@each("given", [{}, {"coat": pb.ClearCoat(1.5, 0.1)}])
def test_a_fit_states_the_index_by_eye_of_each_material(given) -> None:
    """A coat moves the peak, so that it says nothing about what is below."""
    capture = plates([1.5, 2.4], 0.002, np.arange(40.0, 82.0, 4.0), fraction=0.0)
    scene = pb.Scene(PLATE.surface, PLATE.subsurface, PLATE.mixing, **given)
    request = resolve(capture, "per_material", scene, None, LINKS, None, 0, "double")
    stated = fitting._indices_by_eye(request)
    expected = {} if given else {"patch 0": 1.5, "patch 1": 2.4}
    assert {name: round(center, 1) for name, (_, center, _, _) in stated.items()} == expected
