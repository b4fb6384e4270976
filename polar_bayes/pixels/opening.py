"""Images and maps that are there already, in files or still to be computed."""

import os

import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.paths import as_path
from polar_bayes.pixels.store import open_image

MOST_BYTES = 2**31
"""Maps in chunks (Dask) that are computed at once, into memory."""


def open_capture(path: str | os.PathLike[str]) -> xr.Dataset:
    """A capture from a file, its values read when they are needed where it is a Zarr store.

    Args:
        path: A netCDF file, or the folder of a Zarr store (its name ends in .zarr).

    Returns:
        The capture; that of a Zarr store is not validated.

    Raises:
        CaptureError: It cannot be read.
    """
    return open_image(as_path(path, "capture"))


def open_map(path: str | os.PathLike[str]) -> xr.Dataset:
    """The maps of a Zarr store, their values read when they are needed.

    Args:
        path: What `polar_bayes.map_file` or `polar-bayes map` wrote.

    Returns:
        The maps.

    Raises:
        CaptureError: It is no path.
        FitError: There is no such store, it is not finished, or it holds no maps.
    """
    store = as_path(path, "map")
    where = str(store)
    if not store.is_dir():
        raise FitError("there is no such store", where=where, mend="check the path")
    # What is not yet written reads as zero, and zero is a status: good.
    if store.with_name(f"{store.name}.progress").exists():
        raise FitError(
            "it is not finished", where=where, mend="wait, or go on with `polar-bayes map --resume`"
        )
    try:
        maps = xr.open_zarr(store, chunks=None, consolidated=False)
    except Exception as error:  # the libraries below raise nearly every type for a broken store
        raise FitError(
            "it cannot be read as Zarr", where=where, mend="make the map again"
        ) from error
    if PROVENANCE not in maps.attrs or "status" not in maps:
        raise FitError("it holds no maps", where=where, mend="give what `polar-bayes map` wrote")
    return maps


def at_hand(maps: xr.Dataset) -> xr.Dataset:
    """Maps whose values can be looked at again and again.

    Those in chunks (Dask) would be fitted anew at each look: they are computed, once.

    Args:
        maps: Of `polar_bayes.fit_pixels`, or opened from a store.

    Returns:
        The maps: in memory, or in a store from which they are read when they are needed.

    Raises:
        FitError: They are in chunks, and too large for memory.
    """
    if not any(variable.chunks for variable in maps.variables.values()):
        return maps
    if maps.nbytes > MOST_BYTES:
        raise FitError(
            f"these maps are in chunks and take {maps.nbytes / 2**30:.0f} GB",
            where="maps",
            mend="write them with to_zarr, if they are not yet, and open them with open_map",
        )
    return maps.compute()
