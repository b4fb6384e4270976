"""A finished fit as an ArviZ DataTree: draws, readings, their labels, and the provenance.

The provenance is one root attribute in JSON, because netCDF holds only text and numbers. It is
complete enough to repeat the fit.
"""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from arviz_base import from_dict

from polar_bayes.errors import FitError
from polar_bayes.inference.program import Draw, Program, Values
from polar_bayes.observation.data import ANGLES, Observations
from polar_bayes.physics.part import notation
from polar_bayes.priors import RANGES

PROVENANCE = "polar_bayes"

CENTRAL_95 = (0.025, 0.975)
"""Quantile levels of the equal-tailed 95% interval."""

type Provenance = dict[str, Any]
"""What a result says of how it was made, as JSON holds it."""


def assemble(
    program: Program,
    capture: xr.Dataset,
    data: Observations,
    posterior: Draw,
    prior: Draw,
    sample_stats: Mapping[str, np.ndarray],
    comparisons: Mapping[str, xr.Dataset],
    provenance: Mapping[str, object],
) -> xr.DataTree:
    """Combine draws, data and provenance into one tree."""
    groups: dict[str, dict[str, np.ndarray]] = {
        "posterior": _shaped(program, posterior.parameters),
        "sample_stats": {name: np.asarray(x) for name, x in sample_stats.items()},
        "posterior_predictive": _in_own_unit(posterior.predictive, data),
        "log_likelihood": _measured(posterior.log_likelihood, data),
        "noise_free": _in_own_unit(posterior.center, data),
        "prior": _shaped(program, prior.parameters),
        "prior_predictive": _in_own_unit(prior.predictive, data),
    }
    if program.auxiliary:
        groups["unconstrained_posterior"] = _shaped(program, posterior.coordinates)
    coords = {
        dim: capture[dim].to_numpy() if dim in capture.coords else np.arange(capture.sizes[dim])
        for dim, _ in data.dims
    }
    tree = from_dict(groups, coords=coords, dims=dims_of(program))
    # The log prior is one number per site and draw, whatever the site's own axes are.
    log_prior = {n: (("chain", "draw"), np.asarray(x)) for n, x in posterior.log_prior.items()}
    added = {"log_prior": xr.Dataset(log_prior), **_data_groups(program, capture, data, coords)}
    for name, dataset in comparisons.items():
        labels = {dim: values for dim, values in coords.items() if dim in dataset.dims}
        added[name] = dataset.assign_coords(labels)
    for name, dataset in added.items():
        tree[name] = xr.DataTree(dataset)
    for group in ("posterior", "prior"):
        for parameter, variable in tree.children[group].data_vars.items():
            variable.attrs |= attributes_of(str(parameter))
    tree.attrs[PROVENANCE] = json.dumps(provenance, sort_keys=True)
    return tree


def capture_of(result: xr.DataTree) -> xr.Dataset:
    """Return the capture of a fit, with the variables that were fitted."""
    parts = (result[name].to_dataset() for name in ("observed_data", "constant_data"))
    capture = xr.merge(parts, join="exact", compat="equals")
    of_others = [  # errors of readings that were not fitted
        name
        for name in capture
        if str(name).endswith("_error") and str(name).removesuffix("_error") not in capture
    ]
    found = capture.drop_vars([d for d in ("view", "x", "y") if d in capture.coords] + of_others)
    flags = {name: found[name].astype(bool) for name in ("valid", "saturated")}
    return found.assign(flags).assign_attrs(provenance_of(result).get("capture", {}))


def attributes_of(name: str) -> dict[str, str]:
    """Return meaning, unit and symbol of a parameter as attributes of its variable."""
    symbol, meaning, unit = notation(name)
    known = {"long_name": meaning, "units": unit}
    return known | {"symbol": symbol} if symbol else known


def provenance_of(result: xr.DataTree | xr.Dataset) -> Provenance:
    """Return the provenance of a result, without null entries."""
    try:
        found = json.loads(result.attrs.get(PROVENANCE, "{}"))
    except (TypeError, ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise FitError(
            "it is no mapping in JSON",
            where=f"result: attribute {PROVENANCE}",
            hint="give the result as it was saved, or delete the attribute",
        )
    return {key: value for key, value in found.items() if value is not None}


def bounds_of(provenance: Provenance, name: str) -> tuple[float, float]:
    """Return the support of the prior of a parameter."""
    bounds = (provenance.get("bounds") or {}).get(name)
    if bounds is None:
        return RANGES.get(name, (-math.inf, math.inf))
    low, high = bounds
    return -math.inf if low is None else low, math.inf if high is None else high


def posterior_of(program: Program, parameters: Values) -> xr.Dataset:
    """Return the group `posterior` of a fit without any other group."""
    tree = from_dict({"posterior": _shaped(program, parameters)}, dims=dims_of(program))
    return tree["posterior"].to_dataset()


def dims_of(program: Program) -> dict[str, list[str]]:
    """Return the axes of every site: those of its plates, then those of its event."""
    return {
        name: [*program.dims[name], *(f"{name}_{i}" for i, _ in enumerate(program.events[name]))]
        for name in program.dims
    }


def shape_of(program: Program, name: str) -> tuple[int, ...]:
    """Return lengths of the axes of a site, without axes of length 1 from plates."""
    return (*(program.plates[dim] for dim in program.dims[name]), *program.events[name])


def _shaped(program: Program, values: Values) -> dict[str, np.ndarray]:
    return {
        name: np.asarray(value).reshape(*np.shape(value)[:2], *shape_of(program, name))
        for name, value in values.items()
    }


def _measured(readings: Values, data: Observations) -> dict[str, np.ndarray]:
    """Return readings of draws, or their densities, without padding."""
    return {name: np.asarray(value)[..., data.measured] for name, value in readings.items()}


def _in_own_unit(readings: Values, data: Observations) -> dict[str, np.ndarray]:
    """Return readings of draws in the unit of the capture."""
    unit = {"intensity": float(data.intensity_unit)}
    return {name: x * unit.get(name, 1.0) for name, x in _measured(readings, data).items()}


def _data_groups(
    program: Program, capture: xr.Dataset, data: Observations, coords: Mapping[str, np.ndarray]
) -> dict[str, xr.Dataset]:
    """Return fitted readings, and the model's inputs: geometry, errors, flags, truth."""
    order = [dim for dim, _ in data.dims]
    bare = capture.drop_vars(capture.coords)
    valid, saturated = (
        xr.DataArray(np.asarray(flag)[..., data.measured], dims=order)
        for flag in (data.valid, data.saturated)
    )
    readings = [name for name in program.observed if name in bare]
    given = [n for n in bare if str(n).startswith("true_") or str(n).endswith("_error")]
    flags = {"valid": valid.astype("int8"), "saturated": saturated.astype("int8")}
    groups = {
        "observed_data": {name: bare[name].transpose(*order).where(valid) for name in readings},
        "constant_data": {str(name): bare[name] for name in (*ANGLES, *given)} | flags,
    }
    return {name: xr.Dataset(group, coords=dict(coords)) for name, group in groups.items()}
