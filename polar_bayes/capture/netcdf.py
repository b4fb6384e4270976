"""netCDF files with a checksum: what is read is what was written, or an error says that it is not.

The last line of a file is the SHA-256 digest of all bytes before it; HDF5 does not read so far. It
is verified before a library sees the file, since HDF5 crashes or hangs on some damages.
Fletcher-32, the filter of HDF5, would not do: it applies neither to single numbers nor to text, and
a flipped bit in the index of chunks that it needs gives fill values for a whole array. Whoever
edits the file with netCDF, xarray or HDF5 drops the line; the file is then one from elsewhere,
which has none.
"""

import hashlib
from pathlib import Path
from typing import Any

import xarray as xr

from polar_bayes.errors import PolarBayesError
from polar_bayes.paths import system_error

MARK = b"\npolar_bayes sha256 "
TAIL = 4096
"""Bytes at the end of a file in which the mark is looked for, should more have been added."""

BLOCK = 2**20


def read_netcdf[Data: (xr.Dataset, xr.DataTree)](
    kind: type[Data], file: Path, broken: PolarBayesError
) -> Data:
    """Read a file whole, and verify its checksum where it has one."""
    try:
        is_whole = _is_whole(file)
    except OSError as error:
        raise system_error(error, file) from error
    if not is_whole:
        raise type(broken)(
            "its checksum is wrong: the file was damaged after it was written",
            where=str(file),
            mend="restore it from a copy, or make it again",
        )
    try:
        with open_netcdf(kind, file) as opened:
            return opened.load()
    except PermissionError as error:
        raise system_error(error, file) from error
    except Exception as error:  # the libraries below raise nearly every type for a broken file
        raise broken from error


def write_netcdf(data: xr.Dataset | xr.DataTree, path: Path) -> None:
    """Write a netCDF-4 file with a checksum, at a path that `polar_bayes.paths.replacing` gives."""
    data.to_netcdf(path, engine="netcdf4", format="NETCDF4")
    digest = _digest(path, path.stat().st_size)
    with path.open("ab") as file:
        file.write(MARK + digest.encode() + b"\n")


def open_netcdf(kind: type, file: Path) -> Any:
    """The data of a file, read when they are needed; a context that closes it."""
    open_file = xr.open_datatree if kind is xr.DataTree else xr.open_dataset
    # Absolute, so that netCDF takes no path for an address; times stay the numbers they are.
    return open_file(file.absolute(), engine="netcdf4", decode_times=False)


def _is_whole(path: Path) -> bool:
    """Whether a file is what was written, as far as it says so."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - TAIL))
        tail = file.read()
    before, mark, line = tail.rpartition(MARK)
    if not mark:
        return True
    return line == _digest(path, size - len(tail) + len(before)).encode() + b"\n"


def _digest(path: Path, size: int) -> str:
    """SHA-256 of the first bytes of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while size > 0 and (block := file.read(min(BLOCK, size))):
            digest.update(block)
            size -= len(block)
    return digest.hexdigest()
