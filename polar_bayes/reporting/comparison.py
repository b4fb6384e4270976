"""Fits of one capture in a picture: the same parameter by each of them."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from polar_bayes.diagnostics.compare_fits import FitComparison
from polar_bayes.errors import FitError
from polar_bayes.reporting.style import (
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    grid,
    plain,
    quiet_ticks,
    styled,
    wrapped,
)

COLORS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, GRAY)
MOST_PANELS = 12


@styled
def plot_comparison(comparison: FitComparison) -> Figure:
    """Means and 95% intervals of each parameter by every fit that has it.

    Args:
        comparison: Of `polar_bayes.compare_fits`.

    Returns:
        The figure, a panel for each of the first 12 parameters. Point fits have twice their
        standard error in place of an interval, drawn dashed.

    Raises:
        FitError: No parameter has a finite mean.
    """
    table = comparison.parameters
    fits = list(comparison.verdicts)
    finite = table[np.isfinite(table["mean"])]
    labels = list(dict.fromkeys(finite.index.get_level_values("parameter")))[:MOST_PANELS]
    if not labels:
        raise FitError(
            "there is nothing to draw", where="plot_comparison", mend="give fits with finite draws"
        )
    colors = {name: COLORS[at % len(COLORS)] for at, name in enumerate(fits)}
    height = 0.55 + 0.2 * len(fits)
    figure, panels = grid(len(labels), columns=3, width=8.2, panel_height=height, header=0.4)
    for axes, label in zip(panels, labels, strict=True):
        own = finite.xs(label, level="parameter")
        for name, row in own.iterrows():
            at = -fits.index(str(name))
            ends = [row["q2.5"], row["q97.5"]]
            is_point = not np.isfinite(ends).all()
            if is_point:
                ends = [row["mean"] - 2.0 * row["sd"], row["mean"] + 2.0 * row["sd"]]
            color, line = colors[str(name)], (0, (2, 1)) if is_point else "-"
            axes.plot(ends, [at, at], color=color, lw=2.0, ls=line, solid_capstyle="butt")
            axes.plot([row["mean"]], [at], "o", color=color, ms=4.5)
        axes.set(ylim=(0.6 - len(fits), 0.4), yticks=[])
        axes.spines["left"].set_visible(False)
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(wrapped(plain(label.replace("_", " ")), 38), loc="left")
    quiet_ticks(panels)
    handles = [
        Line2D([], [], color=color, marker="o", ms=4.5, lw=2.0, label=plain(name, 24))
        for name, color in colors.items()
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=4, frameon=False)
    return figure
