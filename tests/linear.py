"""A model that is linear in its parameters, so that shifts and widths are known exactly.

Parameters have standard normal priors and no bounds; the reading q is a weighted sum of columns,
with normal noise. A scene decides which columns take part.
"""

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import distributions as dist

import polar_bayes as pb

NOISE = 0.2
LINKS = {"q": pb.links.NormalLink()}
SCENE = pb.Scene(
    surface=pb.SmoothSurface(),
    subsurface=pb.Unpolarized(),
    mixing=pb.StokesMixing(),
    instrument=pb.instrument.Instrument(
        (pb.instrument.AngleZero(), pb.instrument.DarkLevel(), pb.instrument.DolpGain())
    ),
)


# These parameters have no bounds here, so they do not go by the names of ones that do.
STANDS_FOR = {"body": "subsurface_fraction", "slope": "refractive_index", "gain": "dolp_gain"}


def columns(x):
    """Return the derivative of the readings by each parameter; x runs from 0 to 1."""
    return {
        "body": np.ones_like(x),
        "slope": x,
        "angle_zero": 0.03 * x**2,
        "dark_level": 0.025 * x**3,
        "gain": np.sin(20.0 * x),
    }


def model(data, scene, priors, links):
    x = np.linspace(0.0, 1.0, data.dims[-1][1])
    mean = sum(
        numpyro.sample(name, dist.Normal(0.0, 1.0)) * jnp.asarray(column)
        for name, column in columns(x).items()
        if STANDS_FOR.get(name, name) in scene.parameters
    )
    with numpyro.plate("view", x.size):
        noisy = dist.Normal(mean, NOISE).mask(data.valid)
        numpyro.sample("q", noisy, obs=data.readings["q"])


def posterior(q, names):
    """Mean and covariance of the named parameters, in closed form."""
    design = np.stack([columns(np.linspace(0.0, 1.0, q.size))[name] for name in names], axis=1)
    covariance = np.linalg.inv(np.eye(len(names)) + design.T @ design / NOISE**2)
    return covariance @ design.T @ q / NOISE**2, covariance
