"""What a calibration says of readings, on its page."""

import dataclasses

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.calibration.joint import limit_of
from polar_bayes.calibration.prediction import (
    calibration_readings,
    how_predictions_stray,
    reading_ranks,
)
from polar_bayes.pixels.importance import LARGEST_TRUSTED
from polar_bayes.reporting.calibration_tables import chance
from polar_bayes.reporting.style import QUANTITIES
from polar_bayes.reporting.tables import Row, Table
from polar_bayes.reporting.text import DASH, or_dash

CAPTION = (
    "In each simulation one entry of each reading is looked at. Fresh: read once more from the "
    "same truth, and ranked among what the fit predicts. Left out: one that was fitted, ranked "
    "among what the fit of all the others predicts. p: how often uniform ranks stray as far; "
    "marked below {level:.2g} (5% shared by these rows, beside the 5% of the parameters). Mean "
    "rank: above 0.5 predictions are too low, below too high. Spread, over that of uniform ranks: "
    "above 1 predictions are too narrow, below too wide. Untrusted: fits whose weights without "
    "the reading say little (Pareto k above {k:g}); where they are many, the weights stray."
)


@dataclasses.dataclass(frozen=True, eq=False)
class ReadingRanks:
    """What a calibration knows of one reading."""

    label: str
    title: str
    answered: np.ndarray
    row: pd.Series
    passes: bool
    level: float


def ranks_of_readings(calibration: xr.DataTree) -> list[ReadingRanks]:
    """Every row of `calibration_readings` with its ranks."""
    table, ranks = calibration_readings(calibration), reading_ranks(calibration)
    level = limit_of(table)
    return [
        ReadingRanks(
            label=label,
            title=f"{QUANTITIES.get(row['reading'], row['reading'])}, {row['test']}",
            answered=ranks[label][np.isfinite(ranks[label])],
            row=row,
            passes=bool(row["p_value"] >= level),
            level=level,
        )
        for label, row in table.iterrows()
    ]


def reading_rows(parts: list[ReadingRanks]) -> Table:
    """Every reading: uniform ranks, and how far leaving it out can be trusted."""
    rows = []
    for part in parts:
        row = part.row
        words = "uniform" if part.passes else how_predictions_stray(row)
        every = int(row["answered"] + row["failed"])
        cells = [chance(row["p_value"], part.passes), words, f"{int(row['failed']):,} of {every:,}"]
        cells += [or_dash(row[name], "{:.3f}") for name in ("rank_mean", "rank_spread")]
        cells.append(DASH if np.isnan(row["untrusted"]) else f"{int(row['untrusted']):,}")
        rows.append(Row(part.label, part.title, tuple(cells)))
    heads = ("reading", "p", "the ranks", "failed", "mean rank", "spread", "untrusted")
    behind = pd.DataFrame({part.label: part.row for part in parts}).T
    caption = CAPTION.format(level=parts[0].level, k=LARGEST_TRUSTED)
    return Table(caption, heads, tuple(rows), behind)
