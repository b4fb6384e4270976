"""Accuracy studies in netCDF files, and what they hold."""

import dataclasses
import os

import xarray as xr

from polar_bayes.inference.files import ACCURACY, OF_ALL, holds, load_tree
from polar_bayes.inference.schema import Schema

STUDY = Schema(
    kind="accuracy study",
    made_by="polar_bayes.accuracy or load_accuracy",
    command="`polar-bayes accuracy`",
    groups={"accuracy": dataclasses.replace(ACCURACY, needed=True)},
    provenance=OF_ALL,
)


def is_accuracy(tree: object) -> bool:
    """Whether a tree is what `polar_bayes.accuracy` returns, and no fit."""
    return STUDY.describes(tree)


def holds_accuracy(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds an accuracy study; its numbers are not read.

    Args:
        path: Any file.

    Returns:
        False where it is not there, cannot be read, or holds something else.

    Raises:
        Nothing.
    """
    return holds(path, STUDY)


def load_accuracy(path: str | os.PathLike[str]) -> xr.DataTree:
    """An accuracy study from a netCDF file.

    Args:
        path: A file that `polar-bayes accuracy` or `polar_bayes.save_result` wrote.

    Returns:
        The tree, in memory; the file is closed.

    Raises:
        CaptureError: The file is not there.
        FitError: It was damaged, or holds no accuracy study; the variable that is wrong.
    """
    return load_tree(path, STUDY)
