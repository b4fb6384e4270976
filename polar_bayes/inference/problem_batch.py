"""Captures of one layout that are fitted together, and the results of methods for them."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from polar_bayes.inference.batching import MethodUsed, ObservationBatch, Status
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.program import Values
from polar_bayes.numerics.batches import AnyArray


@dataclasses.dataclass(frozen=True, eq=False)
class ProblemBatch:
    """Posteriors of many captures of one layout.

    Args:
        engine: Programs of the model for the layout.
        pixels: The captures.
        keys: Data of the random key of each capture, shape (capture, 2).
        at: Places of these captures among all to which they belong, shape (capture,).
        seed: Of random numbers that all captures share.
    """

    engine: CompiledModel
    pixels: ObservationBatch
    keys: np.ndarray
    at: np.ndarray
    seed: int = 0

    def __len__(self) -> int:
        return len(self.at)

    def subset(self, index: np.ndarray) -> "ProblemBatch":
        """Return a batch of some of the captures, in that order."""
        pixels, keys, at = self.pixels.subset(index), self.keys[index], self.at[index]
        return dataclasses.replace(self, pixels=pixels, keys=keys, at=at)


def problem_batch(
    engine: CompiledModel, pixels: ObservationBatch, numbers: np.ndarray, seed: int
) -> ProblemBatch:
    """Make a batch of captures, each with a random key that depends on its number alone."""
    return ProblemBatch(
        engine, pixels, random_keys(seed, numbers), np.arange(len(pixels)), seed=seed
    )


class BatchDraws(NamedTuple):
    """Results of a method for some captures of a batch: one row each, or one value for all.

    `mode` is a mode of each capture and a root of the covariance there; `draws` is empty where
    there is no answer. What is found later for a capture replaces what was found before.
    """

    at: np.ndarray
    status: np.ndarray | Status
    draws: Values = {}
    weights: np.ndarray = np.empty((0, 0))
    ess: np.ndarray | float = np.nan
    method: np.ndarray | MethodUsed = MethodUsed.NONE
    pareto_k: np.ndarray | float = np.nan
    condition: AnyArray | float = np.nan
    steps: np.ndarray | int = 0
    mode: tuple[AnyArray, AnyArray] | None = None


class Outcome(NamedTuple):
    """Diagnostics of the captures of a batch; NaN until they are known.

    Those of the search for modes and of the first proposal stay where a later one gives the answer.
    """

    pareto_k: np.ndarray
    ess: np.ndarray
    condition: np.ndarray
    steps: np.ndarray
    method: np.ndarray
    status: np.ndarray

    def put(self, found: BatchDraws) -> None:
        """Enter the results of some captures."""
        at = found.at
        self.ess[at], self.method[at] = found.ess, found.method
        self.status[at] = found.status
        self.steps[at] += found.steps
        for own, new in ((self.pareto_k, found.pareto_k), (self.condition, found.condition)):
            own[at] = np.where(np.isnan(own[at]), new, own[at])


def empty_outcome(count: int, status: Status = Status.NOT_CONVERGED) -> Outcome:
    """Return an outcome of captures that have not been fitted."""
    return Outcome(
        pareto_k=np.full(count, np.nan),
        ess=np.full(count, np.nan),
        condition=np.full(count, np.nan),
        steps=np.zeros(count, np.int32),
        method=np.full(count, MethodUsed.NONE, np.int8),
        status=np.full(count, status, np.int8),
    )


def random_keys(seed: int, numbers: np.ndarray) -> np.ndarray:
    """Return random keys, as arrays, that depend on the number of each capture alone."""
    base = jax.random.key(seed)
    keys = jax.vmap(lambda number: jax.random.fold_in(base, number))(numbers.astype(np.uint32))
    return np.asarray(jax.random.key_data(keys))
