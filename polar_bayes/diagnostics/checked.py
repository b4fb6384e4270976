"""What was checked of a fit: the checks behind its verdict, by name."""

import math

import pandas as pd

from polar_bayes.diagnostics.convergence import WEIGHTED, Verdict
from polar_bayes.diagnostics.parameters import APPROXIMATIONS

NAMES = {
    "angle": "residuals over the angle",
    "wavelength": "residuals over the wavelength",
    "leave-one-out": "leave-one-out predictions",
    "influence": "the influence of single readings",
    "repeats": "repeated views",
    "alternatives": "alternative parts of the scene",
}
"""Checks of the criticism whose own names do not say what they look at."""
NEVER_AGAINST = ("absent",)
"""Checks that describe, and say nothing against the intervals."""
TESTED = (
    *("noise", "systematic errors", "angle", "wavelength", "outliers", "leave-one-out"),
    "alternatives",
)
"""Checks that have a p-value wherever there is something to check."""
LEVELS = ("passed", "note", "caution", "problem")


def checks_made(method: str, criticism: pd.DataFrame) -> tuple[list[str], list[str]]:
    """What was checked of a fit by draws, and what could not be, in words.

    Args:
        method: The method of the fit.
        criticism: The table of `polar_bayes.diagnostics.criticize`.
    """
    how = "chains (R-hat, effective sample sizes, divergences)"
    if method in APPROXIMATIONS:
        how = "the approximation (Pareto k-hat)"
    elif method in WEIGHTED:
        how = "weighted draws (effective sample size, Pareto k-hat)"
    made, missing = [how], []
    for check, row in criticism.drop(index=[*NEVER_AGAINST], errors="ignore").iterrows():
        name = NAMES.get(str(check), str(check))
        if row["level"] == "not computed":
            missing.append(name)
        elif row["level"] in LEVELS and (check not in TESTED or math.isfinite(row["p_value"])):
            made.append(name)
    return made, missing


def nothing_against(method: str, verdict: Verdict, criticism: pd.DataFrame) -> str:
    """What was checked, of a fit without problem and caution; empty of any other."""
    if not verdict.passed or verdict.cautions:
        return ""
    made, missing = checks_made(method, criticism)
    left = f" Not computed: {', '.join(missing)}." if missing else ""
    listed = " and ".join(filter(None, [", ".join(made[:-1]), made[-1]]))
    return f"Nothing speaks against the intervals in what was checked: {listed}.{left}"
