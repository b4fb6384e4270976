"""Where the map of a capture with many patches is anchored: each patch climbed on its own first.

One climb of thousands of coordinates from a prior draw ends in some bad mode of some patch. So
each patch is climbed alone, from many starts, first with noise and instrument of its own, then
with those of all. Last, all patches are climbed together in the coordinates of the map
(`transport`), in which a population without spread is no cliff, and the peak is that of the
population with its members integrated out.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array

from polar_bayes.inference.alone import Alone, Lone, Starts
from polar_bayes.inference.groups import Groups
from polar_bayes.inference.modes import Modes, ValueAndGradient
from polar_bayes.inference.search import from_prior
from polar_bayes.inference.transport import Anchored, Anchors, Transport
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

TYPICAL_DRAWS = 200
FEWEST_STARTS, MOST_STARTS, ALL_STARTS = 4, 16, 256
MOST_ROUNDS = 4

WIDEST = 3.0
"""Largest standard deviation of a common coordinate that is taken from its curvature."""


class Peaks(NamedTuple):
    """What is known of the patches, one by one."""

    common: np.ndarray
    movable: np.ndarray
    of_patch: list[Modes]
    starts: int
    failures: int


@dataclasses.dataclass(frozen=True, eq=False)
class Anchoring:
    """The map with its anchors, compiled."""

    transport: Transport
    given: Anchored
    potential: ValueAndGradient
    peaks: Peaks
    decrement: float

    def draw_starts(self, key: Array, chains: int) -> np.ndarray:
        """Starting points in the map's coordinates: each patch at one of its peaks, by weight."""
        random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        groups, dtype = self.transport.groups, self.given.anchors.common.dtype
        starts = []
        for _ in range(chains):
            w = random.normal(size=self.transport.size)
            z = np.array(self.transport.there(jnp.asarray(w, dtype), self.given))
            for place, modes in zip(groups.local, self.peaks.of_patch, strict=True):
                which = random.choice(len(modes.weight), p=modes.weight)
                if which:
                    z[place] = modes.z[which]
            start = np.asarray(self.transport.back(jnp.asarray(z, dtype), self.given), float)
            usable = np.isfinite(start).all() and np.isfinite(self.potential(start)[0])
            starts.append(start if usable else np.zeros_like(start))
        return np.stack(starts)


def anchor(
    lone: Lone, transport: Transport, data: Observations, key: Array, tell: Progress
) -> Anchoring:
    """Find the anchors."""
    alone, groups, size = Alone(lone, data), transport.groups, transport.size
    surveyor = _Surveyor(alone, transport, data)
    peaks = _find_peaks(alone, transport, surveyor, data, key, tell)
    dtype = data.brightness.dtype

    def potential_at(given: Anchored) -> ValueAndGradient:
        def potential(w: np.ndarray) -> tuple[float, np.ndarray]:
            value, gradient = transport.value_and_gradient(jnp.asarray(w, dtype), given)
            return float(value), np.asarray(gradient, float)

        return potential

    common, local = peaks.common, np.stack([modes.z[0] for modes in peaks.of_patch])
    factor = np.eye(common.size)
    for number in range(MOST_ROUNDS):
        given = surveyor.anchors(common, local, factor, peaks)
        potential = potential_at(given)
        w = _descend(potential, size)
        z = np.asarray(transport.there(jnp.asarray(w, dtype), given), float)
        common, local = z[groups.common], z[groups.local]
        factor = _spread_of_common(potential, w, factor, dtype)
        tell("joining the patches", (number + 1) / MOST_ROUNDS)
        if number and np.linalg.norm(w) < 0.1 * np.sqrt(w.size):
            break
    given = surveyor.anchors(common, local, factor, peaks)
    potential = potential_at(given)
    decrement = float(np.linalg.norm(potential(np.zeros(size))[1]))
    return Anchoring(transport, given, potential, peaks, decrement)


class _Surveyor:
    """Measures what the anchors are made of."""

    def __init__(self, alone: Alone, transport: Transport, data: Observations) -> None:
        self._alone, self._data = alone, data
        self._of_population = transport.of_population
        self._dtype = data.brightness.dtype

    def population(self, common: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Slope and curvature of minus the log prior of the patches, each (group, local)."""
        g, z = (jnp.asarray(x, self._dtype) for x in (common, local))
        slope, curvature = self._of_population(g, z, self._data)
        return np.asarray(slope, float), np.asarray(curvature, float)

    def anchors(
        self, common: np.ndarray, local: np.ndarray, factor: np.ndarray, peaks: Peaks
    ) -> Anchored:
        """Slope, curvature and coupling of the readings alone, around a point."""
        prior_slope, prior_curvature = self.population(common, local)
        slopes, curvatures, couplings = [], [], []
        for patch, modes in enumerate(peaks.of_patch):
            spread = np.sqrt(np.diagonal(modes.covariance[0]))
            slope, hessian, mixed = self._alone.expand(patch, local[patch], common, spread)
            values, vectors = np.linalg.eigh(hessian - np.diag(prior_curvature[patch]))
            slopes.append(slope - prior_slope[patch])
            curvatures.append((vectors * np.maximum(values, 0.0)) @ vectors.T)
            # What couples a patch to its population is in the population already.
            couplings.append(mixed * peaks.movable)
        parts = (common, factor, local, *map(np.stack, (slopes, curvatures, couplings)))
        return Anchored(Anchors(*(jnp.asarray(x, self._dtype) for x in parts)), self._data)


def _find_peaks(
    alone: Alone,
    transport: Transport,
    surveyor: _Surveyor,
    data: Observations,
    key: Array,
    tell: Progress,
) -> Peaks:
    """Climb each patch with noise and instrument of its own, then with those of all."""
    groups = transport.groups
    drawn = from_prior(transport.program, key, TYPICAL_DRAWS, data)
    number = int(np.clip(ALL_STARTS // groups.count, FEWEST_STARTS, MOST_STARTS))
    common = np.median(drawn[:, groups.common], axis=0).astype(drawn.dtype)
    movable = ~_of_population(surveyor, drawn[0], groups)
    size = groups.local.shape[1]

    def from_draws(patch: int) -> Starts:
        return drawn[:number, groups.local[patch]], drawn[:number, groups.common]

    own = alone.peaks(
        from_draws, common, movable, lambda done: tell("searching for modes", 0.8 * done)
    )
    common[movable] = _weighted_medians(
        np.stack([modes.z[0, size:] for modes in own]),
        np.stack([np.diagonal(modes.covariance[0])[size:] for modes in own]),
    )

    def from_peaks(patch: int) -> Starts:
        fresh = drawn[number : number + FEWEST_STARTS, groups.local[patch]]
        local = np.concatenate([own[patch].z[:, :size].astype(fresh.dtype), fresh])
        return local, np.tile(common, (len(local), 1))

    still = np.zeros(common.size, bool)
    shared = alone.peaks(
        from_peaks, common, still, lambda done: tell("searching for modes", 0.8 + 0.2 * done)
    )
    return Peaks(common, movable, shared, number, sum(modes.failures for modes in own))


def _of_population(surveyor: _Surveyor, z: np.ndarray, groups: Groups) -> np.ndarray:
    """True for common coordinates that the prior of a patch depends on: its hyperparameters."""
    common, local = z[groups.common], z[groups.local]

    def told(common: np.ndarray) -> np.ndarray:
        return np.concatenate([part.ravel() for part in surveyor.population(common, local)])

    before = told(common)
    steps = 0.5 * np.eye(common.size)
    return np.array([bool(np.any(told(common + step) != before)) for step in steps], bool)


def _weighted_medians(values: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """For each column the value that half of the information lies below; outliers do not pull."""
    middles = []
    for column, variance in zip(values.T, variances.T, strict=True):
        order = np.argsort(column)
        share = np.cumsum(1.0 / variance[order])
        middles.append(column[order][np.searchsorted(share, 0.5 * share[-1])])
    return np.array(middles)


def _descend(potential: ValueAndGradient, size: int) -> np.ndarray:
    def guarded(w: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = potential(w)
        finite = np.isfinite(value) and np.isfinite(gradient).all()
        return (value, gradient) if finite else (1e10, np.zeros_like(gradient))

    options = {"maxiter": 300, "maxcor": 20, "gtol": 1e-4}
    start = np.zeros(size)
    return scipy.optimize.minimize(guarded, start, jac=True, method="L-BFGS-B", options=options).x


def _spread_of_common(
    potential: ValueAndGradient, w: np.ndarray, factor: np.ndarray, dtype: np.dtype
) -> np.ndarray:
    """Cholesky factor of the covariance of the common coordinates, from their curvature."""
    size = len(factor)
    if not size:
        return factor
    step = np.finfo(dtype).eps ** 0.25
    rows = []
    for index in range(size):
        shift = np.zeros_like(w)
        shift[index] = step
        rows.append((potential(w + shift)[1] - potential(w - shift)[1])[:size] / (2.0 * step))
    curvature = np.nan_to_num(np.stack(rows))
    back = np.linalg.inv(factor)  # to the coordinates themselves
    values, vectors = np.linalg.eigh(back.T @ (0.5 * (curvature + curvature.T)) @ back)
    return np.linalg.cholesky((vectors / np.maximum(values, WIDEST**-2)) @ vectors.T)
