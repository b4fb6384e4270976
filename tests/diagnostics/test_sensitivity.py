"""What the data determined, and what would move with the prior."""

import arviz_stats
import numpy as np
import pytest
import xarray as xr
from cases import each
from scipy import stats
from synthetic_results import PRIOR, make_result, replace

from polar_bayes.diagnostics.compare import compare_without
from polar_bayes.diagnostics.sensitivity import _remarks, sensitivity


def test_widths_are_those_of_normal_distributions() -> None:
    tree = make_result(draws=1000)
    table = sensitivity(tree)
    sd = tree["posterior"].to_dataset()["subsurface_fraction"].std().item()
    share = sd / PRIOR["subsurface_fraction"][1]
    row = table.loc["subsurface_fraction"]
    # 500 prior draws know their own 95% width to about 4%.
    assert row["width_left"] == pytest.approx(share, rel=0.15)
    assert row["contraction"] == pytest.approx(1.0 - share**2, abs=0.02)
    low, high = (stats.norm(*PRIOR["subsurface_fraction"]).cdf(row[q]) for q in ("q2.5", "q97.5"))
    assert row["prior_inside"] == pytest.approx(high - low, abs=0.07)


def test_verdicts() -> None:
    table = sensitivity(make_result(discrepancy=True))
    assert table.loc["refractive_index[550]", "verdict"] == "determined"
    assert table.loc["discrepancy_weights[2]", "verdict"] == "not determined"
    assert list(table.index[:2]) == ["roughness", "subsurface_fraction"]
    draws = np.random.default_rng(0).normal(*PRIOR["exposure"], (4, 250))
    as_prior = sensitivity(replace(make_result(), "posterior", "exposure", draws))
    assert as_prior.loc["exposure", "verdict"] == "not determined"


def with_prior_and_posterior(prior: np.ndarray, posterior: np.ndarray):
    """The row of a parameter with these draws."""
    tree = replace(make_result(), "prior", "exposure", prior.reshape(1, 500))
    tree = replace(tree, "posterior", "exposure", posterior.reshape(4, 250))
    return sensitivity(tree).loc["exposure"]


@each("scale", [np.log, np.exp, lambda x: x])
def test_the_verdict_is_the_same_for_a_parameter_and_its_logarithm(scale) -> None:
    rng = np.random.default_rng(1)
    prior, posterior = np.exp(rng.normal(0.0, 1.0, 500)), np.exp(rng.normal(0.5, 0.2, 1000))
    row = with_prior_and_posterior(scale(prior), scale(posterior))
    plain = with_prior_and_posterior(prior, posterior)
    assert row["prior_inside"] == pytest.approx(plain["prior_inside"], abs=0.01)
    assert row["verdict"] == plain["verdict"] == "determined"


@each(
    ("verdict", "likelihood", "said"),
    [
        ("not determined", 0.01, ["depends on the priors"]),
        ("determined", 0.01, []),
        ("determined", 0.1, ["priors and data may conflict"]),
    ],
)
def test_no_remark_contradicts_that_data_determine_a_parameter(verdict, likelihood, said) -> None:
    compared = [-2.0, 2.0, -0.2, 0.2, 0.1, 0.1, 0.99, verdict]
    assert _remarks(np.zeros(3), compared, 0.1, likelihood) == said


def test_a_posterior_in_the_tail_of_its_prior_is_not_the_prior() -> None:
    """As wide as the prior, but where the prior did not expect it: the data put it there."""
    rng = np.random.default_rng(1)
    row = with_prior_and_posterior(np.exp(rng.normal(-1.0, 0.5, 500)), rng.normal(1.24, 0.2, 1000))
    assert row["width_left"] > 0.7
    assert row["verdict"] == "determined"
    assert "outside the prior's 95%" in row["remark"]
    # Over decades of a wide prior: narrow beside its upper end, and yet most of what it allowed.
    rng = np.random.default_rng(1)
    row = with_prior_and_posterior(
        np.exp(rng.normal(0.0, 3.0, 500)), np.exp(rng.normal(-1.0, 2.0, 1000))
    )
    assert row["width_left"] < 0.2
    assert row["verdict"] != "determined"


def test_power_scaling_agrees_with_arviz() -> None:
    tree = make_result()
    table = sensitivity(tree)
    for group, column in (("prior", "prior_sensitivity"), ("likelihood", "likelihood_sensitivity")):
        theirs = arviz_stats.psense(tree, group=group)
        assert table.loc["roughness", column] == pytest.approx(theirs["roughness"].item())
        index = theirs["refractive_index"].sel(wavelength=550.0).item()
        assert table.loc["refractive_index[550]", column] == pytest.approx(index)


def test_without_densities_or_prior_the_rest_stands() -> None:
    tree = make_result()
    for group in ("prior", "log_prior"):
        del tree[group]
    table = sensitivity(tree)
    assert (table["verdict"] == "unknown").all()
    assert table["prior_sensitivity"].isna().all()
    assert table["likelihood_sensitivity"].notna().all()
    assert table["q2.5"].notna().all()


def test_constant_columns_and_draws_that_are_not_finite() -> None:
    tree = make_result()
    tree = replace(tree, "posterior", "roughness", np.full((4, 250), 0.2))
    tree = replace(tree, "posterior", "exposure", np.full((4, 250), np.nan))
    tree["log_prior"] = xr.DataTree(tree["log_prior"].to_dataset() * 0.0)
    table = sensitivity(tree)
    assert np.isnan(table.loc["roughness", "likelihood_sensitivity"])
    assert np.isnan(table.loc["exposure", "width_left"])
    assert table.loc["exposure", "verdict"] == "unknown"
    assert table["prior_sensitivity"].isna().all()


def test_a_point_fit_has_no_widths() -> None:
    assert sensitivity(make_result(method="point")).empty


def test_fits_without_the_discrepancy_stand_beside() -> None:
    table = compare_without(make_result(discrepancy=True), "discrepancy")
    assert "exposure" not in table.index
    np.testing.assert_allclose(table["width_ratio"], 0.4, rtol=1e-2)
    assert compare_without(make_result(), "discrepancy").empty
