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
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, override

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.special
from jaxtyping import Array, Float

from polar_bayes.errors import FitError
from polar_bayes.inference.batch_fit import BatchFit
from polar_bayes.inference.batching import MethodUsed, Status, batched, take_rows
from polar_bayes.inference.compile import JitOnce
from polar_bayes.inference.compiled_model import (
    MOMENTS,
    SMALL_BATCH,
    CompiledModel,
    evaluate_draws,
)
from polar_bayes.inference.levenberg_marquardt import (
    NormalApproximation,
    find_all_modes,
    find_conditional_modes,
)
from polar_bayes.inference.method import AbstractBatchMethod, AbstractMethod, PosteriorDraws
from polar_bayes.inference.optimize import finite_sd
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.profile_mixture import (
    LEAST_WEIGHT,
    MOST_COORDINATES,
    Conditional,
    Peaks,
    mixture_of,
    profile_components,
    profile_mixture,
)
from polar_bayes.inference.program import THREADS, Values
from polar_bayes.inference.proposals import Mixture, draw_mixture, fit_mixture, log_density
from polar_bayes.inference.psis import (
    FINITE_VARIANCE,
    MAX_PARETO_K,
    effective_draws,
    numpy_generator,
    smooth,
    systematic_resample,
)
from polar_bayes.inference.result import CENTRAL_95
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress, no_progress

SIDE_BY_SIDE = 1024
"""Draws whose proposal density is computed together: that of all at once would fill the memory."""


GROUP = 64
"""Captures at most whose draws are in memory in each thread."""


@dataclasses.dataclass(frozen=True)
class Importance(AbstractMethod):
    """Importance sampling from a mixture at all modes and along their profiles.

    Draws come from a mixture of Student t distributions with 8 degrees of freedom, at each mode
    that holds 0.1% of the Laplace evidence or more and along the profiles of every coordinate
    through it, each as heavy as the square root of its evidence. Weighting them by the posterior
    corrects what the normal approximation gets wrong, as far as the mixture reaches; Pareto k-hat
    says how far. In further rounds a mixture that is fitted to the weighted draws of all rounds
    before proposes as many draws again, until there are enough effective ones and their weights
    have a finite variance.

    Args:
        draws: Of the mixture of each round, at least 256.
        rounds: At most, at least 1.

    Raises:
        FitError: Fewer draws or rounds.
    """

    draws: int = 2048
    rounds: int = 6

    group_size: ClassVar[int] = AbstractBatchMethod.group_size

    def __post_init__(self) -> None:
        if self.draws < 256:
            raise FitError(f"draws is {self.draws}", where="Importance", hint="give at least 256")
        if self.rounds < 1:
            raise FitError(f"rounds is {self.rounds}", where="Importance", hint="give at least 1")

    @override
    def prepare(self, problem: Problem) -> None:
        problem.prepare_search()

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        initialization = problem.initialize(progress)
        key_draw, key_resample = jax.random.split(key)
        coordinates = initialization.joint_coordinates("Importance")
        sample = Rounds(self.draws, self.rounds)
        proposal = profile_mixture(coordinates)
        while True:
            sample.weigh(coordinates.log_density(sample.draw(proposal, key_draw)))
            if not sample.calls_for_more:
                break
            progress("weighting draws", len(sample.proposals) / self.rounds)
            key_draw, key_fit = jax.random.split(key_draw)
            proposal = sample.fit(key_fit)
        weights, k_hat = sample.weights, sample.k_hat
        if not np.isfinite(weights).all():
            raise FitError(
                "the posterior density is zero at every draw",
                where="Importance",
                hint="use method='nuts'",
            )
        effective = sample.effective
        z = coordinates.forward(sample.z)
        index = systematic_resample(weights, effective, numpy_generator(key_resample))
        problems = []
        if not k_hat <= MAX_PARETO_K:
            problems.append(
                f"Pareto k-hat of the weights is {k_hat:.2f} (at most {MAX_PARETO_K}): they do "
                "not reach all of the posterior, so use method='nuts'"
            )
        return PosteriorDraws(
            method="importance",
            z=z[index],
            stats={"lp": sample.log_posterior[index]},
            problems=problems,
            weighted=(z, weights),
            k_hat=float(k_hat),
            effective_draws=effective,
            gradients=float(initialization.metadata["gradients"]),
            densities=float(len(z)),
            metadata={"modes": initialization.metadata},
        )

    @override
    def fit(
        self, batch: BatchFit, at: np.ndarray, modes: NormalApproximation | None = None
    ) -> None:
        if not batch.engine.initializer.is_plain:
            super().fit(batch, at)
            return
        groups = np.array_split(at, max(min(THREADS, at.size), -(-at.size // GROUP)))
        found: list[int] = []
        with ThreadPoolExecutor(THREADS) as pool:
            for pixels in pool.map(functools.partial(self._fit, batch), groups):
                for pixel in pixels:
                    pixel.record(batch)
                    found.append(pixel.at)
        lost = np.setdiff1d(at, found)
        if lost.size:  # no mode was found side by side
            super().fit(batch, lost)

    def _fit(self, batch: BatchFit, at: np.ndarray) -> list["_Pixel"]:
        """Weighted draws of the pixels that have a mode."""
        engine, pixels = batch.engine, batch.pixels.subset(at)
        with jax.enable_x64(engine.precision == "double"):  # a thread does not inherit it
            found = {
                row: _Pixel(at[row], Rounds(self.draws, self.rounds), batch.keys[at[row]], mixture)
                for row, mixture in _profile_mixtures(batch, at)
            }
            left = list(found)
            while left:
                z = np.stack([found[row].draw() for row in left])
                some = pixels.subset(np.array(left))
                drawn = engine.run(_densities, self.draws, some, z, batch=SMALL_BATCH)
                for at_row, row in enumerate(left):
                    found[row].weigh(*jax.tree.map(lambda x, i=at_row: x[i], drawn))
                left = [row for row in left if found[row].rounds.calls_for_more]
        return list(found.values())


def tail_shares(problem: Problem, parameters: Values, key: Array) -> dict[str, Any]:
    """Shares of weighted draws beyond the 95% intervals of chains, an entry of the provenance.

    Chains that never entered an arm of the posterior agree with each other; draws along its
    profiles reach the arm. Empty where such draws do not suit the problem.
    """
    if problem.program.size > MOST_COORDINATES:
        return {}
    try:
        found = Importance(draws=2048, rounds=1).run(problem, key, no_progress)
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
    known = {"k_hat": found.k_hat, "effective_draws": found.effective_draws}
    return {"tails": {**known, "shares": shares}}


COMPONENTS = 8
"""Of the mixtures of further rounds."""

ENOUGH_SHARE = 0.2
"""Effective sample size, as a share of the draws of one round, after which no round follows."""

FITTED_PER_SIZE = 10
"""Effective draws for each coordinate to which a mixture is fitted: weights that leave fewer are
raised to a power below 1."""


class Rounds:
    """Draws of all rounds, weighted over the mean density of their proposals."""

    def __init__(self, draws: int, rounds: int) -> None:
        self._draws, self._rounds = draws, rounds
        self.proposals: list[Mixture] = []
        self._z: list[np.ndarray] = []
        self._log_posterior: list[np.ndarray] = []
        self._log_proposals = np.empty((0, 0))  # (proposal, draw)

    @property
    def z(self) -> Float[np.ndarray, "draw size"]:
        """Draws of all rounds."""
        return np.concatenate(self._z)

    @property
    def log_posterior(self) -> Float[np.ndarray, " draw"]:
        """Their log posterior densities."""
        return np.concatenate(self._log_posterior)

    def draw(self, proposal: Mixture, key: Array) -> np.ndarray:
        """Draws of one more proposal, (draw, size), to be weighed next."""
        z, log_proposal = map(np.asarray, _propose(proposal, self._draws, key))
        older = [np.asarray(_log_densities(each, z)) for each in self.proposals]
        newer = [np.asarray(_log_densities(proposal, block)) for block in self._z]
        above = np.concatenate([self._log_proposals, np.reshape(older, (-1, len(z)))], axis=1)
        below = np.concatenate([*newer, log_proposal])
        self._log_proposals = np.concatenate([above, below[None]])
        self.proposals.append(proposal)
        self._z.append(z)
        return z

    def weigh(self, log_posterior: np.ndarray) -> None:
        """Weigh the last draws by their log posterior densities, and all others anew."""
        self._log_posterior.append(log_posterior)
        mean = scipy.special.logsumexp(self._log_proposals, axis=0) - math.log(len(self.proposals))
        self.log_ratios = self.log_posterior - mean
        weights, k_hat = smooth(self.log_ratios[None])
        self.weights, self.k_hat = weights[0], float(k_hat[0])
        self.effective = float(effective_draws(weights)[0])

    @property
    def calls_for_more(self) -> bool:
        """Whether a further round is needed, and there are draws to which it can be fitted."""
        enough = self.effective >= ENOUGH_SHARE * self._draws and self.k_hat <= FINITE_VARIANCE
        is_last = len(self.proposals) == self._rounds
        return not (enough or is_last) and bool(np.isfinite(self.weights).all())

    def fit(self, key: Array) -> Mixture:
        """A mixture for the next round."""
        z = self.z
        weights = _temper(self.log_ratios, FITTED_PER_SIZE * z.shape[1])
        # One length compiles once: the draws of rounds to come have no weight.
        missing = self._rounds * self._draws - len(z)
        z = np.pad(z, ((0, missing), (0, 0)))
        padded = np.pad(weights, (0, missing)).astype(z.dtype)
        return _fit_mixture(jnp.asarray(z), jnp.asarray(padded), COMPONENTS, key)


_fit_mixture = functools.partial(jax.jit, static_argnums=2)(fit_mixture)


@jax.jit
def _log_densities(proposal: Mixture, z: Array) -> Array:
    return jax.lax.map(
        lambda z: log_density(proposal, z[None])[0], z, batch_size=min(SIDE_BY_SIDE, len(z))
    )


def _temper(log_ratios: np.ndarray, least: float) -> np.ndarray:
    """Weights, raised to the largest power up to 1 that leaves so large an effective sample."""
    relative = log_ratios - np.max(log_ratios)

    def weights(power: float) -> np.ndarray:
        raised = np.exp(power * np.where(np.isfinite(relative), relative, -1e300))
        return raised / raised.sum()

    def excess(power: float) -> float:
        return float(effective_draws(weights(power)[None])[0]) - least

    if excess(1.0) >= 0.0 or excess(1e-6) <= 0.0:
        return weights(1.0)
    return weights(scipy.optimize.brentq(excess, 1e-6, 1.0, xtol=1e-3))


@functools.partial(jax.jit, static_argnums=1)
def _propose(proposal: Mixture, count: int, key: Array) -> tuple[Array, Array]:
    z = draw_mixture(proposal, count, key)
    return z, _log_densities(proposal, z)


# --- Many captures side by side -------------------------------------------------------------------


class _Pixel:
    """Rounds of one pixel, and the parameters of their draws."""

    def __init__(self, at: int, rounds: Rounds, key: np.ndarray, proposal: Mixture) -> None:
        self.at, self.rounds = at, rounds
        self._key, self._proposal = jax.random.wrap_key_data(jnp.asarray(key)), proposal
        self._parameters: list[Values] = []

    def draw(self) -> np.ndarray:
        """Draws of the next proposal, (draw, size)."""
        self._key, key_draw = jax.random.split(self._key)
        return self.rounds.draw(self._proposal, key_draw)

    def weigh(self, parameters: Values, log_posterior: np.ndarray) -> None:
        """Weigh these draws, and fit a proposal to all where a further round is needed."""
        self.rounds.weigh(log_posterior)
        self._parameters.append(parameters)
        if self.rounds.calls_for_more:
            self._key, key_fit = jax.random.split(self._key)
            self._proposal = self.rounds.fit(key_fit)

    def record(self, batch: BatchFit) -> None:
        """The answer, where any draw has a density."""
        one, rounds = np.array([self.at]), self.rounds
        batch.record_pareto_k(one, np.array([rounds.k_hat]))
        if np.isfinite(rounds.weights).all():
            draws = jax.tree.map(lambda *rows: np.concatenate(rows)[None], *self._parameters)
            status = Status.GOOD if rounds.k_hat <= MAX_PARETO_K else Status.NOT_TRUSTED
            effective = np.array([rounds.effective])
            batch.record(one, draws, rounds.weights[None], effective, MethodUsed.IMPORTANCE, status)


def _profile_mixtures(batch: BatchFit, at: np.ndarray) -> Iterator[tuple[int, Mixture]]:
    """The first proposal of every pixel that has a mode, and the number of the pixel."""
    engine, pixels = batch.engine, batch.pixels.subset(at)
    owner, modes = find_all_modes(engine, pixels)
    if not owner.size:
        return
    evidence, largest = modes.log_evidence, np.full(len(pixels), -np.inf)
    np.maximum.at(largest, owner, evidence)
    is_first = evidence == largest[owner]
    batch.record_approximation(at[owner[is_first]], take_rows(modes, is_first))
    weight = np.exp(evidence - largest[owner])
    heavy = weight >= LEAST_WEIGHT * np.bincount(owner, weight)[owner]
    owner, modes = owner[heavy], take_rows(modes, heavy)
    z, value, root = map(np.asarray, modes[:3])

    def conditional(peak: np.ndarray, z: np.ndarray, axis: np.ndarray) -> Conditional:
        return find_conditional_modes(engine, pixels.subset(owner[peak]), z, axis)

    peaks = Peaks(z, value, np.swapaxes(root, 1, 2) @ root)
    prior_sd = finite_sd(engine.prior_draws(MOMENTS))
    components = profile_components(peaks, np.arange(engine.program.size), prior_sd, conditional)
    for pixel in np.unique(owner):
        own = take_rows(components, owner[components.peak] == pixel)
        yield int(pixel), mixture_of(own, engine.dtype)


def _densities(engine: CompiledModel, draws: int) -> JitOnce:
    """The program of parameters and log posterior densities of so many draws of one pixel."""
    del draws  # programs of other numbers are others
    program = engine.program

    def of_pixel(data: Observations, z: Array) -> tuple[Values, Array]:
        return evaluate_draws(program, z, data)

    return batched(of_pixel, lanes=1)
