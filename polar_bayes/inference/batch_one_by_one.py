"""A method of one capture, applied to one pixel after another."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import override

import numpy as np

from polar_bayes.inference.batch_engine import BatchEngine
from polar_bayes.inference.batch_method import AbstractPixelMethod, BatchFit
from polar_bayes.inference.batching import Outcome
from polar_bayes.inference.levenberg_marquardt import NormalApproximation
from polar_bayes.inference.method import AbstractMethod
from polar_bayes.inference.problem import CompiledModel
from polar_bayes.inference.program import THREADS, Values


@dataclasses.dataclass(frozen=True)
class PixelByPixel(AbstractPixelMethod):
    """A method of one capture in every pixel, with its own search for modes and its own judgment.

    Args:
        method: Of each pixel, such as `Importance(draws=4096)`.
    """

    method: AbstractMethod

    @override
    def thinning(self, count: int) -> int:
        return self.method.thinning(count)

    @override
    def fit(
        self, batch: BatchFit, at: np.ndarray, modes: NormalApproximation | None = None
    ) -> None:
        compiled = batch.engine.programs.of("one by one", lambda: _compiled_model(batch.engine))

        def run(pixel: int) -> tuple[np.ndarray, Outcome, list[tuple[Values, np.ndarray]]]:
            one, found = np.array([pixel]), []
            outcome = self.method.run_batch(
                compiled,
                batch.pixels.subset(one),
                batch.keys[one, -1],  # a number of the pixel's own, on which its answer depends
                batch.seed,
                lambda _, draws, weights: found.append((draws, weights)),
            )
            return one, outcome, found

        with ThreadPoolExecutor(THREADS) as pool:
            for one, outcome, found in pool.map(run, at):
                batch.record_pareto_k(one, outcome.pareto_k)
                for draws, weights in found:
                    judged = outcome.effective_draws, outcome.approach, outcome.status
                    batch.record(one, draws, weights, *judged)


def _compiled_model(engine: BatchEngine) -> CompiledModel:
    program = engine.program
    return CompiledModel(
        lambda: program.model, program.model, program, engine.layout, engine.precision
    )
