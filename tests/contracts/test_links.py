"""Every link goes through the same checks; one of a user's own takes one class in one file."""

import dataclasses
import functools
from typing import ClassVar, override

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from numpyro import distributions as dist
from numpyro.infer.util import log_density
from synthetic_observations import make_observations

from polar_bayes.design.fisher import information
from polar_bayes.errors import FitError
from polar_bayes.maps.residuals import standardize
from polar_bayes.models.per_material import per_material
from polar_bayes.observation import links
from polar_bayes.observation.data import observe
from polar_bayes.observation.links import (
    AbstractLink,
    BetaLink,
    LogitNormalLink,
    NormalLink,
    StokesLink,
    StudentTLink,
    noise_parameters,
)
from polar_bayes.physics.mixing import StokesMixing
from polar_bayes.physics.scene import Scene
from polar_bayes.physics.subsurface import Unpolarized
from polar_bayes.physics.surface import SmoothSurface
from polar_bayes.priors import PRIORS, RANGES, resolve_priors
from polar_bayes.simulation import NOISE, Protocol, simulate

LINKS = [
    ("dop", BetaLink()),
    ("dop", LogitNormalLink()),
    ("dop", NormalLink()),
    ("q", NormalLink()),
    ("q", StokesLink()),
    ("u", StokesLink(degrees_of_freedom=4.0)),
    ("q", StokesLink(stated_errors=True)),
    ("intensity", StudentTLink()),
    ("intensity", StudentTLink(stated_errors=True)),
]
EVERY_LINK = each(("name", "link"), LINKS, ids=lambda part: repr(part)[:60])

ZENITHS = (0.0, 30.0, 55.0, 85.0)
LEADING = (("wavelength", 3),)
SHAPE = (3, 4)


def make_prediction(dtype=np.float64):
    """Every observable, spread over its range; (wavelength, view)."""
    spread = jnp.linspace(0.05, 0.9, 12, dtype=dtype).reshape(SHAPE)
    return {"dop": spread, "q": spread - 0.5, "u": 0.4 - spread, "intensity": spread}


def make_noise(link, dtype=np.float64):
    """The noise parameters that the link names, and no others."""
    return {name: jnp.asarray({"exposure": 1.0, **NOISE}[name], dtype) for name in link.parameters}


def make_data(dtype=np.float64):
    """The views, without any reading: a link must not look at what it describes."""
    return make_observations(ZENITHS, leading=LEADING, full_scale=1.0, dtype=dtype)


@functools.cache
def draw(name, link):
    """400 draws of every view, and whether each is possible; made once for all tests."""

    @jax.jit
    def drawn(key, *given):
        distribution = link.distribution(name, *given)
        assert distribution.batch_shape == SHAPE
        assert distribution.event_shape == ()
        draws = link.reading(distribution.sample(key, (400,)))
        return draws, distribution.support(draws)

    return drawn(jax.random.key(1), make_prediction(), make_data(), make_noise(link))


@EVERY_LINK
def test_a_draw_has_one_finite_reading_per_view(name, link):
    draws, are_possible = draw(name, link)
    assert draws.shape == (400, *SHAPE)
    assert np.all(np.isfinite(draws))
    assert np.all(are_possible)


@EVERY_LINK
def test_designs_and_maps_know_the_noise_of_its_readings(name, link):
    def known(reading, *given):
        distribution = link.distribution(name, *given)
        return information(distribution)[1], standardize(distribution, reading).center

    prediction = make_prediction()
    given = prediction, make_data(), make_noise(link)
    matrix, center = jax.eval_shape(known, prediction[name], *given)
    assert matrix.shape == (*SHAPE, 2, 2)
    assert center.shape == SHAPE


def density_of(name, link, dtype):
    """The log density as a function, and its arguments: prediction, noise, views, reading."""

    def density(prediction, noise, data, reading):
        return link.distribution(name, prediction, data, noise).log_prob(reading)

    reading = draw(name, link)[0][0].astype(dtype)
    return density, (make_prediction(dtype), make_noise(link, dtype), make_data(dtype), reading)


def slopes_of(density):
    """Compiled: density in every view, and the slopes of their sum by prediction and noise."""

    def total(*arguments):
        found = density(*arguments)
        return found.sum(), found

    return jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))


TRUST = jnp.array([[1.0, 0.25, 0.04, 1e-12]])
"""In the normal of each view, down to none at all."""
PRECISIONS = (np.float64, np.float32)


def trusting(data, confidence):
    return dataclasses.replace(data, confidence=confidence)


@EVERY_LINK
@each("dtype", PRECISIONS, quick=1)
@each("trust", [None, TRUST], quick=1)
def test_density_and_gradient_are_finite(name, link, dtype, trust):
    density, (prediction, noise, data, reading) = density_of(name, link, dtype)
    data = data if trust is None else trusting(data, trust.astype(dtype))
    given = prediction, noise, data, reading
    (_, density), (by_prediction, by_noise) = slopes_of(density)(*given)
    assert density.shape == SHAPE
    assert density.dtype == dtype
    assert all(np.isfinite(x).all() for x in (density, *by_prediction.values(), *by_noise.values()))
    if trust is None:
        assert np.any(by_prediction[name] != 0.0)
        # Every parameter that a link names matters, and it names every one that it reads.
        assert all(slope != 0.0 for slope in by_noise.values())


@EVERY_LINK
def test_single_precision_stays_single(name, link):
    """A trace tells, and needs no program."""
    density, arguments = density_of(name, link, np.float32)
    assert jax.eval_shape(density, *arguments).dtype == np.float32


@pytest.mark.thorough
@EVERY_LINK
def test_compiling_changes_nothing(name, link):
    density, arguments = density_of(name, link, np.float64)
    # Compiled arithmetic may be fused: some units in the last place, of sums up to about ten.
    np.testing.assert_allclose(
        density(*arguments), jax.jit(density)(*arguments), rtol=1e-13, atol=1e-13
    )


@pytest.mark.thorough
@EVERY_LINK
def test_draws_scatter_around_the_center(name, link):
    center = link.center(name, make_prediction(), make_noise(link))
    assert center.shape == SHAPE
    # Above and below equally often, if the center is the median; means of skewed noise lie
    # elsewhere, but not beyond its quartiles. 0.25 is 10 standard errors of a share of 400 draws.
    share = np.mean(np.asarray(draw(name, link)[0]) > np.asarray(center), axis=0)
    assert np.all(np.abs(share - 0.5) < 0.25)


@EVERY_LINK
def test_every_noise_parameter_has_a_prior_and_a_range(name, link):
    assert name in link.observables
    assert set(link.parameters) <= set(PRIORS)
    assert set(link.parameters) <= set(RANGES)


@EVERY_LINK
def test_a_link_is_a_constant_of_a_compiled_program(name, link):
    twin = dataclasses.replace(link)
    assert link == twin
    assert hash(link) == hash(twin)
    assert eval(repr(link), vars(links)) == link  # what a report prints can be typed back in
    with pytest.raises(dataclasses.FrozenInstanceError):
        link.margin = 0.5


@pytest.mark.thorough
@EVERY_LINK
def test_brightness_and_angle_of_one_view_do_not_reach_another(name, link):
    density, (prediction, noise, data, reading) = density_of(name, link, np.float64)
    changed = dataclasses.replace(data, brightness=data.brightness.at[1, 2].set(0.01))
    compiled = jax.jit(density)
    plain, other = (compiled(prediction, noise, views, reading) for views in (data, changed))
    rest = np.ones(SHAPE, bool)
    rest[1, 2] = False
    np.testing.assert_array_equal(np.asarray(plain)[rest], np.asarray(other)[rest])


# --- trust in the normal ------------------------------------------------------------------------


@EVERY_LINK
def test_full_trust_is_as_if_nothing_were_said(name, link):
    density, (prediction, noise, data, reading) = density_of(name, link, np.float64)
    plain, sure = (
        jax.jit(density)(prediction, noise, views, reading)
        for views in (data, trusting(data, jnp.ones((1, 4))))
    )
    np.testing.assert_array_equal(sure, plain)


@EVERY_LINK
def test_trust_of_one_view_is_its_precision(name, link):
    """Twice the noise at a quarter of the trust; a quarter of the concentration that is gained."""
    data = trusting(make_data(), TRUST)
    found, plain = (
        link.distribution(name, make_prediction(), each, make_noise(link))
        for each in (data, make_data())
    )
    assert found.batch_shape == SHAPE
    if isinstance(link, BetaLink):
        gained, sure = (each.concentration - link.schedule.minimum for each in (found, plain))
        np.testing.assert_allclose(gained, sure * TRUST, rtol=1e-3, atol=1e-12)
    else:
        wide, sure = (getattr(each, "base_dist", each).scale for each in (found, plain))
        np.testing.assert_allclose(
            jnp.broadcast_to(wide, SHAPE), sure / jnp.sqrt(TRUST) * jnp.ones(SHAPE), rtol=1e-13
        )


@each("link", [BetaLink(margin=1e-3), LogitNormalLink(margin=1e-3)])
def test_readings_at_0_and_1_come_to_the_margin_and_others_stay(link):
    given = jnp.array([0.0, 1e-4, 0.3, 1.0 - 1e-4, 1.0])
    np.testing.assert_allclose(link.reading(given), [1e-3, 1e-3, 0.3, 0.999, 0.999], rtol=1e-15)


def test_stated_errors_set_the_scale_and_the_factor_stretches_it():
    data = make_observations(ZENITHS, error=[0.1, 0.2, 0.3, 0.4])
    prediction = {"q": jnp.zeros(4)}
    noise = {"stokes_error_factor": jnp.asarray(2.0)}
    found = StokesLink(stated_errors=True).distribution("q", prediction, data, noise)
    np.testing.assert_allclose(found.scale, [0.2, 0.4, 0.6, 0.8], rtol=1e-15)


def test_shot_noise_grows_as_the_view_darkens_until_nothing_is_known():
    data = make_observations(ZENITHS, brightness=[1.0, 0.25, 1e-3, 0.0])
    prediction, noise = {"q": jnp.full(4, 0.5)}, {"stokes_scale": jnp.asarray(0.01)}
    found = StokesLink().distribution("q", prediction, data, noise)
    shot = np.array([0.01, 0.02, 0.1**0.5, 1e-2 / StokesLink().least_brightness ** 0.5])
    np.testing.assert_allclose(found.scale, shot / np.sqrt(1.0 + 2.0 * shot**2), rtol=1e-12)
    np.testing.assert_allclose(found.loc, 0.5 / np.sqrt(1.0 + shot**4), rtol=1e-12)
    assert abs(found.scale[3] - 0.5**0.5) < 1e-4  # of a point on the unit circle
    assert found.loc[3] < 1e-4


def test_the_light_of_a_view_is_that_of_the_prediction_where_it_is_fitted():
    """A dark view reads noise: as if bright, its polarization would count."""
    data = make_observations(ZENITHS, brightness=[0.3, 0.3, 0.3, 0.3])
    light = jnp.array([0.1, 0.03, 1e-8, 5.0])
    prediction = {"q": jnp.full(4, 0.5), "intensity": light}
    noise = {"stokes_scale": jnp.asarray(0.01), "exposure": jnp.asarray(2.0)}
    scale = StokesLink().distribution("q", prediction, data, noise).scale
    np.testing.assert_allclose(scale[:2], 0.01 / np.sqrt([0.2, 0.06]), rtol=3e-3)
    assert scale[2] > 0.5
    assert 0.0099 < scale[3] < 0.0101  # no more than full scale


def test_a_capture_without_errors_is_refused_where_they_are_needed():
    data = dataclasses.replace(make_data(), errors={})
    link = StokesLink(stated_errors=True)
    with pytest.raises(FitError, match="states no q_error; add that variable") as caught:
        link.distribution("q", make_prediction(), data, make_noise(link))
    assert str(caught.value).startswith("StokesLink(stated_errors=True): ")


def test_only_the_link_of_stated_errors_reads_them():
    assert [link for _, link in LINKS if link.reads_errors] == [
        link for _, link in LINKS if "stokes_error_factor" in link.parameters
    ]


@each(
    ("make", "message"),
    [
        (lambda: BetaLink(margin=0.0), "^BetaLink: margin is 0.0; give a number from 1e-6"),
        (lambda: LogitNormalLink(margin=0.1), "^LogitNormalLink: margin is 0.1; give"),
        (lambda: StokesLink(2.0), "^StokesLink: degrees_of_freedom is 2.0; give a number above"),
        (lambda: StokesLink(least_brightness=0.0), "^StokesLink: least_brightness is 0.0; give"),
        (lambda: StudentTLink(2.9), "^StudentTLink: degrees_of_freedom is 2.9; give a number from"),
        (lambda: StudentTLink(float("nan")), "^StudentTLink: degrees_of_freedom is nan; give"),
    ],
)
def test_a_field_outside_its_range_is_refused_by_name(make, message):
    with pytest.raises(FitError, match=message):
        make()


def test_noise_parameters_are_listed_once_in_the_order_of_the_links():
    links = {"q": StokesLink(), "u": StokesLink(), "intensity": StudentTLink()}
    assert noise_parameters(links) == ("stokes_scale", "exposure", "intensity_scale")


def test_a_contract_left_open_cannot_be_used():
    class Unfinished(AbstractLink):
        observables = ("dop",)

    with pytest.raises(TypeError, match="abstract"):
        Unfinished()


# --- a link of a user's own: this class is all that it takes --------------------------------------


@dataclasses.dataclass(frozen=True)
class LaplaceLink(AbstractLink):
    """Noise with an absolute-value penalty: sharp at the prediction, forgiving far from it."""

    observables: ClassVar[tuple[str, ...]] = ("q", "u")
    parameters: ClassVar[tuple[str, ...]] = ("laplace_scale",)

    @override
    def distribution(self, name, prediction, data, noise):
        return dist.Laplace(prediction[name], noise["laplace_scale"])


@pytest.mark.thorough
def test_a_link_of_a_users_own_simulates_and_fits_in_a_model():
    links = {"q": LaplaceLink(), "u": LaplaceLink()}
    scene = Scene(SmoothSurface(), Unpolarized(), StokesMixing())
    protocol = Protocol(views=8, wavelengths=(450.0, 550.0))
    noise = {"laplace_scale": 0.01}
    capture = simulate("glass", scene=scene, links=links, protocol=protocol, noise=noise, seed=5)
    data = observe(capture)
    names = (*scene.parameters, *noise_parameters(links))
    own = {"laplace_scale": dist.HalfNormal(0.05)}
    arguments = (data, scene, resolve_priors(names, own), links)
    with pytest.raises(FitError, match=r"laplace_scale.*no prior"):
        resolve_priors(names)

    def density(scale):
        # On the axes of the plates: wavelength, then view, of length 1 where they do not repeat.
        values = {
            "subsurface_fraction": capture["true_subsurface_fraction"].values.reshape(1, 1),
            "refractive_index": capture["true_refractive_index"].values.reshape(2, 1),
            "laplace_scale": scale,
        }
        return log_density(per_material, arguments, {}, values)[0]

    totals, slopes = jax.jit(jax.vmap(jax.value_and_grad(density)))(jnp.array([0.001, 0.01, 0.1]))
    assert np.all(np.isfinite(slopes))
    # 32 readings drawn with a scale of 0.01 tell it from one ten times off by 30 and more.
    assert totals[1] > max(totals[0], totals[2]) + 10.0
