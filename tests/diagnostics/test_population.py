"""Populations against posteriors known in closed form: normal members of a normal population."""

import json

import numpy as np
import pandas as pd
import pytest
import scipy.special
import scipy.stats
import xarray as xr
from cases import each
from synthetic_results import make_result, pool

from polar_bayes.diagnostics.population import (
    MEMBER_COLUMNS,
    SUMMARY_COLUMNS,
    population_summary,
    populations,
    shrinkage,
    unpooled_estimate,
)
from polar_bayes.errors import FitError

CHAINS, DRAWS = 4, 2000
READINGS = np.array([1.31, 1.40, 1.44, 1.47, 1.50, 1.62])
ERRORS = np.array([0.02, 0.10, 0.05, 0.03, 0.20, 0.08])
LINKS = {
    "refractive_index": (lambda x: x, lambda x: x),
    "roughness": (np.log, np.exp),
    "subsurface_fraction": (scipy.special.logit, scipy.special.expit),
}


FLAT = np.zeros(CHAINS * DRAWS)


def tree(name, value, location, spread, bounds=None, dims=("patch",)):
    """A result with one population; values on its scale, members first, draws last."""
    grid = (CHAINS, DRAWS)
    forward = LINKS[name][1]
    members = np.moveaxis(forward(value), -1, 0).reshape(*grid, *value.shape[:-1])
    posterior = {
        name: (("chain", "draw", *dims), members),
        f"{name}_location": (("chain", "draw"), forward(location).reshape(grid)),
        f"{name}_spread": (("chain", "draw"), spread.reshape(grid)),
    }
    found = xr.DataTree.from_dict({"posterior": xr.Dataset(posterior)})
    found.attrs["polar_bayes"] = json.dumps({"method": "nuts", "bounds": bounds or {}})
    return found


def known_population(name, location, spread=0.1):
    """The row of a population of two members whose location and spread are known."""
    members = np.stack([FLAT + location - spread, FLAT + location + spread])
    return population_summary(tree(name, members, FLAT + location, FLAT + spread)).iloc[0]


def exact_draws(readings, errors, spreads, rng, *, location=None):
    """Draws of members, location and spread; the location's prior is flat unless it is given."""
    grid = np.asarray(spreads, float)
    weight = 1.0 / (errors[:, None] ** 2 + grid**2)
    center = (weight * readings[:, None]).sum(0) / weight.sum(0)
    log_density = 0.5 * np.log(weight).sum(0) - 0.5 * np.log(weight.sum(0))
    log_density -= 0.5 * (weight * (readings[:, None] - center) ** 2).sum(0)
    share = np.exp(log_density - log_density.max())
    at = rng.choice(grid.size, CHAINS * DRAWS, p=share / share.sum())
    spread, sd = grid[at], weight.sum(0)[at] ** -0.5
    mu = center[at] + sd * rng.standard_normal(at.size)
    mu = mu if location is None else np.full(at.size, location)
    precision = errors[:, None] ** -2.0 + spread**-2.0
    mean = (readings[:, None] / errors[:, None] ** 2 + mu / spread**2) / precision
    return mean + rng.standard_normal(mean.shape) / np.sqrt(precision), mu, spread


def error_of_unpooled(reading, error, mu, spread):
    """Monte Carlo standard errors of b / p and p, from the information in the draws."""
    v = 1.0 / (error**-2.0 + spread**-2.0)
    m = v * (reading / error**2 + mu / spread**2)
    cross = -np.sum(m * v)
    information = np.array([[np.sum(v), cross], [cross, np.sum(m**2 * v + 0.5 * v**2)]])
    slope = np.array([[error**2, -reading * error**2], [0.0, 1.0]])
    return np.sqrt(np.diag(slope @ np.linalg.inv(information) @ slope.T))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@each("spreads", [[0.06], np.linspace(0.01, 0.3, 200)])
def test_estimates_alone_are_what_the_readings_say(spreads, rng) -> None:
    """With the spread known, and with a spread that the members tell poorly."""
    value, mu, spread = exact_draws(READINGS, ERRORS, spreads, rng)
    for x, reading, error in zip(value, READINGS, ERRORS, strict=True):
        unpooled = unpooled_estimate(x, mu, spread)
        of_mean, of_precision = error_of_unpooled(reading, error, mu, spread)
        if np.isnan(unpooled.mean):
            assert error**-2.0 < 5.0 * of_precision
            continue
        assert abs(unpooled.mean - reading) < 5.0 * of_mean
        assert abs(unpooled.sd**-2.0 - error**-2.0) < 5.0 * of_precision
        expected = np.mean(spread**-2.0 / (spread**-2.0 + error**-2.0))
        assert unpooled.shrinkage == pytest.approx(expected, abs=5.0 * of_precision * error**2)


@pytest.mark.thorough
def test_a_member_without_readings_says_nothing_and_one_that_does_not_move_neither(rng) -> None:
    assert np.isnan(unpooled_estimate(np.ones(9), np.zeros(9), np.ones(9))).all()
    no_progress = 1e6
    value, mu, spread = exact_draws(READINGS, np.append(ERRORS[:-1], no_progress), [0.06, 0.1], rng)
    unpooled = unpooled_estimate(value[-1], mu, spread)
    assert np.isnan(unpooled.mean)
    assert np.isnan(unpooled.sd)
    assert unpooled.shrinkage > 0.95


@each("name", LINKS)
def test_shrinkage_is_on_the_scale_of_the_population(name, rng) -> None:
    forward, back = LINKS[name]
    readings, errors = READINGS - 1.45, ERRORS[[0, 2, 3, 5, 2, 5]]
    value, mu, spread = exact_draws(readings, errors, [0.1], rng)
    table = shrinkage(tree(name, value, mu, spread))
    assert list(table.columns) == list(MEMBER_COLUMNS)
    assert list(table.index) == [f"{name}[{i}]" for i in range(6)]
    assert table["mean"].to_numpy() == pytest.approx(back(value).mean(axis=1))
    for row, reading, error in zip(table.itertuples(), readings, errors, strict=True):
        of_mean, _ = error_of_unpooled(reading, error, mu, spread)
        assert abs(forward(row.unpooled) - reading) < 5.0 * of_mean
        width = forward(row._6) - forward(row._5)
        assert width == pytest.approx(2 * 1.96 * error, rel=0.2)


def test_pooling_factor_of_a_known_population(rng) -> None:
    """With location and spread known, members are independent normals: the factor is exact."""
    spread, location = 0.08, 1.45
    value, mu, s = exact_draws(READINGS, ERRORS, [spread], rng, location=location)
    weight = spread**2 / (spread**2 + ERRORS**2)
    between = np.var(weight * (READINGS - location), ddof=1)
    expected = 1.0 - between / (between + np.mean(weight * ERRORS**2))
    row = population_summary(tree("refractive_index", value, mu, s)).loc["refractive_index"]
    assert row["pooling"] == pytest.approx(expected, abs=5.0 * (CHAINS * DRAWS) ** -0.5)
    assert row["members"] == 6
    assert row["meaning"] == "members differ by about 0.08"


@pytest.mark.thorough
@each(("error", "low", "high"), [(1e-3, 0.0, 0.01), (10.0, 0.99, 1.0)])
def test_pooling_factor_from_none_to_all(error, low, high, rng) -> None:
    value, mu, s = exact_draws(READINGS, np.full(6, error), [0.1], rng, location=1.45)
    factor = population_summary(tree("refractive_index", value, mu, s))["pooling"].iloc[0]
    assert low - 0.01 <= factor <= high + 1e-9


@each(
    ("name", "location", "between"),
    [
        ("refractive_index", 1.6, 0.1),
        ("roughness", 0.2, np.exp(0.1)),
        ("subsurface_fraction", 0.2, 0.1 * scipy.special.expit(0.2) * scipy.special.expit(-0.2)),
    ],
)
def test_a_new_member_and_a_spread_have_the_unit_of_the_parameter(name, location, between) -> None:
    row = known_population(name, location)
    expected = LINKS[name][1](scipy.stats.norm(location, 0.1).ppf([0.025, 0.975]))
    assert [row["new_q2.5"], row["new_q97.5"]] == pytest.approx(expected, rel=1e-3)
    assert row["between"] == pytest.approx(between)
    assert ("a factor of about 1.11" in row["meaning"]) == (name == "roughness")


@pytest.mark.thorough
def test_a_new_member_is_cut_not_heaped_up_at_the_bounds() -> None:
    value = np.array([[1.22], [1.25]]) + FLAT
    bounds = {"refractive_index_location": (1.2, 2.0)}
    (population,) = populations(tree("refractive_index", value, FLAT + 1.25, FLAT + 0.1, bounds))
    # By inversion on a grid: SciPy's own truncated normal is what is tested.
    at = np.linspace(1.2, 2.0, 200_001)
    mass = np.cumsum(np.exp(-0.5 * ((at - 1.25) / 0.1) ** 2))
    ranks = [0.025, 0.25, 0.5, 0.975]
    exact = np.interp(ranks, mass / mass[-1], at)
    assert np.quantile(population.new_members(), ranks) == pytest.approx(exact, rel=1e-4)
    assert np.array_equal(population.new_members(), population.new_members())


@pytest.mark.thorough
@each(
    ("said", "bounds"),
    [(None, (1.0, np.inf)), ((1.2, None), (1.2, np.inf)), ((1.25, 10), (1.25, 10))],
)
def test_bounds_come_from_the_prior_of_the_location(said, bounds, rng) -> None:
    value = 1.5 + 0.1 * rng.standard_normal((3, CHAINS * DRAWS))
    told = {} if said is None else {"refractive_index_location": said}
    (found,) = populations(tree("refractive_index", value, value[0], FLAT + 0.1, told))
    assert (found.low, found.high) == bounds


@pytest.mark.thorough
def test_every_wavelength_is_a_population_of_its_own() -> None:
    layout = {"materials": ("a", "b", "c"), "wavelengths": (450.0, 550.0), "draws": 50}
    result = pool(make_result(**layout), "refractive_index", "roughness")
    table = population_summary(result)
    assert list(table.columns) == list(SUMMARY_COLUMNS)
    assert list(table.index) == ["roughness", "refractive_index[450]", "refractive_index[550]"]
    assert (table["members"] == 3).all()
    assert table["spread"].iloc[1] == table["spread"].iloc[2]
    assert len(shrinkage(result)) == 9


@pytest.mark.thorough
@each(
    "result",
    [
        make_result(wavelengths=(), views=8, draws=20),
        pool(make_result(materials=("a", "b"), wavelengths=(), method="point"), "roughness"),
    ],
    ids=["nothing pooled", "point fit"],
)
def test_no_rows_where_nothing_can_be_said(result) -> None:
    tables = {SUMMARY_COLUMNS: population_summary(result), MEMBER_COLUMNS: shrinkage(result)}
    for columns, table in tables.items():
        assert isinstance(table, pd.DataFrame)
        assert table.empty
        assert tuple(table.columns) == columns


def test_draws_that_are_not_finite_give_nan(rng) -> None:
    value, mu, spread = exact_draws(READINGS, ERRORS, [0.06], rng)
    value[2, 5] = np.nan
    result = tree("refractive_index", value, mu, spread)
    row = population_summary(result).iloc[0]
    assert np.isnan(row[["pooling", "new_q2.5", "between"]].astype(float)).all()
    assert np.isfinite(row["location"])
    assert shrinkage(result).isna().all(axis=None)


def test_what_is_no_result_is_refused() -> None:
    with pytest.raises(FitError, match="it holds no fit"):
        populations(xr.DataTree())
