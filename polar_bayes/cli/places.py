"""Where commands write, and in which set-up they read."""

import tempfile
from pathlib import Path
from typing import Any

import polar_bayes as pb


def in_setup(capture: Any, setup: str | None) -> Any:
    """The capture as if it named that set-up, so that scene, links and limits fit together."""
    return capture if setup is None else capture.assign_attrs(setup=setup)


def check_writable(path: Path) -> None:
    """Refuse a place that cannot be written before minutes are spent, not after."""
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise pb.FitError(
            f"cannot write there ({error.strerror})",
            where=str(path),
            mend="give --out in a folder that exists and is writable",
        ) from error


def make_folder(path: Path) -> None:
    """A folder to write in, made if it is not there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise pb.FitError(
            f"cannot make the folder ({error.strerror})", where=str(path), mend="give another --out"
        ) from error
    check_writable(path / "capture.nc")
