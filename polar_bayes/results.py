"""Results of every kind: `summary`, `verdict`, `save` and `load`."""

import dataclasses
import os
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.benchmark.advice import STUDY, accuracy_sentences, accuracy_table, accuracy_view
from polar_bayes.calibration.scores import is_calibrated
from polar_bayes.calibration.verdict import (
    CALIBRATION,
    calibration_table,
    calibration_verdict,
    calibration_view,
    check_calibration,
)
from polar_bayes.capture.files import is_result, read_netcdf, write_netcdf
from polar_bayes.diagnostics import convergence
from polar_bayes.diagnostics.convergence import Verdict, setup_cautions
from polar_bayes.diagnostics.coverage import map_scalars
from polar_bayes.errors import FitError, OutputError
from polar_bayes.frames import PrintedFrame
from polar_bayes.inference.batching import Status
from polar_bayes.inference.files import FIT, check_fit, in_present_names
from polar_bayes.inference.result import provenance_of
from polar_bayes.maps.lazy import count_pixels, criticism_sentences, open_map
from polar_bayes.paths import as_path, atomic_write, existing_file

MIN_GOOD_SHARE = 0.95
"""Share of pixels with readings that must have an answer for a map to pass."""

type Capture = xr.Dataset
type Fit = xr.DataTree
type Result = xr.DataTree | xr.Dataset
"""A result of any kind."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of result: name, recognition, table, verdict, check and reports.

    The reports are the constant `REPORT` of that file of `polar_bayes.reporting`, which is loaded
    when it is used; a kind without has neither page nor figure.
    """

    name: str
    applies: Callable[[Any], bool]
    summary: Callable[[Any], pd.DataFrame]
    verdict: Callable[[Any], Verdict]
    check: Callable[[Any, str], None] = lambda result, source: None
    reports: str = ""


def _describing(name: str, variable: str, source: str) -> Kind:
    """Return a descriptive kind, without verdict, from two functions of its file."""

    # That file computes with JAX, and is loaded for a result of this kind only.
    def call(what: str, result: object) -> Any:
        return pkgutil.resolve_name(f"polar_bayes.{source}_{what}")(result)

    return Kind(
        name,
        applies=lambda result: isinstance(result, xr.Dataset) and variable in result,
        summary=lambda result: call("table", result),
        verdict=lambda result: Verdict(True, (), (), tuple(call("sentences", result))),
    )


def _calibration_verdict(calibration: xr.DataTree) -> Verdict:
    view = calibration_view(calibration)
    sentences, passed = tuple(calibration_verdict(view)), is_calibrated(view.table)
    return Verdict(passed, () if passed else sentences, (), sentences if passed else ())


def _accuracy_verdict(study: Result) -> Verdict:
    view = accuracy_view(study)
    problems = (f"The reference is in doubt: {view.doubts}.",) if view.doubts else ()
    return Verdict(not view.doubts, problems, (), tuple(accuracy_sentences(view)))


def _map_summary(maps: xr.Dataset) -> pd.DataFrame:
    """Summarize good pixels: mean and sd of posterior means, and median posterior sd."""
    good = (maps["status"] == Status.GOOD).to_numpy()
    rows = {}
    for scalar in map_scalars(maps):
        mean, sd = (
            np.asarray(maps[name].isel(dict(scalar.index)), float)[good]
            for name in (scalar.name, f"{scalar.name}_sd")
        )
        rows[scalar.label] = (
            (mean.mean(), mean.std(), np.median(sd)) if mean.size else (np.nan,) * 3
        )
    columns = ["mean", "sd_over_pixels", "median_sd"]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns)


def _map_verdict(maps: xr.Dataset) -> Verdict:
    counts = count_pixels(maps)
    total, good = sum(counts.values()), counts["good"]
    read = total - counts["masked"]
    passed = good > 0 and good >= MIN_GOOD_SHARE * read
    sentence = f"{good:,} of {read:,} pixels that were read have a good posterior."
    others = tuple(
        f"{number:,} pixels are {status}."
        for status, number in counts.items()
        if number and status not in ("good", "contradicted")
    )
    others += tuple(criticism_sentences(maps))
    return Verdict(passed, () if passed else (sentence,), others, (sentence,) if passed else ())


KINDS = (
    Kind("accuracy", STUDY.describes, accuracy_table, _accuracy_verdict, STUDY.check, "accuracy"),
    Kind(
        "calibration",
        CALIBRATION.describes,
        calibration_table,
        _calibration_verdict,
        check_calibration,
        "calibration_page",
    ),
    Kind(
        "map",
        lambda result: isinstance(result, xr.Dataset) and "status" in result,
        _map_summary,
        _map_verdict,
        reports="maps",
    ),
    _describing("profile", "prior_beyond", "design.profile:profile"),
    _describing("identification", "prior_share", "design.identify:identifiability"),
    _describing("next views", "interval_width", "design.next_views:next_views"),
    _describing("effects", "kept", "scenes.effects:ledger"),
    Kind(
        "several fits",
        lambda result: (
            isinstance(result, Mapping) and not isinstance(result, xr.DataTree | xr.Dataset)
        ),
        convergence.summary,  # refuses them, with a hint
        convergence.verdict,
        reports="comparison",
    ),
    Kind("fit", FIT.describes, convergence.summary, convergence.verdict, check_fit, "fit_page"),
)
"""Kinds of results in the order of their tests."""


def kind_of(result: object) -> Kind:
    """Return the kind of a result; unknown trees count as fits, which refuse them."""
    return next((kind for kind in KINDS if kind.applies(result)), KINDS[-1])


def summary(result: Result) -> pd.DataFrame:
    """Return the table of a result of any kind, with all columns and numbers unrounded.

    Args:
        result: What `polar_bayes.fit`, `fit_pixels`, `calibrate`, `accuracy`, `identify`,
            `profile` or `next_views` returned, the `ledger` of `choose_effects`, or one of them
            read back from a file.

    Returns:
        Of a fit: a row for each scalar parameter with mean, sd, q2.5, q97.5 (unit of the
        parameter), r_hat, ess_bulk, ess_tail (unit 1) and mcse_mean; intervals are equal-tailed. A
        point fit has standard errors in `sd` and NaN elsewhere. Of a map: a row for each parameter
        over the good pixels. Of a calibration: coverage and ranks of each parameter. Of an accuracy
        study: the errors and times of each method. Of the others: a row for each parameter, grid
        value, view or effect.

    Raises:
        FitError: It is no result, or its parts do not fit together.

    Source:
        Vehtari et al. (2021), Bayesian Analysis 16(2): rank-normalized split R-hat and ESS.
    """
    return PrintedFrame(kind_of(result).summary(result))


def verdict(result: Result) -> Verdict:
    """Judge whether the numbers of a result may be used, and what follows from them.

    A fit by sampling fails on any R-hat above 1.01, any effective sample size below 400 and any
    divergence; every method fails on a draw that is not finite or that its prior or physics rules
    out, on draws of a parameter that are all equal, and on a problem that the fit itself noted. A
    calibration fails where ranks are not uniform, a map where fewer than 95% of the pixels read
    have an answer that their readings bear out, an accuracy study where its reference is in doubt.
    The other kinds describe and do not fail.

    Args:
        result: As for `summary`.

    Returns:
        `passed`, and sentences: `problems`, `cautions` and `findings`.

    Raises:
        FitError: It is no result, or its parts do not fit together.
    """
    kind = kind_of(result)
    judged = kind.verdict(result)
    if kind.name == "fit":
        return judged
    cautions = (*setup_cautions(provenance_of(result)), *judged.cautions)
    return dataclasses.replace(judged, cautions=cautions)


def save(result: Result, path: str | os.PathLike[str]) -> None:
    """Write a result of any kind to a netCDF-4 file with a checksum, which `load` verifies.

    Args:
        result: As for `summary`.
        path: The file; an older one is replaced when the new one is complete, and its mode kept.

    Raises:
        FitError: It is no result, or netCDF cannot hold it.
        OutputError: The file cannot be written, or is none that may be replaced.
    """
    if not isinstance(result, xr.DataTree | xr.Dataset):
        what = f"a {type(result).__name__} is no result"
        raise FitError(what, where="save", hint="give what polar_bayes.fit returned")
    with atomic_write(path, is_result) as unfinished:
        try:
            write_netcdf(result, unfinished)
        except (OSError, RuntimeError, OutputError):
            raise
        except Exception as error:  # xarray raises nearly every type for what it cannot encode
            what = f"netCDF cannot hold it ({error or type(error).__name__})"
            raise FitError(what, where="save", hint="store numbers and text only") from error


def load(path: str | os.PathLike[str], kind: str | None = None) -> Any:
    """Read a result of any kind from the file of `save`, or a map from its Zarr store.

    Args:
        path: A netCDF file, or the folder of a store (its name ends in .zarr).
        kind: Refuse other kinds: "fit", "calibration", "accuracy", "map", "profile",
            "identification", "next views" or "effects".

    Returns:
        A DataTree (fit, calibration, accuracy) or a Dataset, in memory and the file closed; the
        values of a Zarr store are read when they are needed.

    Raises:
        CaptureError: The file is not there.
        FitError: It was damaged, holds no such result, or its parts do not fit together; the group
            and variable that is wrong.
    """
    wanted = kind or "result"
    result, source = _read(path, wanted)
    found = kind_of(result)
    if not found.applies(result) or kind not in (None, found.name):
        hint = "give the file that polar_bayes.save or a command wrote"
        raise FitError(f"it holds no {wanted}", where=source, hint=hint)
    found.check(result, source)
    return result


def _read(path: str | os.PathLike[str], wanted: str) -> tuple[Result, str]:
    """Return a tree, or a dataset without groups, from a path, and the path as text."""
    if as_path(path, wanted).suffix == ".zarr":
        return open_map(path), str(path)
    file = existing_file(path, wanted)
    hint = "give the file that polar_bayes.save or a command wrote"
    broken = FitError("it cannot be read as netCDF", where=str(file), hint=hint)
    tree = in_present_names(read_netcdf(xr.DataTree, file, broken))
    return (tree if tree.children else tree.to_dataset()), str(file)
