"""Images of smooth plates whose truth is drawn from the priors: textbook optics, NumPy only."""

import jax
import numpy as np
import xarray as xr
from plates import KNOWN, LINKS, PLATE, at_mirror
from scipy import stats
from textbook import plate_q

import polar_bayes as pb
from polar_bayes.inference.batching import cut
from polar_bayes.inference.problem_batch import ProblemBatch
from polar_bayes.maps.fit_map import (
    MapPlan,
    blank,
    estimate_plan,
    fit_block,
    mask_missing,
    plan_map,
    with_pixel_numbers,
)

NOISE = 0.02
# Away from Brewster's angle q stays so far from -1 that ordinary noise is never clipped.
VIEWS = np.array([30.0, 36.0, 42.0, 68.0, 74.0, 80.0])
NAMES = ("refractive_index", "subsurface_fraction")

# A plate read by q with normal noise as large as each pixel says: two parameters. A set-up of its
# own has the priors from which the truth is drawn.
ASKED = {**KNOWN, "scene": pb.setups.Setup(PLATE, LINKS)}


def plate_image(rows, columns, *, noise=NOISE, views=VIEWS, seed=0):
    """Every pixel is a plate of its own; `noise` is one number or (rows, columns)."""
    rng = np.random.default_rng(seed)
    low, high = (1.2 - 1.45) / 0.15, (2.0 - 1.45) / 0.15
    shape = (rows, columns)
    index = stats.truncnorm(low, high, 1.45, 0.15).rvs(shape, random_state=rng)
    fraction = stats.beta(2.0, 2.0).rvs(shape, random_state=rng)
    q = plate_q(index[..., None], fraction[..., None], np.radians(views))
    error = np.broadcast_to(np.broadcast_to(noise, shape)[..., None], q.shape)
    found = at_mirror(
        views,
        q=(("y", "x", "view"), np.clip(q + error * rng.normal(size=q.shape), -1.0, 1.0)),
        q_error=(("y", "x", "view"), error.copy()),
        true_refractive_index=(("y", "x"), index),
        true_subsurface_fraction=(("y", "x"), fraction),
    )
    return found.assign_attrs(name="plates")


def on_a_grid(q, error, views):
    """Mean, sd and skewness of each parameter, by adding up 800 x 800 cells."""
    cells = (np.arange(800) + 0.5) / 800
    index, fraction = np.meshgrid(1.2 + 0.8 * cells, cells, indexing="ij")
    log = stats.norm(1.45, 0.15).logpdf(index) + stats.beta(2.0, 2.0).logpdf(fraction)
    for reading, zenith in zip(q, np.radians(views), strict=True):
        log += stats.norm(reading, error).logpdf(plate_q(index, fraction, zenith))
    weights = np.exp(log - log.max())
    weights /= weights.sum()
    found = {}
    for name, x in zip(NAMES, (index, fraction), strict=True):
        mean = np.sum(weights * x)
        sd = np.sqrt(np.sum(weights * (x - mean) ** 2))
        found[name] = (mean, sd, np.sum(weights * ((x - mean) / sd) ** 3))
    return found


def planned(capture, method=None, *, seed=0, precision="double", **asked):
    """The plan of a map; with one plan, the same programs serve many tests."""
    given = {**ASKED, **asked}
    scene, links = given["scene"], given["links"]
    asked_for = plan_map(capture, given["model"], method, scene, None, links, None, seed, precision)
    return estimate_plan(asked_for, capture)


def stacked(capture: xr.Dataset, plan: MapPlan) -> ProblemBatch:
    """The pixels of an image in a row."""
    return plan.batch(mask_missing(capture))


def backwards(potential):
    """Value, gradient and Hessian of a potential as JAX finds them."""
    return lambda z, data: (
        potential(z, data),
        jax.grad(potential)(z, data),
        jax.hessian(potential)(z, data),
    )


def mapped(capture: xr.Dataset, plan: MapPlan, block: int = 4096) -> xr.Dataset:
    """Maps made block by block."""
    numbered = with_pixel_numbers(capture)
    maps = blank(numbered, plan).compute().copy(deep=True)
    for place in cut(numbered, block):
        for name, values in fit_block(numbered.isel(place), plan).items():
            maps[name][place] = values
    return maps
