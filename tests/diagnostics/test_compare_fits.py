"""Fits of one capture side by side; fits of different captures are refused."""

import arviz_stats
import numpy as np
import pytest
import xarray as xr
from cases import each
from synthetic_results import make_result, replace

import polar_bayes as pb
from polar_bayes.diagnostics.convergence import summary
from polar_bayes.diagnostics.predictive import predictive_checks
from polar_bayes.errors import FitError

SMALL = {"wavelengths": (), "views": 16, "draws": 150, "variables": ("dop",)}


def off(result: xr.DataTree, by: float) -> xr.DataTree:
    """Return the same fit with a prediction that misses the readings."""
    density = result["log_likelihood"].to_dataset()["dop"]
    return replace(result, "log_likelihood", "dop", density - by * (density["view"] % 3))


def test_parameters_stand_side_by_side_and_a_point_fit_has_no_predictions() -> None:
    methods = {"a": "nuts", "b": "laplace", "p": "point"}
    fits = {name: make_result(**SMALL, method=method) for name, method in methods.items()}
    compared = pb.diagnostics.compare_fits(fits)
    for name, fit in fits.items():
        own = compared.parameters.xs(name, level="fit")
        assert list(own.index) == list(summary(fit).index)
        np.testing.assert_array_equal(own["mean"], summary(fit)["mean"])
    assert (compared.parameters["verdict"] != "").all()
    assert list(compared.left_out) == ["p"]
    assert set(compared.loo.index) == {"a", "b"}


def test_predictions_are_those_of_the_reports_and_of_arviz() -> None:
    good, bad = make_result(**SMALL), off(make_result(**SMALL), 1.0)
    loo = pb.diagnostics.compare_fits({"bad": bad, "good": good}).loo
    assert list(loo.index) == ["good", "bad"]
    assert loo.loc["good", "elpd"] == pytest.approx(predictive_checks(good)["dop"].loo.elpd)
    assert loo.loc["bad", "elpd_diff"] == pytest.approx(-15.0)
    theirs = arviz_stats.compare({"good": good, "bad": bad}, round_to="none")
    for column in ("elpd", "elpd_diff", "dse", "weight"):
        np.testing.assert_allclose(loo[column], theirs.loc[loo.index, column], rtol=2e-3, atol=1e-3)


@each("by", [-2_000.0, 2_000.0])
def test_readings_that_every_fit_contradicts_or_foretells_are_compared(by: float) -> None:
    """Exponentials of such densities leave double precision, those of their differences do not."""
    good, bad = make_result(**SMALL), off(make_result(**SMALL), 1.0)
    plain = pb.diagnostics.compare_fits({"bad": bad, "good": good}).loo
    moved = {"bad": off(bad, by), "good": off(good, by)}
    loo = pb.diagnostics.compare_fits(moved).loo
    for column in ("elpd_diff", "dse", "weight"):
        np.testing.assert_allclose(loo[column], plain[column], rtol=1e-6, atol=1e-9)


@pytest.mark.thorough
def test_all_variables_count_together() -> None:
    two = {**SMALL, "variables": ("dop", "intensity")}
    fit = make_result(**two)
    loo = pb.diagnostics.compare_fits({"a": fit, "b": make_result(**two, method="laplace")}).loo
    parts = [check.loo.elpd for check in predictive_checks(fit).values()]
    assert loo.loc["a", "elpd"] == pytest.approx(sum(parts))


def test_another_capture_is_refused() -> None:
    one = make_result(**SMALL)
    for change, differs in (
        ({"seed": 1}, "other: it is of another capture than one: dop differs"),
        ({"azimuths": (90.0,)}, "view_azimuth differs"),
        ({"views": 15}, "view_zenith differs"),
    ):
        with pytest.raises(FitError, match=differs):
            pb.diagnostics.compare_fits({"one": one, "other": make_result(**SMALL | change)})


@pytest.mark.thorough
def test_other_views_or_variables_are_not_compared_by_predictions() -> None:
    whole = make_result(**SMALL)
    masked = replace(
        make_result(**SMALL), "constant_data", "valid", [0, *[1] * (SMALL["views"] - 1)]
    )
    compared = pb.diagnostics.compare_fits({"whole": whole, "part": masked})
    assert compared.loo.empty
    assert "set aside different views" in compared.left_out[""]
    both = make_result(**{**SMALL, "variables": ("dop", "q")})
    also = both.copy()
    also["observed_data"] = xr.DataTree(both["observed_data"].to_dataset()[["dop"]])
    compared = pb.diagnostics.compare_fits({"both": both, "dop alone": also})
    assert "They predict different readings" in compared.left_out[""]


@pytest.mark.thorough
@each("fits", [{}, {"a": make_result(**SMALL)}, None])
def test_one_fit_is_not_compared(fits) -> None:
    with pytest.raises(FitError, match="there is nothing to compare"):
        pb.diagnostics.compare_fits(fits)
