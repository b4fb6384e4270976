"""Optimal design: criteria of an expected covariance, and Fedorov's exchange algorithm.

Sources: Atkinson, Donev & Tobias (2007), Optimum Experimental Designs, chapters 10 and 12; Fedorov
(1972), Theory of Optimal Experiments, chapter 3.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, override

import numpy as np
from jaxtyping import Bool, Float

from polar_bayes.errors import FitError

Covariance = Float[np.ndarray, "... parameter parameter"]
Losses = Float[np.ndarray, "..."]

# --- Criteria -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class AbstractCriterion(abc.ABC):
    """A scalar measure of an expected covariance, to be minimized."""

    @abc.abstractmethod
    def loss(self, covariance: Covariance, parameters: Sequence[str]) -> Losses:
        """Return the number that a choice of views is to minimize.

        Args:
            covariance: Expected covariance of the material's parameters, in their prior sds.
            parameters: Their labels, such as `refractive_index[550]`.

        Returns:
            One number for each matrix.

        Raises:
            FitError: The criterion asks for a parameter that is not there.
        """


@dataclasses.dataclass(frozen=True)
class DOptimal(AbstractCriterion):
    r"""Volume of the joint credible region: $\tfrac12 \log\det$ of the covariance.

    It does not depend on units, and counts what parameters share.

    Source:
        Atkinson, Donev & Tobias (2007), Optimum Experimental Designs, chapter 10.
    """

    @override
    def loss(self, covariance: Covariance, parameters: Sequence[str]) -> Losses:
        values = np.linalg.eigvalsh(covariance)
        # Smaller variances are rounding, in squared prior sds: one parameter follows from others.
        return 0.5 * np.sum(np.log(np.maximum(values, 1e-14)), axis=-1)


@dataclasses.dataclass(frozen=True)
class AOptimal(AbstractCriterion):
    """Sum of the variances of all parameters, each in squared prior sds.

    Source:
        Atkinson, Donev & Tobias (2007), Optimum Experimental Designs, chapter 10.
    """

    @override
    def loss(self, covariance: Covariance, parameters: Sequence[str]) -> Losses:
        return np.trace(covariance, axis1=-2, axis2=-1)


@dataclasses.dataclass(frozen=True)
class SingleParameter(AbstractCriterion):
    """Variance of one parameter, in squared prior sds; all others are nuisance parameters.

    Args:
        name: Such as "refractive_index" (summed over wavelengths or patches where it has several
            values), or one of them, "refractive_index[550]".
    """

    name: str

    @override
    def loss(self, covariance: Covariance, parameters: Sequence[str]) -> Losses:
        names = [(label, label.split("[")[0]) for label in parameters]
        rows = [i for i, known in enumerate(names) if self.name in known]
        if not rows:
            what, hint = "no parameter of the material has that name", ", ".join(parameters)
            where = f"SingleParameter({self.name!r})"
            raise FitError(what, where=where, hint=f"give one of {hint}")
        return np.sum(np.diagonal(covariance, axis1=-2, axis2=-1)[..., rows], axis=-1)


# --- Fedorov's exchange algorithm -----------------------------------------------------------------


Loss = Callable[[Float[np.ndarray, "draw option size size"]], Float[np.ndarray, " option"]]


class Selection(NamedTuple):
    """Candidates in the order of selection, and the loss before and after each."""

    picks: list[int]
    losses: list[float]
    exchanges: int


def fedorov_exchange(
    loss: Loss,
    base: Float[np.ndarray, "draw size size"],
    each: Float[np.ndarray, "draw candidate size size"],
    allowed: Bool[np.ndarray, " candidate"],
    conflicts: Bool[np.ndarray, "candidate candidate"],
    count: int,
) -> Selection:
    """Select candidates whose summed information has a small loss: greedily, then by exchange."""
    best = functools.partial(_best_addition, loss, base, each)

    def free(picks: list[int]) -> list[int]:
        return np.flatnonzero(allowed & ~conflicts[picks].any(axis=0)).tolist()

    picks: list[int] = []
    for number in range(count):
        if not (options := free(picks)):
            what = f"only {number} of {len(allowed)} candidates can be taken together"
            hint = "ask for fewer, or give more candidates or wider constraints"
            raise FitError(what, where="next_views", hint=hint)
        pick, reached = best(picks, options)
        picks.append(pick)
    exchanges, before = 0, -1
    while exchanges > before:  # each exchange lowers the loss, so this ends
        before = exchanges
        for at in range(count):
            others = picks[:at] + picks[at + 1 :]
            pick, lower = best(others, free(others))
            if lower < reached - 1e-9 * max(1.0, abs(reached)):  # smaller gains are rounding
                picks[at], reached, exchanges = pick, lower, exchanges + 1
    ordered: list[int] = []
    losses = [float(loss(base[:, None])[0])]
    while picks:  # the same candidates in greedy order
        pick, lowest = best(ordered, picks)
        picks.remove(pick)
        ordered.append(pick)
        losses.append(lowest)
    return Selection(ordered, losses, exchanges)


def _best_addition(
    loss: Loss, base: np.ndarray, each: np.ndarray, picks: list[int], options: list[int]
) -> tuple[int, float]:
    """Return the option whose information, added to that of the picks, has the lowest loss."""
    known = base + each[:, picks].sum(axis=1)
    losses = loss(known[:, None] + each[:, options])
    at = int(np.argmin(losses))
    return options[at], float(losses[at])
