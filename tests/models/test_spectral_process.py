"""The process over wavelength alone: what it draws, how it is conditioned, that it is finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from tinygp import GaussianProcess, kernels

from polar_bayes.errors import FitError
from polar_bayes.models.spectral_process import KERNELS, LEAST_NUGGET, SpectralProcess

IRREGULAR = np.array([405.0, 450.0, 452.0, 532.0, 550.0, 633.0, 780.0])

HARD = {
    "one": np.array([550.0]),
    "two equal": np.array([550.0, 550.0]),
    "two hundred equal": np.full(200, 550.0),
    "a thousandth apart": 550.0 + 1e-3 * np.arange(20),
    "repeated": np.array([450.0, 450.0, 550.0, 650.0]),
    "descending": np.array([650.0, 550.0, 450.0]),
    "two hundred": np.linspace(400.0, 800.0, 200),
}
LENGTHS = (1e-2, 1.0, 60.0, 300.0, 1e5)


def covariance(process: SpectralProcess, length: float, wavelength: np.ndarray) -> np.ndarray:
    """Return the covariance of the values by the weights, without drawing."""
    length, wavelength = jnp.asarray(length), jnp.asarray(wavelength)
    knot_wavelengths = process.knot_wavelengths(wavelength)
    weights = jnp.eye(min(wavelength.size, process.knots))
    each = np.asarray(jax.jit(process.values)(weights, length, knot_wavelengths, wavelength))
    return each.T @ each


def kernel_matrix(length: float, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * ((first[:, None] - second) / length) ** 2)


@each("length", [20.0, 100.0, 1000.0])
def test_standard_weights_have_the_covariance_of_the_kernel(length: float) -> None:
    found = covariance(SpectralProcess(), length, IRREGULAR)
    # The nugget is all that is missing.
    np.testing.assert_allclose(found, kernel_matrix(length, IRREGULAR, IRREGULAR), atol=1e-9)


@pytest.mark.thorough
@each(("length", "error"), [(60.0, 1e-3), (100.0, 1e-7), (300.0, 1e-8)])
def test_twenty_knots_stand_for_two_hundred_wavelengths(length: float, error: float) -> None:
    many = np.linspace(400.0, 800.0, 200)
    found = covariance(SpectralProcess(), length, many)
    np.testing.assert_allclose(found, kernel_matrix(length, many, many), atol=error)


@pytest.mark.thorough
def test_equal_wavelengths_have_equal_values() -> None:
    process, wavelength = SpectralProcess(), jnp.array([450.0, 550.0, 450.0, 650.0])
    weights = jax.random.normal(jax.random.key(0), (5, 4))
    values = process.values(
        weights, jnp.asarray(100.0), process.knot_wavelengths(wavelength), wavelength
    )
    np.testing.assert_array_equal(values[:, 0], values[:, 2])


@each("kernel", KERNELS)
def test_prediction_is_that_of_tinygp(kernel: str) -> None:
    """The mean and the covariance at new wavelengths, given the values at the knots."""
    process, length = SpectralProcess(kernel), jnp.asarray(80.0)
    measured, new = jnp.asarray(IRREGULAR), jnp.linspace(380.0, 900.0, 23)
    knot_wavelengths = process.knot_wavelengths(measured)
    weights = jax.random.normal(jax.random.key(1), (measured.size,))

    @jax.jit
    def both(length: jax.Array) -> tuple[jax.Array, ...]:
        known = process.values(weights, length, knot_wavelengths, knot_wavelengths)
        made = getattr(kernels, kernel)(scale=length)
        given = GaussianProcess(made, knot_wavelengths, diag=LEAST_NUGGET).condition(known, new)
        mean = process.values(weights, length, knot_wavelengths, new)
        factor = process.remainder(length, knot_wavelengths, new)
        return mean, factor @ factor.T, given.gp.loc, given.gp.covariance

    mean, left, their_mean, their_covariance = both(length)
    # Far outside, the smoothest kernel multiplies rounding by the inverse of the nugget.
    np.testing.assert_allclose(mean, their_mean, atol=2e-4 if kernel == "ExpSquared" else 1e-7)
    np.testing.assert_allclose(left, their_covariance, atol=2e-8)


@pytest.mark.thorough
def test_bands_widen_away_from_the_knots() -> None:
    process, knot_wavelengths = SpectralProcess(), jnp.array([450.0, 550.0, 650.0])
    new = jnp.array([450.0, 500.0, 660.0, 700.0, 800.0, 3000.0])
    factor = process.remainder(jnp.asarray(100.0), knot_wavelengths, new)
    spread = np.sqrt(np.diag(np.asarray(factor @ factor.T)))
    assert spread[0] < 2e-4  # the two nuggets
    assert spread[0] < spread[1]
    assert np.all(np.diff(spread[2:]) > 0.0)
    assert spread[-1] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.thorough
@each("dtype", [jnp.float64, jnp.float32])
@each(
    ("kernel", "cases"),
    [("ExpSquared", tuple(HARD)), *((k, ("two hundred",)) for k in KERNELS if k != "ExpSquared")],
)
def test_values_and_gradients_are_finite_at_hard_points(kernel, cases, dtype):
    process = SpectralProcess(kernel)

    def loss(weights, amplitude, length, wavelength):
        values = process.values(weights, length, process.knot_wavelengths(wavelength), wavelength)
        scales = process.scales(length, process.knot_wavelengths(wavelength))
        return jnp.sum((amplitude * values - 1.0) ** 2) + jnp.sum(jnp.log(scales))

    compiled = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2)))
    for name in cases:
        wavelength = HARD[name]
        weights = np.random.default_rng(3).normal(size=min(wavelength.size, process.knots))
        for length in LENGTHS:
            given = (jnp.asarray(x, dtype) for x in (weights, 0.02, length, wavelength))
            value, gradient = compiled(*given)
            assert value.dtype == dtype
            assert np.isfinite(value), (name, length)
            assert all(np.isfinite(part).all() for part in gradient), (name, length)


@pytest.mark.thorough
def test_what_the_knots_leave_is_finite_at_hard_points() -> None:
    remainder = jax.jit(SpectralProcess().remainder)
    for name in ("two equal", "two hundred equal", "a thousandth apart", "two hundred"):
        knot_wavelengths = SpectralProcess().knot_wavelengths(jnp.asarray(HARD[name]))
        for length in LENGTHS:
            factor = remainder(
                jnp.asarray(length), knot_wavelengths, jnp.linspace(380.0, 900.0, 40)
            )
            assert np.isfinite(factor).all(), (name, length)


def test_a_function_of_length_and_a_kernel_object_are_kernels() -> None:
    wavelength, length = jnp.asarray(IRREGULAR), jnp.asarray(80.0)
    named = covariance(SpectralProcess("Matern52"), 80.0, IRREGULAR)
    made = SpectralProcess(lambda scale: kernels.Matern52(scale=scale))
    np.testing.assert_allclose(covariance(made, 80.0, IRREGULAR), named, atol=1e-12)
    assert made.fits_length
    fixed = SpectralProcess(kernels.Matern52(scale=80.0))
    assert not fixed.fits_length
    weights = jnp.eye(wavelength.size)
    found = fixed.values(weights, None, fixed.knot_wavelengths(wavelength), wavelength)
    np.testing.assert_allclose(found.T @ found, named, atol=1e-12)
    sum_of_two = SpectralProcess(lambda scale: 0.5 * kernels.Exp(scale) + 0.5 * kernels.Exp(50.0))
    assert np.diag(covariance(sum_of_two, length, IRREGULAR)) == pytest.approx(1.0)


@each(
    ("settings", "message"),
    [
        ({"kernel": "Matern42"}, "no stationary kernel 'Matern42'.*Exp, ExpSquared, Matern32"),
        ({"kernel": 3.0}, "a float is no kernel"),
        ({"knots": 1}, "knots=1 cannot span"),
        ({"knots": 2.5}, "knots=2.5 cannot span"),
    ],
)
def test_what_is_no_process_is_refused(settings: dict, message: str) -> None:
    with pytest.raises(FitError, match=message):
        SpectralProcess(**settings)
