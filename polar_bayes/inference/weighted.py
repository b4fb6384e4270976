"""Importance sampling from Laplace mixtures, and adaptive tempered SMC, of one posterior.

Source:
    Vehtari, Simpson, Gelman, Yao & Gabry (2024), JMLR 25(72): Pareto-smoothed importance sampling;
    Dau & Chopin (2022), J. R. Stat. Soc. B 84(1), 114-148: waste-free sequential Monte Carlo.
"""

import collections
import dataclasses
import functools
import math
from typing import Any, Self, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import FitError
from polar_bayes.inference.batch_fit import tempered_draws
from polar_bayes.inference.batch_programs import BatchEngine
from polar_bayes.inference.batch_result import Row, Status
from polar_bayes.inference.batching import Stack
from polar_bayes.inference.compile import TRACING_LOCK
from polar_bayes.inference.initialization import STARTS, JointInit
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.optimize import Modes
from polar_bayes.inference.problem import CompiledModel, Problem
from polar_bayes.inference.proposals import Mixture, draw_mixture, log_density
from polar_bayes.inference.psis import LARGEST_TRUSTED, effective_draws, smooth
from polar_bayes.inference.resampling import numpy_generator, systematic_resample
from polar_bayes.inference.smc import PixelTempering
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress, no_progress

LEAST_WEIGHT = 1e-3
"""Share of the Laplace evidence; modes of less get no draws."""

SIDE_BY_SIDE = 1024
"""Draws whose proposal density is computed together: that of all at once would fill the memory."""


@dataclasses.dataclass(frozen=True)
class Importance(AbstractMethod):
    """Laplace with importance correction.

    Draws come from a mixture of Student t distributions with 8 degrees of freedom, one at each
    mode that holds 0.1% of the Laplace evidence or more, as heavy as its evidence. Weighting them
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
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        if not isinstance(initialization, JointInit):
            raise FitError(
                "importance weights of many patches together are useless",
                where="Importance",
                hint="use method='nuts'",
            )
        proposal = laplace_mixture(initialization.modes, problem.dtype)
        key_draw, key_resample = jax.random.split(key)
        z, log_proposal = (np.asarray(x) for x in _propose(proposal, self.draws, key_draw))
        log_ratios = problem.log_density(z) - log_proposal
        weights, k_hat = (x[0] for x in smooth(log_ratios[None]))
        if not np.isfinite(weights).all():
            raise FitError(
                "the posterior density is zero at every draw",
                where="Importance",
                hint="use method='nuts'",
            )
        effective = float(effective_draws(weights[None])[0])
        index = systematic_resample(weights, effective, numpy_generator(key_resample))
        problems = []
        if not k_hat <= LARGEST_TRUSTED:
            problems.append(
                f"Pareto k-hat of the weights is {k_hat:.2f} (at most {LARGEST_TRUSTED}): they do "
                "not reach all of the posterior, so use method='nuts'"
            )
        return PosteriorDraws(
            method="importance",
            z=z[index],
            stats={"lp": (log_ratios + log_proposal)[index]},
            problems=problems,
            weighted=(z, weights),
            k_hat=float(k_hat),
            effective_draws=effective,
            gradients=float(initialization.said["gradients"]),
            densities=float(self.draws),
            metadata={"modes": initialization.said},
        )


@functools.partial(jax.jit, static_argnums=1)
def _propose(proposal: Mixture, count: int, key: Array) -> tuple[Array, Array]:
    z = draw_mixture(proposal, count, key)
    densities = jax.lax.map(
        lambda z: log_density(proposal, z[None])[0], z, batch_size=min(SIDE_BY_SIDE, count)
    )
    return z, densities


def laplace_mixture(modes: Modes, dtype: np.dtype) -> Mixture:
    """A component for each heavy mode; always as many, so that one program draws from all."""
    # There are never more modes than starts; a mode has several components where there are fewer.
    heavy = np.flatnonzero(modes.weight >= LEAST_WEIGHT)
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


# --- Adaptive tempered SMC ------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Tempered(AbstractMethod):
    """Adaptive tempered SMC of one material in one color, corrected by weights.

    Particles start from the prior, so they reach every mode before any of them is narrow; no
    gradient is computed.

    Args:
        settings: Of the particles, and of the mixtures that are fitted to them; one fit alone has
            time for more draws than each of thousands.

    Raises:
        FitError: A setting is outside its range.
    """

    settings: PixelTempering = dataclasses.field(
        default_factory=functools.partial(PixelTempering, draws=4096)
    )

    @property
    @override
    def num_draws(self) -> int:
        return self.settings.answer_draws

    @override
    def scale_draws(self, factor: float) -> Self:
        settings = self.settings
        wanted = factor * settings.answer_draws
        if wanted < settings.crowd:
            raise FitError(
                f"{wanted:g} draws are fewer than the crowd of {settings.crowd}",
                where="Tempered",
                hint="give a smaller crowd, or more draws",
            )
        scaled = self.with_draws(wanted).settings
        effective = settings.effective_draws * scaled.answer_draws / settings.answer_draws
        return dataclasses.replace(
            self, settings=dataclasses.replace(scaled, effective_draws=effective)
        )

    def with_draws(self, count: float) -> Self:
        """The same method with at least so many weighted draws.

        Args:
            count: Above 0.

        Returns:
            Other settings.
        """
        half = math.ceil(0.5 * max(count, self.settings.crowd))
        effective = min(self.settings.effective_draws, float(half))
        changed = dataclasses.replace(self.settings, draws=half, effective_draws=effective)
        return dataclasses.replace(self, settings=changed)

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        if not problem.is_one_spectrum_point:
            raise FitError(
                "tempered draws are of one material in one color only",
                where="Tempered",
                hint="use method='nuts'",
            )
        # Maps and calibrations temper many captures side by side; this is a batch of one.
        settings, row = self.settings, Row(1, lambda at, parameters, weights: None)
        engine = counting_engine(problem.compiled_model, progress)
        keys = np.asarray(jax.random.key_data(key))[None]
        data, at = _batch_of_one(problem.data), np.zeros(1, int)
        answers = list(tempered_draws(engine, settings, data, keys, at, row))
        progress("tempering", 1.0)
        if not answers:
            raise FitError(
                "the particles did not arrive at the posterior", where="Tempered", hint="use 'nuts'"
            )
        found = answers[-1][1]
        z, weights = found.z[0].astype(float), found.weights[0].astype(float)
        weights = weights / weights.sum()
        effective, k_hat = float(found.worth[0]), float(found.pareto_k[0])
        index = systematic_resample(weights, effective, numpy_generator(key))
        problems = []
        if row.status[0] != Status.GOOD:
            problems.append(
                f"the effective sample size of the weighted draws is {effective:.0f} (at least "
                f"{settings.effective_draws:.0f}), with a Pareto k-hat of {k_hat:.2f} (at "
                f"most {LARGEST_TRUSTED}): use method='nuts'"
            )
        stages, rounds = int(row.outcome.steps[0]), engine.counts["rounds"]
        densities = (
            engine.counts["crowds"] * settings.looks * settings.crowd
            + stages * settings.walks * (settings.length - 1)
            + rounds * settings.draws
        )
        return PosteriorDraws(
            method="tempered",
            z=z[index],
            stats={"log_weight": np.log(np.maximum(weights, 1e-300))[index]},
            problems=problems,
            weighted=(z, weights),
            k_hat=k_hat,
            effective_draws=effective,
            gradients=0.0,
            densities=float(densities),
            metadata={"stages": stages, "rounds": rounds},
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _CountingEngine(BatchEngine):
    """The programs of a layout, and how often one fit runs them."""

    counts: collections.Counter = dataclasses.field(default_factory=collections.Counter)
    progress: Progress = no_progress

    @override
    def temper(self, pixels: Stack, settings: PixelTempering, *others: Any) -> Any:
        self._count("crowds", settings)
        return super().temper(pixels, settings, *others)

    @override
    def propose(self, pixels: Stack, settings: PixelTempering, *others: Any) -> Any:
        self._count("rounds", settings)
        return super().propose(pixels, settings, *others)

    def _count(self, what: str, settings: PixelTempering) -> None:
        """Report progress; a fit that was abandoned ends here."""
        every = settings.crowds * (settings.rounds + 1)
        self.progress("tempering", self.counts.total() / every)
        self.counts[what] += 1


def counting_engine(model: CompiledModel, progress: Progress) -> _CountingEngine:
    """The compiled programs of a model, with counts that begin at zero."""

    def make() -> BatchEngine:
        single = model.single
        with TRACING_LOCK:  # no mode is searched for, so one candidate stands for all
            return BatchEngine(
                model.program, single, np.zeros((1, model.program.size)), model.precision
            )

    made = model.programs.of("tempered", make)
    fields = {field.name: getattr(made, field.name) for field in dataclasses.fields(made)}
    return _CountingEngine(**fields, progress=progress)


def _batch_of_one(data: Observations) -> Stack:
    """One capture as a batch that shares nothing."""
    own = jax.tree.map(lambda x: np.asarray(x)[None], data)
    return Stack(own, jax.tree.map(lambda _: None, data), np.array([int(np.sum(data.valid))]))
