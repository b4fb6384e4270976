"""What fits hold, and their netCDF files: one tree a file, whole or not at all."""

import os
from collections.abc import Mapping

import xarray as xr

from polar_bayes.capture.files import is_result
from polar_bayes.capture.netcdf import open_netcdf, read_netcdf, write_netcdf
from polar_bayes.errors import FitError, OutputError
from polar_bayes.inference.result import GEOMETRY, PROVENANCE
from polar_bayes.inference.schema import (
    ANY,
    BOUNDS,
    COUNT,
    DRAWS,
    EACH,
    FINITE,
    FLAG,
    FLAGS,
    OPTIONAL,
    TEXT,
    TEXTS,
    Group,
    Like,
    Schema,
    Spec,
)
from polar_bayes.paths import existing_file, replacing

OF_ALL: Mapping[str, Spec] = {
    "method?": TEXT,
    "model?": TEXT,
    "scene?": TEXT,
    "scene_parts?": TEXT,
    "seed?": FINITE,
    "priors?": {EACH: TEXT},
    "links?": {EACH: TEXT},
    "versions?": {EACH: ANY},
    "timings?": {EACH: FINITE},
}
"""Provenance that every kind of tree may have."""

_STEP = {"name": TEXT, "taken": FLAG, "why": TEXT, "seconds": FINITE, "monte_carlo?": FINITE}
OF_FIT: Mapping[str, Spec] = {
    **OF_ALL,
    "settings?": {EACH: ANY},
    "model_settings?": {EACH: ANY},
    "model_source?": TEXT,
    "bounds?": {EACH: BOUNDS},
    "declared?": {EACH: ANY},
    "fixed?": {EACH: ANY},
    "swapped?": [TEXT],
    "largest_view_zenith?": FINITE,
    "machine?": {EACH: ANY},
    "counts?": {"at_margin?": {EACH: COUNT}, EACH: COUNT},
    "problems?": [TEXT],
    "capture?": {EACH: ANY},
    "comparisons_failed?": {EACH: TEXT},
    "standard_errors?": {EACH: [OPTIONAL]},
    "modes?": {"weights?": [FINITE]},
    "k_hat?": FINITE,
    "effective_draws?": FINITE,
    "auto?": {"tolerance": FINITE, "met": FLAG, "chosen": TEXT, "steps": [_STEP]},
}

STATISTICS = (
    "acceptance_rate",
    "diverging",
    "log_weight",
    "loss",
    "reached_max_treedepth",
    "step_size",
)
"""What is read of `sample_stats`; samplers of other packages have more."""

_EFFECT, _PARAMETER, _ROW = ("effect",), ("parameter",), ("row",)
_COSTS = ("operations", "compile_seconds", "run_seconds")
_OF_LEDGER = {
    **dict.fromkeys(("effect", "path", "reason", "kept", "forced"), _EFFECT),
    **dict.fromkeys(("largest_move", "rms_move", "change", *_COSTS), _EFFECT),
    **dict.fromkeys(("shift", "sd_ratio"), (*_EFFECT, *_PARAMETER)),
    **dict.fromkeys(("parameter", "judged"), _PARAMETER),
}
LEDGER = Group(
    labeled=False,
    names=tuple(_OF_LEDGER),
    variables=_OF_LEDGER,
    kinds={
        **dict.fromkeys(("effect", "path", "parameter", "reason"), TEXTS),
        **dict.fromkeys(("kept", "forced", "judged"), FLAGS),
    },
    attributes={
        **{f"{which}_{cost}": OPTIONAL for which in ("full", "chosen") for cost in _COSTS},
        "combined_change": OPTIONAL,
        "tolerance": FINITE,
    },
)
"""The group `effects`: a ledger of `polar_bayes.choose_effects`."""

_OF_ACCURACY = {
    **dict.fromkeys(("mean_error", "sd_error", "low_error", "high_error"), (*_ROW, *_PARAMETER)),
    "wasserstein": (*_ROW, *_PARAMETER),
    **dict.fromkeys(("rung", "dial", "problems", "r_hat", "k_hat", "effective_draws"), _ROW),
    **dict.fromkeys(("gradients", "densities", "seconds_first", "seconds_again"), _ROW),
    "peak_memory": _ROW,
    "parameter": _PARAMETER,
}
ACCURACY = Group(
    labeled=False,
    names=tuple(_OF_ACCURACY),
    variables=_OF_ACCURACY,
    kinds=dict.fromkeys(("rung", "dial", "parameter", "problems"), TEXTS),
    attributes={
        "reference": TEXT,
        "reference_draws": COUNT,
        "reference_effective_draws": FINITE,
        "reference_error": FINITE,
        "reference_doubts": TEXT,
    },
)
"""The group `accuracy`: a study of `polar_bayes.accuracy`."""

_FLAGS = ("valid", "saturated", "diverging", "reached_max_treedepth")
_OF_READINGS = Group(DRAWS, tied=True, like=Like("observed_data", {"": DRAWS}))
FIT = Schema(
    kind="fit",
    made_by="polar_bayes.fit or load_result",
    command="`polar-bayes fit`",
    groups={
        "posterior": Group(DRAWS, needed=True, tied=True),
        "unconstrained_posterior": Group(DRAWS, tied=True, labeled=False),
        "prior": Group(DRAWS),
        "sample_stats": Group(
            DRAWS, others=False, tied=True, kinds=dict.fromkeys(_FLAGS, FLAGS), names=STATISTICS
        ),
        "log_prior": Group(DRAWS, tied=True, labeled=False),
        "observed_data": Group(never=DRAWS, marks={"saturation_level?": FINITE}),
        "posterior_predictive": _OF_READINGS,
        "noise_free": _OF_READINGS,
        "log_likelihood": _OF_READINGS,
        "prior_predictive": Group(DRAWS, like=Like("observed_data", {"": DRAWS})),
        "constant_data": Group(
            kinds=dict.fromkeys(_FLAGS, FLAGS),
            names=(*GEOMETRY, *_FLAGS, "true_*"),
            inside=dict.fromkeys((*GEOMETRY, *_FLAGS), "observed_data"),
        ),
        "without_discrepancy": Group(DRAWS, labeled=False),
        "without_instrument": Group(DRAWS, labeled=False),
        "effects": LEDGER,
        "accuracy": ACCURACY,
    },
    provenance=OF_FIT,
)
"""What is read of a fit."""


def check_fit(result: xr.DataTree, source: str = "result") -> None:
    """Refuse what is no fit, or does not hold together."""
    FIT.check(result, source)


def load_result(path: str | os.PathLike[str]) -> xr.DataTree:
    """A result from a netCDF file.

    Args:
        path: A file that `save_result` wrote.

    Returns:
        The tree, in memory; the file is closed.

    Raises:
        CaptureError: The file is not there.
        FitError: It was damaged, or is not a result; the group and variable that is wrong.
    """
    return load_tree(path, FIT)


def load_tree(path: str | os.PathLike[str], schema: Schema) -> xr.DataTree:
    """A tree of one kind from a netCDF file."""
    file = existing_file(path, schema.kind)
    mend = f"give the file that {schema.command} or save_result wrote"
    broken = FitError("it cannot be read as netCDF", where=str(file), mend=mend)
    tree = read_netcdf(xr.DataTree, file, broken)
    if not schema.describes(tree) or PROVENANCE not in tree.attrs:
        raise FitError(f"it holds no {schema.kind}", where=str(file), mend=mend)
    schema.check(tree, str(file))
    return tree


def holds(path: str | os.PathLike[str], schema: Schema) -> bool:
    """Whether a file holds a tree of one kind; its numbers are not read."""
    try:
        with open_netcdf(xr.DataTree, existing_file(path, schema.kind)) as tree:
            return schema.describes(tree)
    except Exception:  # the libraries below raise nearly every type for a broken file
        return False


def save_result(result: xr.DataTree | xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a result to a netCDF-4 file, beside its place first and then moved there.

    A checksum goes with it, which `load_result` verifies.

    Args:
        result: A tree that `polar_bayes.fit`, `calibrate` or `accuracy` returned, or a dataset of
            another function of this package.
        path: The file; an older one is replaced and its mode kept.

    Raises:
        FitError: It is neither, or netCDF cannot hold it.
        OutputError: The file cannot be written, or is none that may be replaced.
    """
    if not isinstance(result, xr.DataTree | xr.Dataset):
        what = f"a {type(result).__name__} is no result"
        raise FitError(what, where="save_result", mend="give what polar_bayes.fit returned")
    with replacing(path, is_result) as unfinished:
        try:
            write_netcdf(result, unfinished)
        except (OSError, RuntimeError, OutputError):
            raise
        except Exception as error:  # xarray raises nearly every type for what it cannot encode
            what = f"netCDF cannot hold it ({error or type(error).__name__})"
            mend = "store numbers and text only"
            raise FitError(what, where="save_result", mend=mend) from error
