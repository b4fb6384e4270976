"""The distributions of the noise, against 50 digits, NumPyro, quadrature and their own draws."""

import itertools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import numpyro
import pytest
from cases import each
from digits import assert_accurate, assert_finite, exactly, value_gradient_hessian
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import log_density
from scipy import stats

from polar_bayes.observation.distributions import (
    MeanConcentrationBeta,
    SensorStudentT,
    StudentT,
    log_survival,
)

PRECISIONS = each("dtype", [np.float64, np.float32])

pytestmark = pytest.mark.usefixtures("fifty_digits")

MEANS = (1e-6, 1e-4, 0.1, 0.5, 0.9, 1 - 1e-4)
CONCENTRATIONS = (1e-3, 1.0, 5.0, 300.0, 1e5, 1e8)
MARGINS = (1e-6, 1e-4, 1e-3, 1 - 1e-3, 1 - 1e-4, 1 - 1e-6)
DEGREES_OF_FREEDOM = (3.0, 5.0, 7.0)


def beta_cases(dtype):
    """Mean, concentration and reading: at the margins, at the mean, near it and far from it."""
    rows = []
    for mean, concentration in itertools.product(MEANS, CONCENTRATIONS):
        width = np.sqrt(mean * (1 - mean) / (1 + concentration))
        near = (mean, mean * (1 + 1e-6), mean * 1.09, mean * 1.11)
        around = [mean + steps * width for steps in (-3.0, -0.5, 0.5, 3.0)]
        for reading in (*MARGINS, 0.3, 0.7, *near, *around):
            if MARGINS[0] <= dtype(reading) <= MARGINS[-1]:
                rows.append((mean, concentration, reading))
    return np.array(rows, dtype)


def beta_log_density(row):
    return MeanConcentrationBeta(row[0], row[1], validate_args=False).log_prob(row[2])


def sensor_cases(dtype):
    """Location, scale, reading and flag: at both stops, at the location, 1e8 scales away."""
    locations = (0.0, 1e-6, 0.3, 0.999, 1.0, 1.5, 1e8)
    scales = (1e-8, 1e-4, 0.01, 1.0, 1e4)
    readings = ((0.0, 0), (1e-6, 0), (0.3, 0), (0.999, 0), (1.0, 0), (1.0, 1))
    rows = [(a, b, *c) for a, b, c in itertools.product(locations, scales, readings)]
    return np.array([row for row in rows if abs(row[2] - row[0]) <= 1.1e8 * row[1]], dtype)


def sensor_log_density(row, degrees_of_freedom):
    location, scale, reading, saturated = row
    return SensorStudentT(
        degrees_of_freedom, location, scale, saturated > 0, 1.0, validate_args=False
    ).log_prob(reading)


def assert_within(values, truth, rows, dtype):
    """Relative to max(1, |truth|), at every case: none needs slack for rounded inputs."""
    assert_accurate(values, truth, dtype, rows, floor=1.0)


@PRECISIONS
def test_the_beta_log_density_agrees_with_fifty_digits(dtype):
    rows = beta_cases(dtype)
    truth = []
    for mean, concentration, x in exactly(rows):
        a, b = mean * concentration, (1 - mean) * concentration
        constant = mp.loggamma(a) + mp.loggamma(b) - mp.loggamma(concentration)
        truth.append((a - 1) * mp.log(x) + (b - 1) * mp.log(1 - x) - constant)
    assert_within(jax.jit(jax.vmap(beta_log_density))(rows), truth, rows, dtype)


@PRECISIONS
def test_the_beta_gradient_agrees_with_fifty_digits(dtype):
    rows = beta_cases(dtype)
    by_mean, by_concentration = [], []  # a reading is data: nothing follows its gradient
    for mean, concentration, x in exactly(rows):
        a, b = mean * concentration, (1 - mean) * concentration
        first, second = mp.log(x) - mp.psi(0, a), mp.log(1 - x) - mp.psi(0, b)
        by_mean.append(concentration * (first - second))
        total = mp.psi(0, concentration)
        by_concentration.append(mean * first + (1 - mean) * second + total)
    gradient = np.asarray(jax.jit(jax.vmap(jax.grad(beta_log_density)))(rows))
    for column, truth in enumerate((by_mean, by_concentration)):
        assert_within(gradient[:, column], truth, rows, dtype)


@PRECISIONS
@each("degrees_of_freedom", DEGREES_OF_FREEDOM)
def test_the_sensor_log_density_agrees_with_fifty_digits(degrees_of_freedom, dtype):
    rows = sensor_cases(dtype)
    nu = mp.mpf(degrees_of_freedom)
    truth = []
    for location, scale, reading, saturated in exactly(rows):
        distance = (reading - location) / scale
        constant = mp.log(mp.beta(nu / 2, mp.mpf(1) / 2)) + mp.log(nu) / 2 + mp.log(scale)
        inside = -(nu + 1) / 2 * mp.log1p(distance**2 / nu) - constant
        if saturated:
            truth.append(mp.log(upper_tail(distance, nu)))
        else:
            truth.append(inside if reading > 0 else mp.log(upper_tail(-distance, nu)))
    values = jax.jit(jax.vmap(lambda row: sensor_log_density(row, degrees_of_freedom)))(rows)
    assert_within(values, truth, rows, dtype)


def upper_tail(distance, nu):
    """Probability that Student's t exceeds a distance."""
    inner = nu / (nu + distance**2)
    tail = mp.betainc(nu / 2, mp.mpf(1) / 2, 0, inner, regularized=True) / 2
    return tail if distance >= 0 else 1 - tail


@PRECISIONS
@each("degrees_of_freedom", [0.5, *DEGREES_OF_FREEDOM, 6.3])
def test_the_log_survival_agrees_with_fifty_digits(degrees_of_freedom, dtype):
    steps = np.array([0.0, 1e-12, 1e-4, 0.1, 0.5, 1.0, 2.0, 5.0, 100.0, 1e4, 1e8])
    distances = np.concatenate([-steps, steps]).astype(dtype)
    nu = mp.mpf(degrees_of_freedom)
    truth = [mp.log(upper_tail(distance, nu)) for distance in exactly(distances)]
    values = jax.jit(lambda distance: log_survival(distance, degrees_of_freedom))(distances)
    assert_within(values, truth, distances, dtype)


@pytest.mark.thorough
@PRECISIONS
def test_the_slope_of_the_log_survival_is_minus_the_hazard(dtype):
    distances = np.array([-50.0, -1.0, -1e-9, 0.0, 1e-9, 1.0, 50.0, 1e8], dtype)
    slopes = jax.jit(jax.vmap(jax.grad(lambda distance: log_survival(distance, 5.0))))(distances)
    truth = []
    for distance in exactly(distances):
        density = (1 + distance**2 / 5) ** -3 / (mp.sqrt(5) * mp.beta(mp.mpf(5) / 2, 0.5))
        truth.append(-density / upper_tail(distance, mp.mpf(5)))
    assert_within(slopes, truth, distances, dtype)


@pytest.mark.thorough
@PRECISIONS
def test_the_beta_is_finite_with_its_derivatives_up_to_the_margins(dtype):
    means = (1e-6, *MEANS, 1 - 1e-6)
    rows = np.array(list(itertools.product(means, CONCENTRATIONS, (*means, 0.3))), dtype)
    assert_finite(value_gradient_hessian(beta_log_density, rows), rows, dtype)


@pytest.mark.thorough
@PRECISIONS
def test_the_sensor_is_finite_with_its_derivatives_at_the_stops_and_far_away(dtype):
    rows = sensor_cases(dtype)
    assert np.any(rows[:, 0] == rows[:, 2])  # no distance at all
    assert np.max(np.abs(rows[:, 2] - rows[:, 0]) / rows[:, 1]) >= dtype(0.99e8)
    results = value_gradient_hessian(lambda row: sensor_log_density(row, 5.0), rows)
    assert_finite(results, rows, dtype)


@pytest.mark.thorough
def test_the_beta_equals_numpyros_at_moderate_values():
    means, concentrations, readings = np.meshgrid([0.1, 0.5, 0.9], [2.0, 30.0], [0.2, 0.5, 0.8])
    ours = MeanConcentrationBeta(means, concentrations)
    theirs = dist.BetaProportion(means, concentrations)
    found, expected = (jax.jit(each.log_prob)(readings) for each in (ours, theirs))
    # NumPyro's log gamma of 30 is 71 and carries 1e-14; 1e-12 leaves room for three of them.
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-15)
    np.testing.assert_allclose(ours.variance, theirs.variance, rtol=1e-14)


CENSORED = np.array(
    [
        (mean, concentration, reading)
        for mean in (1e-4, 3e-4, 1e-2, 0.5, 0.999, 1.0 - 1e-4)
        for concentration in (1e-3, 0.3, 10.0, 300.0, 1e4, 1e5)
        for reading in (1e-4, 1.0 - 1e-4)
    ]
)
MARGIN = 1e-4


def censored_log_probability(row):
    return MeanConcentrationBeta(row[0], row[1], MARGIN, validate_args=False).log_prob(row[2])


@each("dtype", [np.float64, np.float32], quick=1)
def test_a_reading_at_the_margin_has_the_probability_beyond_it(dtype):
    """Eight nodes leave .003 of the logarithm up to 30 expected readings within the margin."""
    rows = CENSORED.astype(dtype)
    found = value_gradient_hessian(censored_log_probability, rows)
    assert_finite(found, rows, dtype)
    for (mean, concentration, reading), value in zip(CENSORED, found[0], strict=True):
        shapes = mean * concentration, (1.0 - mean) * concentration
        low, high = stats.beta.logcdf(MARGIN, *shapes), stats.beta.logsf(1.0 - MARGIN, *shapes)
        truth = low if reading < 0.5 else high
        if truth > -30.0:
            assert abs(value - truth) < 0.003, (mean, concentration, reading)


def test_draws_of_a_censored_beta_are_its_readings():
    censored, free = (MeanConcentrationBeta(0.003, 300.0, margin) for margin in (1e-3, 0.0))
    sample = jax.jit(lambda noise: noise.sample(jax.random.key(0), (4000,)))
    drawn, all_drawn = (np.asarray(sample(noise)) for noise in (censored, free))
    np.testing.assert_array_equal(drawn, np.clip(all_drawn, 1e-3, 1.0 - 1e-3))
    log_density = jax.jit(lambda noise, x: noise.log_prob(x))
    share, expected = np.mean(drawn == 1e-3), np.exp(float(log_density(censored, 1e-3)))
    assert abs(share - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / 4000.0)
    inside = np.linspace(0.01, 0.5, 5)
    np.testing.assert_array_equal(*(log_density(noise, inside) for noise in (censored, free)))


@jax.jit
def integrand(parameters, reading):
    return MeanConcentrationBeta(*parameters, validate_args=False).log_prob(reading)


@each(("mean", "concentration"), [(0.5, 4.0), (0.1, 30.0), (0.9, 300.0), (0.3, 1e5)])
def test_the_beta_integrates_to_one(mean, concentration):
    # The trapezoidal rule over the log odds converges exponentially; beyond 20 less than e^-40 is
    # left, and steps of 0.001 resolve a peak 0.007 wide. What remains is rounding.
    log_odds = np.linspace(-20.0, 20.0, 40_001)
    reading = 1.0 / (1.0 + np.exp(-log_odds))
    density = np.exp(integrand(np.array([mean, concentration]), reading))
    total = np.sum(density * reading * (1.0 - reading)) * (log_odds[1] - log_odds[0])
    assert total == pytest.approx(1.0, abs=1e-10)


SENSOR = jax.jit(jax.vmap(lambda row: sensor_log_density(row, 5.0)))


@each("location", [0.0, 0.02, 0.5, 1.0, 1.4])
@each("scale", [0.05, 0.5])
def test_the_sensor_integrates_to_one_with_the_mass_at_its_stops(location, scale):
    # The integrand's poles stand at least 0.05 sqrt(5) from the interval, so 200 nodes leave
    # 1.2 ** -400, far below rounding.
    nodes, weights = np.polynomial.legendre.leggauss(200)
    readings = np.array([0.0, *0.5 * (nodes + 1.0), 1.0])
    rows = np.stack(np.broadcast_arrays(location, scale, readings, readings >= 1.0), axis=1)
    density = np.exp(SENSOR(rows))
    total = density[0] + density[1:-1] @ (0.5 * weights) + density[-1]
    assert total == pytest.approx(1.0, abs=1e-12)


# Five standard errors are passed by chance once in 1.7 million; every seed is fixed.
SIGMAS = 5.0
DRAWS = 20_000


@jax.jit
def drawn(distribution, seed):
    return distribution.sample(jax.random.key(seed), (DRAWS,))


def assert_moments(draws, mean, variance):
    squares = (draws - mean) ** 2
    for values, expected in ((draws, mean), (squares, variance)):
        error = values.std(axis=0) / np.sqrt(DRAWS)
        assert np.all(np.abs(values.mean(axis=0) - expected) <= SIGMAS * error)


@pytest.mark.thorough
def test_beta_draws_have_the_stated_mean_and_variance():
    mean, concentration = (grid.ravel() for grid in np.meshgrid([0.1, 0.5, 0.9], [1e-3, 5.0, 1e5]))
    distribution = MeanConcentrationBeta(mean, concentration)
    draws = np.asarray(drawn(distribution, 1))
    assert draws.min() >= 0.0
    assert draws.max() <= 1.0
    assert_moments(draws, np.asarray(distribution.mean), np.asarray(distribution.variance))


@pytest.mark.thorough
def test_sensor_draws_have_the_mean_and_variance_of_student_t_far_from_the_stops():
    distribution = SensorStudentT(5.0, jnp.array([0.5, 0.8]), 0.002, False, jnp.inf)
    assert_moments(
        np.asarray(drawn(distribution, 2)), np.asarray(distribution.mean), 0.002**2 * 5.0 / 3.0
    )


@each("freedom", [1.0, 4.0, 30.0])
def test_draws_of_student_t_have_its_distribution(freedom: float) -> None:
    draws = drawn(StudentT(freedom, 0.5, 0.2), 4)
    # 1 in 1e4 of right samplers would fail, of three degrees of freedom 3 in 1e4.
    assert stats.kstest(draws, stats.t(freedom, 0.5, 0.2).cdf).pvalue > 1e-4


def test_sensor_draws_pile_up_at_the_stops_as_often_as_stated():
    location, stops = jnp.array([[0.01], [0.97]]), jnp.array([0.0, 1.0])
    distribution = SensorStudentT(5.0, location, 0.05, stops > 0.5, 1.0)
    draws = drawn(distribution, 3)
    assert draws.min() >= 0.0
    assert draws.max() <= 1.0
    share = np.exp(np.asarray(jax.jit(distribution.log_prob)(stops)))
    found = np.mean(draws == stops, axis=0)
    assert np.all(np.abs(found - share) <= SIGMAS * np.sqrt(share * (1.0 - share) / DRAWS))


def make_beta(parameter):
    return MeanConcentrationBeta(0.5 * parameter, 30.0)


def make_sensor(parameter):
    return SensorStudentT(5.0, 0.5 * parameter, 0.05, False, jnp.inf)


MAKERS = each("make", [make_beta, make_sensor], quick=1)


@MAKERS
def test_a_distribution_crosses_the_border_of_a_compiled_function(make):
    parameter, reading = jnp.array([0.4, 0.8, 1.2]), 0.3
    plain = make(parameter).log_prob(reading)
    # Compiled arithmetic may be fused: some units in the last place, of logarithms below 100.
    for distribution in (jax.jit(make)(parameter), jax.vmap(make)(parameter)):
        np.testing.assert_allclose(distribution.log_prob(reading), plain, rtol=1e-13, atol=1e-13)
    compiled = jax.jit(lambda p: make(p).log_prob(reading))(parameter)
    np.testing.assert_allclose(compiled, plain, rtol=1e-13, atol=1e-13)


@MAKERS
def test_a_distribution_serves_as_a_site_with_mask_and_expand(make):
    readings = jnp.array([0.2, 0.5, 0.9])
    valid = jnp.array([True, False, True])

    def model(readings=None):
        with numpyro.plate("view", 3):
            numpyro.sample("reading", make(1.0).mask(valid), obs=readings)
        numpyro.sample("copies", make(1.0).expand([2]).to_event(1))

    def draw():
        trace = handlers.trace(handlers.seed(model, jax.random.key(4))).get_trace()
        return {name: trace[name]["value"] for name in ("reading", "copies")}

    shapes = jax.tree.map(lambda value: value.shape, jax.eval_shape(draw))
    assert shapes == {"reading": (3,), "copies": (2,)}
    total = jax.jit(lambda x: log_density(model, (x,), {}, {"copies": x[:2]})[0])(readings)
    density = make(1.0).log_prob(readings)
    expected = density[:2].sum() + density[valid].sum()
    assert float(total) == pytest.approx(float(expected), rel=1e-13)


@MAKERS
def test_a_parameter_outside_its_range_is_refused(make):
    with pytest.raises(ValueError, match="invalid"):
        make(jnp.nan)
