"""Calibrations of one layout by several methods, side by side."""

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.calibration.joint import limit_of
from polar_bayes.calibration.verdict import (
    calibration_scalars,
    calibration_table,
    how_ranks_stray,
)
from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.errors import FitError

PASSES = "the ranks pass"


def compare_calibrations(calibrations: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    """Calibrations of the same parameters, side by side.

    Give all of them the same seed: they are then of the same simulations, and scores are compared
    fit by fit, which tells far smaller differences than their means do.

    Args:
        calibrations: Each what `polar_bayes.calibrate` returns, by a name such as its method. The
            first is what the scores of the others are compared with.

    Returns:
        A row for each parameter and method: the columns of `calibration_table`, and `passes`
        (whether its p-value is at least 5% over the number of parameters), `ways` (in words, how
        its ranks stray), `score_change` (ranked score over that of the first method, minus one:
        below zero is better) and `score_change_error` (its standard error). The change is NaN
        where the simulations differ; a simulation counts where both methods have an answer.

    Raises:
        FitError: There is none, or they are not all calibrations of the same parameters.
    """
    if not calibrations:
        raise FitError(
            "there is nothing to compare", where="compare_calibrations", mend="give calibrations"
        )
    tables = {name: calibration_table(each) for name, each in calibrations.items()}
    (first, expected), *others = tables.items()
    for name, table in others:
        if set(table.index) != set(expected.index):
            raise FitError(
                f"it has other parameters than {first}",
                where=f"compare_calibrations: {name}",
                mend="calibrate the same model on the same layout",
            )
    limit = limit_of(expected)
    rows = {}
    for scalar in calibration_scalars(calibrations[first], "truth"):
        for name, calibration in calibrations.items():
            row = tables[name].loc[scalar.label]
            passes = bool(row["p_value"] >= limit)
            change, error = _score_change(calibration, calibrations[first], scalar)
            rows[scalar.label, name] = {
                **row,
                "passes": passes,
                "ways": PASSES if passes else how_ranks_stray(row),
                "score_change": change,
                "score_change_error": error,
            }
    found = pd.DataFrame.from_dict(rows, orient="index")
    found.index = found.index.set_names(["parameter", "method"])
    return found.astype({"answered": int, "failed": int})


def comparison_sentences(compared: pd.DataFrame) -> list[str]:
    """Which parameters fail by which method, how, and what the other methods make of them.

    Args:
        compared: Of `compare_calibrations`.

    Returns:
        First how many parameters fail by each method, then a sentence for each parameter that
        fails by any.

    Raises:
        Nothing.
    """
    methods = list(compared.index.get_level_values("method").unique())
    labels = list(compared.index.get_level_values("parameter").unique())
    fails = {
        method: int((~compared.xs(method, level="method")["passes"].astype(bool)).sum())
        for method in methods
    }
    counts = ", ".join(
        f"{count or 'none'} {'fail' if count > 1 else 'fails'} by {method}"
        for method, count in fails.items()
    )
    said = [f"Of {len(labels)} parameters {counts}."]
    for label in labels:
        own = compared.loc[label]
        if not own["passes"].all():
            ways = "; ".join(f"by {method} {_way(row)}" for method, row in own.iterrows())
            said.append(f"{label}: {ways}.")
    return said


def _way(row: pd.Series) -> str:
    chance = "" if row["passes"] or row["answered"] < 2 else f"p = {row['p_value']:.2g}, "
    return f"{row['ways']} ({chance}95% intervals hold {row['held_95']:.1%})"


def _score_change(
    calibration: xr.DataTree, first: xr.DataTree, scalar: Scalar
) -> tuple[float, float]:
    """Mean ranked score over that of the first, minus one, and its standard error."""
    own, other = (_of(each, "truth", scalar.name, scalar) for each in (calibration, first))
    if own.shape != other.shape or not np.array_equal(own, other, equal_nan=True):
        return math.nan, math.nan
    score, base = (
        _of(each, "marginals", f"{scalar.name}_crps", scalar) for each in (calibration, first)
    )
    both = np.isfinite(score) & np.isfinite(base)
    if both.sum() < 2 or not base[both].mean() > 0.0:
        return math.nan, math.nan
    score, base = score[both], base[both]
    ratio = score.mean() / base.mean()
    # The ratio of two means that go together, by the delta method.
    error = np.std(score - ratio * base, ddof=1) / (base.mean() * math.sqrt(both.sum()))
    return float(ratio - 1.0), float(error)


def _of(tree: xr.DataTree, group: str, name: str, scalar: Scalar) -> np.ndarray:
    return tree[group][name].isel(dict(scalar.index)).to_numpy().astype(float)
