"""Captures of many patches of known truth, drawn in one go from the paper's scene."""

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import polar_bayes as pb
from polar_bayes.observation.data import observe

NOISE = {"concentration_scale": 300.0, "exposure": 3.0, "intensity_scale": 0.02}


def patch_capture(
    refractive_index,
    *,
    views=40,
    largest_view_zenith=85.0,
    wavelengths=(),
    noise=None,
    setup="paper",
    roughness=(0.08, 0.3),
    subsurface_fraction=(0.2, 0.6),
    seed=0,
):
    """Patches of given index (patch,) or (patch, wavelength); the rest uniform or log-normal.

    Noise is one for all patches, `noise` replaces entries of `NOISE`.
    """
    index = np.asarray(refractive_index, float)
    count = len(index)
    rng = np.random.default_rng(seed)
    truth = {
        "roughness": rng.uniform(*roughness, count),
        "subsurface_fraction": rng.uniform(*subsurface_fraction, count),
        "absorption": rng.lognormal(-1.0, 0.4, index.shape),
        "refractive_index": index,
    }
    protocol = pb.simulation.Protocol(
        views=views, largest_view_zenith=largest_view_zenith, wavelengths=tuple(wavelengths)
    )
    dims = ("patch", *(("wavelength",) if len(wavelengths) else ()), "view")
    shape = (*index.shape, views)
    blank = xr.Dataset(
        {name: ("view", angle) for name, angle in protocol.angles().items()},
        coords={"wavelength": np.asarray(wavelengths, float)} if len(wavelengths) else {},
        attrs={"name": "patches", "setup": setup},
    )
    links = pb.setups.SETUPS[setup].links
    levels = {name: jnp.asarray(x) for name, x in {**NOISE, **(noise or {})}.items()}
    scene = pb.setups.SETUPS[setup].scene
    with jax.enable_x64(True):
        parameters = {
            name: jnp.asarray(value.reshape(value.shape + (1,) * (len(dims) - 1 - value.ndim)))
            for name, value in truth.items()
            if name in scene.parameters
        }
        empty = blank.assign({name: (dims, np.full(shape, 0.5)) for name in links})
        data = observe(pb.capture.validate(empty))
        prediction = scene.predict(parameters, data.geometry)
        keys = dict(zip(links, jax.random.split(jax.random.key(seed), len(links)), strict=True))
        order = sorted(links, key=lambda name: name != "intensity")  # noise depends on brightness
        for name in order:
            drawn = links[name].distribution(name, prediction, data, levels).sample(keys[name])
            low = 0.0 if name in ("dop", "intensity") else -1.0
            blank[name] = (dims, np.clip(np.broadcast_to(drawn, shape), low, 1.0))
            if name == "intensity":
                blank[name].attrs["saturation_level"] = 1.0
                data = observe(pb.capture.validate(empty.assign({name: blank[name]})))
    for name, value in truth.items():
        blank[f"true_{name}"] = (dims[: value.ndim], value)
    return pb.capture.validate(blank)
