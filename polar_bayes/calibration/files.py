"""Calibrations in netCDF files."""

import os

import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.paths import existing_file

GROUPS = frozenset({"prior_sbc", "truth", "marginals", "fits"})


def is_calibration(tree: object) -> bool:
    """Whether a tree is what `polar_bayes.calibrate` returns.

    Args:
        tree: Anything.

    Returns:
        True where it has the groups of a calibration, and is no fit.

    Raises:
        Nothing.
    """
    if not isinstance(tree, xr.DataTree) or "posterior" in tree.children:
        return False
    return set(tree.children) >= GROUPS


def holds_calibration(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds a calibration; its numbers are not read.

    Args:
        path: Any file.

    Returns:
        False where it is not there, cannot be read, or holds something else.

    Raises:
        Nothing.
    """
    try:
        with _open(path) as tree:
            return is_calibration(tree)
    except Exception:  # the libraries below raise nearly every type for a broken file
        return False


def load_calibration(path: str | os.PathLike[str]) -> xr.DataTree:
    """A calibration from a netCDF file.

    Args:
        path: A file that `polar-bayes calibrate` or `polar_bayes.save_result` wrote.

    Returns:
        The tree, in memory; the file is closed.

    Raises:
        CaptureError: The file is not there.
        FitError: It holds no calibration.
    """
    file = existing_file(path, "calibration")
    if not holds_calibration(file):
        raise FitError(
            "it holds no calibration",
            where=str(file),
            mend="give the file that `polar-bayes calibrate` wrote",
        )
    with _open(file) as tree:
        return tree.load()


def _open(path: str | os.PathLike[str]) -> xr.DataTree:
    file = existing_file(path, "calibration")
    return xr.open_datatree(file.absolute(), engine="netcdf4", decode_times=False)
