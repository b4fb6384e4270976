"""Captures in netCDF files, which are verified when read and written atomically.

The last line of a file is the SHA-256 digest of all bytes before it; HDF5 does not read so far. It
is verified before a library reads the file, since HDF5 crashes or hangs on some damages.
Fletcher-32, the filter of HDF5, is not enough: it applies neither to single numbers nor to text,
and a flipped bit in the index of chunks that it needs gives fill values for a whole array. Whoever
edits the file with netCDF, xarray or HDF5 drops the line; a file without it is not verified.
"""

import hashlib
import os
from pathlib import Path
from typing import Any

import xarray as xr

from polar_bayes.capture.schema import validate
from polar_bayes.errors import CaptureError, PolarBayesError
from polar_bayes.paths import atomic_write, existing_file, system_error

MARK = b"\npolar_bayes sha256 "


def read_netcdf[Data: (xr.Dataset, xr.DataTree)](
    kind: type[Data], file: Path, broken: PolarBayesError
) -> Data:
    """Read a whole file, and verify its checksum where it has one."""
    try:
        is_whole = _is_whole(file)
    except OSError as error:
        raise system_error(error, file) from error
    if not is_whole:
        what = "its checksum is wrong: the file was damaged after it was written"
        raise type(broken)(what, where=str(file), hint="restore it from a copy, or make it again")
    try:
        with open_netcdf(kind, file) as opened:
            return opened.load()
    except PermissionError as error:
        raise system_error(error, file) from error
    except Exception as error:  # the libraries below raise nearly every type for a broken file
        raise broken from error


def write_netcdf(data: xr.Dataset | xr.DataTree, path: Path) -> None:
    """Write a netCDF-4 file with a checksum, at a path of `polar_bayes.paths.atomic_write`."""
    data.to_netcdf(path, engine="netcdf4", format="NETCDF4")
    digest = _digest(path, path.stat().st_size)
    with path.open("ab") as file:
        file.write(MARK + digest.encode() + b"\n")


def open_netcdf(kind: type, file: Path) -> Any:
    """Open a file lazily in a context that closes it."""
    open_file = xr.open_datatree if kind is xr.DataTree else xr.open_dataset
    # Absolute, so that netCDF takes no path for an address; times stay the numbers they are.
    return open_file(file.absolute(), engine="netcdf4", decode_times=False)


def _is_whole(path: Path) -> bool:
    """Return whether the checksum of a file is right, or missing."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - 4096))  # more may have been appended to the last line
        tail = file.read()
    before, mark, line = tail.rpartition(MARK)
    if not mark:
        return True
    return line == _digest(path, size - len(tail) + len(before)).encode() + b"\n"


def _digest(path: Path, size: int) -> str:
    """Return the SHA-256 digest of the first bytes of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while size > 0 and (block := file.read(min(2**20, size))):
            digest.update(block)
            size -= len(block)
    return digest.hexdigest()


# --- Captures -------------------------------------------------------------------------------------


def load_capture(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a capture from a netCDF file.

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
    hint = "write it again with save_capture"
    if file.suffix.lower() in (".csv", ".dat", ".tsv", ".txt"):
        hint = f"a table is imported first: polar-bayes import table {file} --out {file.stem}.nc"
        hint += f", or pb.from_table({str(file)!r})"
    broken = CaptureError("it cannot be read as netCDF", where=str(file), hint=hint)
    dataset = read_netcdf(xr.Dataset, file, broken)
    dataset.attrs.setdefault("name", file.stem)
    return validate(dataset, source=str(file))


def save_capture(capture: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a capture to a netCDF-4 file.

    It is written to a temporary file that then replaces `path`, so a failure leaves the older file
    (`polar_bayes.paths.atomic_write`).

    Args:
        capture: The capture; it is validated first.
        path: The file; an older capture there is replaced and its mode kept.

    Raises:
        CaptureError: It is not a capture.
        OutputError: The file cannot be written, or is none that may be replaced.
    """
    checked = validate(capture)
    with atomic_write(path, is_capture) as unfinished:
        write_netcdf(checked, unfinished)


def is_capture(file: Path) -> bool:
    """Return whether a file holds a capture; only its header is read."""
    return "view_zenith" in _header(file).variables


def is_result(file: Path) -> bool:
    """Return whether a file holds a result of any kind; only its header is read."""
    # Provenance, and that of a ledger of effects.
    return not {"polar_bayes", "chosen_scene"}.isdisjoint(_header(file).attrs)


def _header(file: Path) -> xr.Dataset:
    """Return names and attributes of a netCDF file; empty for any other file."""
    try:
        with open_netcdf(xr.Dataset, file) as opened:
            return opened
    except Exception:  # the libraries below raise nearly every type for what is no netCDF
        return xr.Dataset()
