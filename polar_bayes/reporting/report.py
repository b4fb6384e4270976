"""Standard reports of every kind of result, and summaries for notebooks and terminals."""

import dataclasses
import functools
import inspect
import os
import pkgutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import matplotlib.style
import numpy as np
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.capture import plausibility
from polar_bayes.capture.schema import validate
from polar_bayes.errors import FitError
from polar_bayes.expressions import short_text
from polar_bayes.inference.result import PROVENANCE, provenance_of
from polar_bayes.observation.data import ANGLES, READINGS
from polar_bayes.paths import as_path
from polar_bayes.priors import describe_prior, prior_card
from polar_bayes.reporting import text
from polar_bayes.reporting.page import EXPLORER, has_explorer, report_of, write_page
from polar_bayes.repr_html import DisplaySummary, HTMLRepr, Row, Table
from polar_bayes.results import kind_of, save, summary, verdict

MAX_ROWS = 40
"""Largest number of rows of a table in a notebook or terminal."""

HINTS = {
    "truth": "leave it out: a fit carries the truth of its capture",
    "uncorrected": "leave it out: a fit carries the truth of its capture",
    "capture": "leave it out: a fit carries its readings",
    "comparisons": "leave it out, or give what polar_bayes.calibrate returns",
}


@matplotlib.style.context("default")  # whatever style the user has, the same result: the same page
def report(
    result: xr.DataTree | xr.Dataset | Mapping[str, xr.DataTree],
    directory: str | os.PathLike[str],
    *,
    truth: xr.Dataset | None = None,
    uncorrected: xr.Dataset | None = None,
    comparisons: Mapping[str, xr.DataTree] | None = None,
    capture: xr.Dataset | None = None,
) -> Path:
    """Write the standard report of a result, or of several fits side by side: `index.html`.

    The page needs no network, no script and no other file. Everything on it is computed from the
    result, so a report of a file read back is the same report. The folder of a fit also holds
    `result.nc`, that of a calibration `calibration.nc`, of an accuracy study `accuracy.nc`; a map,
    which may be large, stays where it is. Beside the page of a map is `explore.html`, on which one
    can point at its pixels (`polar_bayes.explore`), where Bokeh is installed. A fit
    whose tree has a group `accuracy` (`result["accuracy"] = study["accuracy"]`) shows it.

    Args:
        result: A tree that `polar_bayes.fit`, `polar_bayes.calibrate` or `polar_bayes.accuracy`
            returned, or maps of `polar_bayes.fit_pixels`; or one of them read back from a file. Or
            several fits of one capture by name, which are compared.
        directory: The folder; made if it is not there. An older report in it is replaced.
        truth: Of maps: the simulated capture, whose `true_<parameter>` the intervals are checked
            against.
        uncorrected: Of maps, with `truth`: those of the same image by
            the Laplace approximation alone, whose coverage is compared.
        comparisons: Of a calibration: others of the same layout, by a name such as their method
            ("laplace"), with which it is compared.
        capture: Of maps: the image of which they were made, whose readings `explore.html` shows;
            by default `truth`, where it holds readings.

    Returns:
        The path of the page.

    Raises:
        CaptureError: The directory is no path, or `truth` does not fit the maps.
        FitError: It holds no posterior and no maps, fits are not of one capture, or an argument
            does not apply.
        OutputError: The folder cannot be written, or holds a file of such a name that is no part
            of a report.
    """
    folder = as_path(directory, "report")
    options = {"truth": truth, "uncorrected": uncorrected, "comparisons": comparisons}
    page = render(result, **options, capture=capture)
    files: dict[str, Callable[[Path], object]] = {}
    if "capture" in report_of(result).options and has_explorer():
        has_readings = truth is not None and any(name in truth for name in READINGS)
        image = truth if capture is None and has_readings else capture
        # That file computes with JAX, and is loaded for maps only.
        explore = pkgutil.resolve_name("polar_bayes.reporting.explore:explore")
        files[EXPLORER] = explore(result, image).save
    if file := report_of(result).file:
        files[file] = functools.partial(save, cast(xr.DataTree, result))
    return write_page(folder, page, files)


def render(result: Any, **options: Any) -> str:
    """Return the report as HTML; options that are None are omitted."""
    own = report_of(result)
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if name not in own.options:
            owner = "calibrations" if name == "comparisons" else "maps"
            raise FitError(f"it goes with {owner} only", where=f"report: {name}", hint=HINTS[name])
    return own.page(result, **given).html


def show(result: Any) -> DisplaySummary:
    """Return a summary of a result, capture, scene or table of priors, for notebooks.

    Args:
        result: A result of any kind, or one read back from a file; a capture; a scene, a set-up, or
            a part, link or method; or priors by name. It is not changed.

    Returns:
        A card: HTML in a notebook, text from `print` or in a terminal.

    Raises:
        CaptureError: A capture does not hold together.
        FitError: It is none of these.
    """
    if _is_capture(result):
        return _capture_card(result)
    if isinstance(result, HTMLRepr):
        return _value_card(result)
    return prior_card(result) if _are_priors(result) else _result_card(result)


def _result_card(result: Any) -> DisplaySummary:
    """Return the card of a result."""
    kind = kind_of(result)
    if not kind.reports:
        return _described_card(result)
    sentences, table, passed = report_of(result).card(result)
    total = len(table.rows)
    more = f"The first {MAX_ROWS} of {total} rows." if total > MAX_ROWS else ""
    title = f"{text.capture_name(provenance_of(result))}: {kind.name}"
    lines = tuple(filter(None, [*sentences, more]))
    return DisplaySummary(title, lines, (table.first(MAX_ROWS),), passed)


# --- Cards of what goes into a fit ----------------------------------------------------------------


def _is_capture(value: Any) -> bool:
    is_dataset = isinstance(value, xr.Dataset) and set(value.data_vars) >= {*ANGLES}
    return is_dataset and "status" not in value and PROVENANCE not in value.attrs


def _capture_card(given: xr.Dataset) -> DisplaySummary:
    """Return variables with ranges, first conclusions from readings, and cautions."""
    capture = validate(given)
    columns = ("variable", "dims", "unit", "least", "largest", "meaning")
    rows = []
    for name, variable in {**capture.coords, **capture.data_vars}.items():
        values = np.asarray(variable.to_numpy())
        is_number = values.dtype.kind in "biuf" and np.isfinite(values).any()
        ends = [f"{end(values):.4g}" if is_number else text.DASH for end in (np.nanmin, np.nanmax)]
        words = (str(variable.attrs.get(key, "")) for key in ("units", "long_name"))
        unit, meaning = words
        rows.append(Row(str(name), (" x ".join(map(str, variable.dims)), unit, *ends, meaning)))
    cautions = [f"Caution: {sentence}" for sentence in plausibility.cautions(capture)]
    sentences = (*plausibility.inferred(capture), *plausibility.stated(capture), *cautions)
    table = Table(columns, tuple(rows), prose=("variable", "dims", "unit", "meaning"))
    return DisplaySummary(f"{capture.attrs.get('name', 'capture')}: capture", sentences, (table,))


def _value_card(value: HTMLRepr) -> DisplaySummary:
    """Return fields of a scene, set-up, part, link or method, and parameters of a scene."""
    fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}  # type: ignore[arg-type]
    about = (inspect.getdoc(type(value)) or "").partition("\n")[0]
    sentences = [about, *(f"{name}: {_field_text(each)}" for name, each in fields.items())]
    return DisplaySummary(type(value).__name__, tuple(sentences), value.extra_tables())


def _field_text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_field_text(each)}" for name, each in value.items()) or "none"
    if isinstance(value, dist.Distribution):
        return describe_prior(value)
    return short_text(value)


def _are_priors(value: Any) -> bool:
    are_named = isinstance(value, Mapping) and not isinstance(value, xr.Dataset | xr.DataTree)
    return are_named and all(isinstance(each, dist.Distribution) for each in value.values())


def _described_card(result: xr.Dataset) -> DisplaySummary:
    """Return table and sentences of a descriptive result, which has no verdict."""
    found = summary(result)
    prose = ("", *found.select_dtypes(exclude="number").columns)
    table = Table.of_frame(found, lambda x: f"{x:.4g}" if isinstance(x, float) else str(x), prose)
    return DisplaySummary(
        text.capture_name(provenance_of(result)), tuple(verdict(result).sentences), (table,)
    )
