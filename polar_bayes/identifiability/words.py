"""What a capture determines and what it does not, as a table and in words."""

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.physics.scene import MATERIAL_PARAMETERS

UNTOLD, PARTLY = 0.8, 0.3
"""Share of the prior in a parameter's variance from which it is not, or only partly, determined."""

COUPLED = 0.9
"""Correlation from which two parameters trade off."""


def identifiability_table(found: xr.Dataset) -> pd.DataFrame:
    """One row for each parameter.

    Args:
        found: What `polar_bayes.identify` returns.

    Returns:
        Columns value, prior_sd, expected_sd, prior_share and sensitivity.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    columns = ["value", "prior_sd", "expected_sd", "prior_share", "sensitivity"]
    return found[columns].drop_vars("name").to_dataframe()


def identifiability_sentences(found: xr.Dataset) -> list[str]:
    """What is not determined, and what trades off, in words.

    Args:
        found: What `polar_bayes.identify` returns.

    Returns:
        Parameters of the material that the data tell little of; then pairs that trade off, the
        closest first; or one sentence that says that all is well.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    said = []
    is_material = np.isin(found["name"].to_numpy(), MATERIAL_PARAMETERS)
    for at in np.flatnonzero(is_material):
        row = found.isel(parameter=at)
        share = float(row["prior_share"])
        if share >= PARTLY:
            how = "is not determined" if share >= UNTOLD else "is only partly determined"
            said.append(
                f"{row['parameter'].item()} {how}: {share:.0%} of its variance is the prior's "
                f"(sd {float(row['prior_sd']):.3g} before the data, "
                f"{float(row['expected_sd']):.3g} expected after)."
            )
    told = is_material & (found["prior_share"].to_numpy() < UNTOLD)
    correlation, names = found["correlation"].to_numpy(), found["parameter"].to_numpy()
    for i, j in _coupled(correlation, told, told | ~is_material):
        way = "raises" if correlation[i, j] > 0.0 else "lowers"
        said.append(
            f"{names[i]} and {names[j]} trade off: raising one {way} the other (correlation "
            f"{correlation[i, j]:.2f}), and the readings hardly change."
        )
    return said or ["Every parameter of the material is determined by the data."]


def _coupled(correlation: np.ndarray, first: np.ndarray, second: np.ndarray) -> list:
    """Pairs of the first kind with the second whose correlation is high, the closest first."""
    pairs = [
        (i, j)
        for i in np.flatnonzero(first)
        for j in np.flatnonzero(second)
        if (i < j or not first[j]) and abs(correlation[i, j]) >= COUPLED
    ]
    return sorted(pairs, key=lambda pair: -abs(correlation[pair]))


def _check(found: xr.Dataset) -> None:
    if not isinstance(found, xr.Dataset) or "prior_share" not in found:
        raise FitError(
            "it says nothing of identifiability",
            where="identifiability",
            mend="give what polar_bayes.identify returns",
        )
