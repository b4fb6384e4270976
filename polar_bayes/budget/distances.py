"""How far draws are from those of a reference, in its standard deviations."""

from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float

INTERVAL = (0.025, 0.975)


class Distances(NamedTuple):
    """Of every parameter, in standard deviations of the reference, each (parameter,)."""

    mean_error: Float[np.ndarray, " parameter"]
    sd_error: Float[np.ndarray, " parameter"]
    low_error: Float[np.ndarray, " parameter"]
    high_error: Float[np.ndarray, " parameter"]
    wasserstein: Float[np.ndarray, " parameter"]


def distances(
    draws: Float[np.ndarray, "parameter draw"], reference: Float[np.ndarray, "parameter many"]
) -> Distances:
    """Compare draws with those of a reference."""
    whole = np.isfinite(draws).all(axis=1)
    found = np.full((len(Distances._fields), len(draws)), np.inf)
    for at in np.flatnonzero(whole):
        ours, theirs = draws[at], reference[at]
        unit = theirs.std()
        low, high = np.quantile(ours, INTERVAL) - np.quantile(theirs, INTERVAL)
        apart = scipy.stats.wasserstein_distance(ours, theirs)
        moved = np.array([ours.mean() - theirs.mean(), ours.std() - unit, low, high, apart])
        found[:, at] = moved / unit
    return Distances(*found)
