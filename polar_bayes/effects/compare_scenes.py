r"""How far two scenes lie apart: their readings, and the posteriors that they give.

Each posterior is taken as a normal distribution, at its peak and as wide as the Fisher information
there says,

$$ \text{shift} = \frac{\hat z' - \hat z}{\sigma}, \qquad \text{sd ratio} = \frac{\sigma'}{\sigma},
   \qquad \sigma^2 = \operatorname{diag} F^{-1}, \quad
   F = -\frac{\partial^2 \log p(z \mid \text{readings})}{\partial z^2} $$

in the unconstrained coordinates z of the fit. F is the observed information of these very readings
under their own links, prior included. Both scenes are used as they are; linear is the slope of the
log density around its peak. So a shift above 1 only says that the effect matters.

Derivatives are differences of the log density. In units of the posterior's own width they keep
enough digits, and no derivative has to be compiled, which takes two to four times as long as the
density itself.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import log_density

from polar_bayes.diagnostics.parameters import scalars
from polar_bayes.inference.optimize import (
    ModeStatus,
    ValueAndGradient,
    find_mode,
    find_modes,
    from_prior,
)
from polar_bayes.inference.program import Program, compile_program, inspect_model, noise_free
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import posterior_of
from polar_bayes.observation.data import Observations, observe
from polar_bayes.physics.scene import Scene
from polar_bayes.priors import PriorTable
from polar_bayes.progress import Progress

# --- What a compiled program costs: its operations, its compilation, and its time -----------------


TIMED_ROUNDS = 40
"""How often each program is timed."""

CALLS = 3
"""How many calls make one timing."""


@dataclasses.dataclass(frozen=True)
class Compiled:
    """A compiled program and what it took to make it."""

    call: Callable[..., Any]
    operations: float
    compile_seconds: float


@dataclasses.dataclass(frozen=True)
class Cost:
    """What a program costs."""

    operations: float
    compile_seconds: float
    run_seconds: float


def compile_and_count(function: Callable[..., Any], *arguments: Any) -> Compiled:
    """Compile a function for arguments of these shapes."""
    begin = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - begin
    with_counter = program.cost_analysis() or {}
    operations = sum(with_counter.get(kind, math.nan) for kind in ("flops", "transcendentals"))
    return Compiled(program, float(operations), seconds)


def run_seconds(calls: Sequence[Callable[[], Any]]) -> list[float]:
    """Time of each call at its fastest, results awaited."""
    # The calls take turns, so that a machine that slows down slows them all alike; the fastest
    # round is the one that other programs disturbed least.
    rounds = [[_seconds(call) for call in calls] for _ in range(TIMED_ROUNDS)]
    return [float(fastest) for fastest in np.min(rounds, axis=0)]


def _seconds(call: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    for _ in range(CALLS):
        jax.block_until_ready(call())
    return (time.perf_counter() - begin) / CALLS


# --- The log posterior density of one scene: compiled once, and with a name for every coordinate


Readings = Mapping[str, np.ndarray]
"""One number for every reading, by variable."""


@dataclasses.dataclass(frozen=True, eq=False)
class Density:
    """The log posterior density of one scene, compiled."""

    scene: Scene
    program: Program
    data: Observations
    compiled: Compiled
    labels: tuple[str, ...]
    sites: tuple[str, ...]

    def potential(self, z: np.ndarray) -> float:
        """Minus the log density of an unconstrained vector (size,), up to a constant."""
        return float(self.evaluate(z)[0])

    def noise_free(self, z: np.ndarray) -> Readings:
        """What would be read without noise."""
        return {name: np.asarray(values) for name, values in self.evaluate(z)[1].items()}

    def evaluate(self, z: np.ndarray) -> tuple[Array, dict[str, Array]]:
        """Both, as the compiled program gives them."""
        return self.compiled.call(jnp.asarray(z), self.data)

    def noise_sd(self, z: np.ndarray) -> Readings:
        """Standard deviation of the noise of every reading."""
        # Where a distribution states no finite variance: half the width of the central 68% of a
        # thousand draws, which is the same for normal noise.
        found = self._of_noise(_stated_sd, self.program.observed, z)
        unknown = tuple(name for name, sd in found.items() if not np.isfinite(sd).all())
        return found | (self._of_noise(_drawn_sd, unknown, z) if unknown else {})

    def _of_noise(
        self,
        spread: Callable[[dist.Distribution], Array],
        names: tuple[str, ...],
        z: np.ndarray,
    ) -> dict[str, np.ndarray]:
        def of_noise(z: Array, data: Observations) -> dict[str, Array]:
            fixed = handlers.substitute(self.program.model, data=self.program.constrain(z))
            trace = handlers.trace(handlers.seed(fixed, jax.random.key(0))).get_trace(data)
            return {name: spread(trace[name]["fn"]) for name in names}

        found = jax.jit(of_noise)(jnp.asarray(z), self.data)
        return {name: np.asarray(values) for name, values in found.items()}


def compile_density(request: Request, data: Observations) -> Density:
    """Compile the log density of a request's scene."""
    program = compile_program(request.bind(request.scene), data)

    def evaluate(z: Array, data: Observations) -> tuple[Array, dict[str, Array]]:
        free = program.unravel(z)
        moves = {name: dist.biject_to(program.supports[name]) for name in free}
        latent = {name: move(free[name]) for name, move in moves.items()}
        log_joint, trace = log_density(program.model, (data,), {}, latent)
        volume = sum(
            jnp.sum(move.log_abs_det_jacobian(free[name], latent[name]))
            for name, move in moves.items()
        )
        return -(log_joint + volume), {name: noise_free(trace, name) for name in program.observed}

    compiled = compile_and_count(evaluate, jnp.zeros(program.size), data)
    labels, sites = coordinates(program, request.capture, data)
    return Density(request.scene, program, data, compiled, labels, sites)


def _stated_sd(distribution: dist.Distribution) -> Array:
    try:
        return jnp.sqrt(distribution.variance)
    except NotImplementedError:
        return jnp.asarray(jnp.inf)


def _drawn_sd(distribution: dist.Distribution) -> Array:
    draws = distribution.sample(jax.random.key(0), (1000,))
    low, high = jnp.quantile(draws, jnp.asarray([0.1587, 0.8413]), axis=0)
    return 0.5 * (high - low)


def coordinates(
    program: Program, capture: xr.Dataset, data: Observations
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Label and parameter of every coordinate, as the tables of a fit name them."""
    labels, sites = [""] * program.size, [""] * program.size
    for name, positions in program.unravel(jnp.arange(float(program.size))).items():
        flat = np.ravel(positions).astype(int)
        for number, index in enumerate(flat):
            labels[index], sites[index] = f"{name}[{number}]", name
        shape = tuple(n for d, n in data.dims if d in program.dims[name]) + program.events[name]
        if flat.size != np.prod(shape, initial=1):
            continue  # a simplex, say, has fewer free coordinates than numbers
        group = posterior_of(program, {name: np.reshape(flat, (1, 1, *shape))})
        known = {str(dim): capture[dim] for dim in group.dims if dim in capture.coords}
        for scalar in scalars(group.assign_coords(known)):
            labels[int(scalar.draws[0, 0])] = scalar.label
    return tuple(labels), tuple(sites)


# --- How far two scenes lie apart: their readings, and the posteriors that they give --------------


STARTS = 6
"""Prior draws from which the peak of the full scene is sought."""

FIRST_STEP, STEP = 1e-5, 1e-3
"""Steps of differences: before the width of the posterior is known, and in units of it."""

CLIMBS = 2
"""Climbs to one peak; the second knows the width that the first has found."""

NEW_WIDTH = 0.1
"""A first guess at the width of a parameter that only the simpler scene has."""


@dataclasses.dataclass(frozen=True, eq=False)
class Peak:
    """The normal distribution that stands for a posterior."""

    density: Density
    z: np.ndarray
    covariance: np.ndarray
    found: bool

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each coordinate, (size,)."""
        return np.sqrt(np.diagonal(self.covariance))


@dataclasses.dataclass(frozen=True, eq=False)
class Change:
    """What becomes of readings and posterior when one scene takes another's place."""

    largest_move: float
    rms_move: float
    shift: np.ndarray
    sd_ratio: np.ndarray
    found: bool

    @property
    def size(self) -> np.ndarray:
        """The larger of the shift and the change of the sd, per coordinate."""
        return np.fmax(np.abs(self.shift), np.abs(self.sd_ratio - 1.0))


def find_peak(density: Density, key: Array, progress: Progress) -> Peak:
    """The heaviest peak of a posterior about which nothing is known yet."""
    size = density.program.size
    starts = from_prior(density.program, key, STARTS, density.data)
    plain = _with_gradient(density, np.zeros(size), np.eye(size), FIRST_STEP)
    modes = find_modes(plain, starts, progress)
    return _climb(density, modes.z[0], modes.covariance[0])


def compare(peak: Peak, noise_sd: Readings, other: Density) -> tuple[Change, Peak]:
    """Put another scene in the place of one whose peak is known."""
    here = {label: index for index, label in enumerate(peak.density.labels)}
    theirs = [index for index, label in enumerate(other.labels) if label in here]
    mine = [here[other.labels[index]] for index in theirs]
    start = np.zeros(len(other.labels))
    start[theirs] = peak.z[mine]
    width = np.diag(np.full(start.size, NEW_WIDTH**2))
    width[np.ix_(theirs, theirs)] = peak.covariance[np.ix_(mine, mine)]
    moves = _moves(peak, noise_sd, other, start)
    found = _climb(other, start, width)
    shift, sd_ratio = np.full((2, peak.z.size), np.nan)
    if found.found:
        shift[mine] = (found.z[theirs] - peak.z[mine]) / peak.sd[mine]
        sd_ratio[mine] = found.sd[theirs] / peak.sd[mine]
    largest, rms = float(np.max(np.abs(moves))), float(np.sqrt(np.mean(moves**2)))
    return Change(largest, rms, shift, sd_ratio, found.found), found


def _moves(peak: Peak, noise_sd: Readings, other: Density, start: np.ndarray) -> np.ndarray:
    """Changes of all valid readings' predictions in units of their noise, in one row."""
    # A sensor far beyond its full scale has no noise, and what it records does not move.
    before, after = peak.density.noise_free(peak.z), other.noise_free(start)
    valid = np.asarray(peak.density.data.valid)
    rows = []
    for name, sd in noise_sd.items():
        move = np.where(sd > 0.0, after[name] - before[name], 0.0) / np.where(sd > 0.0, sd, 1.0)
        rows.append(np.broadcast_to(move, valid.shape)[valid])
    return np.concatenate(rows)


def _climb(density: Density, z: np.ndarray, covariance: np.ndarray) -> Peak:
    """Climb in coordinates in which the posterior is round and of width one, as far as known."""
    for _ in range(CLIMBS):
        width = np.linalg.cholesky(covariance)
        potential = _with_gradient(density, z, width, STEP)
        end = find_mode(potential, np.zeros(z.size))
        if not np.isfinite(end.covariance).all():
            return Peak(density, z, np.full_like(covariance, np.nan), found=False)
        # A climb ends within a hundredth of a width; one more step makes that nothing.
        z = z + width @ (end.z - end.covariance @ potential(end.z)[1])
        covariance = width @ end.covariance @ width.T
    return Peak(density, z, covariance, found=end.status is ModeStatus.OK)


def _with_gradient(
    density: Density, origin: np.ndarray, width: np.ndarray, step: float
) -> ValueAndGradient:
    """Potential and gradient in the coordinates y of z = origin + width y."""

    def value_and_gradient(y: np.ndarray) -> tuple[float, np.ndarray]:
        z = origin + width @ y
        slopes = [
            density.potential(z + step * axis) - density.potential(z - step * axis)
            for axis in width.T
        ]
        return density.potential(z), np.asarray(slopes) / (2.0 * step)

    return value_and_gradient


# --- The scales on which scenes are weighed: one capture, densities compiled once, one judge ------


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """A scene that others are compared with."""

    peak: Peak
    noise_sd: Readings
    names: tuple[str, ...] | None

    @property
    def judged(self) -> np.ndarray:
        """For each coordinate, whether it is judged."""
        density = self.peak.density
        if self.names is None:
            return np.ones(len(density.labels), bool)
        both = zip(density.labels, density.sites, strict=True)
        return np.asarray([bool({label, site} & set(self.names)) for label, site in both])

    def compare(self, other: Density) -> Change:
        """What changes when another scene takes the place of this one."""
        return compare(self.peak, self.noise_sd, other)[0]

    def beside(self, other: Density) -> "Reference":
        """A similar scene to compare with."""
        return dataclasses.replace(self, peak=compare(self.peak, self.noise_sd, other)[1])

    def size(self, change: Change) -> float:
        """The largest change of a judged parameter; infinite where it is not known."""
        # A parameter that the other scene lacks is not judged, unless the user named it.
        sizes = change.size[self.judged]
        lost = np.isnan(sizes)
        unknown = not change.found or lost.all() or (self.names is not None and lost.any())
        return np.inf if unknown else float(np.nanmax(sizes))

    def says(self, change: Change) -> str:
        """The largest change in words: `refractive_index[550] moves by +0.43 sd`."""
        if not change.found:
            return "its posterior has no peak near that of the full scene"
        sizes = np.where(self.judged, np.nan_to_num(change.size, nan=-1.0), -1.0)
        most = int(np.argmax(sizes))
        if sizes[most] < 0.0:
            return "it leaves nothing to judge"
        label = self.peak.density.labels[most]
        shift, widening = change.shift[most], change.sd_ratio[most] - 1.0
        if abs(shift) >= abs(widening):
            return f"{label} moves by {shift:+.2g} sd"
        return f"the sd of {label} changes by {widening:+.0%}"

    def lost(self, change: Change) -> tuple[str, ...]:
        """Parameters that the other scene does not have."""
        sites = np.asarray(self.peak.density.sites)
        left = set(sites[~np.isnan(change.size)])
        return tuple(name for name in dict.fromkeys(sites.tolist()) if name not in left)


class Scales:
    """Densities of scenes for one capture."""

    def __init__(
        self, request: Request, priors: Mapping[str, dist.Distribution] | None, progress: Progress
    ) -> None:
        self.progress = progress
        self._request, self._priors = request, priors
        self._data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
        self._densities: dict[Scene, Density] = {}

    def density(self, scene: Scene) -> Density:
        """The density of a scene; a prior for a parameter that it lacks is not used."""
        if scene not in self._densities:
            table = self.priors(scene)
            priors = {name: table.row(name) for name in table.read}
            request = dataclasses.replace(self._request, scene=scene, priors=priors)
            self._densities[scene] = compile_density(request, self._data)
        return self._densities[scene]

    def priors(self, scene: Scene) -> PriorTable:
        """The priors, with a note of which ones the model reads with that scene."""
        table = PriorTable(self._priors)
        inspect_model(self._request.model, self._data, scene, table, self._request.links)
        return table

    def reference(self, scene: Scene, parameters: tuple[str, ...] | None) -> Reference:
        """A scene to compare with."""
        density = self.density(scene)
        peak = find_peak(density, jax.random.key(self._request.seed), self.progress)
        return Reference(peak, density.noise_sd(peak.z), parameters)

    def costs(self) -> dict[Scene, Cost]:
        """What each scene costs, all timed in turns."""
        calls = [
            functools.partial(density.evaluate, np.zeros(density.program.size))
            for density in self._densities.values()
        ]
        timed = zip(self._densities.items(), run_seconds(calls), strict=True)
        return {
            scene: Cost(density.compiled.operations, density.compiled.compile_seconds, seconds)
            for (scene, density), seconds in timed
        }
