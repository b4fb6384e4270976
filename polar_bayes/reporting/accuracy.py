"""Report of an accuracy study: error of every method against time."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator
from matplotlib.transforms import Bbox

from polar_bayes.benchmark.advice import (
    AS_GIVEN,
    AccuracyView,
    Study,
    accuracy_sentences,
    accuracy_view,
    pareto_front,
)
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting import page, style, text
from polar_bayes.reporting.style import BLUE, GRAY, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from polar_bayes.reporting.text import DASH, column, or_dash
from polar_bayes.repr_html import Table

# The last two of the dark ones are of Paul Tol's muted scheme.
COLORS = (VERMILLION, ORANGE, SKY, GREEN, PURPLE, "#882255", GRAY, BLUE, "#332288")
MARKERS = ("o", "^", "v", "s", "D", "P", "X", "*")
TIME_LABELS = {
    "seconds_first": "time of a first fit, compilation included [s]",
    "seconds_again": "time of the next fit, nothing to compile [s]",
}


@style.styled
def plot_accuracy(result: Study, *, times: Sequence[str] | None = None) -> Figure:
    """Plot error against time of every method and its variations, with the Pareto front.

    Args:
        result: What `polar_bayes.accuracy` returns, or one read back from a file.
        times: Columns of `polar_bayes.summary`, a panel each: "seconds_first",
            "seconds_again"; by default both, where they were measured.

    Returns:
        The figure. A color stands for a method, a marker for what was changed of it; methods as
        given are filled and named. The line joins the Pareto front: points than which none is both
        faster and better. In the gray area errors are smaller than that of the reference.

    Raises:
        FitError: It holds no accuracy study, or no such column.
    """
    study = accuracy_view(result)
    table = study.table
    shown = list(times) if times is not None else [t for t in TIME_LABELS if table[t].notna().any()]
    style.check_shown(shown, TIME_LABELS, "time", "plot_accuracy")
    figure = style.NotebookFigure(figsize=(5.2 * len(shown), 4.4), layout="constrained")
    for at, name in enumerate(shown):
        axes = figure.add_subplot(1, len(shown), at + 1)
        front_panel(axes, study, name)
        if at == 0:
            axes.set_ylabel("largest error of a mean or sd [posterior sd]")
    markers = style.in_turn(table["override"], MARKERS)
    if len(markers) > 1:
        fills = [GRAY, *["none"] * (len(markers) - 1)]
        handles = [
            Line2D([], [], ls="", marker=marker, mfc=fill, mec=GRAY, label=variation)
            for fill, (variation, marker) in zip(fills, markers.items(), strict=True)
        ]
        place: style.Look = {"loc": "outside lower center", "ncols": 4 * len(shown)}
        figure.legend(handles=handles, frameon=False, **place)
    return figure


def front_panel(axes: Axes, study: AccuracyView, time: str) -> None:
    """Draw one panel of `plot_accuracy`."""
    table, noise = study.table, study.resolved
    # Logarithmic axes cannot show a time of zero.
    known = table[np.isfinite(table["error"]) & np.isfinite(table[time]) & (table[time] > 0.0)]
    colors = style.in_turn(table["method"], COLORS)
    markers = style.in_turn(table["override"], MARKERS)
    axes.set(xscale="log", yscale="log", xlabel=TIME_LABELS[time])
    axes.axhspan(1e-9, noise, color=style.lighten(GRAY, 0.85), lw=0, zorder=0)
    is_front = pareto_front(known[time].to_numpy(), known["error"].to_numpy())
    front = known[is_front].sort_values(time)
    axes.plot(front[time], front["error"], color=GRAY, lw=1.0, drawstyle="steps-post", zorder=1)
    for _, row in known.iterrows():
        given, color = row["override"] == AS_GIVEN, colors[row["method"]]
        look: style.Look = {"mfc": color, "ms": 6.5, "zorder": 3}
        look = look if given else {"mfc": "none", "ms": 4.5, "zorder": 2}
        marker = markers[row["override"]]
        axes.plot(row[time], row["error"], ls="", marker=marker, mec=color, **look)
    if not known.empty:  # with room for a name on the right
        error = known["error"].clip(lower=1e-6)
        axes.set_xlim(float(known[time].min()) / 1.6, float(known[time].max()) * 3.0)
        axes.set_ylim(min(float(error.min()), noise / 2.0) / 1.6, float(error.max()) * 1.8)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))  # often less than a decade
    style.plain_numbers(axes.xaxis, axes.yaxis)
    _name_methods(axes, known, time, colors)


def _name_methods(axes: Axes, known: pd.DataFrame, time: str, colors: dict[str, str]) -> None:
    """Write the name of each method next to its point, where there is room."""
    figure = axes.get_figure()
    # In points; sizes of letters are approximate, for labels are placed before they are drawn.
    scale = 72.0 / (figure.dpi if figure is not None else 100.0)
    points = axes.transData.transform(known[[time, "error"]].to_numpy(float)) * scale
    taken = [Bbox.from_bounds(x - 3, y - 3, 6, 6) for x, y in points]
    offsets = [(x, up) for ups in ((0, 8, -8), (18, -18)) for x in (6, -6) for up in ups]
    is_given = (known["override"] == AS_GIVEN).to_numpy()
    for (x, y), (_, row) in zip(points[is_given], known[is_given].iterrows(), strict=True):
        name = row["method"]
        width = 5.2 * len(name)
        for right, up in offsets:
            left = x + (right if right > 0 else right - width)
            box = Bbox.from_bounds(left, y + up - 5, width, 10.0)
            if not any(box.overlaps(other) for other in taken):
                break
        taken.append(box)
        line = {"arrowstyle": "-", "color": colors[name], "lw": 0.6}
        place: style.Look = {"xytext": (right, up), "textcoords": "offset points", "va": "center"}
        axes.annotate(
            style.label_text(name),
            (float(row[time]), float(row["error"])),
            ha="left" if right > 0 else "right",
            **{**place, "fontsize": 8, "color": colors[name]},
            arrowprops=line if abs(up) > 8 else None,
            path_effects=[withStroke(linewidth=2.5, foreground=style.background())],
        )


# --- The page -------------------------------------------------------------------------------------


def accuracy_page(result: xr.DataTree) -> page.Page:
    """Return the page of an accuracy study."""
    study, provenance = accuracy_view(result), provenance_of(result)
    facts = {str(key).replace("_", " "): value for key, value in provenance.items()}
    sections = [
        page.Section("front", "Error against time", [accuracy_picture(study)]),
        page.Section("methods", "Methods and settings", [study_table(study)]),
        page.Section("parameters", "Errors of every parameter", [error_table(study)]),
        page.Section("provenance", "Provenance", [page.facts(facts)]),
    ]
    return page.Page(
        kind="Accuracy against time",
        name=text.capture_name(provenance),
        subtitles=[text.made_by(provenance, "every method of the study")],
        headline=" ".join(accuracy_sentences(study)),
        passed=not study.doubts,
        sentences=[text.reference_sentence(study)],
        sections=sections,
        footer="Computed from accuracy.nc, which lies in the same folder.",
    )


def accuracy_card(result: xr.DataTree) -> page.Card:
    """Return the card of an accuracy study."""
    study = accuracy_view(result)
    sentences = [*accuracy_sentences(study), text.reference_sentence(study)]
    return sentences, study_table(study), not study.doubts


def accuracy_picture(study: AccuracyView) -> str:
    """Plot error against time."""
    return page.picture(plot_accuracy(study), "accuracy.figure_front")


def study_table(study: AccuracyView) -> Table:
    """Return a table with a row for each method and each variation of it."""
    table = study.table

    def error(row: pd.Series) -> str:
        if math.isfinite(row["error"]) and not row["resolved"]:
            return f"< {study.resolved:.2g}"
        return or_dash(row["error"], ".2g")

    marks = {
        str(name): "; ".join(filter(None, ["*" if row["on_front"] else "", row["problems"]]))
        for name, row in table.iterrows()
    }
    cells: page.Cells = {
        "error": error,
        "of": lambda row: row["worst"] if math.isfinite(row["error"]) else DASH,
        "first s": column("seconds_first", ".2g"),
        "next s": column("seconds_again", ".2g"),
        "MiB": column("peak_memory", ",.0f"),
        "interval": column("interval", ".2g"),
        "Wasserstein": column("wasserstein", ".2g"),
        "R-hat": column("r_hat", ".3f"),
        "Pareto k": column("pareto_k", ".2f"),
        "ESS": column("ess", ",.0f"),
        "gradients": column("gradients", ",.0f"),
        "densities": column("densities", ",.0f"),
    }
    return page.make_table(
        "accuracy.study", cells, table, label="method", descriptions=marks, prose=["method"]
    )


def error_table(study: AccuracyView) -> Table:
    """Return a table of errors of every parameter by the methods as given."""
    errors = study.errors[study.is_given]
    cells: page.Cells = {str(name): column(name, ".2g") for name in errors.columns}
    return page.make_table("accuracy.error", cells, errors, label="method")


REPORT = page.Report(accuracy_page, accuracy_card, plot_accuracy, file="accuracy.nc")
