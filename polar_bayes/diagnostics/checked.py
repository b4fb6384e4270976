"""The checks behind the verdict of a fit, by name."""

import math

import pandas as pd

from polar_bayes.diagnostics.finding import LEVELS
from polar_bayes.diagnostics.parameters import APPROXIMATIONS, WEIGHTED

NAMES = {
    "index": "Brewster's angle",
    "angle": "residuals over the angle",
    "wavelength": "residuals over the wavelength",
    "leave-one-out": "leave-one-out predictions",
    "influence": "the influence of single readings",
    "repeats": "repeated views",
    "alternatives": "alternative parts of the scene",
}
"""Descriptions of checks whose own names do not say what they examine."""
TESTED = (
    *("noise", "systematic errors", "angle", "wavelength", "outliers", "leave-one-out"),
    "alternatives",
)
"""Checks that have a p-value if there is anything to check."""


def checks_made(method: str, criticism: pd.DataFrame) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Describe which checks of a fit were made, and which could not be.

    Args:
        method: The method of the fit.
        criticism: The table of `polar_bayes.diagnostics.criticize`.
    """
    how = "chains (R-hat, effective sample sizes, divergences)"
    if method in APPROXIMATIONS:
        how = "the approximation (Pareto k)"
    elif method in WEIGHTED:
        how = "weighted draws (effective sample size, Pareto k)"
    made, missing = [how], []
    # What is absent only describes, and says nothing against the intervals.
    for check, row in criticism.drop(index=["absent"], errors="ignore").iterrows():
        name = NAMES.get(str(check), str(check))
        if row["level"] == "not computed":
            missing.append(name)
        elif row["level"] in LEVELS and (check not in TESTED or math.isfinite(row["p_value"])):
            made.append(name)
    return tuple(made), tuple(missing)
