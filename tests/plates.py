"""Small captures of a smooth plate, whose posteriors a grid can hold."""

import numpy as np
import xarray as xr

import polar_bayes as pb

PLATE = pb.Scene(surface=pb.SmoothSurface(), subsurface=pb.Unpolarized(), mixing=pb.StokesMixing())
LINKS = {"q": pb.StokesLink(stated_errors=True)}


def plate_capture(zeniths: np.ndarray, error: float, seed: int) -> xr.Dataset:
    """A plate of index 1.5 and fraction 0.02, with normal errors of q."""
    zeniths = np.asarray(zeniths, float)
    geometry = {
        "view_zenith": zeniths,
        "view_azimuth": np.full(zeniths.size, 180.0),
        "light_zenith": zeniths,
        "light_azimuth": np.zeros(zeniths.size),
    }
    truth = {"subsurface_fraction": 0.02, "refractive_index": 1.5}
    q = np.asarray(PLATE.predict(truth, pb.Geometry.from_degrees(**geometry))["q"])
    noise = np.random.default_rng(seed).normal(0.0, error, zeniths.size)
    return xr.Dataset(
        {name: ("view", angle) for name, angle in geometry.items()}
        | {
            "q": ("view", np.clip(q + noise, -1.0, 1.0)),
            "q_error": ("view", np.full(zeniths.size, error)),
        },
        attrs={"name": "plate"},
    )
