"""netCDF files with a checksum: what is read is what was written, or an error says that it is not.

An attribute of the root group holds the SHA-256 digest of all groups, names, dims, types, values
and attributes. The Fletcher-32 filter of HDF5 would not do: it applies neither to single numbers
nor to text nor to attributes, and a flipped bit in the index of chunks that it needs gives fill
values for a whole array (8 of 6,000 flips). The digest is computed from the written file, so that
a type which netCDF stores as another one makes no difference.
"""

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from polar_bayes.errors import PolarBayesError
from polar_bayes.paths import system_error

CHECKSUM = "polar_bayes_checksum"
"""Root attribute of a file that holds its digest; no data in memory have it."""


def read_netcdf[Data: (xr.Dataset, xr.DataTree)](
    kind: type[Data], file: Path, broken: PolarBayesError
) -> Data:
    """Read a file whole, and verify its checksum where it has one.

    Args:
        kind: What to read: the root group alone, or the tree of all groups.
        file: The path of a file that is there.
        broken: What to raise where it cannot be read.

    Returns:
        The data in memory, without the attribute of the checksum; the file is closed.

    Raises:
        CaptureError: The operating system does not allow to read it.
        PolarBayesError: `broken`; or one of its type, where the file is not what was written.
    """
    try:
        with open_netcdf(kind, file) as opened:
            data = opened.load()
            expected = data.attrs.pop(CHECKSUM, None)
        # A dataset is the root group alone, the digest that of all groups.
        is_whole = expected in (None, _checksum(data)) or expected == _checksum_of(file)
    except PermissionError as error:
        raise system_error(error, file) from error
    except Exception as error:  # the libraries below raise nearly every type for a broken file
        raise broken from error
    if not is_whole:
        raise type(broken)(
            "its checksum is wrong: it was damaged, or edited outside polar_bayes",
            where=str(file),
            mend=f"restore it from a copy, or after an edit delete its attribute {CHECKSUM}",
        )
    return data


def write_netcdf(data: xr.Dataset | xr.DataTree, path: Path) -> None:
    """Write a netCDF-4 file with a checksum, at a path that `polar_bayes.paths.replacing` gives."""
    data.to_netcdf(path, engine="netcdf4", format="NETCDF4")
    attribute = {CHECKSUM: _checksum_of(path)}
    xr.Dataset(attrs=attribute).to_netcdf(path, engine="netcdf4", mode="a")


def open_netcdf(kind: type, file: Path) -> Any:
    """The data of a file, read when they are needed; a context that closes it."""
    open_file = xr.open_datatree if kind is xr.DataTree else xr.open_dataset
    # Absolute, so that netCDF takes no path for an address; times stay the numbers they are.
    return open_file(file.absolute(), engine="netcdf4", decode_times=False)


def _checksum_of(file: Path) -> str:
    """The digest of all groups of a file, of which a dataset is the first."""
    with open_netcdf(xr.DataTree, file) as tree:
        return _checksum(tree)


def _checksum(data: xr.Dataset | xr.DataTree) -> str:
    """The digest of everything but itself; no version of a library changes it."""
    groups = {".": data} if isinstance(data, xr.Dataset) else dict(data.subtree_with_keys)
    digest = hashlib.sha256()
    for path, group in sorted(groups.items()):
        for part in _parts(group if isinstance(group, xr.Dataset) else group.to_dataset(False)):
            digest.update(repr((path, part)).encode("utf-8", "backslashreplace"))
    return digest.hexdigest()


def _parts(dataset: xr.Dataset) -> Iterator[object]:
    yield _attributes(dataset.attrs)
    for name, variable in sorted(dataset.variables.items(), key=lambda item: str(item[0])):
        values = variable.values
        if values.dtype.kind in "OSUT":
            kind, content = "text", repr(_plain(values)).encode("utf-8", "backslashreplace")
        else:
            kind = values.dtype.name
            content = values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
        content_digest = hashlib.sha256(content).hexdigest()
        attributes = _attributes(variable.attrs)
        yield str(name), variable.dims, variable.shape, kind, attributes, content_digest


def _attributes(attributes: Mapping[Any, Any]) -> list[tuple[str, list[Any]]]:
    return [(key, _plain(x)) for key, x in sorted(attributes.items()) if key != CHECKSUM]


def _plain(value: Any) -> list[Any]:
    """Numbers or text in types of Python's own."""
    return np.asarray(value).ravel().tolist()
