"""Model criticism in every pixel: priors, noise, residuals and bounds.

These are the checks of a fit that need no more than the draws of a pixel, by whatever method, and
its readings as predicted at its mode, where the method found one. A pixel with a problem is
contradicted by its readings.
"""

import dataclasses
import enum
import math
from collections.abc import Iterator, Mapping

import jax
import numpy as np
from numpy.typing import ArrayLike
from numpyro import distributions as dist

from polar_bayes.inference.batching import Status
from polar_bayes.inference.checks import (
    CARRIES,
    CAUTION,
    MASS_AT_BOUND,
    NEAR_BOUND,
    NOISE_FACTOR,
    PROBLEM,
    excluding_bounds,
    prior_conflict,
    share_at,
    tail_scores,
)
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.prior_probability import has_probabilities, probability_below
from polar_bayes.inference.problem_batch import BatchDraws, ProblemBatch
from polar_bayes.inference.program import Values
from polar_bayes.maps.residuals import direction_kernels, fitted_readings, residual_tail
from polar_bayes.numerics.psis import LEVELS, Marginals
from polar_bayes.observation.links import PERFECT
from polar_bayes.physics.part import absence
from polar_bayes.physics.scene import MATERIAL_PARAMETERS
from polar_bayes.priors import RANGES, support_bounds

LOWEST, MEDIAN, HIGHEST = (LEVELS.index(level) for level in (0.025, 0.5, 0.975))

PIXELS = 4096
"""Number of pixels whose residuals are in memory together."""


class Criticism(enum.IntEnum):
    """Bit flags of the findings in a pixel."""

    PRIORS_CAUTION = 1
    NOISE_CAUTION = 2
    RESIDUALS_CAUTION = 4
    BOUNDS_CAUTION = 8
    PRIORS_PROBLEM = 16
    NOISE_PROBLEM = 32
    RESIDUALS_PROBLEM = 64
    RESIDUALS_NOT_COMPUTED = -128


PROBLEMS = Criticism.PRIORS_PROBLEM | Criticism.NOISE_PROBLEM | Criticism.RESIDUALS_PROBLEM


@dataclasses.dataclass(frozen=True)
class Scalar:
    """One number of a pixel: a parameter, and an index if the parameter has axes."""

    name: str
    index: tuple[int, ...]

    def of(self, values: Mapping[str, ArrayLike]) -> np.ndarray:
        """Return its values, (..., pixel) or (pixel, draw), from those of all parameters."""
        found = np.asarray(values[self.name])
        return found[(slice(None),) * (found.ndim - len(self.index)) + self.index]


Bound = tuple[Scalar, float]
"""An end of the support of a scalar at which little of the prior is."""


class Criteria:
    """What is checked in each pixel of one model, by names and sizes of what has a map."""

    def __init__(
        self, engine: CompiledModel, sizes: tuple[tuple[str, tuple[int, ...]], ...]
    ) -> None:
        self.priors = priors = engine.priors
        every = [scalar for name, own in sizes for scalar in _scalars(name, own)]
        known = {n for n, x in priors.items() if not x.batch_shape and has_probabilities(x)}
        stated = [each for each in every if each.name in known]
        # Scalars with a prior probability, those of the noise apart; and where each is absent or
        # perfect, as `tail_scores` has it.
        self.judged = tuple(each for each in stated if each.name not in PERFECT)
        self.noise = tuple(each for each in stated if each.name in PERFECT)
        self.ends, self.noise_ends = (
            np.array([_end(each.name, priors[each.name]) for each in some])
            for some in (self.judged, self.noise)
        )
        # Numbers of the material, which others of `judged` may carry.
        self.material = tuple(each for each in every if each.name in MATERIAL_PARAMETERS)
        self.bounds = tuple(_bounds(engine, priors, every))
        self.kernels = direction_kernels(engine.layout.geometry)


def _scalars(name: str, own: tuple[int, ...]) -> list[Scalar]:
    return [Scalar(name, index) for index in np.ndindex(*own)]


def _end(name: str, prior: dist.Distribution) -> float:
    """Return -1 or 1 if a parameter's low or high end means absence or perfection, else 0."""
    low, high = support_bounds(prior)
    absent = absence(name)
    best = PERFECT.get(name, math.nan if absent is None else absent.value)
    return -1.0 if best <= low else 1.0 if best >= high else 0.0


def _bounds(
    engine: CompiledModel, priors: Mapping[str, dist.Distribution], scalars: list[Scalar]
) -> Iterator[Bound]:
    """Yield bounds with little prior probability at which the parameter is not absent."""
    for scalar in scalars:
        name = scalar.name
        ends = support_bounds(priors[name]) if name in priors else RANGES.get(name, ())
        for bound in excluding_bounds(name, ends):
            if share_at(bound, scalar.of(engine.prior_parameters)) < MASS_AT_BOUND:
                yield scalar, bound


class PixelCriticism:
    """Checks of the pixels of a block, made as answers arrive: marginals first."""

    def __init__(self, batch: ProblemBatch, marginals: Marginals) -> None:
        self._batch, self._marginals, engine = batch, marginals, batch.engine
        sizes = tuple((name, x.shape[1:]) for name, x in marginals.mean.items())
        self._checks = checks = engine.made(Criteria, sizes)
        count, size = len(batch), engine.program.size
        self._mode = np.full((count, size), np.nan), np.full((count, size, size), np.nan)
        self._at_bound = np.zeros(count, bool)
        self._carries = np.ones((count, len(checks.judged)), bool)

    def describe(self, found: BatchDraws, parameters: Values) -> None:
        """Take in the weighted draws of some pixels, and their modes where known."""
        at, weights = found.at, found.weights
        if found.mode is not None:
            new = np.isnan(self._mode[1][at]).any(axis=(1, 2))
            for own, mode in zip(self._mode, found.mode, strict=True):
                own[at[new]] = mode[new]
        if not parameters:
            return
        self._at_bound[at] = False
        for bound in self._checks.bounds:
            self._find_bound(bound, at, parameters, weights)
        self._find_carriers(at, parameters, weights)

    def _find_bound(
        self, bound: Bound, at: np.ndarray, parameters: Values, weights: np.ndarray
    ) -> None:
        """Which pixels lie against a bound."""
        scalar, value = bound
        quantiles = scalar.of(self._marginals.quantiles)[:, at]
        width = quantiles[HIGHEST] - quantiles[LOWEST]
        gap = np.min(np.abs(quantiles[[LOWEST, HIGHEST]] - value), axis=0)
        # Of the others, no more than 2.5% can be there.
        near = np.flatnonzero(gap < 2.0 * NEAR_BOUND * width)
        if near.size:
            draws = scalar.of(parameters)[near]
            share = share_at(value, draws, weights[near], width[near])
            self._at_bound[at[near]] |= share >= MASS_AT_BOUND

    def _find_carriers(self, at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        """Find instrument scalars that are correlated with a material parameter."""
        material, marginals = self._checks.material, self._marginals
        for column, scalar in enumerate(self._checks.judged):
            if not material or scalar in material:
                continue
            centered = scalar.of(parameters) - scalar.of(marginals.mean)[at, None]
            centered = weights * centered / scalar.of(marginals.sd)[at, None]
            found = np.zeros(at.size, bool)
            for other in material:
                scores = other.of(parameters) - other.of(marginals.mean)[at, None]
                with np.errstate(invalid="ignore"):  # a parameter may not move at all
                    correlation = np.sum(centered * scores, axis=1) / other.of(marginals.sd)[at]
                found |= np.abs(correlation) >= CARRIES
            self._carries[at, column] = found

    def judge(self, status: np.ndarray) -> np.ndarray:
        """Return the `Criticism` of each pixel with a good posterior, and zero for the others."""
        good = np.flatnonzero(status == Status.GOOD)
        flags = np.zeros(status.size, np.int8)
        if good.size:
            found = self._of_priors(good) | self._of_noise(good)
            found |= np.where(self._at_bound[good], Criticism.BOUNDS_CAUTION, 0).astype(np.int8)
            tails = self._residual_tails(good)
            found |= np.where(np.isnan(tails), Criticism.RESIDUALS_NOT_COMPUTED, 0).astype(np.int8)
            flags[good] = found | _flags(tails, "RESIDUALS")
        return flags

    def _of_priors(self, good: np.ndarray) -> np.ndarray:
        """Return flags of pixels whose medians lie in the tails of their priors."""
        scalars, ends = self._checks.judged, self._checks.ends
        if not scalars:
            return np.zeros(good.size, np.int8)
        # What carries nothing of the material is where the prior has it: it has no tail.
        none = np.where(ends == 0.0, 0.5, ends > 0.0)
        below = np.where(self._carries[good], self._below(scalars, good), none)
        return _flags(prior_conflict(below, ends), "PRIORS")

    def _of_noise(self, good: np.ndarray) -> np.ndarray:
        """Return flags of pixels with noise above its prior."""
        scalars = self._checks.noise
        if not scalars:
            return np.zeros(good.size, np.int8)
        tails, _ = tail_scores(self._below(scalars, good), self._checks.noise_ends)
        return _flags(tails.shape[1] * tails.min(axis=1), "NOISE")

    def _below(self, scalars: tuple[Scalar, ...], good: np.ndarray) -> np.ndarray:
        """Return prior probabilities below the medians, (pixel, scalar)."""
        priors, quantiles = self._checks.priors, self._marginals.quantiles
        medians = ((s.name, s.of(quantiles)[MEDIAN, good]) for s in scalars)
        return np.stack([probability_below(priors[name], x) for name, x in medians], axis=1)

    def _residual_tails(self, good: np.ndarray) -> np.ndarray:
        """Return p-values of residuals of pixels at their modes; NaN if not computed."""
        tails = np.full(good.size, np.nan)
        known = np.flatnonzero(np.isfinite(self._mode[1][good]).all(axis=(1, 2)))
        quantiles = self._marginals.quantiles.get(NOISE_FACTOR)
        factor = np.ones(good.size) if quantiles is None else quantiles[MEDIAN, good]
        for some in np.array_split(known, range(PIXELS, known.size, PIXELS)):
            fitted = self._fitted(good[some])
            if fitted is not None:
                tails[some] = residual_tail(*fitted, self._checks.kernels, factor[some])
        return tails

    def begin_compiling(self) -> None:
        """Compile what residuals need, in parallel with what follows."""
        names, mode = self._batch.engine.program.observed, [np.float32(x[:1]) for x in self._mode]
        self._batch.begin(fitted_readings, names, *mode, single=True)

    def _fitted(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Scores and changes of readings at their modes; None where no distribution is known."""
        if not at.size:
            return None
        batch, modes = self._batch.subset(at), [np.float32(x[at]) for x in self._mode]
        found = batch.run(fitted_readings, batch.engine.program.observed, *modes, single=True)
        data = jax.device_get(batch.pixels.batched)
        views, scores, changes = data.valid.shape[-1], [], []
        for name, (standard, jacobian) in found.items():
            if np.shape(jacobian)[:-1] == data.valid.shape:  # one number for each reading
                e = np.where(data.fitted(name), standard.scores(), np.nan)
                scores.append(e.reshape(at.size, -1, views))
                changes.append(jacobian.reshape(at.size, -1, views, jacobian.shape[-1]))
        if not scores:
            return None
        return np.concatenate(scores, axis=1), np.concatenate(changes, axis=1)


def _flags(p_value: np.ndarray, check: str) -> np.ndarray:
    """Return the flag of each p-value; zero for NaN."""
    caution, problem = Criticism[f"{check}_CAUTION"], Criticism[f"{check}_PROBLEM"]
    found = np.where(p_value < PROBLEM, problem, np.where(p_value < CAUTION, caution, 0))
    return found.astype(np.int8)
