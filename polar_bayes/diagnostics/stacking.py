"""Readings in one row, without those that were not fitted, as tools for plain data want them."""

import numpy as np
import xarray as xr

from polar_bayes.diagnostics.parameters import SAMPLE_DIMS
from polar_bayes.errors import FitError
from polar_bayes.inference.files import check_fit

OF_READINGS = (
    "observed_data",
    "log_likelihood",
    "posterior_predictive",
    "noise_free",
    "prior_predictive",
)


def stack_readings(result: xr.DataTree) -> xr.DataTree:
    """The same result with a single axis of readings, those alone that the fit has read.

    Masked views and views beyond the angle limit stay in a result, so that its axes are those of
    the capture; their log likelihood is zero in every draw. Leave-one-out functions refuse such
    readings, and some take one axis only: give them this.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A new tree. In `observed_data`, `log_likelihood`, `posterior_predictive`, `noise_free` and
        `prior_predictive` each variable `x` has one axis `x_reading` beside chain and draw; all
        other groups and attributes are the same.

    Raises:
        FitError: The tree holds no readings, is no fit, or does not hold together.
    """
    if not isinstance(result, xr.DataTree) or "observed_data" not in result.children:
        raise FitError(
            "it holds no readings",
            where="stack_readings",
            mend="give the tree that polar_bayes.fit or load_result returned",
        )
    check_fit(result)
    observed = result["observed_data"].to_dataset()
    kept = {str(name): _kept(result, observed[name]) for name in observed.data_vars}
    stacked = result.copy()
    for group in OF_READINGS:
        if group in result.children:
            own = result[group].to_dataset()
            rows = {n: _row(own[n], observed[n], keep) for n, keep in kept.items() if n in own}
            stacked[group] = xr.DataTree(xr.Dataset(rows))
    return stacked


def _kept(result: xr.DataTree, reading: xr.DataArray) -> np.ndarray:
    """Whether each reading was fitted, in the order of its axes."""
    finite = reading.notnull()
    if "constant_data" in result.children and "valid" in result["constant_data"].data_vars:
        finite = finite & (result["constant_data"].to_dataset()["valid"] == 1)
    return finite.transpose(*reading.dims).to_numpy().ravel()


def _row(variable: xr.DataArray, reading: xr.DataArray, kept: np.ndarray) -> xr.DataArray:
    lead = [dim for dim in SAMPLE_DIMS if dim in variable.dims]
    values: np.ndarray = variable.transpose(*lead, *reading.dims).to_numpy()
    rows = values.reshape(*values.shape[: len(lead)], -1)[..., kept]
    return xr.DataArray(rows, dims=(*lead, f"{reading.name}_reading"), attrs=variable.attrs)
