r"""Where the map of a capture with many patches is anchored: each patch climbed on its own first.

One climb of thousands of coordinates from a prior draw ends in some bad mode of some patch. So
each patch is climbed alone, from many starts, first with noise and instrument of its own, then
with those of all. Last, all patches are climbed together in the coordinates of the map
(`transport`), in which a population without spread is no cliff, and the peak is that of the
population with its members integrated out.

Given the common parameters, a patch is described twice: by its own readings, about normal around
its own best fit, and by its population. Both together are again about normal, with a mean and a
width that follow from the common parameters in closed form. Each patch is measured from there:

$$ z_m = \hat z_m - P_m^{-1} b_m + L_m^{-T} w_m, \qquad P_m = A_m + D_m(g) = L_m L_m^T, \qquad
   b_m = s_m + C_m (g - \hat g) + d_m(g) $$

with A, s and C curvature, slope and coupling of the readings at the best fit, and d and D those of
the population given the common parameters g. A population without spread then leaves w alone (the
non-centered form), a wide one moves z to where the readings put it (the centered form), and each
patch takes its place between the two, at every value of g. The density is exact whatever A, s and
C are; they only decide how easy it is to sample.

Source:
    Papaspiliopoulos, Roberts and Skold 2007, "A general framework for the parametrization of
    hierarchical models" (the partially non-centered form); Gorinova, Moore and Hoffman 2020.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro import handlers

from polar_bayes.inference.compile import JitByShape, JitOnce
from polar_bayes.inference.group_model import GroupModel, GroupProgram, Groups, Starts
from polar_bayes.inference.optimize import Modes, ValueAndGradient, from_prior
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

# --- Coordinates in which many pooled patches look like independent standard normal variables -----


class Anchors(eqx.Module):
    """Where the map is anchored: numbers, so that moving them compiles nothing."""

    common: Float[Array, " common"]
    factor: Float[Array, "common common"]
    local: Float[Array, "group local"]
    slope: Float[Array, "group local"]
    curvature: Float[Array, "group local local"]
    coupling: Float[Array, "group local common"]


class Anchored(eqx.Module):
    """What the potential of a transported program is a function of, beside the coordinates."""

    anchors: Anchors
    data: Observations


@dataclasses.dataclass(frozen=True, eq=False)
class Transport:
    """The map for one program."""

    program: Program
    groups: Groups

    @property
    def size(self) -> int:
        """Length of the vector w: common coordinates first, then one group after the other."""
        return self.program.size

    def potential(self, w: Float[Array, " size"], given: Anchored) -> Float[Array, ""]:
        """Minus the log density of w, up to a constant."""
        z, log_volume = self.to_program(w, given)
        return self.program.potential(z, given.data) - log_volume

    def to_program(
        self, w: Float[Array, " size"], given: Anchored
    ) -> tuple[Float[Array, " size"], Float[Array, ""]]:
        """The program's coordinates, and the log volume of the map, up to a constant."""
        anchors = given.anchors
        split = self.groups.common.size
        common = anchors.common + anchors.factor @ w[:split]
        mean, lower = self._around(common, given)
        noise = w[split:].reshape(self.groups.local.shape)
        local = mean + _solve_transposed(lower, noise)
        log_volume = -jnp.sum(jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1)))
        return self._join(common, local), log_volume

    def from_program(self, z: Float[Array, " size"], given: Anchored) -> Float[Array, " size"]:
        """The coordinates w of a vector of the program."""
        common, local = z[self.groups.common], z[self.groups.local]
        mean, lower = self._around(common, given)
        noise = jnp.einsum("gji,gj->gi", lower, local - mean)
        first = jnp.linalg.solve(given.anchors.factor, common - given.anchors.common)
        return jnp.concatenate([first, noise.ravel()])

    def population(
        self,
        common: Float[Array, " common"],
        local: Float[Array, "group local"],
        data: Observations,
    ) -> tuple[Float[Array, "group local"], Float[Array, "group local"]]:
        """Slope and curvature of minus the log prior of the groups, given what is common."""
        # The priors of a group's coordinates are taken as independent given what is common, which
        # concerns the ease of sampling only.

        def slope(local: Array) -> Array:
            return jax.grad(lambda x: self._prior(self._join(common, x), data))(local)

        return jax.jvp(slope, (local,), (jnp.ones_like(local),))

    @functools.cached_property
    def potential_jit(self) -> Callable[[Array, Anchored], Array]:
        """The potential; the model is told once, however many programs compute it."""
        return jax.jit(self.potential, inline=True)

    @functools.cached_property
    def value_and_gradient(self) -> Callable[[Array, Anchored], tuple[Array, Array]]:
        """The potential with its gradient, compiled."""
        return JitOnce(jax.value_and_grad(self.potential_jit))

    @functools.cached_property
    def there(self) -> Callable[[Array, Anchored], Array]:
        """`to_program` without the volume, compiled."""
        return JitOnce(lambda w, given: self.to_program(w, given)[0])

    @functools.cached_property
    def back(self) -> Callable[[Array, Anchored], Array]:
        """`from_program`, compiled."""
        return JitOnce(self.from_program)

    @functools.cached_property
    def chains_there(self) -> Callable[[Array, Anchored], Array]:
        """The same as `there` for chains of draws, (chain, draw, size), one after the other."""

        def place(w: Array, given: Anchored) -> Array:
            return jax.lax.map(
                lambda chain: jax.lax.map(lambda x: self.to_program(x, given)[0], chain), w
            )

        return JitByShape(place)

    @functools.cached_property
    def of_population(self) -> Callable[[Array, Array, Observations], tuple[Array, Array]]:
        """`population`, compiled."""
        return JitOnce(self.population)

    def _prior(self, z: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Minus the log prior density of all groups' coordinates."""
        free, latent = self.program.unravel(z), self.program.constrain(z)
        fixed = handlers.substitute(self.program.model, data=latent)
        trace = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(data)
        total = jnp.zeros((), z.dtype)
        for name, value in latent.items():
            if self.groups.axis in self.program.dims[name]:
                move = dist.biject_to(self.program.supports[name])
                total = total - jnp.sum(trace[name]["fn"].log_prob(value))
                total = total - jnp.sum(move.log_abs_det_jacobian(free[name], value))
        return total

    def _around(
        self, common: Float[Array, " common"], given: Anchored
    ) -> tuple[Float[Array, "group local"], Float[Array, "group local local"]]:
        """Mean of every group and the Cholesky factor of its precision, given what is common."""
        anchors = given.anchors
        slope, curvature = self.population(common, anchors.local, given.data)
        precision = anchors.curvature + _diagonal(jnp.maximum(curvature, 0.0))
        pull = anchors.slope + anchors.coupling @ (common - anchors.common) + slope
        lower = jnp.linalg.cholesky(precision)
        step = jax.scipy.linalg.cho_solve((lower, True), pull[..., None])[..., 0]
        return anchors.local - step, lower

    def _join(self, common: Array, local: Array) -> Array:
        z = jnp.zeros(self.size, local.dtype)
        return z.at[self.groups.common].set(common).at[self.groups.local].set(local)


def _solve_transposed(lower: Array, right: Array) -> Array:
    """L^-T r for a stack of lower triangles."""
    solved = jax.scipy.linalg.solve_triangular(lower, right[..., None], trans=1, lower=True)
    return solved[..., 0]


def _diagonal(values: Float[Array, "group local"]) -> Float[Array, "group local local"]:
    return values[..., None] * jnp.eye(values.shape[-1], dtype=values.dtype)


# --- Where the map of a capture with many patches is anchored: each patch climbed on its own first


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
    group_model: GroupModel, transport: Transport, data: Observations, key: Array, tell: Progress
) -> Anchoring:
    """Find the anchors."""
    alone, groups, size = GroupProgram(group_model, data), transport.groups, transport.size
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

    def __init__(self, alone: GroupProgram, transport: Transport, data: Observations) -> None:
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
    alone: GroupProgram,
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
