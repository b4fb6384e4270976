"""Choosing some of many: greedily, then by exchange until no exchange helps."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from polar_bayes.errors import FitError

GAIN = 1e-9
"""Smallest gain for which an exchange is made: below it lies rounding."""

Loss = Callable[[Float[np.ndarray, "draw option size size"]], Float[np.ndarray, " option"]]


class Chosen(NamedTuple):
    """A choice in the order in which each adds most to those before."""

    picks: list[int]
    losses: list[float]
    exchanges: int


def choose(
    loss: Loss,
    base: Float[np.ndarray, "draw size size"],
    each: Float[np.ndarray, "draw candidate size size"],
    allowed: Bool[np.ndarray, " candidate"],
    clashes: Bool[np.ndarray, "candidate candidate"],
    count: int,
) -> Chosen:
    """Pick candidates that make a loss of the summed information small."""
    # Source: Fedorov (1972), Theory of Optimal Experiments, chapter 3: exchange.

    def best(picks: list[int]) -> tuple[int, float]:
        """The candidate that adds most to some picks."""
        free = np.flatnonzero(allowed & ~clashes[picks].any(axis=0))
        if free.size == 0:
            return -1, np.inf
        known = base + each[:, picks].sum(axis=1)
        losses = loss(known[:, None] + each[:, free])
        at = int(np.argmin(losses))
        return int(free[at]), float(losses[at])

    picks: list[int] = []
    for number in range(count):
        pick, reached = best(picks)
        if pick < 0:
            raise FitError(
                f"only {number} of {len(allowed)} candidates can be taken together",
                where="next_views",
                mend="ask for fewer, or give more candidates or a rig that can do more",
            )
        picks.append(pick)
    exchanges, before = 0, -1
    while exchanges > before:  # each exchange lowers the loss, so this ends
        before = exchanges
        for place in range(count):
            pick, lower = best(picks[:place] + picks[place + 1 :])
            if lower < reached - GAIN * max(1.0, abs(reached)):
                picks[place], reached, exchanges = pick, lower, exchanges + 1
    return _in_order(loss, base, each, picks, exchanges)


def _in_order(
    loss: Loss, base: np.ndarray, each: np.ndarray, picks: list[int], exchanges: int
) -> Chosen:
    """The same picks, each time the one first that adds most."""
    left, ordered, known = list(picks), [], base
    losses = [float(loss(known[:, None])[0])]
    while left:
        found = loss(known[:, None] + each[:, left])
        at = int(np.argmin(found))
        losses.append(float(found[at]))
        ordered.append(left.pop(at))
        known = known + each[:, ordered[-1]]
    return Chosen(ordered, losses, exchanges)
