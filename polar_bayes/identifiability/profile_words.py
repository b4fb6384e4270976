"""What a profile says, as a table and in words."""

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.errors import FitError

ALMOST_ALL = 0.02
"""Share of the prior beyond a grid that may be left out of sight."""


def profile_table(found: xr.Dataset) -> pd.DataFrame:
    """One row for each value of the grid.

    Args:
        found: What `polar_bayes.profile` returns.

    Returns:
        Columns posterior and likelihood: logarithms, 0 at the best value; NaN where no fit
        converged. The index is the parameter's value.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    table = found["profile"].transpose("value", "kind").to_pandas()
    table.index.name, table.columns.name = str(found.attrs["parameter"]), None
    return table


def profile_sentences(found: xr.Dataset) -> list[str]:
    """What the data exclude, where they are flat, and what was not found.

    Args:
        found: What `polar_bayes.profile` returns.

    Returns:
        One sentence on the 95% interval of the likelihood ratio, and one on values at which no
        fit converged, where there are any.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    name = str(found.attrs["parameter"])
    row = found.sel(kind="likelihood")
    failed = int(np.sum(~found["converged"]))
    said = [_interval_in_words(name, row)]
    if failed:
        said.append(
            f"At {failed} of {found['converged'].size} points of the two profiles no fit "
            f"converged; they are left out, not interpolated."
        )
    return said


def _interval_in_words(name: str, row: xr.Dataset) -> str:
    if not bool(row["converged"].any()):
        return f"{name}: no fit converged anywhere on the grid."
    low, high = float(row["low"]), float(row["high"])
    below, above = bool(row["open_below"]), bool(row["open_above"])
    ends = (
        _end_in_words(row, "below", low) if below else "",
        _end_in_words(row, "above", high) if above else "",
    )
    if below and above:
        return f"{name} is flat: the data exclude {ends[0]} and {ends[1]}."
    if below or above:
        side = f"above {high:.4g}" if below else f"below {low:.4g}"
        return f"{name} is flat to one side: the data exclude what is {side}, but {''.join(ends)}."
    return f"{name} is between {low:.4g} and {high:.4g} (95% interval of the likelihood ratio)."


def _end_in_words(row: xr.Dataset, side: str, end: float) -> str:
    beyond = float(row["prior_beyond"].sel(side=side))
    if beyond <= ALMOST_ALL:
        return (
            f"nothing {side}, down to {end:.4g}"
            if side == "below"
            else (f"nothing {side}, up to {end:.4g}")
        )
    return f"nothing {side} as far as the grid goes ({end:.4g})"


def _check(found: xr.Dataset) -> None:
    if not isinstance(found, xr.Dataset) or "prior_beyond" not in found:
        raise FitError(
            "it is no profile", where="profile", mend="give what polar_bayes.profile returns"
        )
