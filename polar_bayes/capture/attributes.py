"""Attributes that every file format can hold: text and numbers, nothing else."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from polar_bayes.errors import CaptureError

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.+-]{0,99}")

# xarray gives these a meaning of its own when it writes netCDF.
RESERVED = frozenset({"add_offset", "coordinates", "dtype", "missing_value", "scale_factor"})


def clean_attributes(attributes: Mapping[Any, Any], where: str) -> dict[str, str | int | float]:
    """Attributes as plain text and numbers, so that a file gives back what was saved."""
    # Numbers become Python numbers, truth values 0 or 1; bytes and arrays of numbers or text are
    # kept as text.
    return {
        _clean_name(name, where): _clean_value(value, f"{where}: attribute {name}")
        for name, value in attributes.items()
    }


def _clean_name(name: object, where: str) -> str:
    if isinstance(name, str) and NAME.fullmatch(name) and name not in RESERVED:
        return name
    raise CaptureError(
        f"the attribute name {name!r} cannot be stored",
        where=where,
        mend="rename it: a letter, then letters, digits or any of _ . + -",
    )


def _clean_value(value: object, where: str) -> str | int | float:
    if isinstance(value, bytes):
        return _clean_text(value.decode("utf-8", "backslashreplace"))
    if isinstance(value, str):
        return _clean_text(value)
    if isinstance(value, int) and not isinstance(value, bool):
        return int(value) if -(2**63) <= value < 2**63 else str(value)
    if not isinstance(value, bool | float | list | tuple | np.generic | np.ndarray):
        raise _not_storable(value, where)
    try:
        array = np.asarray(value)
    except ValueError:  # nested lists of unequal length
        raise _not_storable(value, where) from None
    if array.dtype.kind not in "biufSU":
        raise _not_storable(value, where)
    if array.ndim:
        return _clean_text(str(array.tolist()))
    item = array.astype(np.int64).item() if array.dtype.kind == "b" else array.item()
    return _clean_value(item, where) if isinstance(item, str | bytes | int) else float(item)


def _clean_text(text: str) -> str:
    """Text that UTF-8 and C strings can hold: lone surrogates and NUL are escaped."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8").replace("\0", "\\x00")


def _not_storable(value: object, where: str) -> CaptureError:
    return CaptureError(
        f"the value is a {type(value).__name__}, neither a number nor text",
        where=where,
        mend="give a number or text, for instance JSON",
    )
