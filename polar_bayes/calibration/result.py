"""A finished calibration as a tree: labels come back here."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from polar_bayes.calibration.block import Block
from polar_bayes.inference.program import Program, Values
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import PROVENANCE, dims_of, shape_of
from polar_bayes.observation.data import Observations
from polar_bayes.physics.notation import notation
from polar_bayes.pixels.importance import LARGEST_TRUSTED
from polar_bayes.pixels.marginals import LEVELS
from polar_bayes.pixels.outcome import Approach, Status


def assemble(
    program: Program,
    request: Request,
    data: Observations,
    found: Block,
    about: Mapping[str, Any],
) -> xr.DataTree:
    """Put a calibration into one tree."""
    dims = dims_of(program)
    lengths = dict(data.dims)
    captured = request.capture
    axes = {
        dim: captured[dim].to_numpy() if dim in captured.coords else np.arange(lengths[dim])
        for name in found.truth
        for dim in dims[name]
        if dim in lengths
    }
    axes["simulation"] = found.numbers

    def labeled(values: Values, ending: str = "") -> dict[str, xr.DataArray]:
        first = ("quantile",) if ending == "_quantile" else ()
        return {
            f"{name}{ending}": xr.DataArray(
                np.reshape(x, (*np.shape(x)[: len(first) + 1], *shape_of(program, name))),
                dims=(*first, "simulation", *dims[name]),
                attrs={"symbol": notation(name)[0], "units": notation(name)[2]},
            )
            for name, x in values.items()
        }

    flags = {"status": Status, "approach": Approach}
    fits = {
        name: (
            "simulation",
            x,
            {"flag_meanings": " ".join(each.name.lower() for each in flags[name])}
            if name in flags
            else {},
        )
        for name, x in found.outcome._asdict().items()
    }
    quantiles = {name: np.moveaxis(x, 1, 0) for name, x in found.quantiles.items()}
    whole = {
        **labeled(found.mean),
        **labeled(found.sd, "_sd"),
        **labeled(quantiles, "_quantile"),
        **labeled(found.crps, "_crps"),
    }
    simulation = {"simulation": found.numbers}
    groups = {
        "prior_sbc": xr.Dataset(labeled(found.pit), axes),
        "truth": xr.Dataset(labeled(found.truth), axes),
        "marginals": xr.Dataset(whole, {**axes, "quantile": list(LEVELS)}),
        "fits": xr.Dataset(fits, simulation),
    }
    if found.place:
        groups["predictive_pit"] = xr.Dataset(_of_readings(found.fresh), simulation)
        groups["loo_pit"] = xr.Dataset(_of_readings(found.left_out), simulation)
        groups["readings"] = xr.Dataset(_chosen(found, data), simulation)
    tree = xr.DataTree.from_dict(groups)
    tree.attrs[PROVENANCE] = json.dumps(about, sort_keys=True)
    return tree


def _of_readings(values: Values) -> dict[str, tuple]:
    return {
        name: ("simulation", x, {"symbol": notation(name)[0], "units": "1"})
        for name, x in values.items()
    }


def _chosen(found: Block, data: Observations) -> dict[str, tuple]:
    """Which entries were looked at, and how far leaving them out can be trusted."""
    said = f"Pareto k of the weights without it; above {LARGEST_TRUSTED} they say little"
    chosen: dict[str, tuple] = {}
    for name, place in found.place.items():
        chosen[f"{name}_pareto_k"] = ("simulation", found.left_out_k[name], {"long_name": said})
        index = np.unravel_index(np.maximum(place, 0), data.shape)
        for (dim, _), at in zip(data.dims, index, strict=True):
            words = {"long_name": f"number of its {dim}, -1 where none is valid"}
            chosen[f"{name}_{dim}"] = ("simulation", np.where(place < 0, -1, at), words)
    return chosen
