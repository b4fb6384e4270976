"""Model criticism: calm when the model is right, and loud when the readings say that it is not."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from scipy import stats
from synthetic_results import SCALE, edit_provenance, make_result, replace

import polar_bayes as pb
from polar_bayes.diagnostics.criticism import CHECKS, criticize
from polar_bayes.inference.checks import PROBLEM

SMALL = {"wavelengths": (), "variables": ("dop",), "draws": 250}


def _changed(change, **layout):
    """A right result whose readings of dop are changed before the density is computed."""
    tree = make_result(**{**SMALL, **layout})
    zenith = tree["constant_data"]["view_zenith"].to_numpy()
    observed = change(tree["observed_data"]["dop"].to_numpy().copy(), zenith)
    z = (observed - tree["noise_free"]["dop"].to_numpy()) / SCALE["dop"]
    tree = replace(tree, "observed_data", "dop", observed)
    return replace(tree, "log_likelihood", "dop", -0.5 * z**2)


@pytest.mark.parametrize(
    "layout",
    [
        {"views": 16},
        pytest.param({"views": 40}, marks=pytest.mark.thorough),
        pytest.param({"views": 16, "wavelengths": (450.0, 550.0)}, marks=pytest.mark.thorough),
    ],
)
def test_right_models_rarely_have_a_problem(layout) -> None:
    """Eight checks at 0.4% each: more problems than expected of 40 fits have probability 0.001."""
    failed = sum(
        criticize(make_result(**{**SMALL, **layout}, seed=seed))["level"].eq("problem").any()
        for seed in range(40)
    )
    assert failed <= stats.binom.isf(1e-3, 40, len(CHECKS) * PROBLEM)


def _wave(q, zenith):
    return q + 3.0 * SCALE["dop"] * np.sin(np.radians(zenith) * 9.0)


def _outlier(q, zenith):
    del zenith
    q[..., 11] += 9.0 * SCALE["dop"]
    return q


def _common(q, zenith):
    """An error that all wavelengths share."""
    return q + 2.0 * SCALE["dop"] * np.random.default_rng(0).standard_normal(zenith.size)


@each(
    ("check", "change", "layout"),
    [
        ("angle", _wave, {}),
        ("outliers", _outlier, {}),
        ("wavelength", _common, {"wavelengths": (450.0, 550.0, 650.0)}),
    ],
)
def test_residuals_with_structure_are_a_problem(check, change, layout) -> None:
    row = criticize(_changed(change, **layout)).loc[check]
    assert row["level"] == "problem"
    assert f"p = {row['p_value']:.2g}" in row["sentence"]


def test_readings_that_scatter_otherwise_are_not_uniform() -> None:
    assert criticize(make_result(**SMALL, noise=3.0)).loc["leave-one-out", "level"] == "problem"


def test_a_parameter_far_out_in_its_prior_is_a_problem() -> None:
    tree = make_result(**SMALL)
    assert criticize(tree).loc["priors", "level"] == "passed"
    far = {"roughness": [0.5], "refractive_index": [1.0 - 1e-6], "absorption": [0.4]}
    row = criticize(edit_provenance(tree, prior_probability=far)).loc["priors"]
    assert row["level"] == "problem"
    assert "refractive_index 4.8 sd" in row["sentence"]


def test_several_parameters_somewhat_out_are_a_problem_together() -> None:
    names = ("roughness", "subsurface_fraction", "absorption", "refractive_index", "exposure")
    out = {name: [float(stats.norm.cdf(2.3))] for name in names}
    row = criticize(edit_provenance(make_result(**SMALL), prior_probability=out)).loc["priors"]
    assert row["level"] == "problem"


def test_draws_against_a_bound_are_named() -> None:
    tree = edit_provenance(make_result(**SMALL), bounds={"refractive_index": [1.2, 2.0]})
    shape = tree["posterior"]["refractive_index"].shape
    draws = 1.2 + np.abs(np.random.default_rng(1).normal(0.0, 0.01, shape))
    row = criticize(replace(tree, "posterior", "refractive_index", draws)).loc["bounds"]
    assert row["level"] == "caution"
    assert "refractive_index at 1.2" in row["sentence"]


def test_a_bound_where_the_prior_is_highest_is_none() -> None:
    """A half-normal prior reaches zero: a perfect instrument is nothing to be warned of."""
    tree = edit_provenance(make_result(**SMALL), bounds={"exposure": [0.0, None]})
    for group in ("posterior", "prior"):
        shape = tree[group]["exposure"].shape
        draws = np.abs(np.random.default_rng(1).normal(0.0, 0.2, shape))
        tree = replace(tree, group, "exposure", draws)
    assert criticize(tree).loc["bounds", "level"] == "passed"


def test_repeated_views_are_a_problem() -> None:
    tree = make_result(**SMALL, views=20)
    again = np.r_[np.arange(20), [3, 3, 7, 9]]
    repeated = xr.DataTree.from_dict(
        {
            name: group.to_dataset().isel(view=again)
            if "view" in group.to_dataset().dims
            else group.to_dataset()
            for name, group in tree.children.items()
        }
    )
    repeated.attrs = tree.attrs
    row = criticize(repeated).loc["repeats"]
    assert row["level"] == "problem"
    assert row["sentence"].startswith("4 of 24 views repeat another in every digit")


def test_an_influential_reading_is_named() -> None:
    def spoil(q, zenith):
        q[zenith.argmax()] += 5.0 * SCALE["dop"]
        return q

    row = criticize(_changed(spoil, views=6)).loc["influence"]
    assert row["level"] == "caution"
    assert "dop at 85 degrees" in row["sentence"]


def test_a_point_fit_is_not_criticized_and_says_so() -> None:
    result = make_result(**SMALL, method="point")
    assert set(criticize(result)["level"]) == {"not computed"}
    assert any("no draws to criticize" in text for text in pb.verdict(result).cautions)


def test_the_verdict_fails_though_the_chains_converged() -> None:
    found = pb.verdict(_changed(_wave))
    assert not found.passed
    assert found.converged
    assert any("structure over the angle" in text for text in found.problems)
