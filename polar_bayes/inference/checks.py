r"""Checks of a model that fits and maps share, as functions of arrays, with their levels.

A parameter at the value at which what it describes is absent or perfect is no conflict, however
rarely the prior has it there: a body that sends no light is the simplest object there is. Its
tail is therefore one-sided, and of k such tails the sum of squared scores has a mixture of
$\chi^2$ distributions,

$$ P\Big(\sum_j \max(z_j, 0)^2 > s\Big) = \sum_i \binom{k}{i} 2^{-k} P(\chi^2_i > s) $$

Source: Evans & Moshonov (2006), Bayesian Analysis 1, 893 (prior-data conflict by tail probability);
Silvapulle & Sen (2005), Constrained Statistical Inference, section 3.4 (chi-bar-square).
"""

import math
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Float
from scipy import stats

from polar_bayes.inference.result import CENTRAL_95
from polar_bayes.physics.part import absence

CAUTION = 0.02
"""Probability, under a correct model, that one check gives a caution or a problem."""

PROBLEM = 0.004
"""Probability, under a correct model, that one check gives a problem."""

NEAR_BOUND = 0.05
"""Width of the strip at a bound, as a share of the 95% interval."""

MASS_AT_BOUND = 0.068
"""Share of draws in that strip from which a bound is reported: midway between that of a uniform
density, 0.0475, and that of half a normal one, 0.088, whose peak is the bound."""

NOISE_FACTOR = "stokes_error_factor"

CARRIES = 0.3
"""Smallest correlation with a material parameter at which a parameter is checked with it."""

ANGLE_SCALES = (4.0, 15.0)
"""Length scales, in degrees, on which residuals are tested for structure."""


def excluding_bounds(name: str, support: Iterable[float]) -> Iterator[float]:
    """Yield the finite ends of a parameter's support, but not a value at which it is absent."""
    absent = absence(name)
    for bound in filter(math.isfinite, support):
        if absent is None or absent.value != bound:
            yield bound


def share_at(
    bound: float,
    draws: Float[np.ndarray, "... draw"],
    weights: Float[np.ndarray, "... draw"] | None = None,
    width: Float[np.ndarray, "..."] | None = None,
) -> Float[np.ndarray, "..."]:
    """Return the share of draws in the strip at a bound; `width` is that of their interval."""
    if width is None:
        width = np.ptp(np.quantile(draws, CENTRAL_95, axis=-1), axis=0)
    is_near = np.abs(draws - bound) < NEAR_BOUND * width[..., None]
    return is_near.mean(axis=-1) if weights is None else np.sum(weights * is_near, axis=-1)


def tail_scores(
    below: Float[np.ndarray, "... parameter"], end: Float[np.ndarray, " parameter"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return tail probabilities of the prior and their normal scores, (..., parameter).

    `below` is the prior probability below each posterior median; `end` says where the parameter is
    absent or perfect, -1 at the low end, 1 at the high end, 0 nowhere: that end is no tail.
    """
    away = np.where(end < 0.0, 1.0 - below, below)
    tails = np.where(end == 0.0, 2.0 * np.minimum(below, 1.0 - below), away)
    tails = np.clip(tails, 1e-300, 1.0)  # a smaller one is not told from zero
    scores = stats.norm.isf(np.where(end == 0.0, tails / 2.0, tails))
    return tails, np.maximum(scores, 0.0)


def prior_conflict(
    below: Float[np.ndarray, "... parameter"], end: Float[np.ndarray, " parameter"]
) -> np.ndarray:
    """Return p-values of the smallest tail (Bonferroni) and of all tails jointly, by row."""
    tails, scores = tail_scores(below, end)
    farthest = tails.min(axis=-1) * tails.shape[-1]
    one_sided = int(np.sum(end != 0.0))
    squares, two_sided = np.sum(scores**2, axis=-1), tails.shape[-1] - one_sided
    together = sum(
        math.comb(one_sided, i) * 0.5**one_sided * _chi2_tail(squares, i + two_sided)
        for i in range(one_sided + 1)
    )
    return np.minimum(1.0, 2.0 * np.minimum(farthest, together))


def _chi2_tail(squares: np.ndarray, degrees: int) -> np.ndarray:
    """Return the upper tail of chi squared; zero degrees of freedom put all mass at zero."""
    return stats.chi2.sf(squares, degrees) if degrees else np.where(squares > 0.0, 0.0, 1.0)


def level(p_value: float) -> str:
    """Return the level of a check with this p-value."""
    if not math.isfinite(p_value):
        return "not computed"
    return "problem" if p_value < PROBLEM else "caution" if p_value < CAUTION else "passed"
