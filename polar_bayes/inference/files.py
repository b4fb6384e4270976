"""Results in netCDF files: one DataTree a file, whole or not at all."""

import os

import xarray as xr

from polar_bayes.capture.files import is_result
from polar_bayes.errors import FitError
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.paths import existing_file, replacing, system_error


def load_result(path: str | os.PathLike[str]) -> xr.DataTree:
    """A result from a netCDF file.

    Args:
        path: A file that `save_result` wrote.

    Returns:
        The tree, in memory; the file is closed.

    Raises:
        CaptureError: The file is not there.
        FitError: It is not a result.
    """
    file = existing_file(path, "result")
    try:
        with xr.open_datatree(file.absolute(), engine="netcdf4", decode_times=False) as opened:
            tree = opened.load()
    except PermissionError as error:
        raise system_error(error, file) from error
    except Exception as error:  # the libraries below raise nearly every type for a broken file
        raise FitError(
            "it cannot be read as netCDF", where=str(file), mend="fit the capture again"
        ) from error
    if PROVENANCE not in tree.attrs or "posterior" not in tree.children:
        raise FitError(
            "it holds no fit of polar_bayes",
            where=str(file),
            mend="give the file that `polar-bayes fit` or save_result wrote",
        )
    return tree


def save_result(result: xr.DataTree, path: str | os.PathLike[str]) -> None:
    """Write a result to a netCDF-4 file, beside its place first and then moved there.

    Args:
        result: A tree that `polar_bayes.fit` returned.
        path: The file; an older result there is replaced and its mode kept.

    Raises:
        OutputError: The file cannot be written, or is none that may be replaced.
    """
    with replacing(path, is_result) as unfinished:
        result.to_netcdf(unfinished, engine="netcdf4")
