"""One function per figure, from a saved result alone, and `plot` for any result."""

from typing import Any

from matplotlib.figure import Figure

from polar_bayes.diagnostics.compare import FitComparison
from polar_bayes.reporting.accuracy import plot_accuracy
from polar_bayes.reporting.comparison import plot_comparison
from polar_bayes.reporting.maps import plot_maps
from polar_bayes.reporting.page import report_of
from polar_bayes.reporting.plots_calibration import plot_calibration
from polar_bayes.reporting.plots_curves import plot_readings, plot_residuals, plot_spectrum
from polar_bayes.reporting.plots_fit import (
    plot_pairs,
    plot_pit,
    plot_prior_posterior,
    plot_ranks,
    plot_shrinkage,
)

__all__ = [
    "plot",
    "plot_accuracy",
    "plot_calibration",
    "plot_comparison",
    "plot_maps",
    "plot_pairs",
    "plot_pit",
    "plot_prior_posterior",
    "plot_ranks",
    "plot_readings",
    "plot_residuals",
    "plot_shrinkage",
    "plot_spectrum",
]


def plot(result: Any) -> Figure:
    """Plot the main figure of a result.

    Args:
        result: A fit, a map, a calibration, an accuracy study, several fits by name, or what
            `polar_bayes.diagnostics.compare_fits` returned of them.

    Returns:
        Prior and posterior of a fit, or the readings of a point fit; means and widths of a map;
        ranks of a calibration; error against time of a study; intervals of compared fits.

    Raises:
        FitError: It is none of these.
    """
    if isinstance(result, FitComparison):
        return plot_comparison(result)
    return report_of(result).plot(result)
