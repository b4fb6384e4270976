"""Calibrations in netCDF files, and what they hold."""

import os

import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.inference.files import (
    ANY,
    COMMON_PROVENANCE,
    EACH,
    FLAGS,
    TEXT,
    Group,
    Like,
    Schema,
    holds,
    load_tree,
)
from polar_bayes.inference.psis import LEVELS

_SIMULATION = ("simulation",)
_RANKS = Group(_SIMULATION, extra_dims=False)

CALIBRATION = Schema(
    kind="calibration",
    made_by="polar_bayes.calibrate or load_calibration",
    command="`polar-bayes calibrate`",
    groups={
        "prior_sbc": Group(_SIMULATION, required=True),
        "truth": Group(_SIMULATION, required=True, like=Like("prior_sbc", {"": ()}, required=True)),
        "marginals": Group(
            _SIMULATION,
            required=True,
            variables={"quantile": ("quantile",)},
            like=Like(
                "prior_sbc",
                {"": (), "_sd": (), "_crps": (), "_quantile": ("quantile",)},
                required=True,
            ),
        ),
        "fits": Group(
            required=True,
            variables={"status": _SIMULATION},
            kinds={"status": FLAGS, "approach": FLAGS},
            names=("status", "approach", "effective_draws", "pareto_k"),
            dims=_SIMULATION,
            extra_dims=False,
            variable_attributes={"flag_meanings?": TEXT},
        ),
        "predictive_pit": _RANKS,
        "loo_pit": Group(
            _SIMULATION, extra_dims=False, like=Like("predictive_pit", {"": ()}, required=True)
        ),
        "readings": Group(
            _SIMULATION,
            extra_dims=False,
            like=Like("predictive_pit", {"_pareto_k": ()}, required=True),
        ),
    },
    provenance={**COMMON_PROVENANCE, "truth?": {EACH: ANY}, "readings_told?": TEXT},
)


def is_calibration(tree: object) -> bool:
    """Whether a tree is what `polar_bayes.calibrate` returns."""
    return CALIBRATION.describes(tree)


def check_calibration(tree: xr.DataTree, source: str = "calibration") -> None:
    """Refuse what is no calibration, or does not hold together."""
    CALIBRATION.check(tree, source)
    levels = tree["marginals"].to_dataset()["quantile"].to_numpy().tolist()
    if missing := [level for level in LEVELS if levels.count(level) != 1]:
        raise FitError(
            f"the level {missing[0]} is not there once",
            where=f"{source}: marginals/quantile",
            hint=f"give the tree as {CALIBRATION.made_by} returned it",
        )
    groups = {"predictive_pit", "loo_pit", "readings"}
    if (there := groups & set(tree.children)) and there != groups:
        raise FitError(
            f"it has no group {min(groups - there)}",
            where=source,
            hint=f"give the tree as {CALIBRATION.made_by} returned it, or drop {min(there)}",
        )


def holds_calibration(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds a calibration; its numbers are not read.

    Args:
        path: Any file.

    Returns:
        False where it is not there, cannot be read, or holds something else.

    Raises:
        Nothing.
    """
    return holds(path, CALIBRATION)


def load_calibration(path: str | os.PathLike[str]) -> xr.DataTree:
    """A calibration from a netCDF file.

    Args:
        path: A file that `polar-bayes calibrate` or `polar_bayes.save_result` wrote.

    Returns:
        The tree, in memory; the file is closed.

    Raises:
        CaptureError: The file is not there.
        FitError: It was damaged, or holds no calibration; the group and variable that is wrong.
    """
    tree = load_tree(path, CALIBRATION)
    check_calibration(tree, str(path))
    return tree
