"""The Laplace approximation: a normal distribution at the heaviest mode.

Source:
    Tierney and Kadane (1986), J. Am. Stat. Assoc. 81, 82-86.
"""

import dataclasses
from collections.abc import Iterator
from typing import ClassVar, override

import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.batch_modes import find_all_modes
from polar_bayes.inference.batching import MethodUsed, Status, batched
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.problem_batch import BatchDraws, ProblemBatch
from polar_bayes.inference.program import Values
from polar_bayes.methods.method import AbstractBatchMethod, AbstractMethod, PosteriorDraws
from polar_bayes.numerics.batches import take_rows
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.optimize import SETTLED
from polar_bayes.numerics.psis import smooth
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress


@dataclasses.dataclass(frozen=True)
class Laplace(AbstractMethod):
    """The Laplace approximation: a normal distribution at the heaviest mode.

    Args:
        draws: Draws from the fitted normal distribution, in `chains` groups for ArviZ.
        chains: Groups; the draws are independent, so they only serve diagnostics.

    Raises:
        FitError: Fewer than 50 draws or than 1 chain.
    """

    draws: int = 500
    chains: int = 4

    group_size: ClassVar[int] = AbstractBatchMethod.group_size

    def __post_init__(self) -> None:
        self.check_least(draws=50, chains=1)

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        z, stats = initialization.laplace(key, self.chains, self.draws)
        problems = []
        if initialization.decrement > SETTLED:
            problems.append(
                f"the mode is not settled (Newton decrement {initialization.decrement:.2g} "
                "posterior standard deviations): use method='nuts'"
            )
        count = z[..., 0].size
        return PosteriorDraws(
            method="laplace",
            z=z,
            stats=stats,
            problems=problems,
            pareto_k=float(smooth(stats["log_weight"].reshape(1, -1)).pareto_k[0]),
            ess=float(count),
            gradients=float(initialization.metadata.get("gradients", np.nan)) + count,
            densities=0.0,
            metadata={"modes": initialization.metadata},
        )

    @override
    def run_batch(self, batch: ProblemBatch) -> Iterator[BatchDraws]:
        if not batch.engine.initializer.is_joint:
            yield from super().run_batch(batch)
            return
        owner, modes = find_all_modes(batch)
        if not owner.size:
            return
        heaviest = np.unique(owner, return_index=True)[1]
        found, modes = batch.subset(owner[heaviest]), take_rows(modes, heaviest)
        count, mode = self.chains * self.draws, (np.asarray(modes.z), np.asarray(modes.root))
        z, draws = found.run(_normal_draws, count, *mode, found.keys)
        yield BatchDraws(
            found.at,
            Status.GOOD,
            draws,
            np.full((len(found), count), 1.0 / count),
            float(count),
            MethodUsed.LAPLACE,
            condition=np.asarray(modes.condition),
            mode=mode,
            z=lambda: z,
        )


def _normal_draws(engine: CompiledModel, count: int) -> JitOnce:
    """Make the program that draws from the approximation of one capture."""

    def draw(data: Observations, z: Array, root: Array, key: Array) -> tuple[Array, Values]:
        z = z + jax.random.normal(key, (count, len(z)), z.dtype) @ root
        return z, jax.vmap(lambda z: engine.program.parameters(z, data))(z)

    return batched(draw)
