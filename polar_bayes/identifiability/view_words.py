"""Where to look next and what it is worth, as a table and in words."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.errors import FitError

HARDLY = 0.9
"""Width after over width before from which views hardly help."""


def next_views_table(found: xr.Dataset) -> pd.DataFrame:
    """Width of the expected 95% interval of every parameter, before and after each view.

    Args:
        found: What `polar_bayes.next_views` returns.

    Returns:
        One row for each parameter, in its unit; columns "now", "after 1", "after 2" and so on.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    table = found["interval_width"].transpose("parameter", "step").to_pandas()
    table.columns = ["now", *(f"after {step}" for step in table.columns[1:])]
    return table


def next_views_sentences(found: xr.Dataset) -> list[str]:
    """Where to look, and by how much the intervals narrow.

    Args:
        found: What `polar_bayes.next_views` returns.

    Returns:
        The views in their order; each parameter's interval before and after; then the parameters
        that they hardly help, where there are any.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    widths = found["interval_width"].transpose("step", "parameter")
    before, after = widths.isel(step=0).to_numpy(), widths.isel(step=-1).to_numpy()
    names = found["parameter"].to_numpy()
    helped = after < HARDLY * before
    said = [f"Look next at {'; then at '.join(_views_in_words(found))}."]
    said += [
        f"The 95% interval of {name} is expected to narrow from {old:.3g} to {new:.3g}."
        for name, old, new in zip(names[helped], before[helped], after[helped], strict=True)
    ]
    if not helped.all():
        said.append(f"These views hardly help {', '.join(names[~helped])}.")
    return said


def _views_in_words(found: xr.Dataset) -> list[str]:
    light = any(np.ptp(found[f"light_{angle}"].to_numpy()) for angle in ("zenith", "azimuth"))
    rows: list[Mapping[str, Any]] = [
        {str(n): found[n].to_numpy()[pick] for n in found.data_vars if found[n].dims == ("pick",)}
        for pick in range(found.sizes["pick"])
    ]
    return [_view_in_words(row, light) for row in rows]


def _view_in_words(row: Mapping[str, Any], light: bool) -> str:
    words = f"zenith {row['view_zenith']:g}, azimuth {row['view_azimuth']:g}"
    if light:
        words += f" (light at {row['light_zenith']:g}, {row['light_azimuth']:g})"
    if "wavelength" in row:
        words += f", {row['wavelength']:g} nm"
    if "reading" in row:
        words += f", {row['reading']}"
    return words


def _check(found: xr.Dataset) -> None:
    if not isinstance(found, xr.Dataset) or "interval_width" not in found:
        raise FitError(
            "it names no views",
            where="next_views",
            mend="give what polar_bayes.next_views returns",
        )
