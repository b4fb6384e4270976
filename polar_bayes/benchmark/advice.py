"""Table, Pareto front and sentences of an accuracy study."""

import dataclasses
import functools

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.diagnostics.finding import join
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

NUMBERS = (
    *("r_hat", "pareto_k", "ess", "gradients", "densities"),
    *("seconds_first", "seconds_again", "peak_memory"),
)


@dataclasses.dataclass(frozen=True, eq=False)
class AccuracyView:
    """A validated accuracy study with cached tables."""

    study: xr.Dataset

    @functools.cached_property
    def errors(self) -> pd.DataFrame:
        """The larger error of mean and sd of every row and parameter, in reference sds."""
        names = zip(self.study["method"].to_numpy(), self.study["override"].to_numpy(), strict=True)
        return pd.DataFrame(
            self._larger("mean_error", "sd_error"),
            index=[str(name) if how == AS_GIVEN else f"{name}, {how}" for name, how in names],
            columns=[str(label) for label in self.study["parameter"].to_numpy()],
        )

    @functools.cached_property
    def table(self) -> pd.DataFrame:
        """The table of `accuracy_table`."""
        error = np.fmax.reduce(self.errors.to_numpy(), axis=1)
        distance = np.abs(self.study["wasserstein"].to_numpy())
        table = pd.DataFrame(
            {
                "error": error,
                "worst": self.errors.fillna(-np.inf).idxmax(axis=1),
                "resolved": error > self.resolved,
                "interval": np.fmax.reduce(self._larger("low_error", "high_error"), axis=1),
                "wasserstein": np.fmax.reduce(distance, axis=1),
                **{name: self.study[name].to_numpy() for name in NUMBERS},
                **{
                    name: [str(x) for x in self.study[name].to_numpy()]
                    for name in ("method", "override", "problems")
                },
            },
            index=pd.Index(self.errors.index, name="row"),
        )
        table["on_front"] = pareto_front(table[time_column(table)].to_numpy(), error)
        return table

    @property
    def is_given(self) -> np.ndarray:
        """True for rows that show a method as it was given, (row,)."""
        return np.asarray(self.study["override"].to_numpy() == AS_GIVEN)

    @property
    def resolved(self) -> float:
        """The smallest error that differs significantly from 0, in reference sds."""
        # Twice the standard error of the reference.
        return 2.0 * float(self.study.attrs["reference_error"])

    @property
    def doubts(self) -> str:
        """Reasons to doubt the reference, as text; empty without any."""
        return str(self.study.attrs["reference_doubts"])

    def _larger(self, *names: str) -> np.ndarray:
        return np.asarray(np.fmax(*(np.abs(self.study[name].to_numpy()) for name in names)))


type Study = xr.DataTree | xr.Dataset | AccuracyView
"""What holds an accuracy study."""


def accuracy_view(result: Study) -> AccuracyView:
    """Return the view of a study, or of a fit that holds one, after checking it."""
    if isinstance(result, AccuracyView):
        return result
    if isinstance(result, xr.Dataset):
        result = xr.DataTree(children={"accuracy": xr.DataTree(result)})
    # The tree of a fit may hold a study, and has checks of its own.
    is_fit = isinstance(result, xr.DataTree) and FIT.describes(result)
    check = FIT.check if is_fit and "accuracy" in result.children else STUDY.check
    check(result, "accuracy")
    found = result["accuracy"].to_dataset().transpose("row", "parameter", ...)
    for what, names in {"rows": ("method", "override"), "parameters": ("parameter",)}.items():
        if pd.MultiIndex.from_arrays([found[name].to_numpy() for name in names]).has_duplicates:
            hint = "give what polar_bayes.accuracy returned"
            raise FitError(f"two {what} have one name", where="accuracy", hint=hint)
    return AccuracyView(found)


def accuracy_table(result: Study) -> pd.DataFrame:
    """Return one row per method and override, with the errors of its worst parameter.

    `error` is the largest of mean and sd in reference sds, `worst` the parameter that has it;
    `resolved`: it is more than twice the reference's own standard error; `interval` is the largest
    of both ends; `on_front`: nothing is both faster and better. Seconds [s], memory [MiB].
    """
    return accuracy_view(result).table


def pareto_front(seconds: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return True for rows that no other row beats in time without a larger error, (row,)."""
    costs = np.stack([seconds, error], axis=1)
    known = np.isfinite(costs).all(axis=1)
    no_worse = (costs[:, None] <= costs).all(axis=2)
    better = (costs[:, None] < costs).any(axis=2)
    return known & ~(no_worse & better & known[:, None]).any(axis=0)


def time_column(table: pd.DataFrame) -> str:
    """Return the name of the time column: time of the first fit, where it was measured."""
    return "seconds_first" if table["seconds_first"].notna().any() else "seconds_again"


def accuracy_sentences(result: Study, tolerance: float = 0.1) -> list[str]:
    """Return sentences that recommend a method for this capture.

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
    view = accuracy_view(result)
    sentences = [_advice(view.table[view.is_given], view.errors[view.is_given], tolerance)]
    if view.doubts:
        sentences.append(
            f"Use this advice with care, since the reference is in doubt: {view.doubts}."
        )
    return sentences


def _advice(table: pd.DataFrame, errors: pd.DataFrame, tolerance: float) -> str:
    seconds = table[time_column(table)]
    known = table["error"].notna() & (seconds > 0.0)
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
        times = float(seconds[fastest]) / float(seconds[quick])
        return (
            f"{quick} is within {rest:.2g} sd here and {times:.2g} times faster than {fastest}, "
            f"but for {join(missed)}; use {fastest} for {'it' if len(missed) == 1 else 'them'}."
        )
    said = f"{fastest} is within {table['error'][fastest]:.2g} sd here"
    slower = table[good & table.index.str.startswith("nuts") & (seconds > seconds[fastest])]
    if len(slower):
        other = str(seconds[slower.index].idxmin())
        times = float(seconds[other]) / float(seconds[fastest])
        # Times differ by a fifth from run to run.
        faster = f"{times:.2g} times faster than" if times >= 1.2 else "as fast as"
        said += f" and {faster} {other}"
    return f"{said}; use it."


def _partly(
    errors: pd.DataFrame, seconds: pd.Series, fastest: str, tolerance: float
) -> tuple[str, list[str]] | None:
    """Name the fastest row good for most parameters and what it misses, if it is twice as fast."""
    for name in seconds.sort_values(kind="stable").index:
        missed = [label for label, error in errors.loc[name].items() if not error <= tolerance]
        if seconds[fastest] < 2.0 * seconds[name]:
            return None
        if 0 < len(missed) <= errors.shape[1] / 2.0:
            return str(name), [str(label) for label in missed]
    return None
