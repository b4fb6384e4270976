"""Fisher information against the mean outer product of scores, over many simulated readings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from numpyro import distributions as dist

import polar_bayes as pb
from polar_bayes.design.fisher import STEP, information, reading_information
from polar_bayes.design.setup import make_design_problem
from polar_bayes.inference.request import resolve
from polar_bayes.numerics.optimize import finite_sd
from polar_bayes.observation.distributions import MeanConcentrationBeta, SensorStudentT

READINGS = 200_000


def sensor(stop: float):
    def make(location, scale):
        return SensorStudentT(5.0, location, scale, jnp.zeros((), bool), jnp.asarray(stop))

    return make


CASES = {
    "normal": (dist.Normal, (0.3, 0.02)),
    "student": (lambda loc, scale: dist.StudentT(5.0, loc, scale), (0.3, 0.02)),
    "beta": (MeanConcentrationBeta, (0.3, 80.0)),
    "beta near the edge": (MeanConcentrationBeta, (0.01, 40.0)),
    **{
        f"censored beta, mean {mean}, concentration {concentration}": (
            lambda m, k: MeanConcentrationBeta(m, k, 1e-3),
            (mean, concentration),
        )
        for mean, concentration in (
            (1e-3, 40.0),
            (0.003, 300.0),
            (0.998, 300.0),
            (0.05, 300.0),
            (0.06, 500.0),
            (0.002, 1e4),
        )
    },
    "logit": (
        lambda loc, scale: dist.TransformedDistribution(
            dist.Normal(loc, scale), dist.transforms.SigmoidTransform()
        ),
        (-1.0, 0.2),
    ),
    "sensor": (sensor(np.inf), (0.3, 0.02)),
}


@pytest.mark.thorough
@each("case", CASES)
def test_it_is_the_mean_square_of_scores(case: str) -> None:
    make, at = CASES[case]
    given = jnp.asarray(at)
    readings = make(*given).sample(jax.random.key(0), (READINGS,))
    scores = jax.vmap(jax.grad(lambda at, x: make(*at).log_prob(x)), (None, 0))(given, readings)
    products = np.asarray(scores[:, :, None] * scores[:, None, :])
    error = products.std(axis=0) / READINGS**0.5
    parameters, told = information(make(*given))
    assert [float(x) for x in parameters] == pytest.approx(at)
    # Heavy tails of the squares included: five standard errors, and what 400 nodes leave.
    slack = 5.0 * error + 2e-3 * np.abs(np.diagonal(told)).max()
    assert (np.abs(products.mean(axis=0) - told) < slack).all()


@pytest.mark.thorough
@each("location", [0.95, 1.0, 1.05])
def test_a_saturated_reading_tells_less(location: float) -> None:
    """Readings are stopped at 1: simulated as the sensor does, the flag set where it stopped."""
    given = jnp.asarray([location, 0.05])
    free = dist.StudentT(5.0, *given).sample(jax.random.key(1), (READINGS,))

    def log_prob(at, x):
        stopped = SensorStudentT(5.0, at[0], at[1], x >= 1.0, jnp.asarray(1.0))
        return stopped.log_prob(jnp.clip(x, 0.0, 1.0))

    scores = jax.vmap(jax.grad(log_prob), (None, 0))(given, free)
    products = np.asarray(scores[:, :, None] * scores[:, None, :])
    error = products.std(axis=0) / READINGS**0.5
    told = information(sensor(1.0)(*given))[1]
    whole = information(sensor(np.inf)(*given))[1]
    slack = 5.0 * error + 2e-3 * float(whole[0, 0])
    assert (np.abs(products.mean(axis=0) - told) < slack).all()
    assert told[0, 0] < whole[0, 0]


@pytest.mark.thorough
def test_views_masks_and_plates_keep_their_place() -> None:
    mean = jnp.linspace(0.1, 0.9, 6).reshape(2, 3)
    plain = MeanConcentrationBeta(mean, jnp.asarray(50.0))
    masked = plain.mask(jnp.ones((2, 3), bool)).expand((4, 2, 3))
    told = information(masked)[1]
    assert told.shape == (4, 2, 3, 2, 2)
    np.testing.assert_array_equal(told[1], information(plain)[1])


def test_what_is_not_known_is_told() -> None:
    with pytest.raises(pb.FitError, match="Fisher information of Cauchy is not known"):
        information(dist.Cauchy(0.0, 1.0))


def test_slopes_by_differences_are_those_of_derivatives() -> None:
    capture = pb.simulate("plastic", seed=0)
    problem = make_design_problem(
        resolve(capture, "per_material", None, None, None, None, 0, "double")
    )
    with jax.enable_x64(True):
        z, step = problem.prior[0], STEP * finite_sd(problem.prior)
        both = jax.jit(
            lambda z, step, data: (
                reading_information(problem.program, z, data),
                reading_information(problem.program, z, data, step),
            )
        )(z, step, problem.data)
    for exact, found in zip(*(found.values() for found in both), strict=True):
        # Entries are sums of terms as large as the largest; some of them are zero but for rounding.
        rounding = 8.0 * np.spacing(np.abs(exact.information).max())
        np.testing.assert_allclose(exact.information, found.information, rtol=1e-12, atol=rounding)
        size = np.abs(exact.jacobian).max(axis=tuple(range(exact.jacobian.ndim - 1)))
        # Of the second order in the step: a slope that changes over a hundredth of a prior's sd
        # has a relative error of (1e-4 / .01)^2 / 6.
        assert np.all(np.abs(exact.jacobian - found.jacobian) <= 2e-5 * size)
