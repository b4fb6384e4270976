"""Methods that start at the posterior modes (NUTS, Laplace approximation), and least squares."""

import dataclasses
from typing import Self, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import FitError
from polar_bayes.inference import laplace, nuts
from polar_bayes.inference.batch_result import Describe, Outcome
from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.initialization import STARTS
from polar_bayes.inference.laplace import LaplaceSettings
from polar_bayes.inference.mcse import measure
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.nuts import NutsSettings
from polar_bayes.inference.optimize import SETTLED, from_prior
from polar_bayes.inference.problem import CompiledModel, Problem
from polar_bayes.inference.psis import smooth
from polar_bayes.progress import Progress


@dataclasses.dataclass(frozen=True)
class Nuts(NutsSettings, AbstractMethod):
    """The No-U-Turn sampler.

    Args:
        chains: Independent chains, at least 2.
        warmup: Draws spent on step size and metric, per chain. None: 300; 150 for many patches,
            whose metric is known before.
        draws: Draws kept at least, per chain.
        most_draws: Draws kept at most, per chain; set it to `draws` for a fixed length.
        effective_draws: Goal for the bulk and tail effective sample size of every coordinate.
        target_acceptance: Higher means smaller steps, range [0.5, 1). None: 0.9 for one material,
            0.98 for a few patches, 0.7 for many, whose coordinates are close to normal.
        max_tree_depth: A trajectory has at most 2 ** this steps.
        threads: Chains that run at once.
        block: Draws between two reports of progress, per chain.

    Raises:
        FitError: A setting is out of range.

    Source:
        Hoffman & Gelman (2014), JMLR 15, 1593-1623.
    """

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        key_starts, key_chains = jax.random.split(key)
        target = initialization.target(key_starts, self.chains)
        z, stats, mixed = nuts.sample(
            target, key_chains, self, lambda done: progress("sampling", done)
        )
        bulk, tail, r_hat = measure(np.moveaxis(z, -1, 0))
        warmup = np.sum(stats["warmup_steps"][:, 0])
        search = float(initialization.metadata.get("gradients", np.nan))
        return PosteriorDraws(
            method="nuts",
            z=z,
            stats=stats,
            r_hat=float(np.max(r_hat)),
            effective_draws=float(min(np.min(bulk), np.min(tail))),
            gradients=search + float(warmup + np.sum(stats["n_steps"])),
            densities=0.0,
            metadata={"modes": initialization.metadata, "goals_reached": mixed},
        )

    @override
    def prepare(self, problem: Problem) -> None:
        problem.compiled_model.initializer.expect(problem.data, self)

    @override
    def scale_draws(self, factor: float) -> Self:
        scaled = {
            name: int(np.ceil(factor * getattr(self, name))) for name in ("draws", "most_draws")
        }
        return dataclasses.replace(self, effective_draws=factor * self.effective_draws, **scaled)

    @override
    def run_batch(
        self,
        engine: CompiledModel,
        observations: ObservationBatch,
        numbers: np.ndarray,
        seed: int,
        describe: Describe,
    ) -> Outcome:
        # Several batches run at once, each on a thread of its own.
        on_one = dataclasses.replace(self, threads=1)
        return AbstractMethod.run_batch(on_one, engine, observations, numbers, seed, describe)


@dataclasses.dataclass(frozen=True)
class Laplace(LaplaceSettings, AbstractMethod):
    """The Laplace approximation: a normal distribution at the heaviest mode.

    Args:
        draws: Draws from the fitted normal distribution, in `chains` groups for ArviZ.
        chains: Groups; the draws are independent, so they only serve diagnostics.

    Raises:
        FitError: Fewer than 50 draws or than 1 chain.
    """

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        z, stats = initialization.laplace(key, self)
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
            k_hat=float(smooth(stats["log_weight"].reshape(1, -1)).pareto_k[0]),
            effective_draws=float(count),
            gradients=float(initialization.metadata.get("gradients", np.nan)) + count,
            densities=0.0,
            metadata={"modes": initialization.metadata},
        )


@dataclasses.dataclass(frozen=True)
class Point(AbstractMethod):
    """Robust least squares: the deterministic baseline, without priors and without noise models.

    Args:
        starts: Prior draws from which it descends; the best end is kept.

    Raises:
        FitError: Fewer than one start.
    """

    starts: int = 16

    def __post_init__(self) -> None:
        if self.starts < 1:
            raise FitError(f"starts is {self.starts}", where="Point", hint="give at least 1")

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        # The starts are those from which other methods search for modes.
        starts = from_prior(problem.program, problem.key, STARTS, problem.data)
        least_squares = problem.compiled_model.least_squares
        found = laplace.to_numpy(least_squares(jnp.asarray(starts[: self.starts]), problem.data))
        return PosteriorDraws(
            method="point",
            z=np.asarray(found.z)[None, None],
            stats={"loss": np.asarray(found.loss)[None, None]},
            problems=[] if found.converged else ["least squares did not meet its tolerance"],
            covariance=np.asarray(found.covariance),
            metadata={"standard_errors": laplace.standard_errors(problem.program, found)},
        )
