"""The fit of one batch of captures: what is fitted, and its outcome."""

import jax
import numpy as np

from polar_bayes.inference.batching import (
    Describe,
    MethodUsed,
    ObservationBatch,
    Status,
    empty_outcome,
    take_rows,
)
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.levenberg_marquardt import ModeSearch, NormalApproximation
from polar_bayes.inference.program import Values


class BatchFit:
    """One fit of a batch of pixels: what is fitted, and the outcome as it is filled in.

    `mode_z` and `mode_root` are the mode of each pixel and a root of the covariance there, NaN
    where none is known.
    """

    def __init__(
        self,
        engine: CompiledModel,
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
