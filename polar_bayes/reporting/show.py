"""A result at a glance: verdict, what is determined, and the numbers, in a notebook or a terminal.

A result stays the plain tree that ArviZ reads. What a notebook shows of it is xarray's; this is the
same result in the words of a report, without its figures.
"""

from collections.abc import Mapping
from typing import Any

import xarray as xr

from polar_bayes.benchmark.accuracy import is_accuracy
from polar_bayes.benchmark.advice import accuracy_dataset, accuracy_sentences
from polar_bayes.calibration.files import is_calibration
from polar_bayes.calibration.verdict import (
    calibration_table,
    calibration_verdict,
    parameter_deviation,
)
from polar_bayes.diagnostics.convergence import summary, verdict
from polar_bayes.diagnostics.coverage import map_scalars
from polar_bayes.diagnostics.parameters import method_of, posterior_scalars
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.errors import one_line
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting import calibration_page, tables, text
from polar_bayes.reporting import maps as map_tables
from polar_bayes.reporting.accuracy import reference_sentence, study_table
from polar_bayes.reporting.plots_calibration import parts_of
from polar_bayes.reporting.tables import Table, swapped_sentence
from polar_bayes.repr_html import Card, Grid

MOST_ROWS = 40


def show(result: xr.DataTree | xr.Dataset) -> Card:
    """What a result says, for the last line of a cell.

    Args:
        result: What `polar_bayes.fit`, `polar_bayes.calibrate`, `polar_bayes.accuracy` or
            `polar_bayes.fit_pixels` returned, or one read back from a file. It is not changed.

    Returns:
        A card: HTML in a notebook, text from `print` or in a terminal.

    Raises:
        FitError: It is no result.
    """
    if isinstance(result, xr.Dataset):
        return _of_maps(result)
    if is_accuracy(result):
        return _of_study(result)
    return _of_calibration(result) if is_calibration(result) else _of_fit(result)


def _of_fit(result: xr.DataTree) -> Card:
    found, table = posterior_scalars(result), summary(result)
    method, provenance = method_of(result), provenance_of(result)
    judged, prior = verdict(result, table), sensitivity(result)
    posterior = result["posterior"].to_dataset()
    determined = text.determined(found, prior, posterior) if judged.converged else []
    said = [
        text.headline(method, judged.converged, judged.cautions),
        *judged.problems,
        *determined,
        *(f"Caution: {caution}" for caution in judged.cautions),
        swapped_sentence(provenance),
    ]
    numbers = (
        tables.estimate_table(result, found, table)
        if method == "point"
        else tables.parameter_table(result, found, table, prior)
    )
    return _card(_name(provenance, "fit"), said, numbers, judged.converged)


def _of_maps(maps: xr.Dataset) -> Card:
    found, cases = map_scalars(maps), map_tables.count_cases(maps)
    headline, is_enough = map_tables.headline(cases)
    about = provenance_of(maps)
    said = [headline, *map_tables.verdict(cases)]
    return _card(_name(about, "map"), said, map_tables.parameter_table(maps, found), is_enough)


def _of_calibration(calibration: xr.DataTree) -> Card:
    table = calibration_table(calibration)
    parts = parts_of(calibration, table)
    words = {
        label: parameter_deviation(part.row) for label, part in parts.items() if not part.passes
    }
    _, is_good = calibration_page.verdict_head(table, None)
    said = calibration_verdict(calibration)
    rows = calibration_page.calibration_rows(table, parts, words)
    return _card(_name(provenance_of(calibration), "calibration"), said, rows, is_good)


def _of_study(study: xr.DataTree) -> Card:
    said = [*accuracy_sentences(study), reference_sentence(study)]
    found = accuracy_dataset(study)
    is_sound = not found.attrs["reference_doubts"]
    return _card(_name(provenance_of(study), "accuracy"), said, study_table(found), is_sound)


def _name(provenance: Mapping[str, Any], kind: str) -> str:
    """What was captured, and what this is: `leaf: fit`."""
    capture = provenance.get("capture")
    if isinstance(capture, Mapping):
        capture = capture.get("name")
    return one_line(f"{capture or 'capture'}: {kind}")


def _card(title: str, said: list[str], table: Table, good: bool) -> Card:
    rows = tuple((row.name, *row.cells) for row in table.rows[:MOST_ROWS])
    more = len(table.rows) - MOST_ROWS
    said = [*said, f"The first {MOST_ROWS} of {len(table.rows)} rows."] if more > 0 else said
    return Card(title, tuple(filter(None, said)), (Grid(table.heads, rows, numeric=True),), good)
