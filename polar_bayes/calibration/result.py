"""A finished calibration as a tree: labels come back here."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from polar_bayes.calibration.standing import Standing
from polar_bayes.inference.program import Program, Values
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import PROVENANCE, dims_of
from polar_bayes.observation.data import Observations
from polar_bayes.physics.notation import notation
from polar_bayes.pixels.marginals import LEVELS, Marginals
from polar_bayes.pixels.outcome import Approach, Outcome, Status


def assemble(
    program: Program,
    request: Request,
    data: Observations,
    truth: Values,
    marginals: Marginals,
    standing: Standing,
    outcome: Outcome,
    about: Mapping[str, Any],
) -> xr.DataTree:
    """Put a calibration into one tree.

    Args:
        program: The model that was fitted.
        request: What was asked.
        data: The layout.
        truth: By parameter, (simulation, ...).
        marginals: Of every fit.
        standing: Of every truth.
        outcome: What became of every fit.
        about: Whatever JSON can hold.

    Returns:
        The tree that `polar_bayes.calibrate` returns.

    Raises:
        Nothing.
    """
    dims = dims_of(program)
    lengths = dict(data.dims)
    captured = request.capture
    axes = {
        dim: captured[dim].to_numpy() if dim in captured.coords else np.arange(lengths[dim])
        for name in truth
        for dim in dims[name]
        if dim in lengths
    }
    axes["simulation"] = np.arange(len(outcome.status))

    def labeled(values: Values, ending: str = "") -> dict[str, xr.DataArray]:
        first = ("quantile",) if ending == "_quantile" else ()
        return {
            f"{name}{ending}": xr.DataArray(
                x,
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
        for name, x in outcome._asdict().items()
    }
    whole = {
        **labeled(marginals.mean),
        **labeled(marginals.sd, "_sd"),
        **labeled(marginals.quantiles, "_quantile"),
        **labeled(standing.crps, "_crps"),
    }
    tree = xr.DataTree.from_dict(
        {
            "prior_sbc": xr.Dataset(labeled(standing.pit), axes),
            "truth": xr.Dataset(labeled(truth), axes),
            "marginals": xr.Dataset(whole, {**axes, "quantile": list(LEVELS)}),
            "fits": xr.Dataset(fits, {"simulation": axes["simulation"]}),
        }
    )
    tree.attrs[PROVENANCE] = json.dumps(about, sort_keys=True)
    return tree
