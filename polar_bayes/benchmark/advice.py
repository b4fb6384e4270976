"""Table, Pareto front and sentences of an accuracy study."""

import dataclasses

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.inference.files import ACCURACY, COMMON_PROVENANCE, FIT, Schema

AS_GIVEN = "as given"
STUDY = Schema(
    kind="accuracy study",
    made_by="polar_bayes.accuracy or load",
    command="`polar-bayes accuracy`",
    groups={"accuracy": dataclasses.replace(ACCURACY, required=True)},
    provenance=COMMON_PROVENANCE,
)

RESOLVED = 2.0
"""Standard errors of the reference from which an error counts as different from 0."""

MUCH_FASTER = 2.0
"""Ratio of times from which a method is advised for most parameters alone."""

FASTER = 1.2
"""Ratio of times below which they count as equal: times differ so from run to run."""

TOLERANCE = 0.1
TIMES = ("seconds_first", "seconds_again")
NUMBERS = (
    *("r_hat", "k_hat", "effective_draws", "gradients", "densities"),
    *(*TIMES, "peak_memory"),
)
TEXTS = ("method", "override", "problems")


def accuracy_dataset(result: xr.DataTree | xr.Dataset) -> xr.Dataset:
    """The group `accuracy` of a tree."""
    if isinstance(result, xr.Dataset):
        result = xr.DataTree(children={"accuracy": xr.DataTree(result)})
    # The tree of a fit may hold a study, and has checks of its own.
    is_fit = isinstance(result, xr.DataTree) and FIT.describes(result)
    check = FIT.check if is_fit and "accuracy" in result.children else STUDY.check
    check(result, "accuracy")
    found = result["accuracy"].to_dataset().transpose("row", "parameter", ...)
    if pd.MultiIndex.from_arrays([found[name].to_numpy() for name in TEXTS[:2]]).has_duplicates:
        raise FitError(
            "two rows have one name",
            where="accuracy",
            hint="give what polar_bayes.accuracy returned",
        )
    return found


def accuracy_table(result: xr.DataTree | xr.Dataset) -> pd.DataFrame:
    """One row for each method and override, the errors of the worst parameter.

    `error` is the largest of mean and sd in reference sds, `worst` the parameter that has it;
    `resolved`: it is more than twice the reference's own standard error; `interval` is the largest
    of both ends; `on_front`: nothing is both faster and better. Seconds [s], memory [MiB].
    """
    found = accuracy_dataset(result)
    errors = parameter_errors(found)
    error = np.fmax.reduce(errors.to_numpy(), axis=1)
    ends = _larger(found, "low_error", "high_error")
    table = pd.DataFrame(
        {
            "error": error,
            "worst": errors.fillna(-np.inf).idxmax(axis=1),
            "resolved": error > RESOLVED * float(found.attrs["reference_error"]),
            "interval": np.fmax.reduce(ends, axis=1),
            "wasserstein": np.fmax.reduce(np.abs(found["wasserstein"].to_numpy()), axis=1),
            **{name: found[name].to_numpy() for name in NUMBERS},
            **{name: [str(x) for x in found[name].to_numpy()] for name in TEXTS},
        },
        index=pd.Index(errors.index, name="row"),
    )
    table["on_front"] = pareto_front(table[time_column(table)].to_numpy(), error)
    return table


def parameter_errors(result: xr.DataTree | xr.Dataset) -> pd.DataFrame:
    """The larger error of mean and sd of every parameter, in reference sds."""
    found = accuracy_dataset(result)
    rows = zip(found["method"].to_numpy(), found["override"].to_numpy(), strict=True)
    return pd.DataFrame(
        _larger(found, "mean_error", "sd_error"),
        index=[str(name) if how == AS_GIVEN else f"{name}, {how}" for name, how in rows],
        columns=[str(label) for label in found["parameter"].to_numpy()],
    )


def _larger(found: xr.Dataset, one: str, other: str) -> np.ndarray:
    return np.fmax(np.abs(found[one].to_numpy()), np.abs(found[other].to_numpy()))


def pareto_front(seconds: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Which rows are such that no other is at least as fast and as good, and better in one."""
    costs = np.stack([seconds, error], axis=1)
    known = np.isfinite(costs).all(axis=1)
    no_worse = (costs[:, None] <= costs).all(axis=2)
    better = (costs[:, None] < costs).any(axis=2)
    return known & ~(no_worse & better & known[:, None]).any(axis=0)


def time_column(table: pd.DataFrame) -> str:
    """The column of times that is filled in: of the first fit, where it was measured."""
    return TIMES[0] if table[TIMES[0]].notna().any() else TIMES[1]


def accuracy_sentences(result: xr.DataTree | xr.Dataset, tolerance: float = TOLERANCE) -> list[str]:
    """Which method to use for this capture.

    Args:
        result: What `polar_bayes.accuracy` returns, or one read back from a file.
        tolerance: Largest error of a mean or sd, in posterior sds, > 0.

    Returns:
        The advice: `laplace is within 0.08 sd here and 60 times faster than nuts; ...`, and a
        caution where there are doubts of the reference. Speed is that of the first fit where it
        was measured (else of the next), among methods as given.

    Raises:
        FitError: It holds no accuracy study, or the tolerance is not above 0.
    """
    if not tolerance > 0.0:
        raise FitError(
            f"tolerance is {tolerance}", where="accuracy_sentences", hint="give a number above 0"
        )
    found = accuracy_dataset(result)
    table, errors = accuracy_table(found), parameter_errors(found)
    given = table["override"] == AS_GIVEN
    sentences = [_advice(table[given], errors[given.to_numpy()], tolerance)]
    if doubts := found.attrs["reference_doubts"]:
        sentences.append(f"Take it with care: of the reference itself, {doubts}.")
    return sentences


def _advice(table: pd.DataFrame, errors: pd.DataFrame, tolerance: float) -> str:
    seconds = table[time_column(table)]
    known = table["error"].notna() & seconds.notna()
    if not known.any():
        return "No method has an answer here."
    good = known & (table["error"] <= tolerance)
    if not good.any():
        best = str(table["error"][known].idxmin())
        row = table.loc[best]
        return (
            f"No method is within {tolerance:g} sd here; {best} comes nearest, and is off by "
            f"{row['error']:.2g} sd for {row['worst']}."
        )
    fastest = str(seconds[good].idxmin())
    partly = _partly(errors[known.to_numpy()], seconds[known], fastest, tolerance)
    if partly is not None:
        quick, missed = partly
        rest = float(errors.loc[quick].drop(missed).max())
        times = seconds[fastest] / seconds[quick]
        return (
            f"{quick} is within {rest:.2g} sd here and {times:.2g} times faster than {fastest}, "
            f"but for {_listed(missed)}; use {fastest} for {'it' if len(missed) == 1 else 'them'}."
        )
    said = f"{fastest} is within {table['error'][fastest]:.2g} sd here"
    slower = table[good & table.index.str.startswith("nuts") & (seconds > seconds[fastest])]
    if len(slower):
        other = str(seconds[slower.index].idxmin())
        times = seconds[other] / seconds[fastest]
        faster = f"{times:.2g} times faster than" if times >= FASTER else "as fast as"
        said += f" and {faster} {other}"
    return f"{said}; use it."


def _partly(
    errors: pd.DataFrame, seconds: pd.Series, fastest: str, tolerance: float
) -> tuple[str, list[str]] | None:
    """The fastest row good for most parameters, and what it misses, if it is much faster."""
    for name in seconds.sort_values(kind="stable").index:
        missed = [label for label, error in errors.loc[name].items() if not error <= tolerance]
        if seconds[fastest] < MUCH_FASTER * seconds[name]:
            return None
        if 0 < len(missed) <= errors.shape[1] / 2.0:
            return str(name), [str(label) for label in missed]
    return None


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
