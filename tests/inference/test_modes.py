"""Peaks are found, told apart, weighed, and never invented."""

import numpy as np
import pytest
from cases import each
from scipy.stats import multivariate_normal

from polar_bayes.numerics.optimize import (
    ModeStatus,
    central_difference_hessian,
    distinct_modes,
    find_mode,
    likely_starts,
)

SPREAD = np.array([[0.5, 0.2], [0.2, 0.3]])


def normal_potential(center: np.ndarray):
    precision = np.linalg.inv(SPREAD)

    def potential(z: np.ndarray) -> tuple[float, np.ndarray]:
        step = z - center
        return 0.5 * step @ precision @ step, precision @ step

    return potential


def mixture_potential(centers: np.ndarray, shares: np.ndarray):
    """Minus the log density of separate normal peaks, up to a constant."""

    def potential(z: np.ndarray) -> tuple[float, np.ndarray]:
        densities = np.array(
            [
                share * multivariate_normal(c, SPREAD).pdf(z)
                for c, share in zip(centers, shares, strict=True)
            ]
        )
        total = densities.sum() + 1e-300
        pulls = np.stack([np.linalg.solve(SPREAD, z - c) for c in centers])
        return -np.log(total), densities @ pulls / total

    return potential


def test_a_normal_peak_is_found_with_its_width() -> None:
    end = find_mode(normal_potential(np.array([1.0, -2.0])), np.zeros(2))
    assert end.status is ModeStatus.OK
    # The decrement bounds the distance; central differences of a quadratic are exact to rounding.
    np.testing.assert_allclose(end.z, [1.0, -2.0], atol=0.01)
    np.testing.assert_allclose(end.covariance, SPREAD, rtol=1e-7)


@pytest.mark.thorough
def test_curvature_of_a_cubic_is_accurate_to_the_stated_error() -> None:
    def potential(z: np.ndarray) -> tuple[float, np.ndarray]:
        return float(np.sum(np.exp(z))), np.exp(z)

    z = np.array([0.3, -0.7])
    measured = central_difference_hessian(potential, z, np.ones(2), np.dtype(float))
    np.testing.assert_allclose(measured, np.diag(np.exp(z)), atol=1e-7)


def test_two_peaks_are_weighed_by_their_evidence() -> None:
    centers = np.array([[-6.0, 0.0], [6.0, 0.0]])
    potential = mixture_potential(centers, np.array([0.2, 0.8]))
    modes = distinct_modes([find_mode(potential, center + 0.5) for center in (*centers, *centers)])
    assert modes is not None
    np.testing.assert_allclose(modes.weight, [0.8, 0.2], rtol=1e-3)
    assert modes.starts == 4
    assert modes.failures == 0


def test_a_saddle_is_never_called_a_peak() -> None:
    def saddle(z: np.ndarray) -> tuple[float, np.ndarray]:
        return 0.5 * (z[0] ** 2 - z[1] ** 2), np.array([z[0], -z[1]])

    end = find_mode(saddle, np.zeros(2))
    assert end.status is ModeStatus.NOT_A_MAXIMUM
    assert np.isnan(end.covariance).all()
    assert distinct_modes([end]) is None


@pytest.mark.thorough
def test_a_wall_of_nan_ends_a_climb_without_a_peak() -> None:
    def nowhere(z: np.ndarray) -> tuple[float, np.ndarray]:
        return np.nan, np.full(z.size, np.nan)

    assert distinct_modes([find_mode(nowhere, np.zeros(3))]) is None


@each("seed", range(3))
def test_the_order_of_the_starts_does_not_matter(seed: int) -> None:
    centers = np.array([[-6.0, 0.0], [6.0, 0.0]])
    potential = mixture_potential(centers, np.array([0.3, 0.7]))
    starts = np.random.default_rng(seed).permutation(np.repeat(centers, 3, axis=0) + 0.3)
    modes = distinct_modes([find_mode(potential, start) for start in starts])
    assert modes is not None
    np.testing.assert_allclose(modes.z, centers[::-1], atol=0.01)


def test_a_search_that_ends_beside_the_heaviest_peak_counts() -> None:
    # Where readings lie at their floor, a kink of the density leaves a gradient.
    centers = np.array([[-6.0, 0.0], [6.0, 0.0]])
    light = find_mode(mixture_potential(centers, np.array([0.01, 0.99])), centers[0])
    beside = light._replace(
        z=centers[1],
        potential=light.potential - 5.0,
        decrement=0.03,
        status=ModeStatus.NOT_CONVERGED,
    )
    again = beside._replace(z=centers[1] + 0.1 * np.sqrt(np.diagonal(SPREAD)))
    modes = distinct_modes([light, beside, again])
    assert modes is not None
    np.testing.assert_allclose(modes.z, centers[::-1], atol=0.01)
    assert modes.failures == 2


def test_half_of_the_starts_are_the_likeliest_draws() -> None:
    drawn = np.random.default_rng(0).normal(size=(256, 2))
    drawn[7] = np.nan
    starts = likely_starts(normal_potential(np.array([2.0, 1.0])), drawn, 8)
    values = [normal_potential(np.array([2.0, 1.0]))(z)[0] for z in drawn]
    np.testing.assert_array_equal(starts[:4], drawn[np.argsort(values)[:4]])
    others = [z for z in drawn[:8] if not (z == starts[:4]).all(axis=1).any()]
    np.testing.assert_array_equal(starts[4:], others[:4])


def test_a_kink_at_a_peak_is_no_saddle() -> None:
    """A ridge of 2e-3 sds, to steps of 1e-4 a saddle, costs steps of 0.012 this share of curvature.

    The gradient falls by twice the ridge over twice the step: 1 - 0.002 / 0.0122.
    """
    ridge = 2e-3

    def potential(z: np.ndarray) -> tuple[float, np.ndarray]:
        slope = np.array([np.sign(z[0]), 0.0])
        return float(0.5 * z @ z - ridge * abs(z[0])), z - ridge * slope

    end = find_mode(potential, np.array([0.0, 1.0]))
    assert end.status is ModeStatus.OK
    step = 100.0 * np.finfo(float).eps ** 0.25
    variance = 1.0 / (1.0 - ridge / step)
    np.testing.assert_allclose(end.covariance, np.diag([variance, 1.0]), rtol=1e-6, atol=1e-6)
