"""The log posterior density of one scene: compiled once, and with a name for every coordinate."""

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import log_density

from polar_bayes.budget.cost import Compiled, compile_and_count
from polar_bayes.diagnostics.parameters import scalars
from polar_bayes.inference.program import Program, compile_program, noise_free
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import posterior_of
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import Scene

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
