"""Laplace approximation of many pixels, corrected by importance sampling.

Each pixel takes the first of these that can be trusted: quasi-random draws of the normal
approximation at the mode, weighted by Pareto-smoothed importance sampling; draws of Student t
proposals that are fitted to the weighted draws of the previous round (population Monte Carlo);
draws of a sampler (`Importance`, say), which also fits pixels whose mode was not found.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Generator, Iterator
from typing import ClassVar, NamedTuple, Self, override

import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.batch_modes import (
    CANDIDATES,
    RESTARTS,
    ModeSearch,
    find_modes_from,
    find_starts,
)
from polar_bayes.inference.batching import MethodUsed, Status, batched
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.problem_batch import BatchDraws, ProblemBatch
from polar_bayes.inference.program import Values
from polar_bayes.inference.result import Provenance
from polar_bayes.methods.importance import Importance
from polar_bayes.methods.method import AbstractBatchMethod
from polar_bayes.numerics.batches import put_rows, take_rows
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.levenberg_marquardt import NormalApproximation
from polar_bayes.numerics.mixtures import (
    Points,
    Proposal,
    fit_t,
    normal_points,
    random_rotations,
    student_t_points,
)
from polar_bayes.numerics.psis import MAX_PARETO_K, smooth, weighted_ess
from polar_bayes.observation.data import Observations

HARD = 1024
"""Number of pixels whose additional draws are in memory together."""

LANES = 4
"""Pixels of a batch that are computed together when each has hundreds of draws."""

SAME_POTENTIAL = 1e-3
"""Difference of potentials below which two modes count as one."""

LEAST_RIVAL, LEAST_DISTANCE = 0.02, 1.0
"""Evidence of another mode, relative to the heaviest, from which all modes of a pixel are used; its
least distance in posterior sds."""

SMALL_IMAGE, SAMPLE, MOST_MISSED = 2048, 512, 0.01
"""Largest image that is searched from all starts; number of pixels of a larger one that compare
starts; largest share of pixels in which a single start may miss a mode undetected."""

ARM, LONGEST_ARM, MOST_IN_ARM = 2.5, 8.0, 0.025
"""Distance along a profile, in sds of the proposal, where a long tail begins, and where the search
for it ends; largest share of a profile in such tails (.012 for a normal one) that the proposal may
miss."""

STUDENT_T_FACTOR = 2
"""Number of draws of a Student t proposal per draw of the normal approximation."""

NORMAL_SHARE, STUDENT_T_SHARE = 0.6, 0.4
"""Least effective sample size of weighted draws, relative to their number. Pareto k cannot detect a
tail of the posterior that no draw has reached, but a small effective sample size can: docs/maps.md
has the measurement. The longer tails of Student t distributions cost draws."""


@dataclasses.dataclass(frozen=True)
class CorrectedLaplace(AbstractBatchMethod):
    """The Laplace approximation of many captures, checked and corrected by importance weights.

    Weights of its own draws tell where the normal distribution serves, and correct it; proposals
    that are fitted to weighted draws serve elsewhere, and importance sampling what is left.

    Args:
        draws: Of the approximation in each pixel, from which means and quantiles are taken; a
            power of two, >= 64.
        candidates: Prior draws among which the start of each pixel is chosen, >= 8.
        starts: From how many of them every pixel is searched, 1 to 8; the lowest mode counts. By
            default 8. Of an image of more than 2,048 pixels that share nothing, 512 drawn at
            random decide: 1 serves where 8 find another mode in at most 1% of them. Pixels whose
            weights cannot be trusted are searched from 8 in any case.
        rounds: In which the proposal of a pixel with Pareto k above 0.7, or with too few effective
            draws, is fitted to its own weighted draws, until it has neither; >= 0.
        sampler: The method of pixels that still have, and of those whose mode was not found, such
            as `Importance()` or `Nuts()`; None marks them only.

    Raises:
        FitError: A setting is outside its range.
    """

    draws: int = 256
    candidates: int = CANDIDATES
    starts: int | None = None
    rounds: int = 3
    sampler: AbstractBatchMethod | None = dataclasses.field(default_factory=Importance)

    memory_limit: ClassVar[int] = 4096
    most_starts: ClassVar[int] = 1 + len(RESTARTS)

    def __post_init__(self) -> None:
        if self.draws < 64 or self.draws & (self.draws - 1):
            self.refuse(f"draws is {self.draws}", "give 64, 128, 256 or so")
        self.check_least(candidates=8, rounds=0)
        if self.starts is not None and not 1 <= self.starts <= self.most_starts:
            self.refuse(f"starts is {self.starts}", f"give 1 to {self.most_starts}")

    @override
    def run_batch(
        self, batch: ProblemBatch, known: np.ndarray | None = None
    ) -> Iterator[BatchDraws]:
        """Draw from many posteriors; searches start at `known` modes, (pixel, size), if given."""

        def sample(which: np.ndarray) -> Iterator[BatchDraws]:
            if self.sampler is not None and which.size:
                yield from self.sampler.run_batch(batch.subset(which))

        run = _Run(self, batch)
        found = run.approximate(known)
        yield from run.answers(found)
        converged = found.search.converged
        several = converged & found.has_rival & (self.sampler is not None)
        yield from sample(np.flatnonzero(several))
        hard = np.flatnonzero(converged & ~found.is_trusted & ~several)
        for begin in range(0, hard.size, HARD):
            some = hard[begin : begin + HARD]
            left = yield from run.adapt(some, take_rows(found, some))
            yield from sample(some[left])
        yield from sample(np.flatnonzero(~converged))

    @override
    def for_image(
        self, size: int, sample: Callable[[int], ProblemBatch], *, is_shared: bool
    ) -> tuple[Self, Provenance]:
        if self.starts is not None:
            return self, {}
        every = dataclasses.replace(self, starts=self.most_starts)
        if is_shared or size <= SMALL_IMAGE:
            return every, {}
        batch = sample(SAMPLE)
        once = dataclasses.replace(self, starts=1)
        one, best = (_Run(method, batch).approximate() for method in (once, every))
        is_lower = best.search.mode.value < one.search.mode.value - SAME_POTENTIAL
        missed = int(np.sum(one.is_trusted & (is_lower | best.has_rival)))
        chosen = once if missed <= MOST_MISSED * len(batch) else every
        return chosen, {"starts_compared": {"pixels": len(batch), "missed": missed}}


class Approximation(NamedTuple):
    """Normal approximations of a batch of pixels, and their weighted draws."""

    search: ModeSearch
    parameters: Values
    weights: np.ndarray
    pareto_k: np.ndarray
    rival: np.ndarray  # log evidence of the heaviest other mode

    @property
    def is_trusted(self) -> np.ndarray:
        """True if the weights correct the errors of the approximation, (pixel,)."""
        enough = weighted_ess(self.weights) >= NORMAL_SHARE * self.weights.shape[1]
        return self.search.converged & (self.pareto_k <= MAX_PARETO_K) & enough

    @property
    def has_rival(self) -> np.ndarray:
        """True if another mode has too much weight to be left out, (pixel,)."""
        return self.rival - self.search.mode.log_evidence > math.log(LEAST_RIVAL)


class _Run:
    """One run of `CorrectedLaplace` for some pixels of a batch."""

    def __init__(self, settings: CorrectedLaplace, batch: ProblemBatch) -> None:
        self.settings, self.batch, self.at = settings, batch, batch.at
        size, draws = batch.engine.program.size, settings.draws
        self.points = normal_points(draws, size, batch.seed)
        self.student_t = student_t_points(STUDENT_T_FACTOR * draws, size, batch.seed)
        self.rotations = random_rotations(batch.keys, size)

    def approximate(self, known: np.ndarray | None = None) -> Approximation:
        """Fit from the best candidate; untrusted pixels restart and keep the lower mode.

        With known starts, (pixel, size), each pixel is fitted from its own alone.
        """
        starts = self.settings.starts or self.settings.most_starts
        if known is None:
            ranked = find_starts(self.batch, self.settings.candidates)
            self._begin_draws()
        else:
            ranked = known[:, None]
        search = find_modes_from(self.batch, ranked[:, 0])
        found = jax.tree.map(np.array, self._weigh(np.arange(self.at.size), search))
        for start, rank in enumerate(RESTARTS if known is None else (), 2):
            everywhere = start <= starts
            untrusted = np.flatnonzero(everywhere | ~found.is_trusted)
            if not untrusted.size:
                break
            old, begin = take_rows(found.search, untrusted), ranked[untrusted, rank]
            new = find_modes_from(self.batch.subset(untrusted), begin, old)
            is_lower = new.mode.value < old.mode.value - SAME_POTENTIAL
            is_better = new.converged & (~old.converged | is_lower)
            is_other = old.mode.distance(new.mode.z) > LEAST_DISTANCE  # False where one is NaN
            left_out = np.where(is_better, old.mode.log_evidence, new.mode.log_evidence)
            both = new.converged & old.converged & is_other
            rival = np.fmax(found.rival[untrusted], np.where(both, left_out, -np.inf))
            if is_better.any():
                which = untrusted[is_better]
                put_rows(found, which, self._weigh(which, take_rows(new, is_better)))
            found.rival[untrusted] = rival
        return found

    def _weigh(self, which: np.ndarray, search: ModeSearch) -> Approximation:
        """Draw from the normal approximations, and weight the draws."""
        proposal = _proposal_at(search.mode).rotated(self.rotations[which])
        parameters, ratios = self._draw(which, proposal, self.points)
        return Approximation(search, parameters, *smooth(ratios), np.full(which.size, -np.inf))

    def _draw(
        self, which: np.ndarray, proposal: Proposal, points: Points
    ) -> tuple[Values, np.ndarray]:
        """Draw from the proposal of every pixel; return draws and log importance ratios."""
        states, given = (tuple(np.float32(x) for x in each) for each in (proposal, points))
        return self.batch.subset(which).run(_draws, None, *states, given=given, single=True)

    def _begin_draws(self) -> None:
        """Begin to compile the draws while modes are searched."""
        size = self.points.z.shape[1]
        shapes = (1, size), (1, size, size), self.points.z.shape, self.points.log_density.shape
        *states, z, log_density = (np.zeros(shape, np.float32) for shape in shapes)
        given = z, log_density
        self.batch.begin(_draws, None, *states, given=given, single=True)

    def answers(self, found: Approximation) -> Iterator[BatchDraws]:
        """Yield normal approximations, corrected by their weights where these are reliable."""
        converged = found.search.converged
        lost = take_rows(found.search, ~converged)
        no_root = np.full_like(lost.mode.root, np.nan)
        yield BatchDraws(
            self.at[~converged],
            Status.NOT_CONVERGED,
            steps=lost.steps,
            mode=(lost.mode.z, no_root),
        )
        found, trusted = take_rows(found, converged), found.is_trusted[converged]
        mode = found.search.mode
        proposal = _proposal_at(mode).rotated(self.rotations[converged])
        yield BatchDraws(
            self.at[converged],
            np.where(trusted, Status.GOOD, Status.NOT_TRUSTED),
            found.parameters,
            # Weights that cannot be trusted do not correct anything.
            np.where(trusted[:, None], found.weights, 1.0 / self.settings.draws),
            np.where(trusted, weighted_ess(found.weights), np.nan),
            np.where(trusted, MethodUsed.IMPORTANCE, MethodUsed.LAPLACE),
            found.pareto_k,
            mode.condition,
            found.search.steps,
            (mode.z, mode.root),
            functools.partial(proposal.draws, self.points),
        )

    def adapt(
        self, which: np.ndarray, normal: Approximation
    ) -> Generator[BatchDraws, None, np.ndarray]:
        """Fit proposals to their weighted draws; return pixels that have no answer then."""
        left, points, weights = np.arange(which.size), self.points, normal.weights
        proposal = _proposal_at(normal.search.mode).rotated(self.rotations[which])
        for _ in range(self.settings.rounds):
            if not left.size:
                break
            some = which[left]
            proposal = fit_t(proposal.draws(points), weights).rotated(self.rotations[some])
            points = self.student_t
            parts = [  # each as large as `self.points`: one program
                self._draw(some, proposal, part) for part in points.split(STUDENT_T_FACTOR)
            ]
            parameters, ratios = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *parts)
            weights, pareto_k = smooth(ratios)
            effective = weighted_ess(weights)
            least = STUDENT_T_SHARE * weights.shape[1]
            enough = (pareto_k <= MAX_PARETO_K) & (effective >= least)
            if self.settings.sampler is not None and enough.any():
                enough[enough] = ~self._has_arm(some[enough], take_rows(proposal, enough))
            answers = take_rows((parameters, weights, effective), enough)
            at, mode = self.at[some[enough]], take_rows(normal.search.mode, left[enough])
            z = functools.partial(take_rows(proposal, enough).draws, points)
            yield BatchDraws(
                at, Status.GOOD, *answers, MethodUsed.ADAPTED, mode=(mode.z, mode.root), z=z
            )
            left, weights, proposal = take_rows((left, weights, proposal), ~enough)
        return left

    def _has_arm(self, which: np.ndarray, proposal: Proposal) -> np.ndarray:
        """Return whether the posterior extends along an axis beyond the proposal, (pixel,)."""
        size, draws = self.points.z.shape[1], self.settings.draws
        steps = np.linspace(0.0, LONGEST_ARM, draws // (2 * size))
        if steps.size < 2:
            return np.zeros(which.size, bool)  # too many axes for so few points
        along = np.einsum("ij,s->isj", np.eye(size), np.concatenate([-steps[::-1], steps]))
        z = np.zeros_like(self.points.z)
        z[: along.shape[0] * along.shape[1]] = along.reshape(-1, size)
        covariance = np.swapaxes(proposal.root, 1, 2) @ proposal.root
        sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        line = proposal._replace(root=covariance / sd[:, :, None])
        _, log_density = self._draw(which, line, Points(z, np.zeros(draws)))
        profiles = log_density[:, : along.shape[0] * along.shape[1]].reshape(-1, *along.shape[:2])
        profiles = np.where(np.isnan(profiles), -np.inf, profiles)
        profiles = np.exp(profiles - np.max(profiles, axis=(1, 2), keepdims=True))
        beyond = np.concatenate([steps[::-1], steps]) > ARM
        share = profiles[..., beyond].sum(axis=-1) / profiles.sum(axis=-1)
        return np.any(share > MOST_IN_ARM, axis=1)


def _proposal_at(mode: NormalApproximation) -> Proposal:
    """Return the normal approximation as a proposal."""
    return Proposal(np.asarray(mode.z), np.asarray(mode.root))


def _draws(engine: CompiledModel, _: None) -> JitOnce:
    """Make the program that draws from the proposal of one pixel."""
    program = engine.single_program

    def draws(
        points: Array, log_density: Array, data: Observations, center: Array, root: Array
    ) -> tuple[Values, Array]:
        z = center + points @ root
        parameters, values = jax.vmap(lambda z: program.parameters_and_potential(z, data))(z)
        return parameters, -values - log_density

    return batched(draws, given=2, lanes=LANES)
