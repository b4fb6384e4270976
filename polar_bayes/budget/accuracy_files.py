"""Accuracy studies in netCDF files."""

import os

import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.paths import existing_file


def is_accuracy(tree: object) -> bool:
    """Whether a tree is what `polar_bayes.accuracy` returns, and no fit."""
    if not isinstance(tree, xr.DataTree) or "posterior" in tree.children:
        return False
    return "accuracy" in tree.children


def holds_accuracy(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds an accuracy study; its numbers are not read.

    Args:
        path: Any file.

    Returns:
        False where it is not there, cannot be read, or holds something else.

    Raises:
        Nothing.
    """
    try:
        with _open(path) as tree:
            return is_accuracy(tree)
    except Exception:  # the libraries below raise nearly every type for a broken file
        return False


def load_accuracy(path: str | os.PathLike[str]) -> xr.DataTree:
    """An accuracy study from a netCDF file.

    Args:
        path: A file that `polar-bayes accuracy` or `polar_bayes.save_result` wrote.

    Returns:
        The tree, in memory; the file is closed.

    Raises:
        CaptureError: The file is not there.
        FitError: It holds no accuracy study.
    """
    file = existing_file(path, "accuracy study")
    if not holds_accuracy(file):
        raise FitError(
            "it holds no accuracy study",
            where=str(file),
            mend="give the file that `polar-bayes accuracy` wrote",
        )
    with _open(file) as tree:
        return tree.load()


def _open(path: str | os.PathLike[str]) -> xr.DataTree:
    file = existing_file(path, "accuracy study")
    return xr.open_datatree(file.absolute(), engine="netcdf4", decode_times=False)
