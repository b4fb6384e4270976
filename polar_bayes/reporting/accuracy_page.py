"""The report of an accuracy study: advice, the picture, and the numbers behind it."""

import math
from typing import Any

import xarray as xr

from polar_bayes.budget.accuracy import AS_GIVEN
from polar_bayes.budget.advice import (
    RESOLVED,
    accuracy_advice,
    accuracy_of,
    accuracy_table,
    parameter_errors,
)
from polar_bayes.errors import one_line
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting.accuracy import plot_accuracy
from polar_bayes.reporting.page import Picture, fill, picture
from polar_bayes.reporting.provenance import made_by
from polar_bayes.reporting.tables import Row, Table, fact_rows
from polar_bayes.reporting.text import DASH, or_dash

HEADS = (
    "method", "error", "of", "first s", "next s", "MiB", "interval", "Wasserstein", "R-hat",
    "k-hat", "worth", "gradients", "densities",
)  # fmt: skip
CAPTION = (
    "Error: the largest of any mean or standard deviation, in posterior standard deviations, and "
    "of which parameter; marked < where the reference itself cannot tell it from nothing. "
    "Interval: the same of the ends of 95% intervals. Worth: independent draws. First and next: "
    "seconds of a first fit in a fresh process, compilation included, and of the next one. "
    "Gradients of chains count warm-up as long as what is kept. * on the front: nothing is both "
    "faster and better."
)


def render_accuracy(result: xr.DataTree) -> str:
    """The page as text."""
    about = provenance_of(result)
    content = {
        "kind": "Accuracy against time",
        "name": one_line(str(about.get("capture", "capture"))),
        "under": [made_by(about, "every method of the ladder")],
        "facts_of_study": fact_rows(
            {str(key).replace("_", " "): value for key, value in about.items()}
        ),
        **accuracy_section(result),
    }
    return fill("accuracy.html.j2", content)


def accuracy_section(result: xr.DataTree | xr.Dataset) -> dict[str, Any]:
    """What a page says of a study: advice, reference, figure and tables."""
    found = accuracy_of(result)
    return {
        "advice": accuracy_advice(found),
        "is_sound": not found.attrs["reference_doubts"],
        "reference": reference_sentence(found),
        "picture": accuracy_picture(found),
        "table": study_table(found),
        "parameters": parameter_table(found),
    }


def accuracy_picture(found: xr.Dataset) -> Picture:
    """Error against time."""
    return picture(
        plot_accuracy(found),
        "Error against time of every method",
        "Down is better, left is faster. A color stands for a method, a marker for what was turned "
        "beside it; methods as given are filled and named. The line joins those than which nothing "
        "is both faster and better. In the gray area the reference itself cannot tell an error "
        "from nothing.",
    )


def reference_sentence(result: xr.DataTree | xr.Dataset) -> str:
    """What the reference is, and how well it is known."""
    told = accuracy_of(result).attrs
    sentence = (
        f"The reference is {told['reference_draws']:,} draws of {told['reference']}, worth "
        f"{told['reference_effective_draws']:,.0f} independent ones; its own Monte Carlo error is "
        f"at most {told['reference_error']:.2g} posterior sd."
    )
    doubts = told["reference_doubts"]
    return f"{sentence} Against it speaks: {doubts}." if doubts else sentence


def study_table(found: xr.Dataset) -> Table:
    """A row for each method and dial."""
    noise = float(found.attrs["reference_error"])
    rows, table = [], accuracy_table(found)
    for name, row in table.iterrows():
        error = or_dash(row["error"], "{:.2g}")
        if math.isfinite(row["error"]) and not row["resolved"]:
            error = f"< {RESOLVED * noise:.2g}"
        cells = (
            error,
            row["worst"] if math.isfinite(row["error"]) else DASH,
            *(or_dash(row[key], "{:.2g}") for key in ("seconds_first", "seconds_again")),
            or_dash(row["peak_memory"], "{:,.0f}"),
            *(or_dash(row[key], "{:.2g}") for key in ("interval", "wasserstein")),
            or_dash(row["r_hat"], "{:.3f}"),
            or_dash(row["k_hat"], "{:.2f}"),
            *(
                or_dash(row[key], "{:,.0f}")
                for key in ("effective_draws", "gradients", "densities")
            ),
        )
        words = "; ".join(filter(None, ["*" if row["on_front"] else "", row["problems"]]))
        rows.append(Row(str(name), words or str(name), cells))
    return Table(CAPTION, HEADS, tuple(rows), table)


def parameter_table(found: xr.Dataset) -> Table:
    """Errors of every parameter by the methods as given."""
    errors = parameter_errors(found)[found["dial"].to_numpy() == AS_GIVEN]
    rows = tuple(
        Row(str(name), str(name), tuple(or_dash(value, "{:.2g}") for value in row))
        for name, row in errors.iterrows()
    )
    caption = "The larger error of mean and standard deviation of each, in posterior sds."
    return Table(caption, ("method", *map(str, errors.columns)), rows, errors)
