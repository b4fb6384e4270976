"""The figure of an accuracy study: error against time.

In a notebook it is the last line of a cell; `figure.savefig("name.pdf")` writes it.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from matplotlib.transforms import Bbox

from polar_bayes.benchmark.accuracy import AS_GIVEN
from polar_bayes.benchmark.advice import (
    RESOLVED,
    accuracy_dataset,
    accuracy_sentences,
    accuracy_table,
    parameter_errors,
)
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting.page import Picture, fill, picture
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Drawing,
    lighten,
    paper,
    plain,
    quiet_ticks,
    styled,
)
from polar_bayes.reporting.tables import Row, Table, fact_rows, made_by
from polar_bayes.reporting.text import DASH, or_dash

WINE, INDIGO = "#882255", "#332288"  # of Paul Tol's muted scheme, beside those of the house
COLORS = (VERMILLION, ORANGE, SKY, GREEN, PURPLE, WINE, GRAY, BLUE, INDIGO)
MARKERS = ("o", "^", "v", "s", "D", "P", "X", "*")
LETTER, LINE = 5.2, 10.0
"""About the size of a letter of a label, unit point: labels are placed before they are drawn."""

AROUND = (
    (6, 0),
    (6, 8),
    (6, -8),
    (-6, 0),
    (-6, 8),
    (-6, -8),
    (6, 18),
    (6, -18),
    (-6, 18),
    (-6, -18),
)
"""Where a label may stand beside its point, unit point; the first free place is taken."""

NEAR = 8
"""Unit point: a label that is higher or lower has a line to its point."""

TIME_LABELS = {
    "seconds_first": "time of a first fit, compilation included [s]",
    "seconds_again": "time of the next fit, nothing to compile [s]",
}


@styled
def plot_accuracy(
    result: xr.DataTree | xr.Dataset, *, times: Sequence[str] | None = None
) -> Figure:
    """Error against time of every method and override, with the Pareto front.

    Args:
        result: What `polar_bayes.accuracy` returns, or one read back from a file.
        times: Columns of `polar_bayes.benchmark.accuracy_table`, a panel each: "seconds_first",
            "seconds_again"; by default both, where they were measured.

    Returns:
        The figure. A color stands for a method, a marker for the override; methods as given are
        filled and named. The line joins points than which none is both faster and better. In the
        gray area the reference itself does not tell errors from nothing.

    Raises:
        FitError: It holds no accuracy study, or no such column.
    """
    found = accuracy_dataset(result)
    table = accuracy_table(found)
    shown = list(times) if times is not None else _measured(table)
    strange = [name for name in shown if name not in TIME_LABELS]
    if strange or not shown:
        raise FitError(
            f"there is no time {', '.join(strange)}" if strange else "no time was measured",
            where="plot_accuracy",
            hint=f"give some of {', '.join(TIME_LABELS)}",
        )
    figure = Drawing(figsize=(5.2 * len(shown), 4.4), layout="constrained")
    for at, name in enumerate(shown):
        axes = figure.add_subplot(1, len(shown), at + 1)
        front_panel(axes, found, name)
        if at == 0:
            axes.set_ylabel("largest error of a mean or sd [posterior sd]")
    overrides = list(dict.fromkeys(table["override"]))
    if len(overrides) > 1:
        handles = [
            Line2D(
                [],
                [],
                ls="",
                marker=marker,
                mfc=GRAY if at == 0 else "none",
                mec=GRAY,
                label=override,
            )
            for at, (override, marker) in enumerate(
                zip(overrides, _repeat(MARKERS, len(overrides)), strict=True)
            )
        ]
        figure.legend(
            handles=handles, loc="outside lower center", ncols=4 * len(shown), frameon=False
        )
    return figure


def _measured(table: pd.DataFrame) -> list[str]:
    return [name for name in TIME_LABELS if table[name].notna().any()]


def front_panel(axes: Axes, found: xr.Dataset, time: str) -> None:
    """One panel of `plot_accuracy`."""
    table, noise = accuracy_table(found), float(found.attrs["reference_error"])
    # Axes of logarithms have no place for a time of zero.
    known = table[np.isfinite(table["error"]) & np.isfinite(table[time]) & (table[time] > 0.0)]
    methods, overrides = (list(dict.fromkeys(table[name])) for name in ("method", "override"))
    colors = dict(zip(methods, _repeat(COLORS, len(methods)), strict=True))
    markers = dict(zip(overrides, _repeat(MARKERS, len(overrides)), strict=True))
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axhspan(1e-9, RESOLVED * noise, color=lighten(GRAY, 0.85), lw=0, zorder=0)
    front = _front(known, time)
    axes.plot(front[time], front["error"], color=GRAY, lw=1.0, drawstyle="steps-post", zorder=1)
    for _, row in known.iterrows():
        given = row["override"] == AS_GIVEN
        axes.plot(
            row[time],
            row["error"],
            ls="",
            marker=markers[row["override"]],
            ms=6.5 if given else 4.5,
            mfc=colors[row["method"]] if given else "none",
            mec=colors[row["method"]],
            zorder=3 if given else 2,
        )
    _limits(axes, known, time, noise)
    axes.set_xlabel(TIME_LABELS[time])
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))  # often less than a decade
    for axis in (axes.xaxis, axes.yaxis):  # the style reads no formulas
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
    _name_points(axes, known, time, colors)
    quiet_ticks(axes)


def _front(known: pd.DataFrame, time: str) -> pd.DataFrame:
    """Rows that are better than all faster ones."""
    ordered = known.sort_values([time, "error"], kind="stable")
    before = ordered["error"].cummin().shift(fill_value=np.inf)
    return ordered[ordered["error"] < before]


def _limits(axes: Axes, known: pd.DataFrame, time: str, noise: float) -> None:
    """Room around all points, and to the right for a name."""
    if known.empty:
        return
    seconds, error = known[time], known["error"].clip(lower=1e-6)
    axes.set_xlim(float(seconds.min()) / 1.6, float(seconds.max()) * 3.0)
    axes.set_ylim(min(float(error.min()), noise) / 1.6, float(error.max()) * 1.8)


def _name_points(axes: Axes, known: pd.DataFrame, time: str, colors: dict[str, str]) -> None:
    """The name of each method beside its point, where no other name or point stands."""
    figure = axes.get_figure()
    scale = 72.0 / (figure.dpi if figure is not None else 100.0)
    places = axes.transData.transform(known[[time, "error"]].to_numpy(float)) * scale
    taken = [Bbox.from_bounds(x - 3, y - 3, 6, 6) for x, y in places]
    given = known[known["override"] == AS_GIVEN]
    own = places[(known["override"] == AS_GIVEN).to_numpy()]
    for (x, y), name in zip(own, given["method"], strict=True):
        width = LETTER * len(name)
        for right, up in AROUND:
            box = Bbox.from_bounds(
                x + (right if right > 0 else right - width), y + up - 5, width, LINE
            )
            if not any(box.overlaps(other) for other in taken):
                break
        taken.append(box)
        axes.annotate(
            plain(name),
            tuple(given.loc[given["method"] == name, [time, "error"]].to_numpy(float)[0]),
            xytext=(right, up),
            textcoords="offset points",
            ha="left" if right > 0 else "right",
            va="center",
            fontsize=8,
            color=colors[name],
            arrowprops={"arrowstyle": "-", "color": colors[name], "lw": 0.6}
            if abs(up) > NEAR
            else None,
            path_effects=[withStroke(linewidth=2.5, foreground=paper())],
        )


def _repeat(values: Sequence[str], count: int) -> list[str]:
    return [values[at % len(values)] for at in range(count)]


# --- The report of an accuracy study: advice, the picture, and the numbers behind it --------------


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
    found = accuracy_dataset(result)
    return {
        "advice": " ".join(accuracy_sentences(found)),
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
        "Down is better, left is faster. A color stands for a method, a marker for the override "
        "beside it; methods as given are filled and named. The line joins those than which nothing "
        "is both faster and better. In the gray area the reference itself cannot tell an error "
        "from nothing.",
    )


def reference_sentence(result: xr.DataTree | xr.Dataset) -> str:
    """What the reference is, and how well it is known."""
    told = accuracy_dataset(result).attrs
    sentence = (
        f"The reference is {told['reference_draws']:,} draws of {told['reference']}, worth "
        f"{told['reference_effective_draws']:,.0f} independent ones; its own Monte Carlo error is "
        f"at most {told['reference_error']:.2g} posterior sd."
    )
    doubts = told["reference_doubts"]
    return f"{sentence} Against it speaks: {doubts}." if doubts else sentence


def study_table(found: xr.Dataset) -> Table:
    """A row for each method and override."""
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
    errors = parameter_errors(found)[found["override"].to_numpy() == AS_GIVEN]
    rows = tuple(
        Row(str(name), str(name), tuple(or_dash(value, "{:.2g}") for value in row))
        for name, row in errors.iterrows()
    )
    caption = "The larger error of mean and standard deviation of each, in posterior sds."
    return Table(caption, ("method", *map(str, errors.columns)), rows, errors)
