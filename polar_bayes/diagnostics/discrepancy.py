"""What would the fit claim if it denied that the instrument errs?"""

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.diagnostics.parameters import posterior_scalars, scalars

COLUMNS = (
    "mean",
    "q2.5",
    "q97.5",
    "mean_without",
    "q2.5_without",
    "q97.5_without",
    "width_ratio",
)
INTERVAL = (0.025, 0.975)

WITHOUT = {"discrepancy": "the discrepancy term", "instrument": "any instrument term"}
"""Fits that may stand beside the main one, in the groups `without_<key>`: what they leave out."""


def compare_without(result: xr.DataTree, part: str) -> pd.DataFrame:
    """The material's intervals with and without a part of the instrument, side by side."""
    found = posterior_scalars(result)
    rows, labels = [], []
    plain = {}
    if f"without_{part}" in result.children:
        plain = {s.label: s.draws for s in scalars(result[f"without_{part}"].to_dataset())}
    for scalar in found:
        other = plain.get(scalar.label)
        if other is None or not scalar.is_material:
            continue
        if not (np.isfinite(scalar.draws).all() and np.isfinite(other).all()):
            continue
        (low, high), (bare_low, bare_high) = (
            np.quantile(draws, INTERVAL) for draws in (scalar.draws, other)
        )
        ratio = (bare_high - bare_low) / (high - low) if high > low else np.nan
        labels.append(scalar.label)
        rows.append([scalar.draws.mean(), low, high, other.mean(), bare_low, bare_high, ratio])
    return pd.DataFrame(rows, columns=list(COLUMNS), index=pd.Index(labels, dtype=str))
