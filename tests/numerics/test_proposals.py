"""Proposals that learn: their points, their moments, and what they find in skewed pixels."""

import numpy as np
import pytest
from cases import each
from plate_images import NAMES, VIEWS, mapped, on_a_grid, planned, plate_image
from scipy import stats

from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.methods.corrected_laplace import CorrectedLaplace
from polar_bayes.numerics.mixtures import PROPOSAL_DEGREES_OF_FREEDOM as DEGREES_OF_FREEDOM
from polar_bayes.numerics.mixtures import Points, Proposal, fit_t, normal_points, student_t_points

WEAK = plate_image(3, 8, noise=0.15, views=VIEWS[[1, 4]], seed=7)


@each("size", [1, 2, 5])
def test_heavy_points_are_those_of_student(size: int) -> None:
    points = student_t_points(4096, size, seed=1)
    for column in points.z.T:
        # Scrambled Sobol' points are spread more evenly than independent ones, whose largest
        # distance of distribution functions would be above 1.63 / sqrt(4096) once in a hundred.
        assert stats.kstest(column, stats.t(DEGREES_OF_FREEDOM).cdf).statistic < 1.63 / 64.0
    theirs = stats.multivariate_t(shape=np.eye(size), df=DEGREES_OF_FREEDOM).logpdf(points.z)
    offset = theirs - points.log_density
    np.testing.assert_allclose(offset, offset[0], rtol=1e-12)
    np.testing.assert_array_equal(points.z[::2], -points.z[1::2])


@pytest.mark.thorough
def test_points_follow_the_seed() -> None:
    one, two, other = (student_t_points(128, 3, seed).z for seed in (1, 1, 2))
    assert (one == two).all()
    assert (one != other).all()


@pytest.mark.thorough
def test_parts_of_points_are_the_points() -> None:
    whole = normal_points(256, 2, seed=3)
    parts = whole.split(4)
    assert all(part.z.shape == (64, 2) for part in parts)
    again = Points(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
    assert all((one == two).all() for one, two in zip(whole, again, strict=True))


def test_moments_are_those_of_the_weighted_draws() -> None:
    rng = np.random.default_rng(4)
    places, weights = rng.normal(size=(3, 500, 2)), rng.dirichlet(np.ones(500), 3)
    found = fit_t(places, weights)
    for pixel in range(3):
        covariance = np.cov(places[pixel].T, aweights=weights[pixel], ddof=0)
        np.testing.assert_allclose(found.center[pixel], weights[pixel] @ places[pixel])
        np.testing.assert_allclose(found.root[pixel].T @ found.root[pixel], covariance)
    # What a proposal draws has its own moments: normal points with the weights of their number.
    points = normal_points(4096, 2, seed=5)
    drawn = found.draws(points)
    assert np.cov(drawn[0].T) == pytest.approx(found.root[0].T @ found.root[0], rel=0.02, abs=0.01)


@pytest.mark.thorough
def test_draws_without_a_volume_propose_nothing() -> None:
    places = np.random.default_rng(6).normal(size=(3, 64, 2))
    weights = np.full((3, 64), 1.0 / 64.0)
    places[0, :, 1] = 2.0 * places[0, :, 0]  # on a line
    weights[1] = np.eye(64)[5]  # one draw has it all
    weights[2] = np.nan
    found = fit_t(places, weights)
    assert isinstance(found, Proposal)
    assert np.isnan(found.root[1:]).any(axis=(1, 2)).all()
    # On a line rounding decides; if it finds a volume it is next to nothing.
    line = found.root[0]
    assert np.isnan(line).any() or np.abs(np.linalg.det(line)) < 1e-6


@pytest.mark.thorough
def test_where_a_normal_distribution_fails_the_posterior_of_a_grid_is_found() -> None:
    """Largest error of 4 Monte Carlo errors: 6e-5 a comparison, 1e-3 over all of them."""
    method = CorrectedLaplace(sampler=None)
    maps = mapped(WEAK, planned(WEAK, method))
    adapted = np.argwhere((maps["method"] == MethodUsed.ADAPTED).values)
    assert len(adapted) >= 3
    for y, x in adapted:
        pixel = maps.isel(y=y, x=x)
        assert pixel["pareto_k"] > 0.7  # the normal approximation's own
        assert pixel["status"] == Status.GOOD
        error = 1.0 / np.sqrt(float(pixel["ess"]))
        truth = on_a_grid(WEAK["q"].values[y, x], 0.15, WEAK["view_zenith"].values)
        for name in NAMES:
            mean, sd, _ = truth[name]
            assert abs(float(pixel[name]) - mean) < 4.0 * error * sd
            assert abs(float(pixel[f"{name}_sd"]) - sd) < 4.0 * error * sd
