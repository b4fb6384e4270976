"""A method of one capture, applied to one pixel after another."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import override

import numpy as np

from polar_bayes.inference.batch_engine import BatchEngine
from polar_bayes.inference.batch_method import AbstractPixelMethod, BatchFit
from polar_bayes.inference.batching import Outcome
from polar_bayes.inference.laplace import Importance
from polar_bayes.inference.levenberg_marquardt import NormalApproximation
from polar_bayes.inference.method import AbstractMethod
from polar_bayes.inference.problem import CompiledModel
from polar_bayes.inference.program import THREADS, Values


@dataclasses.dataclass(frozen=True)
class PixelByPixel(AbstractPixelMethod):
    """A method of one capture in every pixel, with its own search for modes and its own judgment.

    Args:
        method: Of each pixel. By default draws at all modes and along the profiles through them,
            whose mixture is fitted again until Pareto k is at most 0.5.
    """

    method: AbstractMethod = dataclasses.field(
        default_factory=lambda: Importance(draws=2048, rounds=6)
    )

    @override
    def thinning(self, count: int) -> int:
        return self.method.thinning(count)

    @override
    def fit(
        self, batch: BatchFit, at: np.ndarray, modes: NormalApproximation | None = None
    ) -> None:
        del modes  # the method finds its own, from more starts
        compiled = batch.engine.programs.of("one by one", lambda: _compiled_model(batch.engine))
        answers: dict[int, tuple[Values, np.ndarray]] = {}

        def run(part: np.ndarray) -> Outcome:
            def keep(index: np.ndarray, draws: Values, weights: np.ndarray) -> None:
                answers[int(part[index[0]])] = draws, weights

            numbers = batch.keys[part][:, -1]  # of each pixel's own
            pixels = batch.pixels.subset(part)
            return self.method.run_batch(compiled, pixels, numbers, batch.seed, keep)

        parts = [part for part in np.array_split(at, THREADS) if part.size]
        with ThreadPoolExecutor(THREADS) as pool:  # a pixel's answer depends on its number alone
            outcomes = list(pool.map(run, parts))
        for part, outcome in zip(parts, outcomes, strict=True):
            for i, pixel in enumerate(part):
                if np.isnan(batch.outcome.pareto_k[pixel]):  # else it is that of another proposal
                    batch.outcome.pareto_k[pixel] = outcome.pareto_k[i]
                if int(pixel) in answers:
                    batch.record(
                        part[i : i + 1],
                        *answers[int(pixel)],
                        outcome.effective_draws[i],
                        outcome.approach[i],
                        outcome.status[i],
                    )


def _compiled_model(engine: BatchEngine) -> CompiledModel:
    program = engine.program
    return CompiledModel(
        lambda: program.model, program.model, program, engine.layout, engine.precision
    )
