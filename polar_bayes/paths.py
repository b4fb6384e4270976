"""Paths as users give them, and outputs that are written whole or not at all.

Every file that the package writes goes through `check_output`: it never takes the place of an
input, a device, a folder or a file of another kind. It is written beside its place, synced to the
disk, renamed, and the folder is synced: a process that dies at any moment leaves the older file or
the new one, never a part.
"""

import contextlib
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from polar_bayes.errors import CaptureError, OutputError, PolarBayesError
from polar_bayes.interrupts import on_interrupt

PathLike = str | os.PathLike[str]

UNFINISHED = ".polar-bayes-"
"""Prefix of the folders in which unfinished outputs stand, beside their place."""


def as_path(path: PathLike, what: str, error: type[PolarBayesError] = CaptureError) -> Path:
    """The path, not resolved, or a clear error when it is none."""
    try:
        text = os.fspath(path)
    except TypeError:
        text = None
    if not isinstance(text, str) or not text or "\0" in text:
        raise error(f"{path!r} is not a path", where=what, hint="give the path of a file")
    return Path(text)


def existing_file(path: PathLike, what: str) -> Path:
    """The path of a file that is there, not resolved."""
    file = as_path(path, what)
    try:
        if not file.exists():
            raise CaptureError("there is no such file", where=str(file), hint="check the path")
        if not file.is_file():
            hint = "give the path of a file"
            raise CaptureError("it is a folder or device", where=str(file), hint=hint)
        if file.stat().st_size == 0:
            raise CaptureError("the file is empty", where=str(file), hint="write it again")
    except OSError as error:
        raise system_error(error, file) from error
    return file


def system_error(error: OSError, path: Path) -> CaptureError:
    """What the operating system said of an input, as one line."""
    reason = (error.strerror or str(error)).lower()
    return CaptureError(reason, where=str(path), hint="check the path, its rights and the disk")


def check_output(
    path: PathLike, replaces: Callable[[Path], bool], inputs: Iterable[PathLike] = ()
) -> Path:
    """Refuse an output that cannot be written, or must not be, before anything is computed."""
    given = as_path(path, "output", OutputError)
    where = str(given)
    try:
        file = given.resolve(strict=False)
        refuse_inputs(given, inputs)
        if file.is_dir():
            raise OutputError("it is a folder", where=where, hint="give the path of a file")
        if file.exists() and not file.is_file():
            raise OutputError("it is no regular file", where=where, hint="give the path of a file")
        if not file.parent.is_dir():
            raise OutputError("its folder is not there", where=where, hint="make the folder first")
        if file.exists() and file.stat().st_size and not replaces(file):
            raise OutputError(
                "the file there holds something else",
                where=where,
                hint="give another path, or remove it first",
            )
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except (OSError, RuntimeError) as error:  # RuntimeError: a circle of links
        raise output_error(error, given) from error
    return file


def refuse_inputs(path: Path, inputs: Iterable[PathLike]) -> None:
    """Refuse an output that is one of the inputs, or lies inside one."""
    for each in map(Path, inputs):
        inside = each.is_dir() and any(is_same_place(up, each) for up in path.resolve().parents)
        if inside or is_same_place(path, each):
            raise OutputError(
                f"it {'lies inside' if inside else 'is'} one of the inputs",
                where=str(path),
                hint="give another path to write",
            )


def is_same_place(one: Path, other: Path) -> bool:
    """Whether two paths name one file, by whatever links; neither has to be there."""
    try:
        return one.samefile(other)
    except OSError:
        return one.resolve() == other.resolve()


def output_error(error: Exception, path: Path) -> OutputError:
    """What the operating system or a library said of an output, as one line."""
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return OutputError(
        f"it could not be written ({reason.lower()})",
        where=str(path),
        hint="check the path, its rights and the room on the disk",
    )


@contextlib.contextmanager
def replacing(path: PathLike, replaces: Callable[[Path], bool]) -> Iterator[Path]:
    """A path to write to; its file replaces `path` when the block ends without error."""
    file = check_output(path, replaces)
    with written(file), unfinished_folder(file.parent) as folder:
        yield folder / file.name
        move_into_place(folder / file.name, file)


def move_into_place(unfinished: Path, file: Path) -> None:
    """Put a finished file where it belongs: synced, with the mode of the file that it replaces."""
    if file.exists():
        unfinished.chmod(stat.S_IMODE(file.stat().st_mode))
    sync(unfinished)
    unfinished.replace(file)
    sync(file.parent)


@contextlib.contextmanager
def written(path: Path) -> Iterator[None]:
    """What goes wrong while an output is written, as one line."""
    try:
        yield
    except (OSError, RuntimeError, UnicodeError) as error:  # RuntimeError: netCDF, of a full disk
        raise output_error(error, path) from error


@contextlib.contextmanager
def unfinished_folder(beside: Path) -> Iterator[Path]:
    """A new folder for what is not finished, removed in the end, by an interrupt too."""
    with tempfile.TemporaryDirectory(dir=beside, prefix=UNFINISHED) as made:
        folder = Path(made)

        def remove() -> None:
            # Threads that still write there find no folder, so they add nothing to what is removed.
            hidden = folder.rename(folder.with_name(f"{folder.name}-"))
            shutil.rmtree(hidden, ignore_errors=True)

        with on_interrupt(remove):
            yield folder


def sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    if path.is_dir() and os.name != "posix":
        return  # only POSIX systems open folders
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
