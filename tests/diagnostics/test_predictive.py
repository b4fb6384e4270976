"""Predictive checks: calm when the model is right, loud when not, steady when there is little."""

import arviz_stats
import numpy as np
import pytest
import xarray as xr
from cases import each
from scipy import stats
from synthetic_results import SCALE, make_result, replace

from polar_bayes.diagnostics.predictive import pit_band, predictive_checks, usable_readings

SMALL = {"wavelengths": (), "views": 20, "draws": 150}
DOP = SMALL | {"variables": ("dop",)}


def check_of(tree):
    """The check of the degree of polarization."""
    return predictive_checks(tree)["dop"]


def leaves(band) -> bool:
    """Return whether the curve leaves its band anywhere."""
    outside = (band.difference < band.lower - 1e-9) | (band.difference > band.upper + 1e-9)
    return bool(np.any(outside))


def test_a_calibrated_fit_raises_no_more_alarms_than_it_should() -> None:
    """Of 60 calibrated fits 5% may leave the band: more than 9 has probability 0.0013."""
    alarms = sum(
        leaves(pit_band(check_of(make_result(**DOP, seed=seed)).loo.pit)) for seed in range(60)
    )
    assert alarms <= stats.binom.isf(0.002, 60, 0.05)


@pytest.mark.thorough
def test_pooled_pit_of_calibrated_fits_is_uniform() -> None:
    """Kolmogorov-Smirnov on one reading from each of 100 fits, at a false-alarm rate of 0.001."""
    values = [check_of(make_result(**DOP, seed=seed)).loo.pit[7] for seed in range(100)]
    assert stats.kstest(values, "uniform").pvalue > 1e-3


@each(("noise", "first_side"), [(3.0, "above"), (0.25, "below")])
def test_readings_that_scatter_otherwise_leave_the_band(noise: float, first_side: str) -> None:
    check = check_of(make_result(noise=noise))
    band = pit_band(check.loo.pit)
    assert leaves(band)
    early = band.difference[: len(band.at) // 4]
    assert (early.mean() > 0.0) == (first_side == "above")


def test_coverage_and_residuals() -> None:
    check = check_of(make_result(views=60))
    for probability, share in check.coverage.items():
        chance = np.sqrt(probability * (1.0 - probability) / check.count)
        assert abs(share - probability) < 4.0 * chance
    assert check.residual_rms == pytest.approx(SCALE["dop"], rel=0.2)


def test_leave_one_out_agrees_with_arviz() -> None:
    tree = make_result(**DOP)
    loo = check_of(tree).loo
    theirs = arviz_stats.loo(tree, var_name="dop", pointwise=True)
    assert loo.elpd == pytest.approx(theirs.elpd, rel=1e-8)
    assert loo.standard_error == pytest.approx(theirs.se, rel=1e-8)
    assert loo.p_loo == pytest.approx(theirs.p, rel=1e-6)
    np.testing.assert_allclose(loo.pareto_k, theirs.pareto_k.to_numpy(), atol=1e-8)
    pit = arviz_stats.loo_pit(tree, var_names="dop")["dop"].to_numpy()
    np.testing.assert_allclose(loo.pit, pit, atol=1e-8)


def test_chains_that_stand_still_are_not_relied_upon() -> None:
    """Two values in 600 draws; where all draws are alike, each is as good as any other."""
    tree = make_result(**DOP)
    still = np.zeros(tree["log_likelihood"]["dop"].shape)
    assert check_of(replace(tree, "log_likelihood", "dop", still)).loo.unreliable == 0
    still[:2] = 1.0
    assert check_of(replace(tree, "log_likelihood", "dop", still)).loo.unreliable == 20


@pytest.mark.thorough
def test_laplace_weights_correct_the_leave_one_out() -> None:
    """Draws from a wrong normal with their weights say what draws from the posterior say."""
    right, tree = make_result(**DOP), make_result(**DOP, method="laplace")
    keep = np.random.default_rng(5).normal(size=(4, 150))
    plain = check_of(replace(tree, "sample_stats", "log_weight", 0.0 * keep)).loo
    assert plain.elpd == pytest.approx(check_of(right).loo.elpd, abs=0.5)
    tilted = check_of(replace(tree, "sample_stats", "log_weight", keep)).loo
    assert tilted.elpd != plain.elpd
    assert np.isfinite(tilted.pit).all()


def test_masked_set_aside_and_saturated_readings_are_left_out() -> None:
    tree = make_result(masked=(3, 4), limit=70.0, wavelengths=())
    saturated = tree["constant_data"].to_dataset()["saturated"].to_numpy().copy()
    saturated[10] = 1
    tree = replace(tree, "constant_data", "saturated", saturated)
    keep = usable_readings(tree, "intensity")
    assert not keep[[3, 4, 10, -1]].any()
    for check in predictive_checks(tree).values():
        assert check.count == keep.sum() < 40


@pytest.mark.thorough
def test_unsaturated_readings_are_compared_with_unsaturated_predictions() -> None:
    """Half of the prediction is at full scale; a reading in the middle of the rest is typical."""
    tree = make_result(**SMALL, variables=("intensity",))
    shape = tree["posterior_predictive"].to_dataset()["intensity"].shape
    rng = np.random.default_rng(2)
    below = rng.uniform(0.8, 0.9, shape)
    predicted = np.where(rng.uniform(size=shape) < 0.5, below, 1.0)
    tree = replace(tree, "posterior_predictive", "intensity", predicted)
    tree = replace(tree, "observed_data", "intensity", np.full(shape[-1], 0.85))
    tree = replace(tree, "constant_data", "saturated", np.zeros(shape[-1], "int8"))
    np.testing.assert_allclose(predictive_checks(tree)["intensity"].pit, 0.5, atol=0.15)


@pytest.mark.thorough
@each("views", [2, 3, 5, 20])
def test_few_readings(views: int) -> None:
    checks = predictive_checks(make_result(wavelengths=(), views=views))
    for check in checks.values():
        assert check.count <= views
        assert np.isfinite(check.residual_rms)
        assert pit_band(check.pit) is not None


@pytest.mark.thorough
def test_a_band_needs_two_values_and_many_are_fast() -> None:
    for values in ([0.5], [np.nan, 0.5], []):
        assert pit_band(np.array(values)) is None
    assert not leaves(pit_band(np.array([0.3, 0.8])))
    assert leaves(pit_band(np.full(50, 0.5)))
    band = pit_band(np.random.default_rng(1).uniform(size=20_000))
    assert not leaves(band)
    assert len(band.at) < 1000


@pytest.mark.thorough
def test_constant_predictions_and_readings() -> None:
    tree = make_result(**DOP)
    for group in ("posterior_predictive", "noise_free", "log_likelihood"):
        shape = tree[group].to_dataset()["dop"].shape
        tree = replace(tree, group, "dop", np.full(shape, 0.3))
    tree = replace(tree, "observed_data", "dop", np.full(20, 0.3))
    check = check_of(tree)
    assert check.residual_rms < 1e-12
    assert check.loo.unreliable == 0
    assert ((check.pit >= 0.0) & (check.pit <= 1.0)).all()


def test_predictions_that_are_not_numbers_give_no_check() -> None:
    tree = make_result(**DOP)
    predicted = tree["posterior_predictive"].to_dataset()["dop"].to_numpy().copy()
    predicted[0, 0] = np.nan
    check = check_of(replace(tree, "posterior_predictive", "dop", predicted))
    assert check.pit.size == 0
    assert check.loo is None


def test_a_point_fit_has_residuals_only() -> None:
    check = check_of(make_result(method="point"))
    assert check.residual_rms == pytest.approx(SCALE["dop"], rel=0.3)
    assert check.pit.size == 0
    assert check.coverage == {}
    assert check.loo is None


def test_nothing_observed_gives_no_checks() -> None:
    tree = make_result(**SMALL, masked=range(20))
    assert predictive_checks(tree) == {}
    bare = xr.DataTree.from_dict({"posterior": tree["posterior"].to_dataset()})
    assert predictive_checks(bare) == {}
