"""Parameters that are held: the density is that of the others, and nothing is compiled for it."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from cases import each
from compilations import compilations
from numpyro import distributions as dist
from plates import LINKS, PLATE
from toy_models import NOISE, capture, line, problem

import polar_bayes as pb
from polar_bayes.observation.data import Observations
from polar_bayes.progress import no_progress

ENDS = {
    "amplitude": (lambda: dist.HalfNormal(1.0), (0.0,)),
    "factor": (lambda: dist.LogNormal(0.0, 1.0), (0.0, 1.0)),
    "fraction": (lambda: dist.Beta(0.5, 2.0), (0.0, 1.0)),
    "bounded": (lambda: dist.TruncatedNormal(0.0, 1.0, low=-1.0, high=2.0), (-1.0, 2.0)),
}
"""Priors with the ends of their supports, where densities are zero or infinite."""


def ends(data, scene, priors, links) -> None:
    """Readings of a sum of parameters that are positive, or between two ends."""
    del scene, priors, links
    values = [numpyro.sample(name, prior()) for name, (prior, _) in ENDS.items()]
    weights = numpyro.sample("weights", dist.Normal(0.0, 1.0).expand([2]).to_event(1))
    with numpyro.plate("view", data.shape[-1]):
        x = np.linspace(-1.0, 1.0, data.shape[-1])
        mean = sum(values[1:], values[0] * (weights[0] * x + weights[1] * x**2))
        numpyro.sample("q", dist.Normal(mean, NOISE), obs=data.readings["q"])


def test_the_density_is_that_of_the_others() -> None:
    """Of a line whose slope is known, the level has a normal posterior in closed form."""
    here = problem(line)
    readings, x = np.asarray(here.data.readings["q"]), np.linspace(-1.0, 1.0, 6)
    for slope in (0.0, 0.7):
        held = here.hold({"slope": slope})
        draws = pb.methods.Laplace(draws=50).run(held, jax.random.key(1), no_progress)
        variance = 1.0 / (1.0 + len(readings) / NOISE**2)
        mean = variance * np.sum(readings - slope * x) / NOISE**2
        initialization = held.initialize()
        mode, covariance = initialization.modes.z[0], initialization.modes.covariance[0]
        at = {name: int(index) for name, index in here.program.positions.items()}
        # Central differences of a quadratic form are exact but for rounding over the step squared.
        np.testing.assert_allclose(mode[at["level"]], mean, rtol=1e-6)
        np.testing.assert_allclose(covariance[at["level"], at["level"]], variance, rtol=1e-6)
        np.testing.assert_allclose(covariance[at["slope"], at["slope"]], 1.0, rtol=1e-6)
        assert (held.constrain(draws.z)["slope"] == slope).all()


@each("precision", ["double", "single"], quick=1)
def test_densities_are_smooth_at_the_ends_of_supports(precision: str) -> None:
    with jax.enable_x64(precision == "double"):
        here = problem(ends, precision=precision)

        def slope(z: jax.Array, data: Observations) -> tuple[jax.Array, tuple]:
            value, gradient = jax.value_and_grad(here.program.potential)(z, data)
            return gradient, (value, gradient)

        derivatives = jax.jit(jax.jacfwd(slope, has_aux=True))
        z = jnp.full(here.program.size, 0.3, here.dtype)
        for name, (_, values) in ENDS.items():
            for value in values:
                held = here.hold({name: value})
                at = here.program.positions[name]
                hessian, (density, gradient) = derivatives(z, held.data)
                assert np.isfinite(density)
                assert np.isfinite(gradient).all()
                assert np.isfinite(hessian).all()
                # Its coordinate is a standard normal number by itself.
                np.testing.assert_allclose(gradient[at], 0.3, rtol=1e-6)
                np.testing.assert_allclose(hessian[at], np.eye(here.program.size)[at], atol=1e-6)
                assert (held.constrain(z[None, None])[name] == value).all()


def test_entries_of_a_site_with_one_density_are_held_together() -> None:
    here = problem(ends)
    held = here.hold({"weights": [0.5, -0.5]})
    z = np.random.default_rng(0).normal(size=(1, 3, here.program.size))
    assert (held.constrain(z)["weights"] == [0.5, -0.5]).all()
    with pytest.raises(pb.FitError, match="weights: its entries have one density; hold all"):
        here.hold({"weights": [0.5, np.nan]})


def test_nothing_is_compiled_for_it() -> None:
    here = problem(line)
    method = pb.methods.Importance(draws=256, rounds=1)
    method.run(here, jax.random.key(0), no_progress)
    with compilations() as found:
        for held in ({"slope": 0.2}, {"level": 0.1}, {"slope": 0.0, "level": 0.3}):
            method.run(here.hold(held), jax.random.key(0), no_progress)
    assert found == []


def test_what_cannot_be_held_is_refused() -> None:
    here = problem(line)
    with pytest.raises(pb.FitError, match="hold: gloss: it cannot be held; give some of level, "):
        here.hold({"gloss": 0.0})
    with pytest.raises(pb.FitError, match=r"hold: level: its shape is \(2,\); give one of \(\)"):
        here.hold({"level": [0.0, 1.0]})


@pytest.mark.thorough
def test_a_capture_of_a_layout_that_was_fitted_side_by_side_is_fitted_alone() -> None:
    """Both share programs, whatever is held."""
    one = capture(seed=1)
    asked = {"model": line, "links": LINKS, "scene": PLATE}
    pb.calibrate(one, simulations=20, method="importance", readings=False, **asked)
    result = pb.fit(one, method=pb.methods.Importance(draws=256), **asked)
    assert result["posterior"].sizes["draw"] > 0
    pb.design.identify(one, **asked)
