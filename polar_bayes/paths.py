"""Checks of paths, and atomic writes.

Every file that the package writes goes through `check_output`: it never replaces an input, a
device, a folder or a file of another kind. It is written to a temporary folder next to the output,
synced to the disk, renamed, and the folder is synced: a process that dies at any moment leaves the
older file or the new one, never a part.
"""

import contextlib
import os
import shutil
import stat
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import platformdirs

from polar_bayes.errors import CaptureError, OutputError, PolarBayesError
from polar_bayes.interrupts import on_interrupt

PathLike = str | os.PathLike[str]

TEMPORARY_PREFIX = ".polar-bayes-"
"""Prefix of temporary folders of unfinished outputs."""


def as_path(path: PathLike, what: str, error: type[PolarBayesError] = CaptureError) -> Path:
    """Return a path from a user's argument, not resolved."""
    try:
        text = os.fspath(path)
    except TypeError:
        text = None
    if not isinstance(text, str) or not text or "\0" in text:
        raise error(f"{path!r} is not a path", where=what, hint="give the path of a file")
    return Path(text)


def existing_file(path: PathLike, what: str) -> Path:
    """Return the path of an existing, non-empty file, not resolved."""
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
    """Convert an error of the operating system about an input to one line."""
    reason = (error.strerror or str(error)).lower()
    return CaptureError(reason, where=str(path), hint="check the path, its rights and the disk")


def check_output(
    path: PathLike, replaces: Callable[[Path], bool], inputs: Iterable[PathLike] = ()
) -> Path:
    """Return the resolved path of an output; refuse one that must not be written."""
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
            hint = "give another path, or remove it first"
            raise OutputError("the file there holds something else", where=where, hint=hint)
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except (OSError, RuntimeError) as error:  # RuntimeError: a cycle of links
        raise output_error(error, given) from error
    return file


def refuse_inputs(path: Path, inputs: Iterable[PathLike]) -> None:
    """Refuse an output that is one of the inputs, or lies inside one."""
    for each in map(Path, inputs):
        inside = each.is_dir() and any(is_same_file(up, each) for up in path.resolve().parents)
        if inside or is_same_file(path, each):
            what = f"it {'lies inside' if inside else 'is'} one of the inputs"
            raise OutputError(what, where=str(path), hint="give another path to write")


def is_same_file(one: Path, other: Path) -> bool:
    """Return whether two paths name one file, through any links; neither must exist."""
    try:
        return one.samefile(other)
    except OSError:
        return one.resolve() == other.resolve()


def output_error(error: Exception, path: Path) -> OutputError:
    """Convert an error of the system or a library about an output to one line."""
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    what = f"it could not be written ({reason.lower()})"
    hint = "check the path, its rights and the room on the disk"
    return OutputError(what, where=str(path), hint=hint)


@contextlib.contextmanager
def atomic_write(path: PathLike, replaces: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield a temporary path, whose file replaces `path` if the block ends without error."""
    file = check_output(path, replaces)
    with write_errors(file), temporary_folder(file.parent) as folder:
        yield folder / file.name
        replace_file(folder / file.name, file)


def replace_file(unfinished: Path, file: Path) -> None:
    """Replace a file by a finished one: synced, and with the mode of the older file."""
    if file.exists():
        unfinished.chmod(stat.S_IMODE(file.stat().st_mode))
    sync(unfinished)
    unfinished.replace(file)
    sync(file.parent)


@contextlib.contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Convert errors of the operating system and libraries to `OutputError`."""
    try:
        yield
    except (OSError, RuntimeError, UnicodeError) as error:  # RuntimeError: netCDF, of a full disk
        raise output_error(error, path) from error


@contextlib.contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a temporary folder, removed at the end and by an interrupt."""
    with tempfile.TemporaryDirectory(dir=parent, prefix=TEMPORARY_PREFIX) as made:
        folder = Path(made)

        def remove() -> None:
            # Threads that still write there find no folder, so they add no files meanwhile.
            hidden = folder.rename(folder.with_name(f"{folder.name}-"))
            shutil.rmtree(hidden, ignore_errors=True)

        with on_interrupt(remove):
            yield folder


def sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    if path.is_dir() and os.name != "posix":
        return  # only POSIX systems open folders
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


# --- The folder of compiled programs --------------------------------------------------------------


def compiled_folder() -> Path:
    """Return the default folder of compiled programs."""
    return platformdirs.user_cache_path("polar_bayes") / "compiled"


def make_private(folder: Path) -> str:
    """Create a folder; explain why others could write to it, or return an empty text."""
    ours = (folder.parent, folder)
    try:
        folder.parent.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        for each in ours:
            each.mkdir(mode=0o700, exist_ok=True)
        if os.name != "posix":
            return ""
        for each in (folder.parent.parent, *ours):
            found = each.stat()
            shared = each not in ours and found.st_mode & stat.S_ISVTX  # such as /tmp
            if found.st_uid != os.getuid() and (each in ours or found.st_uid != 0):
                return f"{each} belongs to another user"
            if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not shared:
                return f"other users can write to {each}"
    except OSError as error:
        return f"it cannot be used ({(error.strerror or str(error)).lower()})"
    return ""


# --- Scene files ----------------------------------------------------------------------------------

SCENE_KEYS = (
    *("setup", "quantities", "model", "method", "largest_view_zenith"),
    *("scene", "links", "priors"),
)
"""Keys that a scene file may have (`polar_bayes.load_scene`)."""


def is_scene_file(path: Path) -> bool:
    """Return whether a file is TOML with the keys of a scene file."""
    try:
        return set(tomllib.loads(path.read_text("utf-8"))) <= set(SCENE_KEYS)
    except (OSError, ValueError):
        return False
