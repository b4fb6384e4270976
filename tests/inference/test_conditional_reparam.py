"""Standardized coefficients: exact whatever the map is, ideal where the model is linear."""

import dataclasses
from typing import override

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
import xarray as xr
from numpyro import distributions as dist
from plates import at_mirror
from scipy import stats

import polar_bayes as pb
from polar_bayes.inference.conditional_reparam import ConditionalReparam, find_coefficients
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.numerics.compile import LRUCache
from polar_bayes.observation.data import Observations, observe

VIEWS, NOISE, WIDTH = 9, 0.05, 0.3
LINKS = {"q": pb.links.NormalLink()}
SCENE = pb.Scene(surface=pb.SmoothSurface())
ZENITH = np.linspace(10.0, 70.0, VIEWS)
BASIS = np.cos(np.outer(np.arange(1, 4), np.radians(ZENITH)))  # (coefficient, view)


def linear(data, scene, priors, links):
    """A level that the readings depend on by its square, and a linear term."""
    level = numpyro.sample("level", dist.Normal(0.5, 0.2))
    w = numpyro.sample("w", dist.Normal(0.1, WIDTH).expand([3]).to_event(1))
    numpyro.deterministic("q_mean", level**2 + w @ jnp.asarray(BASIS))
    with numpyro.plate("view", VIEWS):
        likelihood = dist.Normal(level**2 + w @ jnp.asarray(BASIS), NOISE).mask(data.valid)
        numpyro.sample("q", likelihood, obs=data.readings["q"])


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    q = 0.3 + 0.2 * BASIS[0] - 0.1 * BASIS[2]
    q = np.clip(q + np.random.default_rng(3).normal(0.0, NOISE, VIEWS), -1.0, 1.0)
    return pb.capture.validate(at_mirror(ZENITH, q=q, valid=np.arange(VIEWS) != 4))


def found(capture: xr.Dataset, model) -> tuple[ConditionalReparam | None, Observations]:
    request = resolve(capture, model, SCENE, None, LINKS, None, 0, "double")
    data = observe(request.capture)
    return find_coefficients(compile_program(request.bind(), data), data), data


@pytest.fixture(scope="module")
def made(capture: xr.Dataset) -> tuple[ConditionalReparam, Observations]:
    reparam, data = found(capture, linear)
    assert reparam is not None
    assert reparam.names == ("w",)
    return reparam, data


def test_the_density_is_that_of_the_program_with_the_volume_of_the_map(made) -> None:
    reparam, data = made
    random = np.random.default_rng(0)
    half = random.normal(size=(4, 4))
    given = reparam.inputs(random.normal(size=4), half @ half.T + np.eye(4), data)
    x = jnp.asarray(random.normal(size=4))

    @jax.jit
    def both(x: jax.Array) -> tuple[jax.Array, ...]:
        z, log_volume = reparam.forward(x, given)
        jacobian = jax.jacfwd(lambda x: reparam.forward(x, given)[0])(x)
        there = reparam.program.potential(z, data)
        return z, log_volume, jacobian, there, reparam.potential(x, given)

    z, log_volume, jacobian, there, here = both(x)
    np.testing.assert_array_equal(z[reparam.others], x[reparam.others])
    volume = np.linalg.slogdet(jacobian)[1]
    np.testing.assert_allclose(log_volume, volume, rtol=1e-12)
    np.testing.assert_allclose(here, there - volume, rtol=1e-12)


def test_where_the_model_is_linear_coefficients_are_integrated_out(made, capture) -> None:
    """Minus the log density is |c|^2/2 plus that of the level, with the coefficients integrated."""
    reparam, data = made
    given = reparam.inputs(np.zeros(4), np.eye(4), data)
    used = capture["valid"].to_numpy()
    basis, q = BASIS[:, used], capture["q"].to_numpy()[used]
    covariance = NOISE**2 * np.eye(used.sum()) + WIDTH**2 * basis.T @ basis
    random, differences = np.random.default_rng(1), []
    potential = jax.jit(lambda x: reparam.potential(x, given))
    for level in (-0.4, 0.1, 0.5, 0.9):
        for _ in range(2):
            c = random.normal(size=3)
            x = np.zeros(4)
            x[reparam.others], x[reparam.coefficients] = level, c
            mean = level**2 + 0.1 * basis.sum(axis=0)
            marginal = stats.multivariate_normal(mean, covariance).logpdf(q)
            expected = 0.5 * c @ c - marginal - stats.norm(0.5, 0.2).logpdf(level)
            differences.append(float(potential(jnp.asarray(x))) - expected)
    np.testing.assert_allclose(differences, differences[0], atol=1e-9)


def test_models_without_such_coefficients_keep_their_coordinates(capture: xr.Dataset) -> None:
    assert found(capture, "per_material")[0] is None


def posterior_of_index(link: pb.links.AbstractLink | None, method: str) -> tuple[float, float]:
    """Mean of n of a simulated plate, and its Monte Carlo error."""
    links = None if link is None else {"q": link}
    layout = pb.simulation.Protocol(views=30, wavelengths=(), azimuths=(180.0,))
    plate = pb.simulate("glass", scene="goniometer", protocol=layout, seed=2)
    row = pb.summary(pb.fit(plate, links=links, method=method)).loc["refractive_index"]
    return row["mean"], row["mcse_mean"]


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["nuts", "importance"])
def test_chains_of_both_coordinates_agree(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mean, error = posterior_of_index(None, method)
    monkeypatch.setattr("polar_bayes.inference.compiled_model._COMPILED", LRUCache(1))
    monkeypatch.setattr("polar_bayes.inference.initialization.find_coefficients", lambda *_: None)
    expected, own_error = posterior_of_index(None, "nuts")
    assert abs(mean - expected) < 4.0 * np.hypot(error, own_error)


@dataclasses.dataclass(frozen=True)
class CauchyLink(pb.links.AbstractLink):
    """Noise without mean and variance."""

    observables = ("q",)
    parameters = ("normal_scale",)

    @override
    def distribution(self, name, prediction, data, noise):
        return dist.Cauchy(prediction[name], noise["normal_scale"])


@pytest.mark.thorough
def test_noise_without_a_variance_leaves_the_coordinates_as_they_are() -> None:
    mean, error = posterior_of_index(CauchyLink(), "nuts")
    assert np.isfinite(mean)
    assert error > 0.0
