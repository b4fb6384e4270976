"""Prior probabilities without a compiled program against those of NumPyro."""

import functools

import jax
import numpy as np
import pytest
from cases import each
from numpyro import distributions as dist

from polar_bayes import PRIORS
from polar_bayes.inference.prior_probability import has_probabilities, probability_below
from polar_bayes.priors import cast_prior

SCALARS = sorted(name for name, prior in PRIORS.items() if not prior.event_shape)


@functools.cache
def drawn() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Draws of every prior and where they are in it, by NumPyro in one program."""

    @jax.jit
    def of_all(key):
        priors = {name: cast_prior(PRIORS[name]) for name in SCALARS}
        draws = {name: prior.sample(key, (50,)) for name, prior in priors.items()}
        return {name: (draws[name], prior.cdf(draws[name])) for name, prior in priors.items()}

    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, of_all(jax.random.key(0)))


@each("name", SCALARS)
def test_every_default_prior_as_numpyro_has_it(name):
    prior, (x, expected) = PRIORS[name], drawn()[name]
    assert has_probabilities(prior)
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
