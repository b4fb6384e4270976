"""Coefficients of a linear term, and two shares by their sum: exact whatever the map is.

Standardized coefficients are ideal where the model is linear; sums are smooth wherever chains go.
"""

import dataclasses
from collections.abc import Callable
from typing import override

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
import xarray as xr
from cases import each
from numpyro import distributions as dist
from plates import at_mirror
from scipy import stats

import polar_bayes as pb
from polar_bayes.inference.conditional_reparam import ConditionalReparam, find_coefficients
from polar_bayes.inference.problem import make_problem
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import Request, resolve
from polar_bayes.inference.sum_reparam import find_sum
from polar_bayes.numerics.compile import LRUCache
from polar_bayes.observation.data import Observations, observe
from polar_bayes.priors import Beta, HalfNormal

VIEWS = 9
LINKS = {"q": pb.links.NormalLink()}
SCENE = pb.Scene(surface=pb.SmoothSurface())
ZENITH = np.linspace(10.0, 70.0, VIEWS)
BASIS = np.cos(np.outer(np.arange(1, 4), np.radians(ZENITH)))  # (coefficient, view)

NOISE, WIDTH = 0.05, 0.3


def linear(data, scene, priors, links):
    """A level that the readings depend on by its square, and a linear term."""
    level = numpyro.sample("level", dist.Normal(0.5, 0.2))
    w = numpyro.sample("w", dist.Normal(0.1, WIDTH).expand([3]).to_event(1))
    numpyro.deterministic("q_mean", level**2 + w @ jnp.asarray(BASIS))
    with numpyro.plate("view", VIEWS):
        likelihood = dist.Normal(level**2 + w @ jnp.asarray(BASIS), NOISE).mask(data.valid)
        numpyro.sample("q", likelihood, obs=data.readings["q"])


FINE, NARROW, LEAK, POWER = 0.004, 0.1, 0.02, 5.0
"""Noise, width of the coefficients, and priors of both shares."""


def shares(data, scene, priors, links):
    """A model whose readings depend on the sum of two shares and a smooth error."""
    leak = numpyro.sample("leak", HalfNormal(LEAK), infer={"summed": True})
    body = numpyro.sample("body", Beta(1.0, POWER), infer={"summed": True})
    w = numpyro.sample("w", dist.Normal(0.0, NARROW).expand([2]).to_event(1))
    center = 0.9 - leak - body + w @ jnp.asarray(BASIS[:2])
    numpyro.deterministic("q_mean", center)
    with numpyro.plate("view", VIEWS):
        numpyro.sample("q", dist.Normal(center, FINE), obs=data.readings["q"])


def bounded(data, scene, priors, links):
    """The same model with upper bounds on both shares."""
    uniform = dist.Uniform(0.0, 0.5)
    names = ("leak", "body")
    leak, body = (numpyro.sample(name, uniform, infer={"summed": True}) for name in names)
    with numpyro.plate("view", VIEWS):
        numpyro.sample("q", dist.Normal(leak + body, FINE), obs=data.readings["q"])


@pytest.fixture(scope="module")
def captures() -> dict[Callable, xr.Dataset]:
    """Readings that each model could have made."""
    noise = np.random.default_rng(3).normal(size=VIEWS)
    curve = np.clip(0.3 + 0.2 * BASIS[0] - 0.1 * BASIS[2] + NOISE * noise, -1.0, 1.0)
    level = at_mirror(ZENITH, q=0.875 + FINE * noise)
    curve = at_mirror(ZENITH, q=curve, valid=np.arange(VIEWS) != 4)
    found = {linear: curve, shares: level, bounded: level}
    return {model: pb.capture.validate(capture) for model, capture in found.items()}


def asked(captures, model, capture_of=None, precision: str = "double") -> Request:
    capture = captures[capture_of or model]
    return resolve(capture, model, SCENE, None, LINKS, None, 0, precision)


def made(captures, model, precision="double") -> tuple[ConditionalReparam, Observations]:
    request = asked(captures, model, precision=precision)
    data = observe(request.capture)
    data = data if precision == "double" else data.in_single_precision()
    program = compile_program(request.bind(), data)
    reparam = find_coefficients(program, data)
    assert reparam is not None
    assert reparam.names == ("w",)
    assert (None if reparam.sums is None else reparam.sums.names) == (
        ("leak", "body") if model is shares else None
    )
    return reparam, program.free(data)


@each(("model", "rtol"), [(linear, 1e-12), (shares, 1e-10)])
def test_the_density_is_that_of_the_program_with_the_volume_of_the_map(captures, model, rtol):
    reparam, data = made(captures, model)
    random, size = np.random.default_rng(0), reparam.program.size
    half = random.normal(size=(size, size))
    given = reparam.inputs(random.normal(size=size), half @ half.T + np.eye(size), data)

    @jax.jit
    def both(x: jax.Array) -> tuple[jax.Array, ...]:
        z, log_volume = reparam.forward(x, given)
        jacobian = jax.jacfwd(lambda x: reparam.forward(x, given)[0])(x)
        there = reparam.program.potential(z, data)
        return z, log_volume, jacobian, there, reparam.potential(x, given)

    for x in 2.0 * random.normal(size=(6, size)):
        z, log_volume, jacobian, there, here = both(x)
        volume = np.linalg.slogdet(jacobian)[1]
        np.testing.assert_allclose(log_volume, volume, rtol=rtol)
        np.testing.assert_allclose(here, there - volume, rtol=1e-12)
        back = reparam.backward(np.asarray(z)[None], data)[0]
        np.testing.assert_allclose(back[reparam.others], x[reparam.others], rtol=1e-9)
        if model is linear:
            np.testing.assert_array_equal(z[reparam.others], x[reparam.others])


def test_where_the_model_is_linear_coefficients_are_integrated_out(captures) -> None:
    """Minus the log density is |c|^2/2 plus that of the level, with the coefficients integrated."""
    reparam, data = made(captures, linear)
    capture = captures[linear]
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


def test_models_without_such_coefficients_keep_their_coordinates(captures) -> None:
    request = asked(captures, "per_material", capture_of=linear)
    data = observe(request.capture)
    assert find_coefficients(compile_program(request.bind(), data), data) is None


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


# --- two shares by their sum ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "precision", ["double", pytest.param("single", marks=pytest.mark.thorough)]
)
def test_a_sum_is_smooth_far_out(captures, precision: str) -> None:
    """Where a share is a hundred-thousandth of the other, or the sum ten times what is likely."""
    with jax.enable_x64(precision == "double"):
        reparam, data = made(captures, shares, precision)
        sums, size = reparam.sums, reparam.program.size
        assert sums is not None

        def of_both(pair: jax.Array) -> jax.Array:
            x = jnp.zeros(size, pair.dtype).at[jnp.asarray(sums.positions)].set(pair)
            z, volume = sums.forward(x, data)
            return reparam.program.prior_potential(z, data) - volume

        pairs = jnp.asarray([(s, t) for s in (-4.0, 0.0, 4.0, 20.0) for t in (-4.0, 0.0, 4.0)])

        def slope(pair: jax.Array) -> tuple[jax.Array, tuple]:
            value, gradient = jax.value_and_grad(of_both)(pair)
            return gradient, (value, gradient)

        found = jax.jit(jax.vmap(jax.jacfwd(slope, has_aux=True)))(pairs)
        assert all(np.isfinite(each).all() for each in jax.tree.leaves(found))


def test_shares_that_are_held_keep_their_coordinates(captures) -> None:
    problem = make_problem(asked(captures, shares), jax.random.key(0)).hold({"leak": 0.0})
    sums = find_sum(problem.program)
    assert sums is not None
    x = jnp.asarray(np.random.default_rng(1).normal(size=problem.program.size))
    z, volume = sums.forward(x, problem.data)
    np.testing.assert_array_equal(z, x)
    assert volume == 0.0


def test_bounded_shares_keep_their_coordinates(captures) -> None:
    request = asked(captures, bounded)
    program = compile_program(request.bind(), observe(request.capture))
    assert set(program.summed) == {"leak", "body"}
    assert find_sum(program) is None


@pytest.mark.thorough
def test_chains_of_shares_agree_with_a_grid(captures) -> None:
    """Means and sds of both shares, within four Monte Carlo errors."""
    leak, body = np.meshgrid(np.linspace(1e-6, 0.12, 600), np.linspace(1e-6, 0.12, 600))
    covariance = FINE**2 * np.eye(VIEWS) + NARROW**2 * BASIS[:2].T @ BASIS[:2]
    capture = captures[shares]
    residual = capture["q"].to_numpy() - 0.9 + (leak + body)[..., None]
    log_weight = -0.5 * np.einsum("xyi,ij,xyj->xy", residual, np.linalg.inv(covariance), residual)
    log_weight += stats.halfnorm(scale=LEAK).logpdf(leak) + stats.beta(1.0, POWER).logpdf(body)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    method = pb.methods.Nuts(draws=500, most_draws=500)
    found = pb.summary(pb.fit(capture, model=shares, links=LINKS, scene=SCENE, method=method))
    assert found["ess_bulk"].min() > 1000.0
    for name, value in {"leak": leak, "body": body}.items():
        mean = np.sum(weight * value)
        sd = np.sqrt(np.sum(weight * (value - mean) ** 2))
        assert abs(found.loc[name, "mean"] - mean) < 4.0 * found.loc[name, "mcse_mean"]
        # The error of an sd from n effective draws is sd / sqrt(2 n), twice that in heavy tails.
        assert abs(found.loc[name, "sd"] / sd - 1.0) < 8.0 / np.sqrt(2.0 * found["ess_bulk"].min())
