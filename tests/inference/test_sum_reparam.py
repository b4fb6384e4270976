"""Two shares by their sum: exact whatever the readings say, and smooth wherever chains may go."""

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
from polar_bayes.inference.problem import make_problem
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import Request, resolve
from polar_bayes.inference.sum_reparam import find_sum
from polar_bayes.observation.data import Observations, observe
from polar_bayes.priors import Beta, HalfNormal

VIEWS, NOISE, WIDTH, LEAK, POWER = 9, 0.004, 0.1, 0.02, 5.0
LINKS = {"q": pb.links.NormalLink()}
SCENE = pb.Scene(surface=pb.SmoothSurface())
ZENITH = np.linspace(10.0, 70.0, VIEWS)
BASIS = np.cos(np.outer(np.arange(1, 3), np.radians(ZENITH)))  # (coefficient, view)


def shares(data, scene, priors, links):
    """A model whose readings depend on the sum of two shares and a smooth error."""
    leak = numpyro.sample("leak", HalfNormal(LEAK), infer={"summed": True})
    body = numpyro.sample("body", Beta(1.0, POWER), infer={"summed": True})
    w = numpyro.sample("w", dist.Normal(0.0, WIDTH).expand([2]).to_event(1))
    center = 0.9 - leak - body + w @ jnp.asarray(BASIS)
    numpyro.deterministic("q_mean", center)
    with numpyro.plate("view", VIEWS):
        numpyro.sample("q", dist.Normal(center, NOISE), obs=data.readings["q"])


def bounded(data, scene, priors, links):
    """The same model with upper bounds on both shares."""
    uniform = dist.Uniform(0.0, 0.5)
    names = ("leak", "body")
    leak, body = (numpyro.sample(name, uniform, infer={"summed": True}) for name in names)
    with numpyro.plate("view", VIEWS):
        numpyro.sample("q", dist.Normal(leak + body, NOISE), obs=data.readings["q"])


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    q = 0.9 - 0.025 + np.random.default_rng(3).normal(0.0, NOISE, VIEWS)
    return pb.capture.validate(at_mirror(ZENITH, q=q))


def asked(capture: xr.Dataset, model=shares, precision: str = "double") -> Request:
    return resolve(capture, model, SCENE, None, LINKS, None, 0, precision)


def made(capture: xr.Dataset, precision: str = "double") -> tuple[ConditionalReparam, Observations]:
    request = asked(capture, precision=precision)
    data = observe(request.capture)
    data = data if precision == "double" else data.in_single_precision()
    program = compile_program(request.bind(), data)
    reparam = find_coefficients(program, data)
    assert reparam is not None
    assert reparam.sums is not None
    assert reparam.sums.names == ("leak", "body")
    return reparam, program.free(data)


def test_the_density_is_that_of_the_program_with_the_volume_of_the_map(capture) -> None:
    reparam, data = made(capture)
    random, size = np.random.default_rng(0), reparam.program.size
    half = random.normal(size=(size, size))
    given = reparam.inputs(random.normal(size=size), half @ half.T + np.eye(size), data)

    @jax.jit
    def both(x: jax.Array) -> tuple[jax.Array, ...]:
        z, log_volume = reparam.forward(x, given)
        jacobian = jax.jacfwd(lambda x: reparam.forward(x, given)[0])(x)
        return (
            z,
            log_volume,
            jacobian,
            reparam.program.potential(z, data),
            reparam.potential(x, given),
        )

    for x in 2.0 * random.normal(size=(6, size)):
        z, log_volume, jacobian, there, here = both(x)
        volume = np.linalg.slogdet(jacobian)[1]
        np.testing.assert_allclose(log_volume, volume, rtol=1e-10)
        np.testing.assert_allclose(here, there - volume, rtol=1e-12)
        back = reparam.backward(np.asarray(z)[None], data)[0]
        np.testing.assert_allclose(back[reparam.others], x[reparam.others], rtol=1e-9)


@pytest.mark.parametrize(
    "precision", ["double", pytest.param("single", marks=pytest.mark.thorough)]
)
def test_it_is_smooth_far_out(capture, precision: str) -> None:
    """Where a share is a hundred-thousandth of the other, or the sum ten times what is likely."""
    with jax.enable_x64(precision == "double"):
        reparam, data = made(capture, precision)
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


def test_what_is_held_keeps_its_coordinates(capture) -> None:
    problem = make_problem(asked(capture), jax.random.key(0)).hold({"leak": 0.0})
    sums = find_sum(problem.program)
    assert sums is not None
    x = jnp.asarray(np.random.default_rng(1).normal(size=problem.program.size))
    z, volume = sums.forward(x, problem.data)
    np.testing.assert_array_equal(z, x)
    assert volume == 0.0


def test_bounded_shares_keep_their_coordinates(capture) -> None:
    request = asked(capture, bounded)
    program = compile_program(request.bind(), observe(request.capture))
    assert set(program.summed) == {"leak", "body"}
    assert find_sum(program) is None


@pytest.mark.thorough
def test_chains_agree_with_a_grid(capture) -> None:
    """Means and sds of both shares, within four Monte Carlo errors."""
    leak, body = np.meshgrid(np.linspace(1e-6, 0.12, 600), np.linspace(1e-6, 0.12, 600))
    covariance = NOISE**2 * np.eye(VIEWS) + WIDTH**2 * BASIS.T @ BASIS
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
