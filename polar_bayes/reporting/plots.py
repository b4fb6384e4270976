"""Every figure by its own function, from a saved result alone."""

from polar_bayes.reporting.accuracy import plot_accuracy
from polar_bayes.reporting.comparison import plot_comparison
from polar_bayes.reporting.maps import plot_maps
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
