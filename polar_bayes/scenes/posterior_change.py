r"""Change of the readings and of the posterior when another scene replaces the baseline.

$$ \text{shift} = \frac{\hat z' - \hat z}{\sigma}, \qquad \text{sd ratio} = \frac{\sigma'}{\sigma},
   \qquad \sigma^2 = \operatorname{diag} F^{-1}, \quad
   F = -\frac{\partial^2 \log p(z \mid \text{readings})}{\partial z^2} $$

at the mode of the Laplace approximation, in the unconstrained coordinates z of the fit. F is the
observed information of these readings under their own links, prior included. Only the posterior is
approximated, not the scenes, so a shift above 1 only says that the effect matters.

Derivatives are central differences of the log density. In units of the posterior's own width they
keep enough digits, and no derivative is compiled, which takes two to four times as long as the
density itself.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpyro import distributions as dist

from polar_bayes.diagnostics.parameters import label_coordinates
from polar_bayes.inference.problem import observe_request
from polar_bayes.inference.program import (
    Program,
    compile_program,
    from_prior,
    inspect_model,
    noise_free,
)
from polar_bayes.inference.request import Request
from polar_bayes.numerics.optimize import ModeStatus, ValueAndGradient, find_mode, find_modes
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import PriorTable
from polar_bayes.progress import Progress

# --- Cost of a compiled program -------------------------------------------------------------------


def compile_and_count(function: Callable, *arguments: object) -> tuple[Callable, float, float]:
    """A function compiled for arguments of these shapes, its operations, and the time it took."""
    begin = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - begin
    counts = program.cost_analysis() or {}
    operations = sum(counts.get(kind, math.nan) for kind in ("flops", "transcendentals"))
    return program, float(operations), seconds


def run_seconds(
    calls: Sequence[Callable[[], object]], *, rounds: int = 40, repeats: int = 3
) -> list[float]:
    """Return the shortest time of each call, including the wait for its result."""

    # The calls take turns, so that a machine that slows down slows them all alike; the fastest
    # round is the one that other programs disturbed least.
    def seconds(call: Callable[[], object]) -> float:
        begin = time.perf_counter()
        for _ in range(repeats):
            jax.block_until_ready(call())
        return (time.perf_counter() - begin) / repeats

    found = [[seconds(call) for call in calls] for _ in range(rounds)]
    return [float(fastest) for fastest in np.min(found, axis=0)]


# --- The log posterior density of one scene -------------------------------------------------------


Readings = Mapping[str, np.ndarray]
"""Numbers for every reading, by variable."""


@dataclasses.dataclass(frozen=True, eq=False)
class SceneDensity:
    """The compiled log posterior density of one scene, with labels of its coordinates."""

    program: Program
    data: Observations
    call: Callable
    operations: float
    compile_seconds: float
    labels: tuple[str, ...]
    sites: tuple[str, ...]

    def evaluate(self, z: np.ndarray) -> tuple[Array, dict[str, Array]]:
        """The potential and the noise-free readings at an unconstrained vector."""
        return self.call(np.asarray(z), self.data)

    def potential(self, z: np.ndarray) -> float:
        """Return minus the log density of an unconstrained vector (size,), up to a constant."""
        return float(self.evaluate(z)[0])

    def noise_free(self, z: np.ndarray) -> Readings:
        """Return predicted readings without noise."""
        return {name: np.asarray(values) for name, values in self.evaluate(z)[1].items()}

    def noise_sd(self, z: np.ndarray) -> Readings:
        """Return the standard deviation of the noise of every reading."""

        def apply(function: Callable[[dist.Distribution], Array], names: Sequence[str]) -> Readings:
            def of_noise(z: Array, data: Observations) -> dict[str, Array]:
                trace = self.program.trace(z, data)
                return {name: function(trace[name]["fn"]) for name in names}

            found = jax.jit(of_noise)(np.asarray(z), self.data)
            return {name: np.asarray(values) for name, values in found.items()}

        stated = apply(_stated_sd, self.program.observed)
        unknown = [name for name, sd in stated.items() if not np.isfinite(sd).all()]
        return {**stated, **apply(_quantile_sd, unknown)} if unknown else stated


def _stated_sd(distribution: dist.Distribution) -> Array:
    try:
        return jnp.sqrt(distribution.variance)
    except NotImplementedError:
        return jnp.asarray(jnp.inf)


def _quantile_sd(distribution: dist.Distribution) -> Array:
    """Return half the width of the central 68% of draws: the sd of normal noise."""
    draws = distribution.sample(jax.random.key(0), (1000,))
    low, high = jnp.quantile(draws, jnp.asarray([0.1587, 0.8413]), axis=0)
    return 0.5 * (high - low)


def compile_density(request: Request, data: Observations) -> SceneDensity:
    """Compile the log density of a request's scene."""
    # No gradient, no method and no second capture needs this program, so it is not among those that
    # fits of one layout share.
    program = compile_program(request.bind(), data)

    def evaluate(z: Array, data: Observations) -> tuple[Array, dict[str, Array]]:
        terms, trace = program.log_terms(z, data)
        predicted = {name: noise_free(trace, name) for name in program.observed}
        return -sum(terms.values(), jnp.zeros((), z.dtype)), predicted

    counted = compile_and_count(evaluate, np.zeros(program.size), data)
    coordinates = label_coordinates(program, request.capture)
    labels, sites = (tuple(getattr(c, name) for c in coordinates) for name in ("label", "site"))
    return SceneDensity(program, data, *counted, labels, sites)


# --- Laplace approximations of two scenes ---------------------------------------------------------


FIRST_STEP, STEP = 1e-5, 1e-3
"""Steps of differences before the posterior width is known, and in units of it."""


@dataclasses.dataclass(frozen=True, eq=False)
class LaplaceFit:
    """Laplace approximation of a posterior; `found` is False if the search did not converge."""

    density: SceneDensity
    z: np.ndarray
    covariance: np.ndarray
    found: bool

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each coordinate, (size,)."""
        return np.sqrt(np.diagonal(self.covariance))


def fit_laplace(density: SceneDensity, key: Array, progress: Progress) -> LaplaceFit:
    """Find the heaviest mode of a posterior from prior draws."""
    size = density.program.size
    starts = from_prior(density.program, key, 6, density.data)
    potential = _scaled_potential(density, np.zeros(size), np.eye(size), FIRST_STEP)
    modes = find_modes(potential, starts, progress)
    return _refine(density, modes.z[0], modes.covariance[0])


def _refine(density: SceneDensity, z: np.ndarray, covariance: np.ndarray) -> LaplaceFit:
    """Search the mode in coordinates in which the posterior is nearly standard normal."""
    for _ in range(2):  # the second search knows the width that the first has found
        factor = np.linalg.cholesky(covariance)
        potential = _scaled_potential(density, z, factor, STEP)
        end = find_mode(potential, np.zeros(z.size))
        if not np.isfinite(end.covariance).all():
            return LaplaceFit(density, z, np.full_like(covariance, np.nan), found=False)
        # The search ends within a hundredth of an sd; one more Newton step removes that.
        z = z + factor @ (end.z - end.covariance @ potential(end.z)[1])
        covariance = factor @ end.covariance @ factor.T
    return LaplaceFit(density, z, covariance, found=end.status is ModeStatus.OK)


def _scaled_potential(
    density: SceneDensity, origin: np.ndarray, factor: np.ndarray, step: float
) -> ValueAndGradient:
    """Return the potential and its differences in y, with z = origin + factor y."""

    def value_and_gradient(y: np.ndarray) -> tuple[float, np.ndarray]:
        z = origin + factor @ y
        differences = [
            density.potential(z + step * axis) - density.potential(z - step * axis)
            for axis in factor.T
        ]
        return density.potential(z), np.asarray(differences) / (2.0 * step)

    return value_and_gradient


# --- Scenes of one capture ------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class PosteriorChange:
    """Changes of readings and posterior by another scene, per coordinate."""

    fit: LaplaceFit
    largest_move: float
    rms_move: float
    shift: np.ndarray
    sd_ratio: np.ndarray

    @property
    def changes(self) -> np.ndarray:
        """Larger one of the shift and the change of the sd; NaN if unknown."""
        return np.fmax(np.abs(self.shift), np.abs(self.sd_ratio - 1.0))


@dataclasses.dataclass(frozen=True, eq=False)
class Baseline:
    """The scene with which others are compared; `names` are the judged parameters, None for all."""

    fit: LaplaceFit
    noise_sd: Readings
    names: tuple[str, ...] | None

    @property
    def judged(self) -> np.ndarray:
        """True for coordinates that are judged."""
        density = self.fit.density
        if self.names is None:
            return np.ones(len(density.labels), bool)
        return np.isin(density.labels, self.names) | np.isin(density.sites, self.names)

    def compare(self, other: SceneDensity) -> PosteriorChange:
        """Compare another scene, whose mode is searched near that of this one."""
        fit, sd = self.fit, self.fit.sd
        _, ours, theirs = np.intersect1d(fit.density.labels, other.labels, return_indices=True)
        start = np.zeros(len(other.labels))
        start[theirs] = fit.z[ours]
        # A first guess at the width of a parameter that only the simpler scene has.
        covariance = np.diag(np.full(start.size, 0.1**2))
        covariance[np.ix_(theirs, theirs)] = fit.covariance[np.ix_(ours, ours)]
        moves = self._moves(other, start)
        found = _refine(other, start, covariance)
        shift, sd_ratio = np.full((2, fit.z.size), np.nan)
        if found.found:
            shift[ours] = (found.z[theirs] - fit.z[ours]) / sd[ours]
            sd_ratio[ours] = found.sd[theirs] / sd[ours]
        largest, rms = float(np.max(np.abs(moves))), float(np.sqrt(np.mean(moves**2)))
        return PosteriorChange(found, largest, rms, shift, sd_ratio)

    def _moves(self, other: SceneDensity, start: np.ndarray) -> np.ndarray:
        """Return changes of predictions of fitted readings in units of their noise."""
        # A sensor far beyond its full scale has no noise, and what it records does not move.
        before, after = self.fit.density.noise_free(self.fit.z), other.noise_free(start)
        data, rows = jax.device_get(self.fit.density.data), []
        for name, sd in self.noise_sd.items():
            move = np.where(sd > 0.0, after[name] - before[name], 0.0) / np.where(sd > 0.0, sd, 1.0)
            is_fitted = data.fitted(name)
            rows.append(np.broadcast_to(move, is_fitted.shape)[is_fitted])
        return np.concatenate(rows)

    def largest_change(self, change: PosteriorChange) -> float:
        """Return the largest change of a judged parameter; infinite if unknown."""
        # A parameter that the other scene lacks is not judged, unless the user named it.
        changes = change.changes[self.judged]
        missing = np.isnan(changes)
        unknown = missing.all() or (self.names is not None and missing.any())
        return np.inf if unknown or not change.fit.found else float(np.nanmax(changes))

    def describe(self, change: PosteriorChange) -> str:
        """Describe the largest change: `refractive_index[550] moves by +0.43 sd`."""
        if not change.fit.found:
            return "its posterior has no mode near that of the full scene"
        changes = np.where(self.judged, np.nan_to_num(change.changes, nan=-1.0), -1.0)
        most = int(np.argmax(changes))
        if changes[most] < 0.0:
            return "no judged parameter is left without it"
        label = self.fit.density.labels[most]
        shift, widening = change.shift[most], change.sd_ratio[most] - 1.0
        if abs(shift) >= abs(widening):
            return f"{label} moves by {shift:+.2g} sd"
        return f"the sd of {label} changes by {widening:+.0%}"

    def missing(self, change: PosteriorChange) -> list[str]:
        """Return parameters that the other scene does not have."""
        sites = np.asarray(self.fit.density.sites)
        present = set(sites[~np.isnan(change.changes)])
        return [name for name in dict.fromkeys(sites.tolist()) if name not in present]


class SceneDensities:
    """Densities of scenes for one capture, each compiled once."""

    def __init__(
        self, request: Request, priors: Mapping[str, dist.Distribution], progress: Progress
    ) -> None:
        self.progress = progress
        self._request, self._priors = request, priors
        self._data = observe_request(request)
        self._densities: dict[Scene, SceneDensity] = {}

    def density(self, scene: Scene) -> SceneDensity:
        """Return the density of a scene, without priors for parameters it lacks."""
        if scene not in self._densities:
            table = PriorTable(self._priors)
            priors = {name: table.row(name) for name in self.names_read(scene)}
            request = dataclasses.replace(self._request, scene=scene, priors=priors)
            self._densities[scene] = compile_density(request, self._data)
        return self._densities[scene]

    def names_read(self, scene: Scene) -> tuple[str, ...]:
        """Names of the priors that the model reads with a scene."""
        request = dataclasses.replace(self._request, scene=scene, priors=self._priors)
        return inspect_model(request, self._data).priors

    def baseline(self, scene: Scene, parameters: tuple[str, ...] | None) -> Baseline:
        """Return a scene with its mode, to compare others with."""
        density = self.density(scene)
        fit = fit_laplace(density, jax.random.key(self._request.seed), self.progress)
        return Baseline(fit, density.noise_sd(fit.z), parameters)

    def costs(self) -> dict[Scene, dict[str, float]]:
        """Return operations, compile and run seconds of all scenes so far, timed in turns."""
        calls = [
            functools.partial(density.evaluate, np.zeros(density.program.size))
            for density in self._densities.values()
        ]
        timed = zip(self._densities.items(), run_seconds(calls), strict=True)
        return {
            scene: {
                "operations": density.operations,
                "compile_seconds": density.compile_seconds,
                "run_seconds": seconds,
            }
            for (scene, density), seconds in timed
        }
