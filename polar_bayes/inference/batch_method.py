"""The contract of methods that fit many pixels at once, and the fit of one batch of pixels."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NoReturn, Self, override

import jax
import numpy as np

from polar_bayes.errors import FitError
from polar_bayes.inference.batch_engine import BatchEngine
from polar_bayes.inference.batching import (
    MIN_VIEWS,
    Describe,
    MethodUsed,
    ObservationBatch,
    Outcome,
    Status,
    empty_outcome,
    take_rows,
)
from polar_bayes.inference.levenberg_marquardt import ModeSearch, NormalApproximation
from polar_bayes.inference.method import AbstractBatchMethod
from polar_bayes.inference.program import Values


class BatchFit:
    """One fit of a batch of pixels: what is fitted, and the outcome as it is filled in.

    `mode_z` and `mode_root` are the mode of each pixel and a root of the covariance there, NaN
    where none is known.
    """

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
        size = engine.program.size
        self.mode_z = np.full((len(pixels), size), np.nan)
        self.mode_root = np.full((len(pixels), size, size), np.nan)
        self._describe = describe

    def record_modes(self, at: np.ndarray, search: ModeSearch) -> None:
        """Modes were found, and it is not known yet how good a normal approximation there is."""
        found = search.converged
        self.record_approximation(at[found], take_rows(search.mode, found))
        self.outcome.steps[at] = search.steps
        self.outcome.condition[at] = np.where(found, search.mode.condition, np.nan)
        self.outcome.status[at] = np.where(found, Status.NOT_TRUSTED, Status.NOT_CONVERGED)

    def record_approximation(self, at: np.ndarray, mode: NormalApproximation) -> None:
        """Modes of some pixels, those left out of which one is known."""
        new = np.isnan(self.mode_z[at]).any(axis=1)
        self.mode_z[at[new]], self.mode_root[at[new]] = mode.z[new], mode.root[new]

    def record_pareto_k(self, at: np.ndarray, pareto_k: np.ndarray) -> None:
        """Pareto k of pixels that have none; else it is that of an earlier proposal."""
        known = self.outcome.pareto_k[at]
        self.outcome.pareto_k[at] = np.where(np.isnan(known), pareto_k, known)

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
class AbstractPixelMethod(AbstractBatchMethod[BatchEngine]):
    """A method that fits many pixels side by side."""

    memory_limit: ClassVar[int] = 1024
    """Pixels whose draws are in memory at a time."""

    @override
    def run_batch(
        self,
        engine: BatchEngine,
        observations: ObservationBatch,
        numbers: np.ndarray,
        seed: int,
        describe: Describe,
    ) -> Outcome:
        batch = BatchFit(engine, observations, random_keys(seed, numbers), describe, seed)
        self.fit_batch(batch)
        return batch.outcome

    def fit_batch(self, batch: BatchFit) -> None:
        """Fit every pixel that has enough views, and record the outcome of all."""
        views = batch.pixels.views
        batch.outcome.status[views < MIN_VIEWS] = Status.TOO_FEW_VIEWS
        batch.outcome.status[views == 0] = Status.MASKED
        at = np.flatnonzero(views >= MIN_VIEWS)
        for begin in range(0, at.size, self.memory_limit):
            self.fit(batch, at[begin : begin + self.memory_limit])

    @abc.abstractmethod
    def fit(
        self, batch: BatchFit, at: np.ndarray, modes: NormalApproximation | None = None
    ) -> None:
        """Fit the pixels `at` these indices, and record their outcome; modes may be known."""

    def for_image(
        self, size: int, sample: Callable[[int], BatchFit], *, is_shared: bool
    ) -> tuple[Self, dict[str, Any]]:
        """Settings for an image, and entries of its provenance.

        `size` is the number of its pixels, `sample` gives some of them drawn at random, and
        `is_shared` says whether pixels share parameters.
        """
        del size, sample, is_shared
        return self, {}

    def _check_least(self, **least: int) -> None:
        """Refuse settings below their least values."""
        for name, lowest in least.items():
            if getattr(self, name) < lowest:
                self._refuse(f"{name} is {getattr(self, name)}", f"give {lowest} or more")

    def _refuse(self, what: str, hint: str) -> NoReturn:
        raise FitError(what, where=type(self).__name__, hint=hint)
