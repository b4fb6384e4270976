"""Maps made by hand: every quantile, status and method as a test wants it."""

import json

import numpy as np
import xarray as xr

from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.numerics.psis import LEVELS

LEVELS_HERE = np.array(LEVELS)


def flags(names: type[Status] | type[MethodUsed], values: np.ndarray) -> tuple:
    words = " ".join(each.name.lower() for each in names)
    said = {"flag_values": [int(each) for each in names], "flag_meanings": words}
    return ("y", "x"), values.astype(np.int8), said


def make_maps(
    means,
    *,
    width=1.0,
    status=None,
    methods=None,
    wavelengths=(),
    method="corrected-laplace",
    **provenance,
):
    """Uniform posteriors of that width about the means, (y, x) or (y, x, wavelength)."""
    shape = next(iter(means.values())).shape[:2]
    status = np.full(shape, Status.GOOD) if status is None else status
    told = np.where(np.isin(status, (Status.GOOD, Status.NOT_TRUSTED)), MethodUsed.IMPORTANCE, 0)
    found: dict = {}
    for name, mean in means.items():
        axes = ("y", "x", "wavelength")[: mean.ndim]
        nothing = ~np.isin(status, (Status.GOOD, Status.NOT_TRUSTED))
        mean = np.where(nothing.reshape(*shape, *[1] * (mean.ndim - 2)), np.nan, mean)
        steps = (LEVELS_HERE - 0.5).reshape(-1, *[1] * mean.ndim)
        found[name] = (axes, np.float32(mean))
        found[f"{name}_sd"] = (axes, np.float32(0 * mean + width / np.sqrt(12.0)))
        found[f"{name}_quantile"] = (("quantile", *axes), np.float32(mean + width * steps))
    found["pareto_k"] = (("y", "x"), np.where(status == Status.NOT_TRUSTED, 0.9, 0.2))
    found["status"] = flags(Status, status)
    found["method"] = flags(MethodUsed, told if methods is None else methods)
    about = {"method": method, "seed": 3, **provenance}
    coords: dict = {"quantile": LEVELS_HERE}
    coords |= {"wavelength": list(wavelengths)} if wavelengths else {}
    return xr.Dataset(found, coords=coords, attrs={"polar_bayes": json.dumps(about)})
