"""Results of a batch of pixels: status, method used and diagnostics of each."""

import enum
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from polar_bayes.inference.program import Values

MIN_VIEWS = 2
"""Valid views without which a pixel is not fitted."""


class Status(enum.IntEnum):
    """Status of a pixel; the last is the value of chunks that are not written."""

    GOOD = 0
    MASKED = 1
    TOO_FEW_VIEWS = 2
    NOT_CONVERGED = 3
    NOT_TRUSTED = 4
    NOT_FITTED = -1


class MethodUsed(enum.IntEnum):
    """The method by which the numbers of a pixel were found."""

    NONE = 0
    LAPLACE = 1
    IMPORTANCE = 2
    ADAPTED = 3
    NUTS = 4
    TEMPERED = 5
    VARIATIONAL = 6


Describe = Callable[[np.ndarray, Values, np.ndarray], None]
"""Receives indices of pixels with an answer, their draws by name and weights of (pixel, draw)."""


class Outcome(NamedTuple):
    """Diagnostics of a batch of pixels: NaN where there are none."""

    pareto_k: np.ndarray
    effective_draws: np.ndarray
    condition: np.ndarray
    steps: np.ndarray
    approach: np.ndarray
    status: np.ndarray


def empty_outcome(count: int, status: Status = Status.NOT_CONVERGED) -> Outcome:
    """Diagnostics of pixels that are not fitted yet."""
    return Outcome(
        pareto_k=np.full(count, np.nan),
        effective_draws=np.full(count, np.nan),
        condition=np.full(count, np.nan),
        steps=np.zeros(count, np.int32),
        approach=np.full(count, MethodUsed.NONE, np.int8),
        status=np.full(count, status, np.int8),
    )
