"""Importance sampling from mixtures at all modes and along their profiles.

Many captures are fitted side by side by the same mixtures and rounds, with the searches of all
and the densities of all their draws in compiled programs.

Source:
    Vehtari, Simpson, Gelman, Yao & Gabry (2024), JMLR 25(72): Pareto-smoothed importance sampling;
    Cappe, Douc, Guillin, Marin & Robert (2008), Stat. Comput. 18, 447-459: population Monte Carlo;
    Cornuet, Marin, Mira & Robert (2012), Scand. J. Stat. 39(4), 798-812: weights over all rounds.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar, override

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.special
from jaxtyping import Array, Float

from polar_bayes.errors import FitError
from polar_bayes.inference.batch_modes import find_all_modes, find_conditional_modes
from polar_bayes.inference.batching import MethodUsed, Status, batched
from polar_bayes.inference.compiled_model import (
    MOMENTS,
    CompiledModel,
)
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.problem_batch import SMALL_BATCH, BatchDraws, ProblemBatch
from polar_bayes.inference.program import THREADS, Program, Values, split_key
from polar_bayes.inference.result import CENTRAL_95, Provenance
from polar_bayes.methods.method import AbstractBatchMethod, AbstractMethod, PosteriorDraws
from polar_bayes.methods.profile_mixture import (
    LEAST_WEIGHT,
    MOST_COORDINATES,
    Components,
    Conditional,
    mixture_of,
    profile_components,
    profile_mixture,
)
from polar_bayes.numerics.batches import AnyArray, take_rows
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.levenberg_marquardt import NormalApproximation
from polar_bayes.numerics.mixtures import Mixture, draw_mixture, fit_mixture, log_density
from polar_bayes.numerics.optimize import finite_sd
from polar_bayes.numerics.psis import (
    FINITE_VARIANCE,
    MAX_PARETO_K,
    numpy_generator,
    resampled_chains,
    smooth,
    weighted_ess,
)
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress, no_progress


@dataclasses.dataclass(frozen=True)
class Importance(AbstractMethod):
    """Importance sampling from a mixture at all modes and along their profiles.

    Draws come from a mixture of Student t distributions with 8 degrees of freedom, at each mode
    that holds 0.1% of the Laplace evidence or more and along the profiles of every coordinate
    through it, each as heavy as the square root of its evidence. Weighting them by the posterior
    corrects what the normal approximation gets wrong, as far as the mixture reaches; Pareto k
    says how far. In further rounds a mixture that is fitted to the weighted draws of all rounds
    before proposes as many draws again, until there are enough effective ones and their weights
    have a finite variance.

    Args:
        draws: Of the mixture of each round, at least 256.
        rounds: At most, at least 1.

    Raises:
        FitError: Fewer draws or rounds.
    """

    draws: int = 4096
    rounds: int = 12

    group_size: ClassVar[int] = AbstractBatchMethod.group_size

    def __post_init__(self) -> None:
        self.check_least(draws=256, rounds=1)

    @override
    def prepare(self, problem: Problem) -> None:
        problem.prepare_search()

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        coordinates = initialization.joint_coordinates("Importance")
        key_rounds, key_resample = split_key(key)
        sample = Rounds(self, profile_mixture(coordinates), key_rounds)
        while sample.is_open:
            sample.weigh(coordinates.log_density(sample.draw()))
            progress("weighting draws", len(sample.proposals) / self.rounds)
        weights, pareto_k, effective = sample.weights, sample.pareto_k, sample.effective
        if not np.isfinite(weights).all():
            raise FitError(
                "the posterior density is zero at every draw",
                where="Importance",
                hint="use method='nuts'",
            )
        z = coordinates.forward(sample.z)
        index = resampled_chains(weights, effective, numpy_generator(key_resample))
        problems = []
        if not pareto_k <= MAX_PARETO_K:
            problems.append(
                f"Pareto k of the weights is {pareto_k:.2f} (at most {MAX_PARETO_K}): they do "
                "not reach all of the posterior, so use method='nuts'"
            )
        return PosteriorDraws(
            method="importance",
            z=z[index],
            stats={"lp": sample.log_posterior[index]},
            problems=problems,
            weighted=(z, weights),
            pareto_k=pareto_k,
            ess=effective,
            gradients=float(initialization.metadata["gradients"]),
            densities=float(len(z)),
            metadata={"modes": initialization.metadata, "rounds": len(sample.proposals)},
        )

    @override
    def run_batch(self, batch: ProblemBatch) -> Iterator[BatchDraws]:
        if not batch.engine.initializer.is_plain:
            yield from super().run_batch(batch)
            return
        most = 64  # captures whose draws are in memory in each thread
        count = max(min(THREADS, len(batch)), -(-len(batch) // most))
        groups = [batch.subset(x) for x in np.array_split(np.arange(len(batch)), count)]
        found: list[int] = []
        with ThreadPoolExecutor(THREADS) as pool:
            for answer in itertools.chain.from_iterable(pool.map(self._run_group, groups)):
                found.extend(answer.at)
                yield answer
        lost = np.flatnonzero(~np.isin(batch.at, found))
        if lost.size:  # no mode was found side by side
            yield from super().run_batch(batch.subset(lost))

    def _run_group(self, batch: ProblemBatch) -> list[BatchDraws]:
        """Weighted draws of the captures that have a mode."""
        with jax.enable_x64(batch.engine.precision == "double"):  # a thread does not inherit it
            owner, modes = find_all_modes(batch)
            if not owner.size:
                return []
            mixtures = profile_mixtures(batch, owner, modes)
            samples = {
                row: Rounds(self, mixture, jax.random.wrap_key_data(jnp.asarray(batch.keys[row])))
                for row, mixture in mixtures.items()
            }
            while left := [row for row, sample in samples.items() if sample.is_open]:
                z = np.stack([samples[row].draw() for row in left])
                some = batch.subset(np.array(left))
                drawn = some.run(_densities, self.draws, z, batch=SMALL_BATCH)
                for at, row in enumerate(left):
                    parameters, log_posterior = jax.tree.map(lambda x, at=at: x[at], drawn)
                    samples[row].weigh(log_posterior, parameters)
        heaviest = take_rows((modes.z, modes.root), np.unique(owner, return_index=True)[1])
        return [
            sample.answer(batch.at[[row]], take_rows(heaviest, np.array([at])))
            for at, (row, sample) in enumerate(samples.items())
        ]


ONE_ROUND = Importance(rounds=1)
"""Settings of draws that check other draws, or serve a comparison."""


def suits_profiles(program: Program) -> bool:
    """Return whether draws along the profiles of all coordinates are few enough."""
    return program.size <= MOST_COORDINATES


def tail_shares(problem: Problem, parameters: Values, key: Array) -> Provenance:
    """Return weighted shares beyond the 95% intervals of chains, for the provenance.

    Chains that never entered an arm of the posterior agree with each other; draws along its
    profiles reach the arm. Empty where such draws do not suit the problem.
    """
    if not suits_profiles(problem.program):
        return {}
    try:
        found = ONE_ROUND.run(problem, key, no_progress)
    except FitError:
        return {}
    assert found.weighted is not None
    z, weights = found.weighted
    shares = {}
    for name, x in problem.constrain(z[None]).items():
        draws = np.reshape(x, (len(weights), -1))
        low, high = np.quantile(np.reshape(parameters[name], (-1, draws.shape[1])), CENTRAL_95, 0)
        beyond = np.stack([weights @ (draws < low), weights @ (draws > high)], axis=1)
        shares[name] = np.round(beyond, 5).tolist()
    known = {"pareto_k": found.pareto_k, "ess": found.ess}
    return {"tails": {**known, "shares": shares}}


class Rounds:
    """Draws of all rounds of one posterior, weighted by the mean density of their proposals."""

    def __init__(self, settings: Importance, proposal: Mixture, key: Array) -> None:
        self._draws, self._rounds = settings.draws, settings.rounds
        self._next: Mixture | None = proposal
        self._key = key
        self.proposals: list[Mixture] = []
        self._z: list[np.ndarray] = []
        self._log_posterior: list[np.ndarray] = []
        self._parameters: list[Values] = []
        self._log_proposals = np.empty((0, 0))  # (proposal, draw)

    @property
    def is_open(self) -> bool:
        """True if a further round is needed, and there are draws to which it can be fitted."""
        return self._next is not None

    @property
    def z(self) -> Float[np.ndarray, "draw size"]:
        """Draws of all rounds."""
        return np.concatenate(self._z)

    @property
    def log_posterior(self) -> Float[np.ndarray, " draw"]:
        """Log posterior densities of the draws of all rounds."""
        return np.concatenate(self._log_posterior)

    def draw(self) -> np.ndarray:
        """Draw from the next proposal, (draw, size); call `weigh` with their densities next."""
        assert self._next is not None
        self._key, key = split_key(self._key)
        proposal = self._next
        z, log_proposal = map(np.asarray, _propose(proposal, self._draws, key))
        older = [np.asarray(_log_densities(each, z)) for each in self.proposals]
        newer = [np.asarray(_log_densities(proposal, block)) for block in self._z]
        above = np.concatenate([self._log_proposals, np.reshape(older, (-1, len(z)))], axis=1)
        below = np.concatenate([*newer, log_proposal])
        self._log_proposals = np.concatenate([above, below[None]])
        self.proposals.append(proposal)
        self._z.append(z)
        return z

    def weigh(self, log_posterior: np.ndarray, parameters: Values | None = None) -> None:
        """Add densities of the last draws, update all weights, and fit the next proposal."""
        self._log_posterior.append(log_posterior)
        self._parameters.append(parameters or {})
        mean = scipy.special.logsumexp(self._log_proposals, axis=0) - math.log(len(self.proposals))
        log_ratios = self.log_posterior - mean
        weights, pareto_k = smooth(log_ratios[None])
        self.weights, self.pareto_k = weights[0], float(pareto_k[0])
        self.effective = float(weighted_ess(weights)[0])
        enough = self.effective >= 0.2 * self._draws and self.pareto_k <= FINITE_VARIANCE
        is_last = enough or len(self.proposals) == self._rounds
        self._next = None if is_last or not self.is_finite else self._fit(log_ratios)

    @property
    def is_finite(self) -> bool:
        """True if any draw has a finite density."""
        return bool(np.isfinite(self.weights).all())

    def answer(self, at: np.ndarray, mode: tuple[AnyArray, AnyArray]) -> BatchDraws:
        """Return all draws as those of the capture at one place of a batch."""
        if not self.is_finite:
            return BatchDraws(at, Status.NOT_CONVERGED, pareto_k=self.pareto_k, mode=mode)
        return BatchDraws(
            at,
            Status.GOOD if self.pareto_k <= MAX_PARETO_K else Status.NOT_TRUSTED,
            jax.tree.map(lambda *rows: np.concatenate(rows)[None], *self._parameters),
            self.weights[None],
            self.effective,
            MethodUsed.IMPORTANCE,
            self.pareto_k,
            mode=mode,
            z=lambda: self.z[None],
        )

    def _fit(self, log_ratios: np.ndarray) -> Mixture:
        """Fit the mixture of the next round."""
        self._key, key = split_key(self._key)
        z = self.z
        weights = _temper(log_ratios, 10 * z.shape[1])  # effective draws that a fit needs
        # Two lengths compile, that of half of the rounds and that of all: the draws of rounds to
        # come have no weight.
        half = -(-self._rounds // 2) * self._draws
        missing = (half if len(z) <= half else self._rounds * self._draws) - len(z)
        z = np.pad(z, ((0, missing), (0, 0)))
        padded = np.pad(weights, (0, missing)).astype(z.dtype)
        return _fit_mixture(jnp.asarray(z), jnp.asarray(padded), 8, key)


_fit_mixture = functools.partial(jax.jit, static_argnums=2)(fit_mixture)


@jax.jit
def _log_densities(proposal: Mixture, z: Array) -> Array:
    # Some together: the densities of all components at all draws would fill the memory.
    return jax.lax.map(lambda z: log_density(proposal, z[None])[0], z, batch_size=min(1024, len(z)))


def _temper(log_ratios: np.ndarray, least: float) -> np.ndarray:
    """Raise weights to the largest power up to 1 that gives the effective sample size."""
    relative = log_ratios - np.max(log_ratios)

    def weights(power: float) -> np.ndarray:
        raised = np.exp(power * np.where(np.isfinite(relative), relative, -1e300))
        return raised / raised.sum()

    def excess(power: float) -> float:
        return float(weighted_ess(weights(power)[None])[0]) - least

    if excess(1.0) >= 0.0 or excess(1e-6) <= 0.0:
        return weights(1.0)
    return weights(scipy.optimize.brentq(excess, 1e-6, 1.0, xtol=1e-3))


@functools.partial(jax.jit, static_argnums=1)
def _propose(proposal: Mixture, count: int, key: Array) -> tuple[Array, Array]:
    z = draw_mixture(proposal, count, key)
    return z, _log_densities(proposal, z)


# --- Many captures side by side -------------------------------------------------------------------


def profile_mixtures(
    batch: ProblemBatch, owner: np.ndarray, modes: NormalApproximation
) -> dict[int, Mixture]:
    """Yield the first proposal of every pixel, given its modes, heaviest first."""
    first, inverse = np.unique(owner, return_index=True, return_inverse=True)[1:]
    weight = np.exp(modes.log_evidence - modes.log_evidence[first][inverse])
    heavy = weight >= LEAST_WEIGHT * np.bincount(inverse, weight)[inverse]
    owner, modes = owner[heavy], take_rows(modes, heavy)
    z, value, root = map(np.asarray, modes[:3])

    def conditional(peak: np.ndarray, z: np.ndarray, axis: np.ndarray) -> Conditional:
        return find_conditional_modes(batch.subset(owner[peak]), z, axis)

    peaks = Components.at(np.arange(len(z)), z, value, np.swapaxes(root, 1, 2) @ root)
    prior_sd = finite_sd(batch.engine.prior_draws(MOMENTS))
    components = profile_components(
        peaks, np.arange(batch.engine.program.size), prior_sd, conditional
    )
    return {
        int(pixel): mixture_of(
            take_rows(components, owner[components.peak] == pixel), batch.engine.dtype
        )
        for pixel in np.unique(owner)
    }


def _densities(engine: CompiledModel, draws: int) -> JitOnce:
    """The program of parameters and log densities of draws of one pixel; one for each number."""
    program = engine.program

    def of_pixel(data: Observations, z: Array) -> tuple[Values, Array]:
        # Some together: more would be shared among cores that then wait for each other.
        parameters, values = jax.lax.map(
            lambda z: program.parameters_and_potential(z, data), z, batch_size=64
        )
        return parameters, jnp.where(jnp.isnan(values), -jnp.inf, -values)

    return batched(of_pixel, lanes=1)
