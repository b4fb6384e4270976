"""Captures in netCDF files: read whole, written whole or not at all."""

import os
from pathlib import Path

import xarray as xr

from polar_bayes.capture.netcdf import open_netcdf, read_netcdf, write_netcdf
from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError
from polar_bayes.paths import existing_file, replacing

OF_RESULTS = ("polar_bayes", "chosen_scene")
"""Root attributes of results: provenance, and that of a ledger of effects."""


def load_capture(path: str | os.PathLike[str]) -> xr.Dataset:
    """A capture from a netCDF file.

    The file is read whole and closed. Where the capture has no attribute `name`, it is named after
    the file.

    Args:
        path: A netCDF file (version 4 or classic).

    Returns:
        The validated capture.

    Raises:
        CaptureError: The file cannot be read, was damaged, or does not hold a capture.
    """
    file = existing_file(path, "capture")
    mend = "write it again with save_capture"
    broken = CaptureError("it cannot be read as netCDF", where=str(file), mend=mend)
    dataset = read_netcdf(xr.Dataset, file, broken)
    dataset.attrs.setdefault("name", file.stem)
    return validate(dataset, source=str(file))


def save_capture(capture: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a capture to a netCDF-4 file.

    It is written beside its place and then moved there, so a failure leaves what was there before
    (`polar_bayes.paths.replacing`).

    Args:
        capture: The capture; it is validated first.
        path: The file; an older capture there is replaced and its mode kept.

    Raises:
        CaptureError: It is not a capture.
        OutputError: The file cannot be written, or is none that may be replaced.
    """
    checked = validate(capture)
    with replacing(path, is_capture) as unfinished:
        write_netcdf(checked, unfinished)


def is_capture(file: Path) -> bool:
    """Whether a file holds a capture; no value is read."""
    opened = _opened(file)
    return opened is not None and "view_zenith" in opened.variables


def is_result(file: Path) -> bool:
    """Whether a file holds a result that `save_result` wrote, of any kind; no value is read."""
    opened = _opened(file)
    return opened is not None and any(name in opened.attrs for name in OF_RESULTS)


def _opened(file: Path) -> xr.Dataset | None:
    """Names and attributes of a netCDF file; None of anything else."""
    try:
        with open_netcdf(xr.Dataset, file) as opened:
            return opened
    except Exception:  # the libraries below raise nearly every type for what is no netCDF
        return None
