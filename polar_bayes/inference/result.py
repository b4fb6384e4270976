"""A finished fit as an ArviZ DataTree: labels come back here, and everything is saved.

Root attributes are one JSON string, because netCDF holds only text and numbers; it says enough
to repeat the fit.
"""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from arviz_base import from_dict

from polar_bayes.errors import FitError
from polar_bayes.inference.program import Draw, Program
from polar_bayes.observation.data import Observations
from polar_bayes.physics.part import notation
from polar_bayes.priors import RANGES

PROVENANCE = "polar_bayes"
GEOMETRY = ("view_zenith", "view_azimuth", "light_zenith", "light_azimuth")


def assemble(
    program: Program,
    capture: xr.Dataset,
    data: Observations,
    posterior: Draw,
    prior: Draw,
    sample_stats: Mapping[str, np.ndarray],
    beside: Mapping[str, xr.Dataset],
    provenance: Mapping[str, object],
) -> xr.DataTree:
    """Put draws, data and provenance into one tree."""
    groups: dict[str, dict[str, np.ndarray]] = {
        "posterior": _shaped(program, posterior.parameters),
        "sample_stats": {name: np.asarray(x) for name, x in sample_stats.items()},
        "posterior_predictive": _readings(posterior.predictive, data),
        "log_likelihood": {n: np.asarray(x) for n, x in posterior.log_likelihood.items()},
        "log_prior": {n: np.asarray(x) for n, x in posterior.log_prior.items()},
        "noise_free": _readings(posterior.center, data),
        "prior": _shaped(program, prior.parameters),
        "prior_predictive": _readings(prior.predictive, data),
    }
    if program.auxiliary:
        groups["unconstrained_posterior"] = _shaped(program, posterior.coordinates)
    lengths = dict(data.dims)
    coords = {dim: capture[dim].to_numpy() for dim in lengths if dim in capture.coords}
    coords |= {dim: np.arange(length) for dim, length in lengths.items() if dim not in coords}
    # The log prior is one number per site and draw, whatever the site's own axes are.
    log_prior = xr.Dataset(
        {name: (("chain", "draw"), x) for name, x in groups.pop("log_prior").items()}
    )
    tree = from_dict(groups, coords=coords, dims=dims_of(program))
    tree["log_prior"] = xr.DataTree(log_prior)
    tree["observed_data"] = xr.DataTree(_observed(program, capture, data, coords))
    tree["constant_data"] = xr.DataTree(_constants(capture, data, coords))
    for name, dataset in beside.items():
        labels = {dim: values for dim, values in coords.items() if dim in dataset.dims}
        tree[name] = xr.DataTree(dataset.assign_coords(labels))
    for group in ("posterior", "prior"):
        _annotate(tree.children[group])
    tree.attrs[PROVENANCE] = json.dumps(provenance, sort_keys=True)
    return tree


def provenance_of(result: xr.DataTree | xr.Dataset) -> dict[str, Any]:
    """What a result says about how it was made."""
    text = result.attrs.get(PROVENANCE, "{}")
    try:
        said = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        said = None
    if not isinstance(said, dict):
        raise FitError(
            "it is no mapping in JSON",
            where=f"result: attribute {PROVENANCE}",
            hint="give the result as it was saved, or delete the attribute",
        )
    return {key: value for key, value in said.items() if value is not None}


def bounds_of(provenance: Mapping[str, Any], name: str) -> tuple[float, float]:
    """Where the prior of a parameter ends."""
    limits = RANGES.get(name, (-math.inf, math.inf))
    said = (provenance.get("bounds") or {}).get(name)
    if said is None:
        return limits
    low, high = said
    return -math.inf if low is None else low, math.inf if high is None else high


def posterior_of(program: Program, parameters: Mapping[str, Any]) -> xr.Dataset:
    """A posterior group alone, for a fit that stands beside the main one."""
    tree = from_dict({"posterior": _shaped(program, parameters)}, dims=dims_of(program))
    return tree["posterior"].to_dataset()


def dims_of(program: Program) -> dict[str, list[str]]:
    """Axes of every site: those of its plates, then those of its own event."""
    return {
        name: [*program.dims[name], *(f"{name}_{i}" for i, _ in enumerate(program.events[name]))]
        for name in program.dims
    }


def shape_of(program: Program, name: str) -> tuple[int, ...]:
    """Lengths of the axes of a site, without those of length 1 that plates leave behind."""
    return (*(program.plates[dim] for dim in program.dims[name]), *program.events[name])


def _shaped(program: Program, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {
        name: np.asarray(value).reshape(*np.shape(value)[:2], *shape_of(program, name))
        for name, value in values.items()
    }


def _readings(values: Mapping[str, Any], data: Observations) -> dict[str, np.ndarray]:
    unit = {"intensity": float(data.intensity_unit)}
    return {name: np.asarray(value) * unit.get(name, 1.0) for name, value in values.items()}


def _observed(
    program: Program, capture: xr.Dataset, data: Observations, coords: Mapping[str, np.ndarray]
) -> xr.Dataset:
    order = [dim for dim, _ in data.dims]
    valid = xr.DataArray(np.asarray(data.valid), dims=order)
    readings = {
        name: capture[name]
        .transpose(*order)
        .drop_vars(capture.coords, errors="ignore")
        .where(valid)
        for name in program.observed
        if name in capture
    }
    return xr.Dataset(readings, coords=dict(coords))


def _constants(
    capture: xr.Dataset, data: Observations, coords: Mapping[str, np.ndarray]
) -> xr.Dataset:
    order = [dim for dim, _ in data.dims]
    bare = capture.drop_vars(capture.coords)
    constants = {name: bare[name] for name in GEOMETRY}
    constants |= {str(n): bare[n] for n in bare if str(n).startswith("true_")}
    constants |= {str(n): bare[n] for n in bare if str(n).endswith("_error")}
    constants["valid"] = xr.DataArray(np.asarray(data.valid).astype("int8"), dims=order)
    constants["saturated"] = xr.DataArray(np.asarray(data.saturated).astype("int8"), dims=order)
    return xr.Dataset(constants, coords=dict(coords))


def _annotate(group: xr.DataTree) -> None:
    for name, variable in group.data_vars.items():
        symbol, meaning, unit = notation(str(name))
        variable.attrs |= {"long_name": meaning, "units": unit}
        if symbol:
            variable.attrs["symbol"] = symbol
