"""What becomes of a row of pixels, and who is told of their draws."""

import enum
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from polar_bayes.inference.batch_programs import Settled
from polar_bayes.inference.program import Values
from polar_bayes.inference.psis import LARGEST_TRUSTED, effective_draws, effective_tails


class Status(enum.IntEnum):
    """What became of a pixel; the last is what chunks that are not written read as."""

    GOOD = 0
    MASKED = 1
    TOO_FEW_VIEWS = 2
    NOT_CONVERGED = 3
    NOT_TRUSTED = 4
    NOT_FITTED = -1


class Approach(enum.IntEnum):
    """How a pixel's numbers were found."""

    NONE = 0
    LAPLACE = 1
    IMPORTANCE = 2
    ADAPTED = 3
    NUTS = 4
    TEMPERED = 5


Describe = Callable[[np.ndarray, Values, np.ndarray], None]
"""Told which pixels have an answer, their draws by name, and the weights of these (pixel, draw)."""


class Outcome(NamedTuple):
    """What became of a row of pixels: NaN where there is nothing to say."""

    pareto_k: np.ndarray
    effective_draws: np.ndarray
    condition: np.ndarray
    steps: np.ndarray
    approach: np.ndarray
    status: np.ndarray


def no_outcome(count: int) -> Outcome:
    """That of pixels that nothing is known of."""
    return Outcome(
        pareto_k=np.full(count, np.nan),
        effective_draws=np.full(count, np.nan),
        condition=np.full(count, np.nan),
        steps=np.zeros(count, np.int32),
        approach=np.full(count, Approach.NONE, np.int8),
        status=np.full(count, Status.NOT_CONVERGED, np.int8),
    )


class Approximation(NamedTuple):
    """Normal approximations of a row of pixels, and their weighted draws."""

    settled: Settled
    parameters: Values
    weights: np.ndarray
    pareto_k: np.ndarray

    @property
    def is_trusted(self) -> np.ndarray:
        """Whether the weights correct what the approximation gets wrong, (pixel,)."""
        return self.settled.converged & (self.pareto_k <= LARGEST_TRUSTED)


class Weighted(NamedTuple):
    """Weighted draws of a row of pixels."""

    z: np.ndarray
    parameters: Values
    weights: np.ndarray
    pareto_k: np.ndarray

    @property
    def worth(self) -> np.ndarray:
        """Independent draws that they are worth, in the middle and in both tails, (pixel,)."""
        return np.minimum(effective_draws(self.weights), effective_tails(self.z, self.weights))


class Row:
    """What is known of a row of pixels, filled in as answers come."""

    def __init__(self, count: int, describe: Describe) -> None:
        self.outcome = no_outcome(count)
        self._describe = describe

    @property
    def status(self) -> np.ndarray:
        """Of every pixel."""
        return self.outcome.status

    def settle(self, at: np.ndarray, settled: Settled) -> None:
        """Modes were found, and nothing is known yet of what surrounds them."""
        self.outcome.steps[at] = settled.steps
        self.outcome.condition[at] = np.where(settled.converged, settled.peak.condition, np.nan)
        self.status[at] = np.where(settled.converged, Status.NOT_TRUSTED, Status.NOT_CONVERGED)

    def approximate(self, at: np.ndarray, found: Approximation, *, weighted: bool) -> None:
        """Normal approximations, where weights can be trusted corrected by them."""
        self.settle(at, found.settled)
        outcome, converged, trusted = self.outcome, found.settled.converged, found.is_trusted
        approach = np.full(at.size, Approach.LAPLACE)
        if weighted:
            outcome.pareto_k[at] = np.where(converged, found.pareto_k, np.nan)
            outcome.effective_draws[at] = np.where(trusted, effective_draws(found.weights), np.nan)
            approach = np.where(trusted, Approach.IMPORTANCE, Approach.LAPLACE)
        outcome.approach[at] = np.where(converged, approach, Approach.NONE)
        self.status[at[trusted]] = Status.GOOD
        # Weights that cannot be trusted do not correct anything.
        even = 1.0 / found.weights.shape[-1]
        weights = np.where(trusted[:, None], found.weights, even)[converged]
        self._describe(at[converged], rows(found.parameters, converged), weights)

    def adapt(self, at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        """Weighted draws of proposals that were fitted to them."""
        self._answer(at, parameters, weights, effective_draws(weights), Approach.ADAPTED)

    def temper(self, at: np.ndarray, found: Weighted, *, is_worth: np.ndarray) -> None:
        """Weighted draws of mixtures; those that are worth too little are described and told."""
        self._answer(at, found.parameters, found.weights, found.worth, Approach.TEMPERED)
        self.outcome.pareto_k[at] = found.pareto_k
        self.status[at[~is_worth]] = Status.NOT_TRUSTED

    def sample(
        self,
        at: np.ndarray,
        draws: Values,
        r_hat: np.ndarray,
        effective: np.ndarray,
        largest_r_hat: float,
    ) -> None:
        """Chains, where they have mixed; elsewhere what was known before is not to be trusted."""
        mixed = r_hat <= largest_r_hat
        self.status[at[~mixed]] = Status.NOT_TRUSTED
        count = np.asarray(next(iter(draws.values()))).shape[1]
        even = np.full((int(mixed.sum()), count), 1.0 / count)
        self._answer(at[mixed], rows(draws, mixed), even, effective[mixed], Approach.NUTS)

    def _answer(
        self,
        at: np.ndarray,
        draws: Values,
        weights: np.ndarray,
        effective: np.ndarray,
        approach: Approach,
    ) -> None:
        self._describe(at, draws, weights)
        self.outcome.effective_draws[at] = effective
        self.outcome.approach[at] = approach
        self.status[at] = Status.GOOD


def rows[T](values: T, which: np.ndarray) -> T:
    """Some pixels of arrays that all begin with the axis of pixels."""
    return jax.tree.map(lambda array: np.asarray(array)[which], values)
