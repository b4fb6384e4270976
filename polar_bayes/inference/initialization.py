"""Initialization: posterior modes, and coordinates, starting points and metric from them.

`JointInit` is for captures of one material: all coordinates are optimized together and sampled as
they are. `HierarchicalInit` is for captures of many groups: each group is optimized by itself, and
chains run in the partially non-centered coordinates of `hierarchical_reparam`.

An initializer holds what is compiled for one layout, and serves every capture of it.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import ClassVar, NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpyro import handlers
from numpyro.infer.autoguide import AutoLaplaceApproximation

from polar_bayes.errors import FitError
from polar_bayes.inference.conditional_reparam import ConditionalReparam, find_coefficients
from polar_bayes.inference.hierarchical_reparam import (
    GroupModel,
    HierarchicalReparam,
    ReparamInputs,
    ReparamSearch,
    find_group_model,
    find_groups,
)
from polar_bayes.inference.program import (
    BLOCK,
    AbstractDensity,
    Program,
    begin_from_prior,
    first_key,
    from_prior,
    in_blocks,
)
from polar_bayes.inference.result import Provenance
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.optimize import (
    Modes,
    NumpyPotential,
    ValueAndGradient,
    distinct_modes,
    find_mode,
    find_modes,
    finite_sd,
    ignore_line_search_warnings,
    likely_starts,
)
from polar_bayes.numerics.psis import numpy_generator
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

STARTS = 16
"""Number of searches for modes."""

CANDIDATES = 16
"""Number of prior draws per start; a sharp mode, such as that of a near mirror, needs so many."""

HEAVY_MODE = 0.01
"""Smallest Laplace weight of a mode that chains must visit."""

Draws = tuple[np.ndarray, dict[str, np.ndarray]]
"""Unconstrained draws (chain, draw, size), and statistics, each (chain, draw)."""


class Target(NamedTuple):
    """A density for chains, with starting points and metric."""

    density: AbstractDensity
    """Of coordinates and `given`; one object for all captures of a layout."""
    given: object
    potential: ValueAndGradient
    starts: np.ndarray
    metric: np.ndarray
    transform: Callable[[np.ndarray], np.ndarray] = lambda z: z
    """Function from the sampler's coordinates of draws to the program's, (chain, draw, size)."""
    acceptance: float = 0.9
    warmup: int = 300


@dataclasses.dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates of the posterior of one material: the program's, or standardized ones.

    Args:
        density: Of coordinates and `given`; one object for all captures of a layout.
        given: The capture, and what the coordinates depend on.
        potential: `density` of this capture, with its gradient.
        log_density_of: Log densities of vectors of the program, (draw, size).
        modes: The modes in these coordinates.
        axes: Positions of the coordinates that are not standardized.
        prior_sd: Standard deviations of all of them before any reading.
        to_program: From these coordinates to the program's, with the log volume, for a block of
            vectors, compiled; None where they are the same.
    """

    density: AbstractDensity
    given: object
    potential: ValueAndGradient
    log_density_of: Callable[[np.ndarray], np.ndarray]
    modes: Modes
    axes: np.ndarray
    prior_sd: np.ndarray
    to_program: JitOnce | None = None

    def forward(self, x: np.ndarray) -> np.ndarray:
        """Return coordinates of the program, (..., size)."""
        return self._forward(x.reshape(-1, x.shape[-1]))[0].reshape(x.shape)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Return log posterior densities of vectors, (draw, size)."""
        z, log_volume = self._forward(x)
        return np.asarray(self.log_density_of(z) + log_volume, float)

    def _forward(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.to_program is None:
            return x, np.zeros(len(x))
        return in_blocks(self.to_program, (x.astype(self.modes.z.dtype),), self.given)


class AbstractInit(abc.ABC):
    """Result of a search for modes, with what methods need to start their draws."""

    metadata: Provenance
    """Number of starts, failures and weights, for the provenance."""

    @property
    def decrement(self) -> float:
        """Newton decrement: distance to the mode in posterior standard deviations."""
        return float(self.metadata["newton_decrement"])

    @abc.abstractmethod
    def target(self, key: Array, chains: int) -> Target:
        """Return the density for NUTS, with starting points and metric."""

    @abc.abstractmethod
    def laplace(self, key: Array, chains: int, draws: int) -> Draws:
        """Draw from the normal approximation at the mode of largest weight."""

    def joint_modes(self, where: str) -> Modes:
        """The modes of all coordinates together; a `FitError` where groups have modes each."""
        return self.joint_coordinates(where).modes

    def joint_coordinates(self, where: str) -> Coordinates:
        """Coordinates for draws of all together; a `FitError` where groups have modes each."""
        raise FitError(
            "it approximates one material; weights of many patches together are useless",
            where=where,
            hint="use method='nuts'",
        )

    @abc.abstractmethod
    def missed_mode_weight(self, z: np.ndarray) -> float:
        """Return the weight of the heaviest mode that some chain never visited."""


def modes_from_prior(potential: ValueAndGradient, drawn: np.ndarray, progress: Progress) -> Modes:
    """Search for the joint modes from the likeliest of draws (draw, size) from the prior."""
    likely = likely_starts(potential, drawn[: CANDIDATES * STARTS], STARTS)
    return find_modes(potential, likely, progress)


@dataclasses.dataclass(frozen=True, eq=False)
class JointInit(AbstractInit):
    """Initialization of one material: joint coordinates, dense metric from the Hessian."""

    initializer: "JointInitializer"
    data: Observations
    potential: ValueAndGradient
    modes: Modes
    metadata: Provenance

    @override
    def target(self, key: Array, chains: int) -> Target:
        random = numpy_generator(key)
        coordinates, starts = self.joint_coordinates("Nuts"), []
        modes, potential = coordinates.modes, coordinates.potential
        for mode in random.choice(len(modes.weight), size=chains, p=modes.weight):
            start = random.multivariate_normal(modes.z[mode], modes.covariance[mode])
            starts.append(start if np.isfinite(potential(start)[0]) else modes.z[mode])
        return Target(
            coordinates.density,
            coordinates.given,
            potential,
            np.stack(starts),
            modes.covariance[0],
            coordinates.forward,
        )

    @override
    def joint_coordinates(self, where: str) -> Coordinates:
        return self._coordinates

    @functools.cached_property
    def _coordinates(self) -> Coordinates:
        reparam, program = self.initializer.reparam, self.initializer.program
        prior = from_prior(program, first_key(), BLOCK, self.data)
        own = Coordinates(
            program,
            self.data,
            self.potential,
            lambda z: program.log_density(z, self.data),
            self.modes,
            np.arange(program.size),
            finite_sd(prior),
        )
        if reparam is None:
            return own
        dtype = self.data.brightness.dtype
        given = reparam.inputs(self.modes.z[0], self.modes.covariance[0], self.data)
        potential = NumpyPotential(reparam.value_and_gradient, given, dtype)
        starts = reparam.backward(self.modes.z, self.data)
        with ignore_line_search_warnings():
            modes = distinct_modes([find_mode(potential, start) for start in starts])
        if modes is None:
            return own
        prior_sd = finite_sd(reparam.backward(prior, self.data))
        prior_sd[reparam.coefficients] = 1.0
        return Coordinates(
            reparam,
            given,
            potential,
            own.log_density_of,
            modes,
            reparam.others,
            prior_sd,
            reparam.forward_of_block,
        )

    @override
    def laplace(self, key: Array, chains: int, draws: int) -> Draws:
        modes = self.modes
        location, factor, order = self.initializer.guide(
            jnp.asarray(modes.z[0]), jnp.linalg.inv(jnp.asarray(modes.covariance[0])), self.data
        )
        # Where the Hessian is not positive definite, the guide silently has zero width, so that a
        # failed fit would look certain: such draws are NaN.
        factor = jnp.where(jnp.diagonal(factor) > 0.0, factor, jnp.nan)
        noise = jax.random.normal(key, (chains, draws, len(location)))
        z = np.asarray(location + noise @ factor.T)[..., np.argsort(np.asarray(order))]
        return z, _weigh(self.potential, z, np.asarray(noise))

    @override
    def joint_modes(self, where: str) -> Modes:
        return self.modes

    @override
    def missed_mode_weight(self, z: np.ndarray) -> float:
        modes = self.modes
        heavy = np.flatnonzero(modes.weight >= HEAVY_MODE)
        if heavy.size < 2:
            return 0.0
        halves = np.linalg.cholesky(modes.covariance[heavy])
        apart = z[None] - modes.z[heavy][:, None, None]
        steps = np.einsum("mij,mcdj->mcdi", np.linalg.inv(halves), apart)
        volume = np.log(np.diagonal(halves, axis1=1, axis2=2)).sum(axis=1)
        nearest = np.argmin(0.5 * np.sum(steps**2, axis=-1) + volume[:, None, None], axis=0)
        visited = np.array([(nearest == number).any(axis=1).all() for number in range(heavy.size)])
        return float(np.max(modes.weight[heavy], where=~visited, initial=0.0))


@dataclasses.dataclass(frozen=True, eq=False)
class HierarchicalInit(AbstractInit):
    """Initialization of many groups, in coordinates with a nearly standard normal posterior."""

    reparam: HierarchicalReparam
    given: ReparamInputs
    potential: ValueAndGradient
    modes: list[Modes]
    metadata: Provenance

    @override
    def target(self, key: Array, chains: int) -> Target:
        size, dtype = self.reparam.size, self.given.common.dtype
        # A warm-up of some hundred draws can estimate the covariance of so few. The posterior of
        # common parameters can have any shape with few groups; with many it is about normal.
        few = size <= 60
        return Target(
            density=self.reparam,
            given=self.given,
            potential=self.potential,
            starts=self._draw_starts(key, chains),
            metric=np.eye(size, dtype=dtype) if few else np.ones(size, dtype),
            transform=self._to_program,
            acceptance=0.98 if few else 0.7,
            warmup=300 if few else 150,
        )

    def _draw_starts(self, key: Array, chains: int) -> np.ndarray:
        """Starting points in w: each group at one of its modes, drawn by weight."""
        random = numpy_generator(key)
        reparam, dtype = self.reparam, self.given.common.dtype
        starts = []
        for _ in range(chains):
            w = random.normal(size=reparam.size)
            z = np.array(reparam.forward_jit(jnp.asarray(w, dtype), self.given))
            for positions, modes in zip(reparam.groups.local, self.modes, strict=True):
                which = random.choice(len(modes.weight), p=modes.weight)
                if which:
                    z[positions] = modes.z[which]
            start = np.asarray(reparam.inverse_jit(jnp.asarray(z, dtype), self.given), float)
            usable = np.isfinite(start).all() and np.isfinite(self.potential(start)[0])
            starts.append(start if usable else np.zeros_like(start))
        return np.stack(starts)

    @override
    def laplace(self, key: Array, chains: int, draws: int) -> Draws:
        noise = np.asarray(jax.random.normal(key, (chains, draws, self.reparam.size)))
        return self._to_program(noise), _weigh(self.potential, noise, noise)

    @override
    def missed_mode_weight(self, z: np.ndarray) -> float:
        return 0.0  # chains start from modes of each group that are drawn by weight

    def _to_program(self, w: np.ndarray) -> np.ndarray:
        return np.asarray(self.reparam.forward_chains(jnp.asarray(w), self.given))


def _weigh(potential: ValueAndGradient, z: np.ndarray, noise: np.ndarray) -> dict[str, np.ndarray]:
    """Return log densities and log importance weights of affine maps of normal noise."""
    lp = np.apply_along_axis(lambda draw: -potential(draw)[0], -1, z)
    return {"lp": lp, "log_weight": lp + 0.5 * np.sum(noise**2, axis=-1)}


# --- Initializers: what is compiled for a layout --------------------------------------------------


class AbstractInitializer(abc.ABC):
    """The search for modes of all captures of one layout."""

    is_joint: ClassVar[bool] = False
    """Whether all coordinates are optimized together, as those of pixels are."""

    @property
    def is_plain(self) -> bool:
        """True if draws are made in the coordinates of the program, as those of pixels are."""
        return False

    @abc.abstractmethod
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        """Search the modes of one capture from prior draws; raise `FitError` without any."""

    def prepare(self, data: Observations) -> None:
        """Begin to compile what `find` needs; the default does nothing."""
        del data

    def prepare_target(self, data: Observations) -> Target | None:
        """Return a target of the expected shapes, whose programs begin to compile.

        None where the shapes are not known, as by default.
        """
        return None


@dataclasses.dataclass(frozen=True, eq=False)
class JointInitializer(AbstractInitializer):
    """Initializer of captures whose coordinates are optimized jointly."""

    program: Program
    reparam: ConditionalReparam | None

    is_joint: ClassVar[bool] = True

    @property
    @override
    def is_plain(self) -> bool:
        return self.reparam is None

    @functools.cached_property
    def guide(self) -> Callable[[Array, Array, Observations], tuple[Array, Array, Array]]:
        """NumPyro's guide around a mode, compiled."""
        return self.program.once("guide", functools.partial(_guide, self.program))

    @override
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        potential = NumpyPotential(self.program.value_and_gradient, data, data.brightness.dtype)
        drawn = from_prior(self.program, key, CANDIDATES * STARTS, data)
        modes = modes_from_prior(potential, drawn, progress)
        metadata = {
            "starts": modes.starts,
            "failures": modes.failures,
            "weights": [round(float(weight), 6) for weight in modes.weight[:8]],
            "newton_decrement": float(modes.decrement[0]),
            "gradients": potential.calls,
        }
        return JointInit(self, data, potential, modes, metadata)

    @override
    def prepare(self, data: Observations) -> None:
        begin_from_prior(self.program, data)
        z = jax.ShapeDtypeStruct((self.program.size,), data.brightness.dtype)
        self.program.value_and_gradient.begin(z, data)

    @override
    def prepare_target(self, data: Observations) -> Target:
        density: AbstractDensity = self.program
        given: object = data
        starts, metric = np.zeros((1, self.program.size)), np.eye(self.program.size)
        if self.reparam is not None:
            density, given = self.reparam, self.reparam.inputs_like(data)
            self.reparam.value_and_gradient.begin(starts[0], given)
        return Target(density, given, lambda z: (0.0, z), starts, metric)


@dataclasses.dataclass(frozen=True, eq=False)
class HierarchicalInitializer(AbstractInitializer):
    """Initializer of captures whose groups are optimized one by one."""

    group_model: GroupModel
    reparam: HierarchicalReparam

    @override
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        search = ReparamSearch(self.group_model, self.reparam, data, progress)
        given, potential, modes = search.run(key)
        metadata = {
            "starts": modes.starts * self.reparam.groups.count,
            "failures": modes.failures,
            "patches_with_several": sum(len(each.weight) > 1 for each in modes.of_group),
            "newton_decrement": float(np.linalg.norm(potential(np.zeros(self.reparam.size))[1])),
        }
        return HierarchicalInit(self.reparam, given, potential, modes.of_group, metadata)


def make_initializer(program: Program, data: Observations) -> AbstractInitializer:
    """The initializer that the layout of a capture calls for."""
    groups = find_groups(program, data)
    group_model = None if groups is None else find_group_model(program.model, groups, data)
    if groups is None or group_model is None:
        return JointInitializer(program, find_coefficients(program, data))
    return HierarchicalInitializer(group_model, HierarchicalReparam(program, groups))


def _guide(
    program: Program, mode: Array, precision: Array, data: Observations
) -> tuple[Array, Array, Array]:
    """Return location, Cholesky factor and order of coordinates of NumPyro's guide."""
    # The guide orders sites as the model declares them, the program by name. The guide's own search
    # for a starting point is not needed, and compilation removes it.
    order = jnp.zeros(program.size, int)
    auto = AutoLaplaceApproximation(program.model, hessian_fn=lambda *_: precision[order][:, order])
    handlers.seed(auto, jax.random.key(0))(data)
    numbers = jnp.arange(program.size, dtype=mode.dtype)
    unpacked = auto._unpack_latent(numbers)
    for name, positions in program.unravel(numbers).items():
        of_guide = unpacked[name].ravel().astype(int)
        order = order.at[of_guide].set(positions.ravel().astype(int))
    posterior = auto.get_posterior({"auto_loc": mode[order]})
    return posterior.loc, posterior.scale_tril, order
