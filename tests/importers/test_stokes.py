"""Stokes parameters by least squares: exact without noise, and honest with it."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from polar_bayes.errors import CaptureError
from polar_bayes.importers.stokes import StokesImage, check_angles, fit_stokes, unbiased_dop

ANGLES = st.lists(st.floats(-180.0, 180.0), min_size=3, max_size=8)
SIGNED = st.floats(-0.7, 0.7)


def readings(angles, S0, q, u):
    twice = np.deg2rad(2.0 * np.asarray(angles))
    passed = 0.5 * S0 * (1.0 + q * np.cos(twice) + u * np.sin(twice))
    return passed[:, None, None]


def image(q, u, q_variance, u_variance, covariance):
    parts = (
        np.atleast_2d(np.asarray(x, float)) for x in (q, u, q_variance, u_variance, covariance)
    )
    q, u, q_variance, u_variance, covariance = np.broadcast_arrays(*parts)
    ones = np.ones_like(q)
    return StokesImage(ones, q, u, ones, q_variance, u_variance, covariance, None)


@settings(deadline=None, max_examples=60)
@given(ANGLES, st.floats(1e-3, 1e6), SIGNED, SIGNED)
def test_light_without_noise_comes_back(angles, S0, q, u):
    try:
        check_angles(angles)
    except CaptureError:
        assume(False)
    light = readings(angles, S0, q, u)
    found = fit_stokes(light, np.ones_like(light), angles)
    assert found.intensity[0, 0] == pytest.approx(0.5 * S0)
    assert found.q[0, 0] == pytest.approx(q, abs=1e-9)
    assert found.u[0, 0] == pytest.approx(u, abs=1e-9)


@settings(deadline=None, max_examples=60)
@given(SIGNED, SIGNED, st.floats(0.0, 360.0), st.floats(-0.9, 0.9), st.floats(0.1, 10.0))
def test_turning_axes_is_a_rotation(q, u, degrees, correlation, ratio):
    """Turned by chi, light along chi lies along the first axis; lengths and determinants stay."""
    before = image(q, u, 1.0, ratio**2, correlation * ratio)
    twice = np.deg2rad(2.0 * degrees)
    after = before.rotated(np.cos(twice), np.sin(twice))
    turn = np.array([[np.cos(twice), np.sin(twice)], [-np.sin(twice), np.cos(twice)]])
    matrix = np.array([[1.0, correlation * ratio], [correlation * ratio, ratio**2]])
    wanted = turn @ matrix @ turn.T
    np.testing.assert_allclose(
        [after.q_variance[0, 0], after.covariance[0, 0], after.u_variance[0, 0]],
        [wanted[0, 0], wanted[0, 1], wanted[1, 1]],
        atol=1e-9,
    )
    np.testing.assert_allclose(turn @ [q, u], [after.q[0, 0], after.u[0, 0]], atol=1e-12)


def test_covariance_is_that_of_many_drawn_readings():
    """40,000 draws with unequal noise; within five standard errors, sqrt(2/40000) of each."""
    rng = np.random.default_rng(1)
    angles, sigma = (0.0, 20.0, 75.0, 100.0), np.array([1.0, 3.0, 2.0, 0.5])[:, None, None]
    light = readings(angles, 400.0, 0.3, -0.2)
    drawn = light + sigma * rng.normal(size=(4, 200, 200))
    found = fit_stokes(drawn, np.broadcast_to(sigma**2, drawn.shape), angles)
    stated = fit_stokes(light, np.broadcast_to(sigma**2, light.shape), angles)
    tolerance = 5.0 * np.sqrt(2.0 / 40_000)
    for name, values in (("q", found.q), ("u", found.u), ("intensity", found.intensity)):
        variance = getattr(stated, f"{name}_variance")[0, 0]
        assert values.var() / variance == pytest.approx(1.0, abs=tolerance)
    correlation = np.corrcoef(found.q.ravel(), found.u.ravel())[0, 1]
    assert abs(correlation) > 0.1
    assert stated.correlation[0, 0] == pytest.approx(correlation, abs=5.0 / 200.0)
    assert found.misfit.mean() == pytest.approx(1.0, abs=tolerance)


@pytest.mark.thorough
def test_readings_that_no_light_makes_do_not_fit():
    light = readings((0.0, 45.0, 90.0, 135.0), 200.0, 0.1, 0.1)
    light[0] += 30.0  # a frame that was exposed longer
    found = fit_stokes(light, np.ones_like(light), (0.0, 45.0, 90.0, 135.0))
    assert found.misfit[0, 0] == pytest.approx(225.0)
    assert fit_stokes(light[:3], np.ones((3, 1, 1)), (0.0, 45.0, 90.0)).misfit is None


def test_what_noise_adds_to_a_degree_of_polarization_is_taken_off():
    """Means of 90,000 draws, standard error .0033 of the noise: bounds are five of them wide."""
    rng = np.random.default_rng(2)
    noise = rng.normal(size=(2, 300, 300))
    left = {}
    for p in (0.0, 1.0, 2.0, 3.0, 6.0):
        found, error = unbiased_dop(image(p + noise[0], noise[1], 1.0, 1.0, 0.0))
        left[p] = (found.mean() - p, np.hypot(p + noise[0], noise[1]).mean() - p)
        assert (found >= 0.0).all()
        np.testing.assert_allclose(error, 1.0)
    # At zero: (sqrt(pi/2) + sqrt(pi/6))/2 for the estimator, sqrt(pi/2) for the length.
    assert left[0.0][0] == pytest.approx(0.5 * (np.sqrt(np.pi / 2) + np.sqrt(np.pi / 6)), abs=0.02)
    assert left[0.0][1] == pytest.approx(np.sqrt(np.pi / 2), abs=0.02)
    assert abs(left[2.0][0]) < 0.07 < 0.2 < left[2.0][1]
    assert abs(left[3.0][0]) < 0.03 < 0.13 < left[3.0][1]
    assert abs(left[6.0][0]) < 0.02 < 0.06 < left[6.0][1]


def test_the_estimator_is_that_of_the_paper_for_any_ellipse_of_noise():
    """Equations 32 to 37 by principal axes, in place of directions."""
    rng = np.random.default_rng(4)
    q, u = rng.normal(0.0, 0.05, (2, 1, 50))
    sq, su, rho = rng.uniform(0.01, 0.1, 50), rng.uniform(0.01, 0.1, 50), rng.uniform(-0.9, 0.9, 50)
    theta = 0.5 * np.arctan2(2.0 * rho * sq * su, sq**2 - su**2)
    mixed = rho * sq * su * np.sin(2.0 * theta)
    major = sq**2 * np.cos(theta) ** 2 + su**2 * np.sin(theta) ** 2 + mixed
    minor = sq**2 * np.sin(theta) ** 2 + su**2 * np.cos(theta) ** 2 - mixed
    turn = np.arctan2(u, q) - theta
    b2 = minor * np.cos(turn) ** 2 + major * np.sin(turn) ** 2
    p = np.hypot(q, u)
    wanted = p - b2 * (1.0 - np.exp(-(p**2) / b2)) / (2.0 * p)
    found, error = unbiased_dop(image(q, u, sq**2, su**2, rho * sq * su))
    np.testing.assert_allclose(found, wanted, rtol=1e-10)
    along = major * np.cos(turn) ** 2 + minor * np.sin(turn) ** 2
    np.testing.assert_allclose(error, np.sqrt(along), rtol=1e-10)


@pytest.mark.thorough
def test_unpolarized_light_has_a_finite_estimate():
    found, error = unbiased_dop(image(0.0, 0.0, 0.01, 0.04, 0.0))
    assert found[0, 0] == 0.0
    assert error[0, 0] == pytest.approx(0.1)
