"""Slopes and curvatures by forward differentiation are those of JAX, and of Gauss and Newton."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from cases import each
from numpyro import distributions as dist
from numpyro import handlers
from plate_images import ASKED, backwards, plate_image
from plates import PLATE

import polar_bayes as pb
from polar_bayes.inference.program import Program, compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.inference.scoring import exact_derivatives, scoring_derivatives
from polar_bayes.models.per_material import per_material
from polar_bayes.observation.data import Observations, observe

PRIORS = {
    "subsurface_fraction": dist.Beta(2.0, 2.0),
    "refractive_index": dist.TruncatedNormal(1.45, 0.15, low=1.2, high=2.0),
}


class Case(NamedTuple):
    program: Program
    data: Observations
    points: np.ndarray


def gray(**asked) -> tuple[xr.Dataset, dict]:
    return plate_image(1, 1, seed=2).isel(y=0, x=0, drop=True), {**ASKED, **asked}


def brightness(**held: float) -> tuple[xr.Dataset, dict]:
    capture, asked = gray()
    rng = np.random.default_rng(3)
    bright = rng.uniform(0.1, 0.8, capture.sizes["view"])
    bright[2] = 1.0  # at the stop of the sensor
    capture = capture.drop_vars(["q", "q_error"]).assign(
        dop=("view", np.abs(capture["q"].values)), intensity=("view", bright)
    )
    capture["intensity"].attrs["saturation_level"] = 1.0
    asked["model"] = handlers.condition(per_material, data=held)
    return capture, asked | {
        "links": {"dop": pb.links.BetaLink(), "intensity": pb.links.StudentTLink()}
    }


def colors() -> tuple[xr.Dataset, dict]:
    capture, asked = gray()
    other = capture["q"] + np.random.default_rng(4).normal(0.0, 0.03, capture["q"].shape)
    q = xr.concat([capture["q"], other], "wavelength").transpose("view", "wavelength")
    error = capture["q_error"].expand_dims(wavelength=2).transpose("view", "wavelength")
    capture = capture.assign(q=q, q_error=error.copy()).assign_coords(wavelength=[450.0, 650.0])
    capture["q"][4, 1] = np.nan
    return capture.assign(valid=capture["q"].notnull()), asked


CASES: dict[str, tuple[Callable, int]] = {
    "known noise": (gray, 2),
    "noise of unknown scale": (lambda: gray(model="per_material", links=pb.links.NormalLink()), 3),
    "two links": (lambda: brightness(concentration_scale=200.0, exposure=1.0), 3),
    "two links of unknown noise": (brightness, 5),
    "two colors": (colors, 3),
}


EVERY = [
    name if name == "known noise" else pytest.param(name, marks=pytest.mark.thorough)
    for name in CASES
]


@functools.cache
def case(name: str) -> Case:
    build, size = CASES[name]
    capture, asked = build()
    asked = capture, asked["model"], PLATE, PRIORS, asked["links"], None, 0, "double"
    request = resolve(*asked, shared=())
    data = observe(request.capture)
    program = compile_program(request.bind(), data)
    assert program.size == size
    points = np.random.default_rng(5).normal(0.0, 0.7, (4, size))
    return Case(program, data, points)


def everywhere(function: Callable, of: Case) -> Any:
    found = jax.jit(jax.vmap(function, in_axes=(0, None)))(of.points, of.data)
    return jax.tree.map(np.asarray, found)


@functools.cache
def reverse(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, gradient and Hessian as JAX finds them."""
    here = case(name)
    return everywhere(backwards(here.program.potential), here)


def assert_close(ours: np.ndarray, theirs: np.ndarray) -> None:
    """To 1e-10 of the largest entry at each point."""
    axes = tuple(range(1, theirs.ndim))
    largest = np.abs(theirs).max(axis=axes, keepdims=True)
    assert np.abs((ours - theirs) / largest).max() < 1e-10


@pytest.mark.parametrize("name", EVERY)
def test_expanding_is_what_jax_does_backwards(name: str) -> None:
    here = case(name)
    value, gradient, hessian = reverse(name)
    ours = everywhere(functools.partial(exact_derivatives, here.program), here)
    assert_close(ours.value, value)
    assert_close(ours.gradient, gradient)
    assert_close(ours.curvature, hessian)


@pytest.mark.thorough
@pytest.mark.parametrize("name", EVERY)
def test_scoring_has_the_same_value_and_gradient(name: str) -> None:
    here = case(name)
    value, gradient, _ = reverse(name)
    ours = everywhere(functools.partial(scoring_derivatives, here.program), here)
    # Sites that the model itself fixes may add a constant.
    assert np.ptp(ours.value - value) < 1e-10 * np.abs(value).max()
    assert_close(ours.gradient, gradient)
    assert_close(ours.curvature, ours.curvature.swapaxes(-1, -2))


def prior(z: dict[str, jax.Array]) -> jax.Array:
    """`PRIORS`, and that of the noise, on unconstrained lines, up to a constant."""
    fraction = jax.nn.sigmoid(z["subsurface_fraction"])
    share = jax.nn.sigmoid(z["refractive_index"])
    index = 1.2 + 0.8 * share
    out = -2.0 * jnp.sum(jnp.log(fraction) + jnp.log1p(-fraction))
    out += jnp.sum(0.5 * ((index - 1.45) / 0.15) ** 2 - jnp.log(share) - jnp.log1p(-share))
    if "normal_scale" in z:  # log-normal: its coordinate is normal
        out += 0.5 * (z["normal_scale"] - np.log(0.03)) ** 2
    return out


def readings(program: Program, z: jax.Array, data: Observations) -> jax.Array:
    """Without noise, in a row."""
    names = ("subsurface_fraction", "refractive_index")
    parameters = {name: program.constrain(z)[name] for name in names}
    if data.dims[0][0] == "wavelength":
        parameters = {name: jnp.broadcast_to(jnp.ravel(x), (2,)) for name, x in parameters.items()}
    return jnp.ravel(PLATE.predict(parameters, data.geometry)["q"])


@pytest.mark.thorough
@each("name", ["known noise", "two colors"])
def test_scoring_of_normal_noise_is_that_of_gauss_and_newton(name: str) -> None:
    here = case(name)

    def expected(z: jax.Array, data: Observations) -> jax.Array:
        slopes = jax.jacfwd(lambda z: readings(here.program, z, data))(z)
        sharp = jnp.where(data.valid, data.errors["q"] ** -2.0, 0.0).ravel()
        bend = jax.hessian(lambda z: prior(here.program.unravel(z)))(z)
        return slopes.T @ (sharp[:, None] * slopes) + bend

    ours = everywhere(functools.partial(scoring_derivatives, here.program), here)
    assert_close(ours.curvature, everywhere(expected, here))


@pytest.mark.thorough
def test_scoring_of_noise_of_unknown_scale_bends_in_both_arguments() -> None:
    here = case("noise of unknown scale")

    def arguments(z: jax.Array, data: Observations) -> tuple[jax.Array, jax.Array]:
        mean = readings(here.program, z, data)
        return mean, jnp.full_like(mean, here.program.constrain(z)["normal_scale"])

    def expected(z: jax.Array, data: Observations) -> jax.Array:
        mean, scale = arguments(z, data)
        to_mean, to_scale = jax.jacfwd(lambda z: arguments(z, data))(z)
        rest = data.readings["q"] - mean
        # Second derivatives of log scale + rest**2 / (2 scale**2).
        pure = to_mean.T @ (scale[:, None] ** -2 * to_mean)
        mixed = to_mean.T @ ((2.0 * rest / scale**3)[:, None] * to_scale)
        own = to_scale.T @ ((3.0 * rest**2 / scale**4 - scale**-2)[:, None] * to_scale)
        bend = jax.hessian(lambda z: prior(here.program.unravel(z)))(z)
        return pure + mixed + mixed.T + own + bend

    ours = everywhere(functools.partial(scoring_derivatives, here.program), here)
    assert_close(ours.curvature, everywhere(expected, here))


@pytest.mark.thorough
def test_single_precision_stays_single() -> None:
    with jax.enable_x64(False):
        here = case.__wrapped__("known noise")
        found = jax.jit(functools.partial(scoring_derivatives, here.program))(
            np.float32(here.points[0]), here.data
        )
    assert {leaf.dtype for leaf in found} == {np.dtype(np.float32)}
    assert all(np.isfinite(leaf).all() for leaf in found)
