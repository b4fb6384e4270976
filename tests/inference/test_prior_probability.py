"""Prior probabilities without a compiled program against those of NumPyro."""

import jax
import numpy as np
import pytest
from numpyro import distributions as dist

from polar_bayes import PRIORS
from polar_bayes.inference.prior_probability import has_probabilities, probability_below
from polar_bayes.priors import cast_prior

# The prior of an exposure depends on the light.
SCALARS = sorted(
    name for name, prior in PRIORS.items() if not prior.event_shape and name != "exposure"
)


@pytest.mark.parametrize("name", SCALARS)
def test_every_default_prior_as_numpyro_has_it(name):
    prior = PRIORS[name]
    assert has_probabilities(prior)
    with jax.enable_x64(True):
        x = np.asarray(cast_prior(prior).sample(jax.random.key(0), (50,)))
        expected = np.asarray(cast_prior(prior).cdf(x))
    # NumPyro has the ends of a truncated prior in the precision that it was made with.
    np.testing.assert_allclose(probability_below(prior, x), expected, atol=1e-6)


def test_a_prior_of_several_numbers_and_one_of_another_family():
    several = dist.Normal(np.array([0.0, 1.0]), 2.0)
    np.testing.assert_allclose(probability_below(several, np.array([0.0, 1.0])), 0.5)
    other = dist.Gamma(np.array([1.0, 2.0]), 1.0)
    assert probability_below(other, np.array([1.0, 1.0]))[0] == pytest.approx(1.0 - np.exp(-1.0))
    x = np.linspace(0.1, 5.0, 2_000)
    np.testing.assert_allclose(probability_below(dist.Gamma(1.0, 1.0), x), 1.0 - np.exp(-x))
    assert not has_probabilities(dist.Normal(0.0, 1.0).expand([3]).to_event(1))
    assert not has_probabilities(PRIORS["exposure"])
