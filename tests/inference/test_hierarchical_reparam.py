"""The coordinates in which patches look alike: exact whatever the anchors, ideal where normal."""

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
from polar_bayes.inference.hierarchical_reparam import (
    HierarchicalReparam,
    ReparamInputs,
    find_groups,
    group_of,
)
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.observation.data import observe

MEMBERS, VIEWS, NOISE = 5, 3, 0.4
LINKS = {"q": pb.links.NormalLink()}
SCENE = pb.Scene(surface=pb.SmoothSurface())


def normal_normal(data, scene, priors, links):
    """Readings around x_m, which are normal around mu: closed form, given mu and tau."""
    mu = numpyro.sample("mu", dist.Normal(0.0, 0.5))
    tau = numpyro.sample("tau", dist.HalfNormal(0.3))
    with numpyro.plate("patch", data.dims[0][1], dim=-2):
        x = numpyro.sample("x", dist.Normal(mu, tau))
        with numpyro.plate("view", data.dims[1][1], dim=-1):
            likelihood = dist.Normal(x, NOISE).mask(data.valid)
            numpyro.sample("q", likelihood, obs=data.readings["q"])


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    rng = np.random.default_rng(4)
    q = np.clip(rng.normal(0.0, 0.3, (MEMBERS, 1)) + rng.normal(0, NOISE, (MEMBERS, VIEWS)), -1, 1)
    return pb.capture.validate(at_mirror([20.0, 40.0, 60.0], q=(("patch", "view"), q)))


@pytest.fixture(scope="module")
def made(capture: xr.Dataset):
    request = resolve(capture, normal_normal, SCENE, None, LINKS, None, 0, "double")
    data = observe(request.capture)
    program = compile_program(request.bind(), data)
    groups = find_groups(program, data)
    return HierarchicalReparam(program, groups), data


def at_point(data, rng: np.random.Generator, exact: np.ndarray | None = None) -> ReparamInputs:
    """Random anchors; or those of the readings, which are normal around their means."""
    if exact is None:
        half = rng.normal(size=(MEMBERS, 1, 1))
        parts = (
            rng.normal(size=2),
            np.linalg.cholesky(np.eye(2) + 0.3),
            rng.normal(size=(MEMBERS, 1)),
            rng.normal(size=(MEMBERS, 1)),
            half @ half.transpose(0, 2, 1),
            rng.normal(size=(MEMBERS, 1, 2)),
        )
    else:
        curvature = np.full((MEMBERS, 1, 1), VIEWS / NOISE**2)
        nothing = np.zeros((MEMBERS, 1))
        parts = (
            np.zeros(2), np.eye(2), exact.mean(axis=1, keepdims=True), nothing, curvature,
            np.zeros((MEMBERS, 1, 2)),
        )  # fmt: skip
    return ReparamInputs(data, *map(jnp.asarray, parts))


@pytest.mark.thorough
def test_patches_find_their_coordinates(made) -> None:
    transport, data = made
    assert transport.groups.axis == "patch"
    assert transport.groups.local.shape == (MEMBERS, 1)
    assert sorted([*transport.groups.common, *transport.groups.local.ravel()]) == list(range(7))
    alone = group_of(data, 3)
    assert alone.shape == (1, VIEWS)
    np.testing.assert_array_equal(alone.readings["q"][0], data.readings["q"][3])


@pytest.mark.thorough
@each("seed", range(5))
def test_there_and_back_with_the_volume_of_the_map(made, seed: int) -> None:
    transport, data = made
    rng = np.random.default_rng(seed)
    given = at_point(data, rng)
    w = jnp.asarray(rng.normal(size=transport.size))

    @jax.jit
    def there(w: jax.Array) -> tuple[jax.Array, ...]:
        z, log_volume = transport.forward(w, given)
        return z, log_volume, jax.jacfwd(lambda w: transport.forward(w, given)[0])(w)

    z, log_volume, jacobian = there(w)
    np.testing.assert_allclose(transport.inverse(z, given), w, atol=1e-10)
    constant = np.linalg.slogdet(given.factor)[1]
    np.testing.assert_allclose(
        log_volume + constant, np.linalg.slogdet(jacobian)[1], rtol=1e-9, atol=1e-9
    )


def test_where_readings_are_normal_members_are_independent_of_their_population(made, capture):
    """Minus the log density is |w|^2/2 plus that of the population, members integrated out."""
    transport, data = made
    q = capture["q"].to_numpy()
    given = at_point(data, np.random.default_rng(0), q)
    rng = np.random.default_rng(1)
    found, expected = [], []
    potential = jax.jit(lambda w: transport.potential(w, given))
    for log_tau in (-20.0, -5.0, -1.0, 0.0, 3.0):  # from complete pooling to none
        for _ in range(3):
            mu = rng.normal(0.0, 0.5)
            w = np.concatenate([[mu, log_tau], rng.normal(size=MEMBERS)])
            found.append(float(potential(jnp.asarray(w))))
            tau = np.exp(log_tau)
            means = stats.norm(mu, np.hypot(tau, NOISE / np.sqrt(VIEWS))).logpdf(q.mean(axis=1))
            prior = stats.norm(0.0, 0.5).logpdf(mu) + stats.halfnorm(0, 0.3).logpdf(tau) + log_tau
            expected.append(0.5 * np.sum(w[2:] ** 2) - means.sum() - prior)
    difference = np.array(found) - np.array(expected)
    np.testing.assert_allclose(difference, difference[0], atol=1e-7)


@pytest.mark.thorough
def test_a_prior_that_differs_between_patches_keeps_them_together(made, capture) -> None:
    def uneven(data, scene, priors, links):
        width = jnp.linspace(0.1, 0.5, MEMBERS)[:, None]
        with numpyro.plate("patch", MEMBERS, dim=-2):
            x = numpyro.sample("x", dist.Normal(0.0, width))
            with numpyro.plate("view", VIEWS, dim=-1):
                numpyro.sample("q", dist.Normal(x, NOISE), obs=data.readings["q"])

    result = pb.fit(capture, model=uneven, scene=SCENE, links=LINKS, method="laplace")
    width = np.linspace(0.1, 0.5, MEMBERS)
    precision = width**-2 + VIEWS / NOISE**2
    exact = capture["q"].mean("view").to_numpy() * (VIEWS / NOISE**2) / precision
    found = result["posterior"]["x"].mean(("chain", "draw")).to_numpy()
    # Four standard errors of 2000 independent draws.
    assert (np.abs(found - exact) < 4.0 * precision**-0.5 / np.sqrt(2000.0)).all()
