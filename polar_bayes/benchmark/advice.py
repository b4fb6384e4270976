"""What an accuracy study comes to: a table, the front, and one sentence of advice."""

import math

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.benchmark.accuracy import AS_GIVEN, STUDY
from polar_bayes.errors import FitError
from polar_bayes.inference.files import FIT

RESOLVED = 2.0
"""An error is told from nothing where it is so many standard errors of the reference."""

MUCH = 2.0
"""Times faster, from which a method is worth taking for most parameters alone."""

ALIKE = 1.2
"""Times faster, below which two times are the same: they differ so from run to run."""

TOLERANCE = 0.1
TIMES = ("seconds_first", "seconds_again")


def accuracy_of(result: xr.DataTree | xr.Dataset) -> xr.Dataset:
    """The group `accuracy` of a tree."""
    if isinstance(result, xr.Dataset):
        result = xr.DataTree(children={"accuracy": xr.DataTree(result)})
    # A study may stand in the tree of a fit, which has checks of its own.
    is_fit = isinstance(result, xr.DataTree) and FIT.describes(result)
    check = FIT.check if is_fit and "accuracy" in result.children else STUDY.check
    check(result, "accuracy")
    found = result["accuracy"].to_dataset().transpose("row", "parameter", ...)
    pairs = (found[name].to_numpy().tolist() for name in ("method", "override"))
    names = list(zip(*pairs, strict=True))
    if len(set(names)) < len(names):
        raise FitError(
            "two rows have one name",
            where="accuracy",
            hint="give what polar_bayes.accuracy returned",
        )
    return found


def accuracy_table(result: xr.DataTree | xr.Dataset) -> pd.DataFrame:
    """One row for each method and override, the errors of the worst parameter.

    Args:
        result: What `polar_bayes.accuracy` returns, or one read back from a file.

    Returns:
        Indexed by the name of the row: `error` (the largest of mean and sd, in reference sds),
        `worst` (the parameter that has it), `resolved` (whether it is more than twice the
        reference's own standard error), `interval` (the largest of both ends), `wasserstein`,
        `r_hat`, `k_hat`, `effective_draws`, `gradients`, `densities`, `seconds_first` and
        `seconds_again` [s], `peak_memory` [MiB], `on_front` (nothing is both faster and better),
        `method`, `override` and `problems`.

    Raises:
        FitError: It holds no accuracy study.
    """
    found = accuracy_of(result)
    errors = parameter_errors(found)
    worst = [_worst(row) for row in errors.to_numpy()]
    error = np.array([row[at] for row, at in zip(errors.to_numpy(), worst, strict=True)])
    ends = _larger(found, "low_error", "high_error")
    alone = ("r_hat", "k_hat", "effective_draws", "gradients", "densities", *TIMES, "peak_memory")
    table = pd.DataFrame(
        {
            "error": error,
            "worst": [str(errors.columns[at]) for at in worst],
            "resolved": error > RESOLVED * float(found.attrs["reference_error"]),
            "interval": _largest(ends),
            "wasserstein": _largest(found["wasserstein"].to_numpy()),
            **{name: found[name].to_numpy() for name in alone},
            "method": [str(x) for x in found["method"].to_numpy()],
            "override": [str(x) for x in found["override"].to_numpy()],
            "problems": [str(x) for x in found["problems"].to_numpy()],
        },
        index=pd.Index(errors.index, name="row"),
    )
    table["on_front"] = pareto_front(table[time_of(table)].to_numpy(), error)
    return table


def parameter_errors(result: xr.DataTree | xr.Dataset) -> pd.DataFrame:
    """The larger error of mean and sd of every parameter, in reference sds."""
    found = accuracy_of(result)
    values = _larger(found, "mean_error", "sd_error")
    pairs = zip(found["method"].to_numpy(), found["override"].to_numpy(), strict=True)
    names = [
        str(method) if override == AS_GIVEN else f"{method}, {override}"
        for method, override in pairs
    ]
    labels = [str(label) for label in found["parameter"].to_numpy()]
    return pd.DataFrame(values, index=names, columns=labels)


def pareto_front(seconds: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Which rows are such that no other is at least as fast and as good, and better in one."""
    here = np.stack([seconds, error], axis=1)
    known = np.isfinite(here).all(axis=1)
    beaten = [
        bool(known[at]) and any(_beats(here[other], here[at]) for other in np.flatnonzero(known))
        for at in range(len(here))
    ]
    return known & ~np.array(beaten, bool)


def time_of(table: pd.DataFrame) -> str:
    """The column of times that is filled in: of the first fit, where it was measured."""
    return TIMES[0] if table[TIMES[0]].notna().any() else TIMES[1]


def accuracy_advice(result: xr.DataTree | xr.Dataset, tolerance: float = TOLERANCE) -> str:
    """Which method to use for this capture, in one sentence or two.

    Args:
        result: What `polar_bayes.accuracy` returns, or one read back from a file.
        tolerance: Largest error of a mean or sd, in posterior sds, > 0.

    Returns:
        `laplace is within 0.08 sd here and 60 times faster than nuts; ...`. Speed is that of the
        first fit where it was measured (else of the next), among methods as given.

    Raises:
        FitError: It holds no accuracy study, or the tolerance is not above 0.
    """
    if not tolerance > 0.0:
        raise FitError(
            f"tolerance is {tolerance}", where="accuracy_advice", hint="give a number above 0"
        )
    found = accuracy_of(result)
    every, errors = accuracy_table(found), parameter_errors(found)
    given = every["override"] == AS_GIVEN
    told = _advice(every[given], errors[given.to_numpy()], tolerance)
    if found.attrs["reference_doubts"]:
        told += f" Take it with care: of the reference itself, {found.attrs['reference_doubts']}."
    return told


def advised(result: xr.DataTree | xr.Dataset, tolerance: float = TOLERANCE) -> str | None:
    """The fastest method as given that is good for every parameter."""
    table = accuracy_table(result)
    seconds = table[time_of(table)]
    good = (table["override"] == AS_GIVEN) & (table["error"] <= tolerance) & seconds.notna()
    return str(seconds[good].idxmin()) if good.any() else None


def _advice(table: pd.DataFrame, errors: pd.DataFrame, tolerance: float) -> str:
    seconds = table[time_of(table)]
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
            f"but for {_spoken(missed)}; use {fastest} for {'it' if len(missed) == 1 else 'them'}."
        )
    said = f"{fastest} is within {table['error'][fastest]:.2g} sd here"
    slower = table[good & table.index.str.startswith("nuts") & (seconds > seconds[fastest])]
    if len(slower):
        other = str(seconds[slower.index].idxmin())
        times = seconds[other] / seconds[fastest]
        faster = f"{times:.2g} times faster than" if times >= ALIKE else "as fast as"
        said += f" and {faster} {other}"
    return f"{said}; use it."


def _partly(
    errors: pd.DataFrame, seconds: pd.Series, fastest: str, tolerance: float
) -> tuple[str, list[str]] | None:
    """The fastest row good for most parameters, and what it misses, if it is much faster."""
    for name in seconds.sort_values(kind="stable").index:
        missed = [label for label, error in errors.loc[name].items() if not error <= tolerance]
        if seconds[fastest] < MUCH * seconds[name]:
            return None
        if 0 < len(missed) <= errors.shape[1] / 2.0:
            return str(name), [str(label) for label in missed]
    return None


def _beats(one: np.ndarray, other: np.ndarray) -> bool:
    return bool((one <= other).all() and (one < other).any())


def _worst(row: np.ndarray) -> int:
    return int(np.argmax(np.where(np.isnan(row), -math.inf, row)))


def _largest(values: np.ndarray) -> np.ndarray:
    """Of every row; NaN where nothing is known."""
    found = np.max(np.where(np.isnan(values), -np.inf, np.abs(values)), axis=1)
    return np.where(np.isneginf(found), np.nan, found)


def _larger(found: xr.Dataset, one: str, other: str) -> np.ndarray:
    return np.fmax(np.abs(found[one].to_numpy()), np.abs(found[other].to_numpy()))


def _spoken(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
