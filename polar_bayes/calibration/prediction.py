"""What a calibration says of readings: a small table, and in words."""

import math
from collections.abc import Iterator

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.calibration.files import check_calibration
from polar_bayes.calibration.joint import FALSE_ALARMS, is_calibrated, which_stray
from polar_bayes.calibration.uniformity import uniformity
from polar_bayes.errors import FitError
from polar_bayes.inference.result import provenance_of
from polar_bayes.pixels.importance import LARGEST_TRUSTED

TESTS = {"predictive_pit": "fresh", "loo_pit": "left out"}
"""What the groups of a calibration rank, in a word."""


def holds_readings(calibration: xr.DataTree) -> bool:
    """Whether readings were ranked in a calibration."""
    return set(TESTS) <= set(calibration.children)


def calibration_readings(calibration: xr.DataTree) -> pd.DataFrame:
    """Two rows for each reading: a fresh one, and one that is left out of the fit.

    Where model, prior, links and method are right, both stand uniformly among what the fits
    predict. One entry is looked at in each simulation, so that simulations are independent and the
    test that `calibration_table` makes of parameters holds here as it does there.

    Args:
        calibration: What `polar_bayes.calibrate` returns.

    Returns:
        Columns `reading` and `test` ("fresh" or "left out"); `answered` and `failed` (fits);
        `p_value` of uniform ranks; `rank_mean` (above a half predictions are too low) and
        `rank_spread` (above one they are too narrow, below too wide); `untrusted`, how many of
        those left out have a Pareto k above 0.7 (of fresh ones none is needed, NaN): where they
        are many, the weights are what strays.

    Raises:
        FitError: It is no calibration, or readings were not ranked.

    Source:
        See `polar_bayes.calibration.readings.Readings`.
    """
    check_calibration(calibration)
    if not holds_readings(calibration):
        raise FitError(
            "it holds no ranks of readings",
            where="calibration",
            mend="give what polar_bayes.calibrate returns with readings=True",
        )
    rows = {label: row for label, row, _ in _rows(calibration)}
    return pd.DataFrame.from_dict(rows, orient="index")


def reading_ranks(calibration: xr.DataTree) -> dict[str, np.ndarray]:
    """Ranks of readings by their label in `calibration_readings`, NaN where a fit failed."""
    return {label: ranks for label, _, ranks in _rows(calibration)}


def readings_verdict(calibration: xr.DataTree) -> list[str]:
    """What a calibration says of readings, in sentences."""
    if not holds_readings(calibration):
        why = provenance_of(calibration).get("readings_told", "")
        return [f"Readings were not ranked: {why}."] if why else []
    table = calibration_readings(calibration)
    passed = is_calibrated(table)
    names = list(dict.fromkeys(table["reading"]))
    said = [
        f"Readings ({', '.join(names)}; fresh ones and ones left out) "
        f"{'pass' if passed else 'fail'} a joint test of their own that a right model fails "
        f"{FALSE_ALARMS:.0%} of the time."
    ]
    said += which_stray(table, how_predictions_stray)
    for label, row in table.iterrows():
        if row["untrusted"] > 0:
            said.append(
                f"{label}: in {int(row['untrusted'])} of {int(row['answered'])} fits the weights "
                f"without it say little (Pareto k above {LARGEST_TRUSTED:g})."
            )
    return said


def how_predictions_stray(row: pd.Series) -> str:
    """In which way the ranks of a reading stray."""
    count = row["answered"]
    if count < 2:
        return "fewer than two fits have an answer"
    shift = (row["rank_mean"] - 0.5) * math.sqrt(12.0 * count)
    stretch = (row["rank_spread"] - 1.0) * math.sqrt(5.0 * count)  # sd of the spread: 1/sqrt(5 n)
    ways = []
    if abs(shift) > 2.5:
        ways.append(f"predictions are too {'low' if shift > 0.0 else 'high'}")
    if abs(stretch) > 2.5:
        ways.append(f"predictions are too {'narrow' if stretch > 0.0 else 'wide'}")
    return " and ".join(ways) or "the ranks have another shape than the uniform"


def _rows(calibration: xr.DataTree) -> Iterator[tuple[str, dict, np.ndarray]]:
    """Label, row of the table, and ranks."""
    chosen = calibration["readings"].to_dataset()
    for name in map(str, calibration["predictive_pit"].data_vars):
        for group, test in TESTS.items():
            pit = calibration[group][name].to_numpy()
            answered = pit[np.isfinite(pit)]
            told = uniformity(answered) if answered.size > 1 else (math.nan,) * 3
            untrusted = math.nan
            if group == "loo_pit":
                pareto_k = chosen[f"{name}_pareto_k"].to_numpy()
                untrusted = float(np.sum(pareto_k[np.isfinite(pit)] > LARGEST_TRUSTED))
            row = {
                "reading": name,
                "test": test,
                "answered": answered.size,
                "failed": pit.size - answered.size,
                **dict(zip(("p_value", "rank_mean", "rank_spread"), told, strict=True)),
                "untrusted": untrusted,
            }
            yield f"{name}, {test}", row, pit
