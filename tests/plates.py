"""Small captures of a smooth plate, whose posteriors a grid can hold."""

import numpy as np
import xarray as xr
from numpyro import handlers
from textbook import plate_q

import polar_bayes as pb
from polar_bayes.models.per_material import per_material

PLATE = pb.Scene(surface=pb.SmoothSurface(), subsurface=pb.Unpolarized(), mixing=pb.StokesMixing())
LINKS = {"q": pb.links.StokesLink(stated_errors=True)}
ON_PLATE = {"scene": PLATE, "links": LINKS}
KNOWN = ON_PLATE | {"model": handlers.condition(per_material, data={"stokes_error_factor": 1.0})}
"""What is asked of a plate, with a factor on its stated errors or with errors that are known."""

GONIOMETER = {"scene": "goniometer", "links": pb.setups.SETUPS["goniometer"].links}
GONIOMETER_VIEWS = np.arange(12.0, 79.0, 3.0)
"""Views and set-up of a plate on a goniometer, with all unknowns of the instrument."""


VIEWS = np.linspace(35.0, 75.0, 6)


def at_mirror(zeniths, **variables) -> xr.Dataset:
    """Views in the mirror direction of a light that moves along, and what was read there."""
    zeniths = np.asarray(zeniths, float)
    angles = {"view_zenith": zeniths, "view_azimuth": np.full(zeniths.size, 180.0)}
    angles |= {"light_zenith": zeniths, "light_azimuth": np.zeros(zeniths.size)}
    columns = {
        name: values if isinstance(values, tuple) else ("view", np.asarray(values))
        for name, values in (angles | variables).items()
    }
    return xr.Dataset(columns)


def plates(index, error, views=VIEWS, fraction=0.02, seed=0) -> xr.Dataset:
    """Smooth plates of their own index, with normal errors of q."""
    rng = np.random.default_rng(seed)
    index = np.asarray(index, float)
    q = plate_q(index[:, None], fraction, np.radians(views))
    q = np.clip(q + error * rng.normal(size=q.shape), -1.0, 1.0)
    found = at_mirror(
        views, q=(("patch", "view"), q), q_error=(("patch", "view"), np.full(q.shape, error))
    )
    return found.assign(true_refractive_index=("patch", index)).assign_attrs(name="plates")


def plate_capture(zeniths: np.ndarray, error: float, seed: int) -> xr.Dataset:
    """A plate of index 1.5 and fraction 0.02, with normal errors of q."""
    plate = plates([1.5], error, np.asarray(zeniths, float), seed=seed).isel(patch=0)
    return plate.drop_vars("true_refractive_index").assign_attrs(name="plate")
