"""Accuracy studies made by hand: what advice, table and picture make of known numbers."""

import json

import numpy as np
import xarray as xr

PARAMETERS = ("roughness", "subsurface_fraction", "refractive_index")

ROWS = {
    ("point", "as given"): ([0.5, 0.9, 0.3], 1.0, 0.01),
    ("laplace", "as given"): ([0.08, 0.4, 0.02], 3.0, 0.1),
    ("laplace", "draws x 4"): ([0.07, 0.4, 0.02], 3.5, 0.3),
    ("nuts", "as given"): ([0.03, 0.05, 0.02], 18.0, 6.0),
    ("nuts long", "as given"): ([0.01, 0.02, 0.01], 60.0, 40.0),
}
"""Errors of the means, and seconds of the first fit and the next, by method and override."""


def make_accuracy(rows=None, *, fresh=True, doubts=""):
    """A study; all errors but those of the means are half of these, with the other sign."""
    rows = ROWS if rows is None else rows
    error = np.array([errors for errors, *_ in rows.values()], float)
    both = ("row", "parameter")
    found = xr.Dataset(
        {
            "mean_error": (both, error),
            **{name: (both, -0.5 * error) for name in ("sd_error", "low_error", "high_error")},
            "wasserstein": (both, 0.5 * error),
            **{
                name: ("row", np.full(len(rows), value))
                for name, value in {
                    "r_hat": np.nan,
                    "pareto_k": 0.3,
                    "ess": 1000.0,
                    "gradients": 5e3,
                    "densities": 0.0,
                    "peak_memory": 900.0 if fresh else np.nan,
                    "memory_before": 400.0 if fresh else np.nan,
                }.items()
            },
            "seconds_first": ("row", [first if fresh else np.nan for _, first, _ in rows.values()]),
            "seconds_again": ("row", [again for *_, again in rows.values()]),
            "problems": ("row", np.array([""] * len(rows), object)),
            "reference_mean": ("parameter", [0.1, 0.4, 1.5]),
            "reference_sd": ("parameter", [0.02, 0.05, 0.01]),
            "reference_mean_error": ("parameter", [0.01, 0.01, 0.01]),
            "reference_sd_error": ("parameter", [0.008, 0.01, 0.012]),
            "reference_wasserstein": ("parameter", [0.02, 0.02, 0.02]),
        },
        coords={
            "method": ("row", np.array([method for method, _ in rows], object)),
            "override": ("row", np.array([override for _, override in rows], object)),
            "parameter": np.array(PARAMETERS, object),
        },
        attrs={
            "reference": "NUTS",
            "reference_draws": 10000,
            "reference_ess": 5000.0,
            "reference_r_hat": 1.001,
            "reference_error": 0.012,
            "reference_doubts": doubts,
        },
    )
    tree = xr.DataTree(children={"accuracy": xr.DataTree(found)})
    about = {"accuracy": len(rows), "capture": "<leaf>", "model": "per_material", "seed": 0}
    tree.attrs["polar_bayes"] = json.dumps(about)
    return tree
