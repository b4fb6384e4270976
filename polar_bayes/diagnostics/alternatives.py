"""Alternatives to parts of a fit's scene, and the answers that they give."""

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.diagnostics.parameters import with_entries
from polar_bayes.diagnostics.view import FitView, view_of
from polar_bayes.errors import FitError
from polar_bayes.frames import PrintedFrame

NOTHING = "nothing"
"""Name of the part that an additional, unseen layer would replace, and of what replaces a part that
may be absent."""

COLUMNS = ("part", "alternative", "path", "log_bayes_factor", "mean", "other", "shift", "redefined")


def alternatives(result: xr.DataTree | FitView) -> pd.DataFrame:
    """Return the alternatives of a fit: for each, its evidence and its answer.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A row for each alternative and material parameter (every parameter of a model that declares
        none of the material's): part and alternative (class names; "nothing" and a layer such as
        "water film" where the alternative adds one, a body and "nothing" where it leaves the body
        out), path (of the part in the scene), log_bayes_factor (of the alternative over the scene
        of the fit, natural logarithm), mean (posterior mean, unit of the parameter), other (value
        by the alternative: the mean moved by the difference of both modes), shift (that difference
        in posterior sds), and redefined (True where the parameter means something else with the
        alternative). The index holds the names of the parameters. Empty where the scene has no part
        with an alternative.

    Raises:
        FitError: The tree holds no posterior, or its alternatives were not compared.

    Source:
        Kass and Raftery (1995), J. Am. Stat. Assoc. 90, 773 (Bayes factors).
    """
    fit = view_of(result)
    tried = fit.provenance.get("alternatives")
    reason = fit.provenance.get("alternatives_failed") or "the result does not hold them"
    compared = [each for each in tried or () if each.get("log_bayes_factor") is not None]
    if tried is None or len(compared) < len(tried):
        failed = [each["failed"] for each in tried or () if each.get("failed")]
        raise FitError(
            f"alternatives to the parts of its scene were not compared: {[*failed, reason][0]}",
            where="result",
            hint="fit one material, by a method that gives draws",
        )
    material = [scalar for scalar in fit.scalars if scalar.is_material]
    rows, labels = [], []
    for each in compared:
        for scalar, shift in with_entries(material or fit.scalars, each.get("shift") or {}):
            with np.errstate(invalid="ignore"):  # draws may be infinite: what is not known is NaN
                mean, sd = float(scalar.draws.mean()), float(scalar.draws.std())
            redefined = scalar.name in each["defines"]
            given = [each[name] for name in COLUMNS[:4]]
            rows.append([*given, mean, mean + shift * sd, shift, redefined])
            labels.append(scalar.label)
    return PrintedFrame(rows, columns=list(COLUMNS), index=pd.Index(labels, name="parameter"))
