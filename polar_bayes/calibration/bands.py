"""How far the ranks of a right method stray: bands of ECDFs, and of histograms."""

import math
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float

from polar_bayes.calibration.uniformity import MOST_POINTS, NULLS, null_statistics, two_sided


class EcdfBand(NamedTuple):
    """Empirical distributions of uniform samples, minus the uniform one."""

    at: Float[np.ndarray, " point"]
    lower: Float[np.ndarray, " point"]
    upper: Float[np.ndarray, " point"]


def ecdf_band(count: int, level: float) -> EcdfBand:
    """The band that a curve leaves exactly where `uniformity` has a p-value below the level."""
    # Source: Saeilynoja, Buerkner & Vehtari (2022), Stat. Comput. 32, 32.
    table = two_sided(count, min(count, MOST_POINTS))
    # A p-value is (1 + null samples at least as surprising) / (1 + NULLS): below the level are
    # those that surprise more than the null sample of this rank.
    rank = max(math.ceil(round(level * (1 + NULLS), 6)) - 2, 0)
    inside = table >= null_statistics(count)[rank]
    at = np.arange(1, table.shape[1] + 1) / (table.shape[1] + 1)
    lowest = inside.argmax(axis=0) / count
    highest = 1.0 - inside[::-1].argmax(axis=0) / count
    ends = [0.0]
    return EcdfBand(
        np.concatenate([ends, at, [1.0]]),
        np.concatenate([ends, lowest - at, ends]),
        np.concatenate([ends, highest - at, ends]),
    )


def histogram_band(count: int, bins: int, level: float = 0.05) -> tuple[float, float]:
    """How high the bars of a uniform histogram are."""
    tail = level / (2 * bins)
    low, high = scipy.stats.binom.ppf([tail, 1.0 - tail], count, 1.0 / bins)
    return float(low) * bins / count, float(high) * bins / count
