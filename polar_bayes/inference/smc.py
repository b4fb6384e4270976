r"""Adaptive tempered sequential Monte Carlo, waste-free (Dau & Chopin 2022).

$$ p_t(z) \propto p(z) \, p(y|z)^t, \quad 0 = t_0 < t_1 < ... < 1 $$

Particles start from the prior, so every mode has particles before any mode is narrow. At each stage
bisection finds the next temperature, at which the effective sample size of the incremental weights
is `target_ess` of the particles. A few particles are resampled systematically, each starts a chain
of random-walk Metropolis steps, and all states of all chains are the next particles: no evaluation
of the model is wasted. The last particles are not resampled but keep their weights.

Coordinates are normal scores of the prior. An unconstrained vector may have a long tail under its
prior (the log of a roughness that may be zero), in which steps and mixtures with one width for each
coordinate reach either the middle or the tail. Normal scores have neither tail nor skew.

The particles are then the first sample to which rounds of adaptive importance sampling fit
mixtures of Student t distributions (`proposals.py`). The draws to which a mixture was fitted are
never part of an answer: the mixture is dense where they lie, which lowers exactly the weights that
are high, so tails come out too short and the effective sample size too large. Nor are the draws by
which the rounds were ended. When the draws of two rounds have the effective sample size, new draws
of the same two mixtures are the answer, if they have it too.

Source:
    Dau & Chopin (2022), J. R. Stat. Soc. B 84(1), 114-148.
"""

import collections
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Self, override

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float
from scipy.special import ndtr

from polar_bayes.errors import FitError
from polar_bayes.inference.batch_engine import SMALL_BATCH, BatchEngine, evaluate_draws
from polar_bayes.inference.batch_method import AbstractPixelMethod, BatchFit
from polar_bayes.inference.batching import MethodUsed, ObservationBatch, Status, batched, take_rows
from polar_bayes.inference.compile import JitOnce
from polar_bayes.inference.levenberg_marquardt import NormalApproximation
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.problem import CompiledModel, Problem
from polar_bayes.inference.program import Program
from polar_bayes.inference.proposals import (
    Proposed,
    WeightedSample,
    combine_samples,
    draw_mixture,
    fit_mixture,
    moments,
    resample,
)
from polar_bayes.inference.psis import MAX_PARETO_K, numpy_generator, systematic_resample
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

# --- Coordinates in which each parameter's prior is standard normal -------------------------------


KNOTS = np.arange(-3.0, 3.01, 0.25, dtype=np.float32)
"""Normal scores of the knots; between and beyond them the transform is linear."""

FLATTEST = 1e-4
"""Least slope of a transform, in units of its mean slope: it must have an inverse."""


class NormalScoreTransform(NamedTuple):
    """A transform of each unconstrained coordinate to its normal score, and its inverse."""

    # Any increasing transform would do, since densities allow for its slope. This one is the
    # empirical one of draws from the prior, linear between a few knots.

    values: Float[Array, "size knot"]

    def forward(self, z: Float[Array, "*draw size"]) -> Float[Array, "*draw size"]:
        """Normal scores of unconstrained vectors."""

        def one(z: Array, values: Array) -> Array:
            at, slope = _segment(z, values, values)
            return jnp.asarray(KNOTS, z.dtype)[at] + (z - values[at]) / slope

        return jax.vmap(one, in_axes=(-1, 0), out_axes=-1)(z, self.values)

    def inverse(
        self, u: Float[Array, "*draw size"]
    ) -> tuple[Float[Array, "*draw size"], Float[Array, "*draw"]]:
        """Unconstrained vectors of normal scores, and the log Jacobian determinant there."""

        def one(u: Array, values: Array) -> tuple[Array, Array]:
            knots = jnp.asarray(KNOTS, u.dtype)
            at, slope = _segment(u, knots, values)
            return values[at] + (u - knots[at]) * slope, jnp.log(slope)

        z, log_slope = jax.vmap(one, in_axes=(-1, 0), out_axes=-1)(u, self.values)
        return z, jnp.sum(log_slope, axis=-1)


def fit_normal_scores(z: Float[Array, "draw size"]) -> NormalScoreTransform:
    """The transform that makes draws from a prior standard normal in every coordinate."""
    # Source: van der Waerden (1952), Indag. Math. 14, 453-458: normal scores.
    values = _quantiles(z.T, ndtr(KNOTS.astype(float)))
    steps = jnp.diff(values)
    steps = jnp.maximum(steps, FLATTEST * jnp.mean(steps, axis=-1, keepdims=True))
    return NormalScoreTransform(
        jnp.concatenate([values[:, :1], values[:, :1] + jnp.cumsum(steps, 1)], axis=1)
    )


@dataclasses.dataclass(frozen=True, eq=False)
class ScoredProgram:
    """A program whose vectors are normal scores, and their densities."""

    program: Program
    transform: NormalScoreTransform

    def potential(self, u: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Minus the log posterior density of the scores, up to a constant."""
        z, log_jacobian = self.transform.inverse(u)
        return self.program.potential(z, data) - log_jacobian

    def prior_potential(self, u: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Minus the log prior density of the scores, up to a constant."""
        z, log_jacobian = self.transform.inverse(u)
        return self.program.prior_potential(z, data) - log_jacobian

    def parameters_and_potential(
        self, u: Float[Array, " size"], data: Observations
    ) -> tuple[dict[str, Array], Float[Array, ""]]:
        """The parameters of the model, and minus the log posterior density of the scores."""
        z, log_jacobian = self.transform.inverse(u)
        parameters, potential = self.program.parameters_and_potential(z, data)
        return parameters, potential - log_jacobian


def inverse_of_pixels(
    transform: NormalScoreTransform, u: Float[np.ndarray, "pixel draw size"]
) -> np.ndarray:
    """Unconstrained vectors of many pixels, each with a transform of its own."""
    at = np.clip(np.searchsorted(KNOTS, u) - 1, 0, len(KNOTS) - 2)
    values = np.asarray(transform.values)
    slopes = np.diff(values, axis=-1) / np.diff(KNOTS)

    def of(values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, np.moveaxis(at, 1, 2), axis=-1).swapaxes(1, 2)

    return of(values) + (u - KNOTS[at]) * of(slopes)


def _quantiles(x: Float[Array, "size draw"], shares: np.ndarray) -> Float[Array, "size share"]:
    """As `jnp.quantile`, of finite numbers."""
    # Integers in the same order are sorted instead: XLA takes six times as long to compare
    # floating-point numbers.
    integer = jnp.int64 if x.dtype == jnp.float64 else jnp.int32

    def ordered_bits(bits: Array) -> Array:
        return jnp.where(bits < 0, bits ^ jnp.iinfo(integer).max, bits)

    bits = jnp.sort(ordered_bits(jax.lax.bitcast_convert_type(x, integer)), axis=-1)
    ordered = jax.lax.bitcast_convert_type(ordered_bits(bits), x.dtype)
    position = shares * (x.shape[-1] - 1)
    below = np.minimum(position.astype(int), x.shape[-1] - 2)
    low, high = ordered[:, below], ordered[:, below + 1]
    return low + jnp.asarray(position - below, x.dtype) * (high - low)


def _segment(x: Array, ends: Array, values: Array) -> tuple[Array, Array]:
    """Index of the segment in which each x lies, and the slope of the transform there."""
    at = jnp.clip(jnp.searchsorted(ends, x) - 1, 0, len(KNOTS) - 2)
    return at, (values[at + 1] - values[at]) / (KNOTS[1] - KNOTS[0])


# --- Settings, and weighted draws of many pixels --------------------------------------------------


BISECTIONS = 20
"""Of the interval in which the next temperature lies."""

MAX_STAGES = 60
"""Stages after which particles that have not reached temperature 1 count as failed."""

TARGET_ACCEPTANCE = 0.25
"""Share of accepted Metropolis steps to which the step size is adapted."""

PRIOR_BATCH = 256
"""Prior draws that are evaluated together: thousands leave the cache of a core."""

ENGINE = "tempered"
"""Key of the engine among the programs of a model."""

FIRST_KEY = np.uint32(2**32 - 1)
"""Number of the random key of the first particles; those of rounds count up from 0."""


@dataclasses.dataclass(frozen=True)
class PixelSMC(AbstractPixelMethod):
    """Tempered sequential Monte Carlo in every pixel, corrected by importance weights.

    Args:
        num_chains: Particles that are resampled at each stage, >= 16; each starts a chain.
        chain_length: States of each chain, its first included, >= 2; all states of all chains are
            the particles.
        init_factor: Draws from the prior for each particle, >= 1: more find a narrow mode more
            often, and the first step of temperature is longer.
        target_ess: Effective sample size of the incremental weights at each stage, as a share of
            the number of particles, between 0.1 and 0.95.
        draws: Of a mixture in every round, at least half the number of particles. An answer has
            as many new draws of the mixtures of two rounds.
        components: Of the mixtures, >= 1.
        rounds: In which a mixture is fitted to the weighted draws, at most, >= 2.
        num_attempts: Pixels without an answer after these rounds start again from new particles,
            until there were so many attempts, >= 1.
        effective_draws: Least effective sample size of an answer, of the bulk and of both tails,
            >= 1.

    Raises:
        FitError: A setting is outside its range.
    """

    num_chains: int = 256
    chain_length: int = 8
    init_factor: int = 2
    target_ess: float = 0.5
    draws: int = 2048
    components: int = 4
    rounds: int = 8
    num_attempts: int = 3
    effective_draws: float = 400.0

    def __post_init__(self) -> None:
        self._check_least(num_chains=16, chain_length=2, init_factor=1)
        self._check_least(components=1, rounds=2, num_attempts=1, effective_draws=1)
        if not 0.1 <= self.target_ess <= 0.95:
            self._refuse(f"target_ess is {self.target_ess}", "give a number from 0.1 to 0.95")
        if self.answer_draws < self.num_particles:
            self._refuse(
                f"draws is {self.draws}, of {self.num_particles} particles",
                "give at least half of num_chains * chain_length",
            )
        if self.effective_draws >= self.answer_draws:
            self._refuse(
                f"effective_draws is {self.effective_draws}, of {self.answer_draws} draws",
                "give fewer, or more draws",
            )

    @property
    def num_particles(self) -> int:
        """Particles of each stage."""
        return self.num_chains * self.chain_length

    @property
    def answer_draws(self) -> int:
        """Weighted draws of an answer: those of two rounds."""
        return 2 * self.draws

    @override
    def fit(
        self, batch: BatchFit, at: np.ndarray, modes: NormalApproximation | None = None
    ) -> None:
        for _ in smc_draws(batch, self, at):
            pass  # recorded in the batch


def smc_draws(
    batch: BatchFit,
    settings: PixelSMC,
    at: np.ndarray,
    count: Callable[[str], None] = lambda what: None,
) -> Iterator[tuple[np.ndarray, WeightedSample]]:
    """Weighted draws of some pixels as answers come; `count` is called before each computation."""
    outcome = batch.outcome
    outcome.status[at] = Status.NOT_CONVERGED
    for attempt in range(settings.num_attempts):
        left = at
        for some, sample, is_enough in _attempt(batch, settings, at, attempt, count):
            status = np.where(is_enough, Status.GOOD, Status.NOT_TRUSTED)
            found = sample.parameters, sample.weights, sample.ess, MethodUsed.TEMPERED, status
            batch.record(some, *found)
            outcome.pareto_k[some] = sample.pareto_k
            left = np.setdiff1d(left, some)
            yield some, sample
        at = left
        if not at.size:
            return


def _attempt(
    batch: BatchFit, settings: PixelSMC, at: np.ndarray, attempt: int, count: Callable[[str], None]
) -> Iterator[tuple[np.ndarray, WeightedSample, np.ndarray]]:
    """Particles from the prior, then mixtures until their draws have the effective sample size."""

    def run(make: Callable, given: tuple, which: np.ndarray, *states: Any) -> Any:
        return batch.engine.run(
            make,
            settings,
            batch.pixels.subset(which),
            *states,
            batch.keys[which],
            given=given,
            batch=SMALL_BATCH,
            single=True,
        )

    def draw(round_: Round, which: np.ndarray, again: bool) -> Proposed:
        """Draws of the mixtures of a round in some of its pixels, those of the fit or new ones."""
        number, *states = round_.of(which)
        return run(_mixture_draws, (number, np.uint32(again)), at[left[which]], *states)

    count("particles")
    smc: TemperedParticles = run(_particles, (FIRST_KEY - np.uint32(attempt),), at)
    batch.outcome.steps[at] += smc.stages
    left = np.flatnonzero((smc.temperature >= 1.0) & np.isfinite(smc.u).all(axis=(1, 2)))
    repeated = np.arange(settings.answer_draws) % settings.num_particles
    u = np.asarray(smc.u)[left][:, repeated]
    weights = np.asarray(smc.weights)[left][:, repeated] / np.bincount(repeated)[repeated]
    last: tuple[Round, Proposed] | None = None
    for number in range(attempt * settings.rounds, (attempt + 1) * settings.rounds):
        if not left.size:
            return
        count("rounds")
        transform = take_rows(smc.transform, left)
        this = Round(np.uint32(number), transform, u.astype("f4"), weights.astype("f4"))
        drawn = draw(this, np.arange(left.size), again=False)
        sample = combine_samples(drawn if last is None else last[1], drawn)
        possible = np.isfinite(sample.weights).all(axis=-1)
        enough = np.zeros(left.size, bool)
        if last is not None:  # its own weights do not show that one mixture is too narrow
            is_last = number + 1 == (attempt + 1) * settings.rounds
            tested = np.flatnonzero(_is_enough(sample, settings) | (is_last & possible))
            if tested.size:
                count("answers")
                answer = combine_samples(
                    *(draw(each, tested, again=True) for each in (last[0], this))
                )
                good = _is_enough(answer, settings)
                enough[tested] = good | (is_last & np.isfinite(answer.weights).all(axis=-1))
                ended = np.flatnonzero(enough[tested])
                found, some = take_rows(answer, ended), tested[ended]
                z = inverse_of_pixels(take_rows(transform, some), found.z)
                yield at[left[some]], found._replace(z=z), good[ended]
        goes_on = ~enough & possible
        left, last = left[goes_on], (this.of(goes_on), take_rows(drawn, goes_on))
        u, weights = sample.z[goes_on], sample.weights[goes_on]


class Round(NamedTuple):
    """What the mixtures of one round are fitted to, in every pixel."""

    number: np.uint32
    transform: NormalScoreTransform
    u: np.ndarray
    weights: np.ndarray

    def of(self, which: np.ndarray) -> Self:
        """The same of some pixels."""
        rows = take_rows((self.transform, self.u, self.weights), which)
        return type(self)(self.number, *rows)


def _is_enough(sample: WeightedSample, settings: PixelSMC) -> np.ndarray:
    """Which pixels have the effective sample size that was asked for."""
    return (sample.ess >= settings.effective_draws) & (sample.pareto_k <= MAX_PARETO_K)


# --- One capture ----------------------------------------------------------------------------------


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

    settings: PixelSMC = dataclasses.field(default_factory=functools.partial(PixelSMC, draws=4096))

    @property
    @override
    def num_draws(self) -> int:
        return self.settings.answer_draws

    @override
    def scale_draws(self, factor: float) -> Self:
        settings = self.settings
        wanted = factor * settings.answer_draws
        if wanted < settings.num_particles:
            raise FitError(
                f"{wanted:g} draws are fewer than the {settings.num_particles} particles",
                where="Tempered",
                hint="give fewer particles, or more draws",
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
        half = math.ceil(0.5 * max(count, self.settings.num_particles))
        effective = min(self.settings.effective_draws, float(half))
        changed = dataclasses.replace(self.settings, draws=half, effective_draws=effective)
        return dataclasses.replace(self, settings=changed)

    def is_compiled(self, problem: Problem) -> bool:
        """Whether `run` finds all of its programs in the cache.

        Args:
            problem: The capture and its model.

        Returns:
            False where it must compile, which takes longer than many chains.
        """
        engine = problem.compiled_model.programs.get(ENGINE)
        if engine is None:
            return False
        keys = ((make, self.settings) for make in (_particles, _mixture_draws))
        return all(engine.programs.get(key) is not None for key in keys)

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        if not problem.is_one_spectrum_point:
            raise FitError(
                "tempered draws are of one material in one color only",
                where="Tempered",
                hint="use method='nuts'",
            )
        # Maps and calibrations fit many captures side by side; this is a batch of one.
        settings, counts = self.settings, collections.Counter[str]()

        def count(what: str) -> None:
            """Report progress; a fit that was abandoned ends here."""
            progress("tempering", counts.total() / (settings.num_attempts * 2 * settings.rounds))
            counts[what] += 1

        keys = np.asarray(jax.random.key_data(key))[None]
        batch = BatchFit(_engine(problem.compiled_model), _batch_of_one(problem.data), keys)
        answers = list(smc_draws(batch, settings, np.zeros(1, int), count))
        progress("tempering", 1.0)
        if not answers:
            raise FitError(
                "the particles did not arrive at the posterior", where="Tempered", hint="use 'nuts'"
            )
        found = answers[-1][1]
        z, weights = found.z[0].astype(float), found.weights[0].astype(float)
        weights = weights / weights.sum()
        effective, k_hat = float(found.ess[0]), float(found.pareto_k[0])
        index = systematic_resample(weights, effective, numpy_generator(key))
        problems = []
        if batch.outcome.status[0] != Status.GOOD:
            problems.append(
                f"the effective sample size of the weighted draws is {effective:.0f} (at least "
                f"{settings.effective_draws:.0f}), with a Pareto k-hat of {k_hat:.2f} (at "
                f"most {MAX_PARETO_K}): use method='nuts'"
            )
        stages, rounds = int(batch.outcome.steps[0]), counts["rounds"]
        densities = (
            counts["particles"] * settings.init_factor * settings.num_particles
            + stages * settings.num_chains * (settings.chain_length - 1)
            + (rounds + 2 * counts["answers"]) * settings.draws
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


def _engine(model: CompiledModel) -> BatchEngine:
    """The programs of a model for batches."""

    def make() -> BatchEngine:
        return BatchEngine(model.program, model.single, model.layout, model.precision)

    return model.programs.of(ENGINE, make)


def _batch_of_one(data: Observations) -> ObservationBatch:
    """One capture as a batch that shares nothing."""
    batched = jax.tree.map(lambda x: np.asarray(x)[None], data)
    return ObservationBatch(
        batched, jax.tree.map(lambda _: None, data), np.array([int(np.sum(data.valid))])
    )


# --- Compiled programs of one pixel ---------------------------------------------------------------


class Particles(NamedTuple):
    """Particles in normal scores, with their densities."""

    u: Float[Array, "draw size"]
    log_prior: Float[Array, " draw"]
    log_likelihood: Float[Array, " draw"]


class TemperedParticles(NamedTuple):
    """Weighted particles at the last temperature, which is 1 unless there were too many stages."""

    u: Float[Array, "draw size"]
    weights: Float[Array, " draw"]
    transform: NormalScoreTransform
    temperature: Float[Array, ""]
    stages: Array


def _particles(engine: BatchEngine, settings: PixelSMC) -> JitOnce:
    """The program of tempered SMC in one pixel."""

    def pixel(number: Array, data: Observations, key: Array) -> TemperedParticles:
        return temper(engine.single_program, settings, data, jax.random.fold_in(key, number))

    return batched(pixel, given=1, lanes=1)


def _mixture_draws(engine: BatchEngine, settings: PixelSMC) -> JitOnce:
    """The program of one round: fit a mixture to weighted draws, and draw from it (or again)."""

    def pixel(
        number: Array,
        again: Array,
        data: Observations,
        transform: NormalScoreTransform,
        u: Array,
        weights: Array,
        key: Array,
    ) -> Proposed:
        key_fit, key_draw = jax.random.split(jax.random.fold_in(key, number))
        key_draw = jnp.where(again, jax.random.fold_in(key_draw, again), key_draw)
        mixture = fit_mixture(u, weights, settings.components, key_fit)
        drawn = draw_mixture(mixture, settings.draws, key_draw)
        scored = ScoredProgram(engine.single_program, transform)
        return Proposed(mixture, drawn, *evaluate_draws(scored, drawn, data))

    return batched(pixel, given=2, lanes=1)


def temper(
    program: Program, settings: PixelSMC, data: Observations, key: Array
) -> TemperedParticles:
    """Tempered SMC from the prior to the posterior of one pixel."""
    num_chains, count, size = settings.num_chains, settings.num_particles, program.size
    key_init, key_first, key_stages = jax.random.split(key, 3)
    keys = jax.random.split(key_init, settings.init_factor * count)
    z = jax.lax.map(lambda key: program.from_prior(key, data), keys, batch_size=PRIOR_BATCH)
    transform = fit_normal_scores(z)
    scored = ScoredProgram(program, transform)

    def evaluate(u: Array) -> Particles:
        prior = -scored.prior_potential(u, data)
        likelihood = -scored.potential(u, data) - prior
        return Particles(u, prior, jnp.where(jnp.isnan(likelihood), -jnp.inf, likelihood))

    def next_temperature(particles: Particles, temperature: Array) -> tuple[Array, Array]:
        """The next temperature, and its incremental weights."""
        rise = _largest_step(
            particles.log_likelihood, 1.0 - temperature, settings.target_ess * count
        )
        weights = jax.nn.softmax(jnp.where(rise > 0.0, rise * particles.log_likelihood, 0.0))
        return jnp.minimum(temperature + rise, 1.0), weights

    def goes_on(state: tuple) -> Array:
        temperature, *_, stages = state
        # The first particles hold duplicates, so at least one stage moves them.
        return ((temperature < 1.0) | (stages < 1)) & (stages < MAX_STAGES)

    def stage(state: tuple) -> tuple:
        temperature, weights, particles, step_size, key, stages = state
        key, key_resample, key_chains = jax.random.split(key, 3)
        root = moments(particles.u, weights)[1]

        def move(at: Particles, key: Array) -> tuple[Particles, tuple[Particles, Array]]:
            key_step, key_accept = jax.random.split(key)
            noise = jax.random.normal(key_step, at.u.shape, at.u.dtype)
            proposed = jax.vmap(evaluate)(at.u + step_size * noise @ root.T)
            log_ratio = proposed.log_prior - at.log_prior
            log_ratio += temperature * (proposed.log_likelihood - at.log_likelihood)
            uniform = jax.random.uniform(key_accept, log_ratio.shape, log_ratio.dtype)
            accepted = jnp.log(uniform) < log_ratio
            moved = jax.tree.map(lambda new, old: _where(accepted, new, old), proposed, at)
            return moved, (moved, jnp.mean(accepted))

        first = _resampled(particles, weights, num_chains, key_resample)
        keys = jax.random.split(key_chains, settings.chain_length - 1)
        _, (rest, accepted) = jax.lax.scan(move, first, keys)
        particles = jax.tree.map(
            lambda x, y: jnp.concatenate([x[None], y]).reshape(count, *x.shape[1:]), first, rest
        )
        factor = jnp.exp(jnp.clip(2.0 * (jnp.mean(accepted) - TARGET_ACCEPTANCE), -1.0, 1.0))
        following = next_temperature(particles, temperature)
        return *following, particles, step_size * factor, key, stages + 1

    start = jax.lax.map(evaluate, transform.forward(z), batch_size=PRIOR_BATCH)
    one = jnp.ones((), z.dtype)
    temperature, weights = next_temperature(start, 0.0 * one)
    particles = _resampled(start, weights, count, key_first)
    state = (
        *next_temperature(particles, temperature),
        particles,
        2.38 / size**0.5 * one,  # Gelman, Roberts & Gilks (1996), Bayesian Statistics 5, 599-607
        key_stages,
        jnp.int32(0),
    )
    temperature, weights, particles, *_, stages = jax.lax.while_loop(goes_on, stage, state)
    return TemperedParticles(particles.u, weights, transform, temperature, stages)


def _largest_step(log_likelihood: Array, most: Array, target: float) -> Array:
    """The largest step of temperature whose weights have this effective sample size."""

    def is_enough(rise: Array) -> Array:
        log_weights = rise * log_likelihood
        return 2.0 * logsumexp(log_weights) - logsumexp(2.0 * log_weights) >= jnp.log(target)

    def bisect(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        enough = is_enough(middle)
        return jnp.where(enough, middle, low), jnp.where(enough, high, middle)

    low, _ = jax.lax.fori_loop(0, BISECTIONS, bisect, (jnp.zeros_like(most), most))
    return jnp.where(is_enough(most), most, low)


def _resampled(particles: Particles, weights: Array, count: int, key: Array) -> Particles:
    index = resample(weights, count, key)
    return jax.tree.map(lambda x: x[index], particles)


def _where(accepted: Array, new: Array, old: Array) -> Array:
    return jnp.where(accepted.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
