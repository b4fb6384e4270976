"""Paths as users give them, checked before anything is opened."""

import os
from pathlib import Path

from polar_bayes.errors import CaptureError


def as_path(path: str | os.PathLike[str], what: str) -> Path:
    """The path, or a clear error when it is none.

    Args:
        path: Text or a path-like object.
        what: What the path is for, such as "capture".

    Returns:
        The path, not resolved.

    Raises:
        CaptureError: It is empty, of another type, or holds a NUL.
    """
    try:
        text = os.fspath(path)
    except TypeError:
        text = None
    if not isinstance(text, str) or not text or "\0" in text:
        raise CaptureError(f"{path!r} is not a path", where=what, mend="give the path of a file")
    return Path(text)


def existing_file(path: str | os.PathLike[str], what: str) -> Path:
    """The path of a file that is there.

    Args:
        path: Text or a path-like object.
        what: What the path is for, such as "capture".

    Returns:
        The path, not resolved.

    Raises:
        CaptureError: Nothing is there, or it is a folder or a device, or it is empty.
    """
    file = as_path(path, what)
    try:
        if not file.exists():
            raise CaptureError("there is no such file", where=str(file), mend="check the path")
        if not file.is_file():
            mend = "give the path of a file"
            raise CaptureError("it is a folder or device", where=str(file), mend=mend)
        if file.stat().st_size == 0:
            raise CaptureError("the file is empty", where=str(file), mend="write it again")
    except OSError as error:
        raise system_error(error, file) from error
    return file


def system_error(error: OSError, path: Path) -> CaptureError:
    """What the operating system said, as one line.

    Args:
        error: The error that was caught.
        path: The path in question.

    Returns:
        The error to raise.
    """
    reason = (error.strerror or str(error)).lower()
    return CaptureError(reason, where=str(path), mend="check the path, its rights and the disk")
