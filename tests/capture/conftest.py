"""Captures to test with."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

SIZES = {"material": 3, "patch": 2, "y": 2, "x": 3, "view": 5, "wavelength": 2}

MakeCapture = Callable[..., xr.Dataset]


@pytest.fixture
def make_capture() -> MakeCapture:
    """A function of leading dims and spectral that builds a valid capture with every variable."""

    def make(*leading: str, spectral: bool = False, seed: int = 0) -> xr.Dataset:
        random = np.random.default_rng(seed)
        dims = (*leading, "view", *(("wavelength",) if spectral else ()))
        shape = [SIZES[dim] for dim in dims]
        zenith = np.linspace(10.0, 80.0, SIZES["view"])
        dop = random.uniform(0.1, 0.9, shape)
        error = np.full(shape, 0.01)
        valid = np.ones(shape, dtype=bool)
        valid[..., 1] = False
        brightness = {"units": "uA", "saturation_level": 40.0}
        capture = xr.Dataset(
            {
                "view_zenith": ("view", zenith, {"units": "degree"}),
                "view_azimuth": ("view", np.full_like(zenith, 180.0)),
                "light_zenith": ("view", zenith.copy()),
                "light_azimuth": ("view", np.zeros_like(zenith)),
                "normal_confidence": (leading, np.full([SIZES[dim] for dim in leading], 0.5)),
                "dop": (dims, dop),
                "q": (dims, 0.8 * dop),
                "u": (dims, -0.6 * dop),
                "intensity": (dims, random.uniform(0.0, 50.0, shape), brightness),
                "dop_error": (dims, error.copy()),
                "q_error": (dims, error.copy()),
                "u_error": (dims, error.copy()),
                "intensity_error": (dims, error.copy(), {"units": "uA"}),
                "saturated": (dims, random.uniform(size=shape) > 0.8),
                "valid": (dims, valid),
                "interpolated": (dims, ~valid),
                "true_roughness": (leading, np.full([SIZES[dim] for dim in leading], 0.2)),
            },
            attrs={"name": "leaf", "operator": "Ada", "shots": 3, "lamp_current": 1.5},
        )
        return capture.assign_coords(wavelength=[633.0, 450.0]) if spectral else capture

    return make
