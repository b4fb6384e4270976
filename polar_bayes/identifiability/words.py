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

WEAK = 1.0
"""Information along a direction, over the prior's, below which the data say less than it did."""

PART = 0.3
"""Share of the largest movement of the readings from which a parameter is named in a direction."""


def identifiability_table(found: xr.Dataset) -> pd.DataFrame:
    """One row for each parameter.

    Args:
        found: What `polar_bayes.identify` returns.

    Returns:
        Columns value, prior_sd, expected_sd, prior_share, sensitivity and
        paper_sd.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    columns = ["value", "prior_sd", "expected_sd", "prior_share", "sensitivity", "paper_sd"]
    return found[columns].drop_vars("name").to_dataframe()


def identifiability_sentences(found: xr.Dataset) -> list[str]:
    """What is not determined, and what trades off, in words.

    Args:
        found: What `polar_bayes.identify` returns.

    Returns:
        Parameters of the material that the data tell little of; the weakest direction, where the
        data say less of it than the prior, it is one of the material and several parameters make
        it; then pairs that trade off, the closest first; or one sentence that says that all is
        well.

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
    said += _weakest_direction(found, is_material)
    told = is_material & (found["prior_share"].to_numpy() < UNTOLD)
    correlation, names = found["correlation"].to_numpy(), found["parameter"].to_numpy()
    for i, j in _coupled(correlation, told, told | ~is_material):
        way = "raises" if correlation[i, j] > 0.0 else "lowers"
        said.append(
            f"{names[i]} and {names[j]} trade off: raising one {way} the other (correlation "
            f"{correlation[i, j]:.2f}), and the readings hardly change."
        )
    return said or ["Every parameter of the material is determined by the data."]


def _weakest_direction(found: xr.Dataset, is_material: np.ndarray) -> list[str]:
    """The combination that the readings see least of, where its parts alone would be seen."""
    weakest = found.isel(direction=0)
    weight, movement = weakest["weight"].to_numpy(), weakest["movement"].to_numpy()
    parts = np.flatnonzero(movement >= PART * movement.max())
    strength = float(weakest["information"])
    is_mixture = parts.size > 1 and movement.max() > 2.0  # one alone is not determined, as said
    if strength >= WEAK or not is_mixture or not is_material[np.argmax(np.abs(weight))]:
        return []
    names = found["parameter"].to_numpy()
    parts = parts[np.argsort(-np.abs(weight[parts]))]
    mixed = ", ".join(f"{names[part]} by {weight[part]:+.2g}" for part in parts)
    return [
        f"The weakest direction moves {mixed} prior sds together: the readings move by "
        f"{np.sqrt(max(strength, 0.0)):.2g} sds of their noise, though {names[parts[0]]} alone "
        f"would move them by {movement[parts[0]]:.2g}."
    ]


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
