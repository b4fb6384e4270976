"""Captures share programs whatever their numbers of views: padding adds nothing to a density."""

import jax
import numpy as np
import pytest
import xarray as xr
from cases import each
from numpyro import handlers

import polar_bayes as pb
from polar_bayes.inference.model_parts import ModelParts
from polar_bayes.inference.problem import Problem, compile_model, observe_request
from polar_bayes.inference.request import resolve
from polar_bayes.models.per_material import per_material
from polar_bayes.observation.data import padded_length
from polar_bayes.physics.scene import SCENES
from polar_bayes.setups import SETUPS

LENGTHS = {1: 8, 8: 8, 9: 12, 12: 12, 13: 16, 17: 24, 25: 32, 33: 48, 49: 64, 65: 96, 97: 128}


@each("views, length", LENGTHS.items())
def test_lengths_are_powers_of_two_and_what_is_halfway(views: int, length: int) -> None:
    assert padded_length(views) == length


def capture_of(scene: str) -> xr.Dataset:
    """Twenty-one views of a leaf, of which one is missing."""
    capture = pb.simulate("leaf", scene=scene, seed=4).isel(view=slice(21))
    reading = capture["dop" if "dop" in capture else "q"]
    return capture.assign(valid=xr.ones_like(reading, bool) & (capture["view_zenith"].view != 3))


def problem_of(capture: xr.Dataset, scene: str, *, padded: bool) -> Problem:
    request = resolve(capture, "per_material", scene, None, None, None, 0, "double")
    data = observe_request(request, padded=padded)
    model = compile_model(request, data)
    return Problem(model, model.free(data), jax.random.key(0))


@pytest.mark.parametrize(
    "scene",
    [x if x == "goniometer" else pytest.param(x, marks=pytest.mark.thorough) for x in SETUPS],
)
def test_padding_changes_a_density_and_its_slope_by_rounding_only(scene: str) -> None:
    capture = capture_of(scene)
    plain, padded = (problem_of(capture, scene, padded=padded) for padded in (False, True))
    assert (plain.data.shape[-1], padded.data.shape[-1]) == (21, 24)
    for z in np.random.default_rng(1).normal(0.0, 0.5, (6, plain.program.size)):
        both = (each.program.value_and_gradient(z, each.data) for each in (plain, padded))
        (value, slope), (same, same_slope) = both
        # The same terms, summed in another order.
        np.testing.assert_allclose(value, same, rtol=1e-12)
        np.testing.assert_allclose(slope, same_slope, rtol=1e-9, atol=1e-9)
    counts = [each.describe().attrs for each in (plain, padded)]
    assert counts[0] == counts[1]
    assert set(counts[1]["measured"].values()) == {21 * capture.sizes.get("wavelength", 1)}


def own_model(data, scene, priors, links):
    """A model of the user's own, which may take every view for a measured one."""
    per_material(data, scene, priors, links)


@each(
    "model, padded",
    [(per_material, True), (handlers.scale(per_material, 0.5), True), (own_model, False)],
)
def test_what_need_not_mask_is_not_padded(model, padded: bool) -> None:
    parts = ModelParts(model, SCENES["paper"], {}, SETUPS["paper"].links)
    assert parts.is_padded == padded
