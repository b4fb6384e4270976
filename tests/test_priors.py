"""What is believed before any data: the table, what may replace a row, and how it reads."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from numpyro import distributions as dist
from scipy import stats

from polar_bayes.errors import FitError
from polar_bayes.observation.links import noise_parameters
from polar_bayes.priors import PRIORS, RANGES, Beta, describe_prior, resolve_priors, support_bounds
from polar_bayes.setups import SETUPS

KEY = jax.random.key(7)
MATERIAL = ("roughness", "subsurface_fraction", "absorption", "refractive_index")


def refused(name, prior, parameters=tuple(PRIORS)):
    """The one-line message of the refusal, which names the row and says what to do."""
    with pytest.raises(FitError) as caught:
        resolve_priors(parameters, {name: prior})
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"priors[{name!r}]: ")
    assert message.count("; ") >= 1
    return message


# --- the table ------------------------------------------------------------------------------------


@each(
    ("name", "kind", "arguments"),
    [
        ("roughness", dist.HalfNormal, {"scale": 0.2}),
        ("subsurface_fraction", dist.Beta, {"concentration1": 2.0, "concentration0": 2.0}),
        ("absorption", dist.LogNormal, {"loc": -1.0, "scale": 0.5}),
    ],
)
def test_the_priors_of_the_material_are_the_papers(name, kind, arguments):
    assert isinstance(PRIORS[name], kind)
    assert {key: float(getattr(PRIORS[name], key)) for key in arguments} == arguments


def test_the_prior_of_the_index_is_the_papers_truncated_normal():
    prior = PRIORS["refractive_index"]
    assert support_bounds(prior) == (1.2, 2.0)
    assert float(prior.base_dist.loc) == 1.45
    assert float(prior.base_dist.scale) == 0.15


@each("name", PRIORS)
def test_every_row_stays_inside_the_range_of_its_parameter(name):
    low, high = support_bounds(PRIORS[name])
    least, most = RANGES.get(name, (-math.inf, math.inf))
    assert least <= low < high <= most
    assert resolve_priors([name], {name: PRIORS[name]}) == {name: PRIORS[name]}


def test_every_range_has_a_row():
    assert set(RANGES) <= set(PRIORS)
    assert set(MATERIAL) <= set(RANGES)


@each("name", SETUPS)
def test_every_parameter_of_every_setup_has_a_row(name):
    setup = SETUPS[name]
    needed = (*setup.scene.parameters, *noise_parameters(setup.links))
    assert tuple(resolve_priors(needed)) == needed


def test_every_row_can_be_drawn_from():
    draws = {name: row.sample(KEY, (100,)) for name, row in PRIORS.items()}
    assert [name for name, drawn in draws.items() if not np.isfinite(drawn).all()] == []


@pytest.mark.thorough
def test_the_tables_beta_is_numpyros():
    values = jnp.array([1e-6, 0.3, 1.0 - 1e-6])
    ours, theirs = PRIORS["subsurface_fraction"], dist.Beta(2.0, 2.0)
    # The sum of three logarithms of at most 14, in another order.
    rounding = 4.0 * np.spacing(14.0)
    np.testing.assert_allclose(
        ours.log_prob(values), theirs.log_prob(values), rtol=0.0, atol=rounding
    )
    assert (ours.mean, ours.support, ours.shape()) == (theirs.mean, theirs.support, theirs.shape())
    copies = jax.tree.map(lambda number: number, ours.expand([3]))
    assert jax.eval_shape(copies.sample, KEY).shape == (3,)


# --- replacing a row ------------------------------------------------------------------------------


@each("shapes", [(1.0, 20.0), (10.0, 1.0), (2.0, 2.0)])
def test_draws_of_beta_have_its_distribution(shapes):
    draws = Beta(*shapes).sample(KEY, (4000,))
    assert stats.kstest(draws, stats.beta(*shapes).cdf).pvalue > 1e-4  # false alarms: 1 in 1e4


def test_an_override_replaces_its_row_and_no_other():
    own = dist.TruncatedNormal(1.5, 0.02, low=1.0)
    resolved = resolve_priors(MATERIAL, {"refractive_index": own})
    assert resolved["refractive_index"] is own
    assert all(resolved[name] is PRIORS[name] for name in MATERIAL[:3])
    assert tuple(resolved) == MATERIAL


@each(
    ("name", "prior"),
    [
        ("roughness", dist.Uniform(0.01, 0.5)),
        ("roughness", dist.Gamma(2.0, 10.0)),
        ("subsurface_fraction", dist.Uniform(0.0, 1.0)),
        ("refractive_index", dist.Uniform(1.0, 3.0)),
        (
            "refractive_index",
            dist.TransformedDistribution(
                dist.LogNormal(-1.0, 0.5),
                dist.transforms.AffineTransform(1.0, 1.0, domain=dist.constraints.positive),
            ),
        ),
        ("dark_level", dist.Cauchy(0.0, 0.01)),
        ("discrepancy_weights", dist.Normal(0.0, 2.0).expand([6]).to_event(1)),
        ("absorption", dist.LogNormal(jnp.zeros((3, 1)), 0.5)),
    ],
)
def test_a_distribution_of_the_right_support_is_taken(name, prior):
    assert resolve_priors([name], {name: prior})[name] is prior


@pytest.mark.thorough
def test_a_parameter_of_a_users_own_takes_its_prior_from_the_caller():
    own = dist.Normal(0.0, 1.0).expand([3]).to_event(1)
    assert resolve_priors(["tilt"], {"tilt": own}) == {"tilt": own}


def test_a_parameter_without_prior_is_named():
    with pytest.raises(FitError, match=r"^priors\['tilt'\]: this parameter has no prior; give one"):
        resolve_priors(["roughness", "tilt"])


def test_a_misspelled_name_gets_a_suggestion_and_the_list():
    message = refused("refractive_indx", dist.Uniform(1.2, 2.0), MATERIAL)
    assert "did you mean 'refractive_index'?" in message
    assert "the parameters are roughness, subsurface_fraction, absorption" in message


@pytest.mark.thorough
def test_a_name_of_another_model_is_refused_without_a_wild_guess():
    message = refused("zzz", dist.Normal(0.0, 1.0), MATERIAL)
    assert "did you mean" not in message
    assert "no such parameter in this model" in message


@each("priors", [[dist.Normal(0.0, 1.0)], dist.Normal(0.0, 1.0), "roughness"])
def test_what_is_no_mapping_is_refused(priors):
    with pytest.raises(FitError, match=r"^priors: a \w+ does not name what it replaces; give"):
        resolve_priors(MATERIAL, priors)


OUTSIDE = "allows values outside"
ODD_SHAPE = "one draw of it has shape"
REFUSED = [
    ("roughness", 0.3, "a float is not a NumPyro distribution"),
    ("roughness", (0.0, 1.0), "a tuple is not a NumPyro distribution"),
    ("roughness", None, "a NoneType is not a NumPyro distribution"),
    ("roughness", dist.Normal, f"a {type(dist.Normal).__name__} is not a NumPyro distribution"),
    ("roughness", np.zeros(2), "a ndarray is not a NumPyro distribution"),
    ("roughness", dist.Poisson(3.0), "is discrete"),
    ("roughness", dist.Bernoulli(0.5), "is discrete"),
    ("subsurface_fraction", dist.Normal(0.5, 0.1), OUTSIDE),
    ("subsurface_fraction", dist.HalfNormal(0.5), OUTSIDE),
    ("subsurface_fraction", dist.Uniform(0.0, 1.1), OUTSIDE),
    ("refractive_index", dist.HalfNormal(1.0), OUTSIDE),
    ("refractive_index", dist.Normal(1.5, 0.02), OUTSIDE),
    ("refractive_index", dist.LogNormal(0.4, 0.1), OUTSIDE),
    ("refractive_index", dist.TruncatedNormal(1.5, 0.02, high=2.0), OUTSIDE),
    ("refractive_index", dist.Uniform(jnp.array([[0.9], [1.2]]), 2.0), OUTSIDE),
    ("roughness", dist.Normal(0.2, 0.05), OUTSIDE),
    ("absorption", dist.Laplace(0.0, 1.0), OUTSIDE),
    ("dolp_gain", dist.LogNormal(0.0, 0.1), OUTSIDE),
    ("concentration_scale", dist.StudentT(3.0, 200.0, 50.0), OUTSIDE),
    ("roughness", dist.HalfNormal(0.2).expand([4]).to_event(1), ODD_SHAPE),
    ("subsurface_fraction", dist.Dirichlet(jnp.ones(3)), ODD_SHAPE),
    ("discrepancy_weights", dist.Normal(0.0, 1.0), ODD_SHAPE),
    ("refractive_index", dist.Uniform(1.2, jnp.array([1.8, 2.0])), "a batch of 2 distributions"),
]


@each(("name", "prior", "words"), REFUSED)
def test_what_is_no_prior_of_a_parameter_is_refused(name, prior, words):
    message = refused(name, prior)
    assert words in message
    if words == OUTSIDE:
        least, most = RANGES[name]
        assert f"{OUTSIDE} {least:g} to {most:g}" in message


# --- as text --------------------------------------------------------------------------------------

WEIGHTS = dist.Categorical(probs=jnp.array([0.25, 0.75]))
SHIFTED = dist.TransformedDistribution(
    dist.HalfNormal(0.5),
    dist.transforms.AffineTransform(1.0, 2.0, domain=dist.constraints.positive),
)


@each(
    ("prior", "text"),
    [
        (dist.HalfNormal(0.2), "HalfNormal(scale=0.2)"),
        (dist.LogNormal(-1.0, 0.5), "LogNormal(loc=-1, scale=0.5)"),
        (dist.Beta(2.0, 3.0), "Beta(concentration1=2, concentration0=3)"),
        (dist.Uniform(1.2, 2.0), "Uniform(low=1.2, high=2)"),
        (dist.Normal(np.float32(1.5), jnp.asarray(0.25)), "Normal(loc=1.5, scale=0.25)"),
        (PRIORS["refractive_index"], "TruncatedNormal(loc=1.45, scale=0.15, low=1.2, high=2)"),
        (dist.TruncatedNormal(1.45, 0.15, low=1.0), "TruncatedNormal(loc=1.45, scale=0.15, low=1)"),
        (dist.TruncatedCauchy(0.0, 1.0, high=2.0), "TruncatedCauchy(loc=0, scale=1, high=2)"),
        (
            dist.Normal(0.0, 1.0).expand([4]).to_event(1),
            "Normal(loc=0, scale=1).expand([4]).to_event(1)",
        ),
        (dist.Normal(0.0, 1.0).expand([3]), "Normal(loc=0, scale=1).expand([3])"),
        (dist.Normal(0.0, 1.0).mask(False), "Normal(loc=0, scale=1)"),
        (dist.LogNormal(jnp.array([0.0, 1.0]), 0.5), "LogNormal(loc=[0, 1], scale=0.5)"),
        (dist.LogNormal(jnp.zeros((3, 1)), 0.5), "LogNormal(loc=<array (3, 1)>, scale=0.5)"),
        (
            dist.MixtureSameFamily(WEIGHTS, dist.Normal(jnp.array([1.4, 1.6]), 0.1)),
            "MixtureSameFamily(CategoricalProbs(probs=[0.25, 0.75]), "
            "Normal(loc=[1.4, 1.6], scale=0.1))",
        ),
        (
            dist.MixtureGeneral(WEIGHTS, [dist.Gamma(2.0, 3.0), dist.LogNormal(0.0, 1.0)]),
            "MixtureGeneral(CategoricalProbs(probs=[0.25, 0.75]), [Gamma(concentration=2, rate=3), "
            "LogNormal(loc=0, scale=1)])",
        ),
        (
            SHIFTED,
            "TransformedDistribution(HalfNormal(scale=0.5), [AffineTransform(loc=1, scale=2)])",
        ),
        (dist.ImproperUniform(dist.constraints.positive, (), ()), "ImproperUniform()"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_prior_reads_as_it_would_be_typed(prior, text):
    assert describe_prior(prior) == text


@pytest.mark.thorough
def test_a_prior_that_fails_to_describe_itself_still_has_a_name():
    class Broken(dist.Normal):
        @property
        def arg_constraints(self):
            raise RuntimeError("no")

    broken = object.__new__(Broken)
    broken._batch_shape = broken._event_shape = ()
    assert describe_prior(broken) == "Broken"


@pytest.mark.thorough
@each("name", PRIORS)
def test_every_row_is_described_in_one_line(name):
    text = describe_prior(PRIORS[name])
    assert "(" in text
    assert "\n" not in text
    assert "object at" not in text
