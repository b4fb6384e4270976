"""Results of a batch of pixels: status, method used and diagnostics of each."""

import abc
import dataclasses
import enum
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import jax
import numpy as np

from polar_bayes.inference.batch_engine import BatchEngine
from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.levenberg_marquardt import ModeSearch, NormalApproximation
from polar_bayes.inference.program import Values
from polar_bayes.repr_html import HTMLRepr

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


class BatchFit:
    """One fit of a batch of pixels: what is fitted, and the outcome as it is filled in."""

    def __init__(
        self,
        engine: BatchEngine,
        pixels: ObservationBatch,
        keys: np.ndarray,
        describe: Describe = lambda at, draws, weights: None,
        seed: int = 0,
    ) -> None:
        self.engine, self.pixels, self.keys, self.seed = engine, pixels, keys, seed
        self.outcome = empty_outcome(len(pixels))
        self._describe = describe

    def record_modes(self, at: np.ndarray, search: ModeSearch) -> None:
        """Modes were found, and it is not known yet how good a normal approximation there is."""
        found = search.converged
        self.outcome.steps[at] = search.steps
        self.outcome.condition[at] = np.where(found, search.mode.condition, np.nan)
        self.outcome.status[at] = np.where(found, Status.NOT_TRUSTED, Status.NOT_CONVERGED)

    def record(
        self,
        at: np.ndarray,
        draws: Values,
        weights: np.ndarray,
        effective: np.ndarray,
        method: MethodUsed | np.ndarray,
        status: Status | np.ndarray = Status.GOOD,
    ) -> None:
        """Weighted draws of some pixels, and their effective sample size."""
        self._describe(at, draws, weights)
        self.outcome.effective_draws[at] = effective
        self.outcome.approach[at] = method
        self.outcome.status[at] = status


def random_keys(seed: int, numbers: np.ndarray) -> np.ndarray:
    """Random keys that depend on the number of each pixel alone, as arrays."""
    base = jax.random.key(seed)
    keys = jax.vmap(lambda number: jax.random.fold_in(base, number))(numbers.astype(np.uint32))
    return np.asarray(jax.random.key_data(keys))


@dataclasses.dataclass(frozen=True)
class AbstractPixelMethod(HTMLRepr, abc.ABC):
    """A method that fits many pixels at once."""

    def run_batch(
        self,
        engine: BatchEngine,
        pixels: ObservationBatch,
        numbers: np.ndarray,
        seed: int,
        describe: Describe,
    ) -> Outcome:
        """Fit every pixel of a batch.

        Args:
            engine: Compiled programs of the model.
            pixels: Their readings.
            numbers: Of the pixels, (pixel,): with the seed they fix the random keys.
            seed: Of the image.
            describe: Receives the weighted draws of pixels as answers come.

        Returns:
            The diagnostics of each pixel.
        """
        batch = BatchFit(engine, pixels, random_keys(seed, numbers), describe, seed)
        batch.outcome.status[pixels.views < MIN_VIEWS] = Status.TOO_FEW_VIEWS
        batch.outcome.status[pixels.views == 0] = Status.MASKED
        at = np.flatnonzero(pixels.views >= MIN_VIEWS)
        for begin in range(0, at.size, self.memory_limit):
            self.fit(batch, at[begin : begin + self.memory_limit])
        return batch.outcome

    memory_limit: ClassVar[int] = 1024
    """Pixels whose draws are in memory at a time."""

    @abc.abstractmethod
    def fit(
        self, batch: BatchFit, at: np.ndarray, modes: NormalApproximation | None = None
    ) -> None:
        """Fit the pixels `at` these indices, and record their outcome; modes may be known."""
