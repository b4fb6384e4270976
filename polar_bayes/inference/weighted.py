"""The normal approximations of all modes together, their draws weighed by the posterior."""

import collections
import dataclasses
import functools
from typing import override

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.errors import FitError
from polar_bayes.inference.batch_engine import BatchEngine
from polar_bayes.inference.batch_method import BatchFit
from polar_bayes.inference.batch_result import Outcome, Status
from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.compile import TRACING_LOCK, LRUCache
from polar_bayes.inference.initialization import STARTS, JointInit
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.optimize import Modes
from polar_bayes.inference.problem import CompiledModel, Problem
from polar_bayes.inference.program import Program, compile_program
from polar_bayes.inference.proposals import (
    Mixture,
    WeightedSample,
    draw_mixture,
    log_density,
)
from polar_bayes.inference.psis import MAX_PARETO_K, effective_draws, smooth
from polar_bayes.inference.resampling import choose, generator, log_densities
from polar_bayes.inference.smc import PixelSMC, smc_draws
from polar_bayes.observation.data import Observations

LEAST_SHARE = 1e-3
"""Of the Laplace evidence: lighter modes get no draws."""

SIDE_BY_SIDE = 1024
"""Draws whose density is computed together: that of all modes at once would fill the memory."""


@dataclasses.dataclass(frozen=True)
class Importance(AbstractMethod):
    """Laplace with importance correction.

    Draws come from a mixture of Student t distributions with 8 degrees of freedom, one at each
    mode that holds 0.1% of the Laplace evidence or more, as heavy as its evidence. Weighing them
    by the posterior corrects what the normal approximation gets wrong, as far as the mixture
    reaches; Pareto k-hat says how far.

    Args:
        draws: Of the mixture, at least 256.

    Raises:
        FitError: Fewer draws.
    """

    draws: int = 4096

    def __post_init__(self) -> None:
        if self.draws < 256:
            raise FitError(f"draws is {self.draws}", where="Importance", hint="give at least 256")

    @override
    def draw(self, problem: Problem) -> PosteriorDraws:
        initialization = problem.initialization
        if not isinstance(initialization, JointInit):
            raise FitError(
                "the weights of many patches together say nothing",
                where="Importance",
                hint="use method='nuts'",
            )
        proposal = _proposal(initialization.modes, problem.dtype)
        key_draw, key_choice = jax.random.split(problem.key_of_draws)
        places, proposed = (np.asarray(x) for x in _drawn(proposal, self.draws, key_draw))
        ratios = log_densities(problem.program, places, problem.data) - proposed
        weights, k_hat = (x[0] for x in smooth(ratios[None]))
        worth = float(effective_draws(weights[None])[0])
        said = {"modes": initialization.said}
        evaluations = {
            "gradients": float(initialization.said["gradients"]),
            "densities": float(self.draws),
        }
        if not np.isfinite(weights).all():
            raise FitError(
                "the posterior density is zero at every draw",
                where="Importance",
                hint="use method='nuts'",
            )
        index = choose(weights, worth, generator(key_choice))
        problems = []
        if not k_hat <= MAX_PARETO_K:
            problems.append(
                f"Pareto k-hat of the weights is {k_hat:.2f} (at most {MAX_PARETO_K}): they do "
                "not reach all of the posterior, so use method='nuts'"
            )
        return PosteriorDraws(
            kind="importance",
            z=places[index],
            stats={"lp": (ratios + proposed)[index]},
            problems=problems,
            weighted=(places, weights),
            k_hat=float(k_hat),
            effective_draws=worth,
            said=said,
            **evaluations,
        )


@functools.partial(jax.jit, static_argnums=1)
def _drawn(proposal: Mixture, count: int, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    places = draw_mixture(proposal, count, key)
    densities = jax.lax.map(
        lambda z: log_density(proposal, z[None])[0], places, batch_size=min(SIDE_BY_SIDE, count)
    )
    return places, densities


def _proposal(modes: Modes, dtype: np.dtype) -> Mixture:
    """A component for each heavy mode; always as many, so that one program draws from all."""
    # There are never more modes than climbs; a mode has several components where there are fewer.
    heavy = np.flatnonzero(modes.weight >= LEAST_SHARE)
    which = np.resize(heavy, max(STARTS, heavy.size))
    times = np.bincount(which, minlength=len(modes.weight))[which]
    share = modes.weight[which] / times
    size = modes.z.shape[1]
    return Mixture(
        center=jnp.zeros(size, dtype),
        half=jnp.eye(size, dtype=dtype),
        log_share=jnp.asarray(np.log(share / share.sum()), dtype),
        mean=jnp.asarray(modes.z[which], dtype),
        scale=jnp.asarray(np.linalg.cholesky(modes.covariance[which]), dtype),
    )


# --- Draws led from the prior to the posterior, by what calibrations are made with ----------------


MOST_KEPT = 4


@dataclasses.dataclass(frozen=True)
class Tempered(AbstractMethod):
    """Tempered draws of one material in one color, corrected by weights.

    Particles start from the prior, so every mode has particles before any mode is narrow, and
    nothing is differentiated.

    Args:
        settings: Of the particles, and of the mixtures that are fitted to them; a single fit has
            time for more draws than each of thousands.

    Raises:
        FitError: A setting is outside its range.
    """

    settings: PixelSMC = dataclasses.field(default_factory=functools.partial(PixelSMC, draws=4096))

    @override
    def draw(self, problem: Problem) -> PosteriorDraws:
        if any(name != "view" and length > 1 for name, length in problem.data.dims):
            raise FitError(
                "draws are tempered of one material in one color only",
                where="Tempered",
                hint="use method='nuts'",
            )
        keys = np.asarray(jax.random.key_data(problem.key_of_draws))[None]
        counts: collections.Counter[str] = collections.Counter()
        every = self.settings.num_attempts * (self.settings.rounds + 1)

        def count(what: str) -> None:
            problem.progress("tempering", counts.total() / every)
            counts[what] += 1

        batch = BatchFit(_engine(problem), _batch_of_one(problem.data), keys)
        found: WeightedSample | None = None
        for _, sample in smc_draws(batch, self.settings, np.zeros(1, int), count):
            found = sample
        problem.progress("tempering", 1.0)
        if found is None:
            raise FitError(
                "the particles did not reach the posterior", where="Tempered", hint="use 'nuts'"
            )
        return self._answer(problem, found, batch.outcome, counts)

    def _answer(
        self, problem: Problem, found: WeightedSample, outcome: Outcome, counts: collections.Counter
    ) -> PosteriorDraws:
        z, weights = found.z[0].astype(float), found.weights[0].astype(float)
        weights = weights / weights.sum()
        worth, k_hat = float(found.ess[0]), float(found.pareto_k[0])
        index = choose(weights, worth, generator(problem.key_of_draws))
        problems = []
        if outcome.status[0] != Status.GOOD:
            problems.append(
                f"the weighted draws are worth {worth:.0f} independent ones (at least "
                f"{self.settings.effective_draws:.0f}), with a Pareto k-hat of {k_hat:.2f} (at "
                f"most {MAX_PARETO_K}): use method='nuts'"
            )
        num_chains, length = self.settings.num_chains, self.settings.chain_length
        steps = int(outcome.steps[0]) * num_chains * (length - 1)
        drawn = counts["rounds"] * self.settings.draws
        looked = counts["particles"] * self.settings.init_factor * self.settings.num_particles
        densities = looked + steps + drawn
        return PosteriorDraws(
            kind="tempered",
            z=z[index],
            stats={"log_weight": np.log(np.maximum(weights, 1e-300))[index]},
            problems=problems,
            weighted=(z, weights),
            k_hat=k_hat,
            effective_draws=worth,
            gradients=0.0,
            densities=float(densities),
            said={"stages": int(outcome.steps[0]), "rounds": counts["rounds"]},
        )


_ENGINES: LRUCache[tuple[CompiledModel, BatchEngine]] = LRUCache(MOST_KEPT)
"""With what they were made for, so that its identity is not given to another."""


def _engine(problem: Problem) -> BatchEngine:
    """The programs of the problem's layout, kept from fit to fit."""

    def make() -> tuple[CompiledModel, BatchEngine]:
        single = _rough(problem)
        return problem.compiled_model, BatchEngine(
            problem.program, single, problem.data, problem.request.precision
        )

    return _ENGINES.of(id(problem.compiled_model), make)[1]


def _rough(problem: Problem) -> Program:
    """The same model in single precision."""
    if problem.request.precision == "single":
        return problem.program
    single = dataclasses.replace(problem.request, precision="single")
    with jax.enable_x64(False), TRACING_LOCK:
        return compile_program(single.bind(single.scene), problem.data.in_single_precision())


def _batch_of_one(data: Observations) -> ObservationBatch:
    """One capture as a batch of one pixel."""
    batched = jax.tree.map(lambda x: np.asarray(x)[None], data)
    return ObservationBatch(
        batched, jax.tree.map(lambda _: None, data), np.array([int(np.sum(data.valid))])
    )
