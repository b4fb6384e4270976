"""Values as the calls that make them: read without evaluation, and written as short as they can."""

import jax.numpy as jnp
import pytest
from cases import each
from numpyro import distributions as dist

import polar_bayes as pb
from polar_bayes.errors import FitError
from polar_bayes.expressions import parse_value, short_text
from polar_bayes.priors import PRIORS, parse_prior, prior_text
from polar_bayes.scenes.scene_file import parse_link, parse_method, parse_scene
from polar_bayes.setups import SETUPS

WEIGHTS = dist.CategoricalProbs(jnp.array([0.25, 0.75]))
GIVEN = {
    **PRIORS,
    "wavelengths": dist.Normal(jnp.array([[1.4], [1.5]]), 0.1).to_event(2),
    "mixture": dist.MixtureGeneral(WEIGHTS, [dist.Gamma(2.0, 3.0), dist.LogNormal(0.0, 1 / 3)]),
    "same": dist.MixtureSameFamily(WEIGHTS, dist.Normal(jnp.array([1.4, 1.6]), 0.1)),
    "cut": dist.TruncatedDistribution(dist.StudentT(4.0, 1.5, 0.1), low=1.0),
    "moved": dist.TransformedDistribution(
        dist.HalfNormal(0.5), [dist.transforms.AffineTransform(1.0, 2.0)]
    ),
}


@each("name", GIVEN)
def test_a_prior_is_read_back_with_every_digit(name):
    text = prior_text(GIVEN[name])
    assert prior_text(parse_prior(text, "here")) == text


@each("name", SETUPS)
def test_a_scene_and_its_links_are_read_back_from_the_short_and_the_long_text(name):
    setup = SETUPS[name]
    for text in (repr(setup.scene), short_text(setup.scene)):
        assert parse_scene(text, "here") == setup.scene
    for link in setup.links.values():
        assert parse_link(short_text(link), "here") == parse_link(repr(link), "here") == link


def test_a_method_is_a_name_or_settings():
    assert parse_method("nuts", "here") == "nuts"
    assert parse_method("pb.methods.Nuts(draws=700)", "here") == pb.methods.Nuts(draws=700)
    assert short_text(pb.methods.Nuts(draws=700)) == "Nuts(draws=700)"


WRONG = {
    "": "'' cannot be read",
    "Normal": "'Normal' is no call",
    "1.5": "'1.5' is no call",
    "Norml(0, 1)": "Norml is not known here; did you mean Normal",
    "open('x')": "open is not known here; give one of those of NumPyro",
    "__import__('os').system('ls')": "is not known here",
    "Normal(0, 1).log_prob(0)": "is not known here",
    "Normal(0, 10**9)": "10 \\*\\* 9 is neither a number",
    "Normal(0, Normal)": "Normal is not called; write Normal()",
    "Normal(**{'loc': 1})": "stands for no argument",
    "Normal(mu=0)": "unexpected keyword argument 'mu'.; it takes loc, scale",
    "Normal(0, -1)": "invalid scale parameter",
    "ExpTransform()": "a ExpTransform is not a NumPyro distribution",
}


@each("text", WRONG)
def test_what_is_no_prior_is_refused_and_nothing_is_evaluated(text):
    with pytest.raises(FitError, match=WRONG[text]) as caught:
        parse_prior(text, "--prior n")
    assert str(caught.value).startswith("--prior n: ")


def test_a_number_in_place_of_a_text_is_refused():
    with pytest.raises(FitError, match=r"1\.5 is no text; quote it"):
        parse_value(1.5, {}, "here")
