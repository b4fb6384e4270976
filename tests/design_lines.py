"""A straight line with normal noise, whose posterior and designs are known in closed form."""

import numpy as np
import numpyro
import xarray as xr
from numpyro import distributions as dist

import polar_bayes as pb

NOISE, PRIOR = 0.05, 2.0
ASKED = {"scene": pb.Scene(pb.SmoothSurface())}


def line(data, scene, priors, links):
    """q = level + slope x, with x the view zenith over 45 degrees, less one."""
    level = numpyro.sample("level", dist.Normal(0.0, PRIOR))
    slope = numpyro.sample("slope", dist.Normal(0.0, PRIOR))
    mean = level + slope * (data.geometry.view_zenith / 45.0 - 1.0)
    with numpyro.plate("view", data.shape[-1]):
        numpyro.sample("q", dist.Normal(mean, NOISE).mask(data.valid), obs=data.readings["q"])


def rows_of(zeniths):
    """The design matrix, (view, 2)."""
    x = np.asarray(zeniths, float) / 45.0 - 1.0
    return np.stack([np.ones_like(x), x], axis=-1)


def precision_of(zeniths):
    rows = rows_of(zeniths)
    return rows.T @ rows / NOISE**2 + np.eye(2) / PRIOR**2


def angles(zeniths):
    zeniths = np.asarray(zeniths, float)
    return xr.Dataset(
        {
            "view_zenith": ("view", zeniths),
            "view_azimuth": ("view", np.full(zeniths.size, 180.0)),
            "light_zenith": ("view", np.full(zeniths.size, 45.0)),
            "light_azimuth": ("view", np.zeros(zeniths.size)),
        }
    )


def line_capture(zeniths, seed=0):
    rng = np.random.default_rng(seed)
    q = rows_of(zeniths) @ [0.2, 0.3] + rng.normal(0.0, NOISE, len(zeniths))
    return angles(zeniths).assign(q=("view", q)).assign_attrs(name="line", setup="camera")
