"""Models whose posteriors are known: they compile in a second, and no method may get them wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import xarray as xr
from numpyro import distributions as dist
from plates import plate_capture

import polar_bayes as pb
from polar_bayes.inference.problem import Problem, make_problem
from polar_bayes.inference.request import Request, resolve

NOISE = 0.5
VIEWS, BEND = np.linspace(35.0, 75.0, 6), 0.02


def capture(seed: int = 0) -> xr.Dataset:
    """Six readings of q."""
    return plate_capture(VIEWS, 0.05, seed)


def request_of(model, precision: str = "double") -> Request:
    """Return the request of a model for these readings."""
    links = {"q": pb.links.StokesLink()}
    return resolve(capture(), model, "paper", None, links, 90.0, 0, precision)


def problem(model, seed: int = 0, precision: str = "double") -> Problem:
    """A model of these readings, compiled."""
    key = jax.random.split(jax.random.key(seed))[0]
    return make_problem(request_of(model, precision), key)


def line(data, scene, priors, links) -> None:
    """Readings on a line over the views: the posterior is normal."""
    del scene, priors, links
    level = numpyro.sample("level", dist.Normal(0.0, 1.0))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    with numpyro.plate("view", data.shape[-1]):
        x = np.linspace(-1.0, 1.0, data.shape[-1])
        numpyro.sample("q", dist.Normal(level + slope * x, NOISE), obs=data.readings["q"])


def of_line(readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of level and slope."""
    design = np.stack([np.ones(len(readings)), np.linspace(-1.0, 1.0, len(readings))], axis=1)
    covariance = np.linalg.inv(np.eye(2) + design.T @ design / NOISE**2)
    return covariance @ design.T @ readings / NOISE**2, covariance


def least_squares(readings: np.ndarray) -> list[float]:
    """Level and slope of the line of least squares."""
    slope, level = np.polyfit(np.linspace(-1.0, 1.0, len(readings)), readings, 1)
    return [level, slope]


def squared(data, scene, priors, links) -> None:
    """Readings of a square: the root may have either sign, and half of the posterior has each."""
    del scene, priors, links
    root = numpyro.sample("root", dist.Normal(0.0, 1.0))
    other = numpyro.sample("other", dist.Normal(0.0, 1.0))
    with numpyro.plate("view", data.shape[-1]):
        mean = root**2 + 0.0 * other
        numpyro.sample("q", dist.Normal(mean, 0.05), obs=data.readings["q"])


def waves(data, scene, priors, links) -> None:
    """Readings of a wave: each of many frequencies is better than those beside it."""
    del scene, priors, links
    frequency = numpyro.sample("frequency", dist.Uniform(0.0, 500.0))
    with numpyro.plate("view", data.shape[-1]):
        x = np.linspace(0.0, 1.0, data.shape[-1]) ** 2
        numpyro.sample("q", dist.Normal(jnp.sin(frequency * x), NOISE), obs=data.readings["q"])


def funnel(data, scene, priors, links) -> None:
    """Readings that say nothing of a funnel: its peak is far from where most of it lies."""
    del scene, priors, links
    width = numpyro.sample("width", dist.Normal(0.0, 3.0))
    numpyro.sample("inside", dist.Normal(0.0, jnp.exp(0.5 * width)))
    with numpyro.plate("view", data.shape[-1]):
        numpyro.sample("q", dist.Normal(0.0, NOISE), obs=data.readings["q"])


def deep_funnel(data, scene, priors, links) -> None:
    """One width for eight: next to nothing of it lies near its peak (Neal 2003, Ann. Stat.)."""
    del scene, priors, links
    width = numpyro.sample("width", dist.Normal(0.0, 3.0))
    for number in range(8):
        numpyro.sample(f"inside_{number}", dist.Normal(0.0, jnp.exp(0.5 * width)))
    with numpyro.plate("view", data.shape[-1]):
        numpyro.sample("q", dist.Normal(0.0, NOISE), obs=data.readings["q"])


def bent(data, scene, priors, links) -> None:
    """Readings that say nothing of a narrow ridge along a parabola, and of a place on it."""
    del scene, priors, links
    along = numpyro.sample("along", dist.Normal(0.0, 1.0))
    numpyro.sample("across", dist.Normal(along**2, BEND))
    numpyro.sample("place", dist.Normal(along, BEND))
    with numpyro.plate("view", data.shape[-1]):
        numpyro.sample("q", dist.Normal(0.0, NOISE), obs=data.readings["q"])
