"""Importance sampling of many pixels from mixtures at all their modes and along their profiles.

This is what the method `Importance` does for one capture, with the searches of all pixels and the
densities of all their draws in compiled programs.
"""

import dataclasses
import functools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.batch_engine import (
    MOMENTS,
    SMALL_BATCH,
    BatchEngine,
    evaluate_draws,
)
from polar_bayes.inference.batch_method import AbstractPixelMethod, BatchFit
from polar_bayes.inference.batch_one_by_one import PixelByPixel
from polar_bayes.inference.batching import MethodUsed, Status, batched, take_rows
from polar_bayes.inference.compile import JitOnce
from polar_bayes.inference.laplace import Importance, Rounds
from polar_bayes.inference.levenberg_marquardt import (
    NormalApproximation,
    find_all_modes,
    find_conditional_modes,
)
from polar_bayes.inference.optimize import finite_sd
from polar_bayes.inference.profile_mixture import (
    LEAST_WEIGHT,
    Conditional,
    Peaks,
    mixture_of,
    profile_components,
)
from polar_bayes.inference.program import THREADS, Values
from polar_bayes.inference.proposals import Mixture
from polar_bayes.inference.psis import MAX_PARETO_K
from polar_bayes.observation.data import Observations

GROUP = 64
"""Pixels at most whose draws are in memory in each thread."""


@dataclasses.dataclass(frozen=True)
class PixelImportance(AbstractPixelMethod):
    """Importance sampling in every pixel, from a mixture at all modes and along their profiles.

    Modes are searched from 16 starts. See `Importance` for mixtures and rounds. A pixel without a
    mode is fitted by that method.

    Args:
        draws: Of the mixture of each round, >= 256.
        rounds: At most, >= 1.

    Raises:
        FitError: A setting is outside its range.
    """

    draws: int = 2048
    rounds: int = 6

    def __post_init__(self) -> None:
        self._check_least(draws=256, rounds=1)

    @override
    def fit(
        self, batch: BatchFit, at: np.ndarray, modes: NormalApproximation | None = None
    ) -> None:
        groups = np.array_split(at, max(min(THREADS, at.size), -(-at.size // GROUP)))
        found: list[int] = []
        with ThreadPoolExecutor(THREADS) as pool:
            for pixels in pool.map(functools.partial(self._fit, batch), groups):
                for pixel in pixels:
                    pixel.record(batch)
                    found.append(pixel.at)
        lost = np.setdiff1d(at, found)
        if lost.size:
            PixelByPixel(Importance(self.draws, self.rounds)).fit(batch, lost)

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


def _densities(engine: BatchEngine, draws: int) -> JitOnce:
    """The program of parameters and log posterior densities of so many draws of one pixel."""
    del draws  # programs of other numbers are others
    program = engine.program

    def of_pixel(data: Observations, z: Array) -> tuple[Values, Array]:
        return evaluate_draws(program, z, data)

    return batched(of_pixel, lanes=1)
