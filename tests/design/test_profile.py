"""Profiles against closed forms, in words, and where they cannot be found."""

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from cases import each
from design_lines import ASKED, NOISE, PRIOR, line, line_capture, precision_of, rows_of

import polar_bayes as pb
from polar_bayes.design.profile import KINDS, likelihood_interval, log_density_parts
from polar_bayes.design.setup import make_design_problem
from polar_bayes.inference.request import resolve

ZENITHS = np.array([20.0, 40.0, 60.0, 70.0])


@pytest.fixture(scope="module")
def slope() -> xr.Dataset:
    return pb.profile(line_capture(ZENITHS), "slope", model=line, points=9, **ASKED)


def closed_form(capture, theta, weight):
    """Log density of a line with one slope, at its best level."""
    rows, q = rows_of(ZENITHS), capture["q"].to_numpy()
    precision = len(q) / NOISE**2 + weight / PRIOR**2
    level = (q[:, None] - rows[:, 1:] * theta).sum(axis=0) / NOISE**2 / precision
    residual = q[:, None] - level - rows[:, 1:] * theta
    height = -0.5 * (residual**2).sum(axis=0) / NOISE**2
    return height - 0.5 * weight * (level**2 + theta**2) / PRIOR**2, level


@each(("kind", "weight"), [("posterior", 1.0), ("likelihood", KINDS["likelihood"])])
def test_the_profile_of_a_line_is_its_parabola(slope: xr.Dataset, kind: str, weight: float) -> None:
    theta = slope["value"].to_numpy()
    height, level = closed_form(line_capture(ZENITHS), theta, weight)
    found = slope.sel(kind=kind)
    assert found["converged"].all()
    np.testing.assert_allclose(found["profile"], height - height.max(), atol=2e-3)
    np.testing.assert_allclose(found["others"].sel(parameter="level"), level, atol=1e-3)
    np.testing.assert_allclose(found["others"].sel(parameter="slope"), theta)
    assert float(found["profile"].max()) == 0.0


def test_the_interval_is_that_of_the_normal_distribution(slope: xr.Dataset) -> None:
    """Between grid points the end is interpolated, so it is a little inside."""
    found = slope.sel(kind="posterior")
    width = float(found["high"] - found["low"])
    sd = np.linalg.inv(precision_of(ZENITHS))[1, 1] ** 0.5
    assert width == pytest.approx(2.0 * np.sqrt(2.0 * 1.92) * sd, rel=0.05)
    assert not found["open_below"]
    assert not found["open_above"]
    low, high = (float(slope[end].sel(kind="likelihood")) for end in ("low", "high"))
    assert list(pb.verdict(slope).sentences) == [
        f"slope is between {low:.4g} and {high:.4g} (95% interval of the likelihood ratio)."
    ]


@pytest.mark.thorough
def test_a_grid_of_ones_own_keeps_its_values() -> None:
    found = pb.profile(line_capture(ZENITHS), "level", model=line, values=[0.19, 0.21], **ASKED)
    assert {0.19, 0.21} < set(found["value"].to_numpy().round(12))
    assert found["open_below"].all()
    said = pb.verdict(found).sentences
    assert said[0].startswith("level is flat: the data exclude nothing below as far as the grid")


@pytest.mark.thorough
def test_what_is_known_beside_the_readings_is_of_the_likelihood() -> None:
    request = resolve(line_capture(ZENITHS), line, ASKED["scene"], None, None, None, 0, "double")
    problem = make_design_problem(request)
    z = jnp.array([0.3, -0.2])
    bare = log_density_parts(problem.program, (), z, problem.data)
    told = log_density_parts(problem.program, ("level", "dark_level"), z, problem.data)
    level = problem.program.unravel(z)["level"]
    known = -0.5 * (level / PRIOR) ** 2 - np.log(PRIOR * np.sqrt(2.0 * np.pi))
    np.testing.assert_allclose(told[0] - bare[0], known, rtol=1e-5)
    np.testing.assert_allclose(sum(told), sum(bare), rtol=1e-5)


@pytest.mark.thorough
def test_a_gap_is_left_out_and_counted(slope: xr.Dataset) -> None:
    broken = slope.copy(deep=True)
    broken["converged"][1, 2] = False
    assert (
        pb.verdict(broken).sentences[1].startswith("At 1 of 18 points of the two profiles no fit")
    )


@each(
    ("value", "expected"),
    [
        ([-3.84, 0.0, -3.84], (0.5, 1.5, False, False)),
        ([-1.0, 0.0, -3.84], (0.0, 1.5, True, False)),
        ([-8.0, np.nan, 0.0, -1.0], (0.0, 3.0, False, True)),
        ([np.nan, np.nan], (np.nan, np.nan, True, True)),
    ],
)
def test_where_a_profile_has_fallen(value, expected) -> None:
    found = likelihood_interval(np.arange(float(len(value))), np.asarray(value))
    np.testing.assert_allclose(found[:2], expected[:2], atol=1e-9)
    assert found[2:] == expected[2:]


def test_what_cannot_be_profiled_is_told() -> None:
    capture = line_capture(ZENITHS)
    with pytest.raises(pb.FitError, match=r"parameter='bend': no sampled .* one of level, slope"):
        pb.profile(capture, "bend", model=line, **ASKED)
    with pytest.raises(pb.FitError, match="points is 2; give 5 or more"):
        pb.profile(capture, "slope", model=line, points=2, **ASKED)
    with pytest.raises(pb.FitError, match="values of slope: nan is not inside its prior"):
        pb.profile(capture, "slope", model=line, values=[np.nan], **ASKED)
