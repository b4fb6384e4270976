"""Where compiled programs are kept between runs: a folder that nobody else can write to.

A compiled program is native code that the next run loads, so whoever can write it can run it.
"""

import os
import stat
from pathlib import Path

import click
import platformdirs

FOLDER = "JAX_COMPILATION_CACHE_DIR"
OTHERS = stat.S_IWGRP | stat.S_IWOTH


def keep_compiled_programs() -> None:
    """Keep compiled programs between runs; a second run of the same fit compiles nothing."""
    # The folder that the user gives by JAX_COMPILATION_CACHE_DIR is used as it is. The own one is
    # not used where other users could write to it; one line on stderr says so.
    if FOLDER not in os.environ:
        folder = platformdirs.user_cache_path("polar_bayes") / "compiled"
        doubt = _doubt(folder)
        if doubt:
            hint = f"mend that, or set {FOLDER} to a folder of your own"
            click.echo(f"{folder}: compiled programs are not kept: {doubt}; {hint}", err=True)
            return
        os.environ[FOLDER] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


def _doubt(folder: Path) -> str:
    """Why others could write to the folder, which is made if it is not there; empty if not."""
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
            if found.st_mode & OTHERS and not shared:
                return f"other users can write to {each}"
    except OSError as error:
        return f"it cannot be used ({(error.strerror or str(error)).lower()})"
    return ""
