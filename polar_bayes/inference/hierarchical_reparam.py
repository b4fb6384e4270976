r"""Partially non-centered reparametrization of many groups, expanded around the joint mode.

Given the common parameters, a group (a patch or a material) has two densities: that of its own
readings, about normal around its own mode, and that of its population. Their product is again about
normal, with a mean and a covariance that follow from the common parameters in closed form. The
coordinates w of a group are standardized by them:

$$ z_m = \hat z_m - P_m^{-1} b_m + L_m^{-T} w_m, \qquad P_m = A_m + D_m(g) = L_m L_m^T, \qquad
   b_m = s_m + C_m (g - \hat g) + d_m(g) $$

with A, s and C the Hessian, gradient and mixed derivatives of the readings at the expansion point,
and d and D gradient and curvature of the population given the common parameters g. Where the
population is narrow, w is the non-centered form; where it is wide, the centered one; each group is
in between at every value of g. The density is exact whatever A, s and C are: they only decide how
efficient sampling is.

Given the common parameters, the groups are independent, so each has a mode search and a Hessian of
its own, which makes captures of many groups cheap. A search over thousands of coordinates from a
prior draw ends in a poor mode of some group. `ReparamSearch` therefore searches each group alone
from many starts, first with common parameters of its own, then with those of all groups. Last, it
optimizes all coordinates jointly in w, in which a population of zero width is no singularity: that
is the mode of the population with its members integrated out.

Source:
    Papaspiliopoulos, Roberts and Skold 2007, "A general framework for the parametrization of
    hierarchical models", Statist. Sci. 22(1), 59-73 (partial non-centering); Gorinova, Moore and
    Hoffman 2020, "Automatic reparameterisation of probabilistic programs".
"""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, override

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float

from polar_bayes.errors import FitError
from polar_bayes.inference.program import (
    THREADS,
    AbstractDensity,
    Model,
    Program,
    compile_program,
    from_prior,
)
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.optimize import (
    Modes,
    NumpyPotential,
    ValueAndGradient,
    central_difference_hessian,
    distinct_modes,
    find_mode,
    finite_potential,
    ignore_line_search_warnings,
    symmetrize,
)
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

# --- The model of one group: the modes of each patch or material, and its density around a point --


@dataclasses.dataclass(frozen=True, eq=False)
class Groups:
    """Positions in the flat vector of a program: of the groups, (group, local), and of the rest."""

    axis: str
    local: np.ndarray
    common: np.ndarray

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self.local)


def find_groups(program: Program, data: Observations) -> Groups | None:
    """Return the groups along the only leading axis of a capture; None without one."""
    if len(data.leading) != 1:
        return None
    name, length = data.leading[0]
    local, common = [], [np.zeros(0, int)]
    for site, positions in program.unravel(jnp.arange(float(program.size))).items():
        flat = np.asarray(positions).astype(int)
        if name not in program.dims[site]:
            common.append(flat.ravel())
            continue
        # Axes of plates come first, outermost first; then those of the event or its bijection.
        sizes = [program.plates[dim] for dim in program.dims[site]]
        per_plate = flat.reshape(*sizes, -1)
        local.append(np.moveaxis(per_plate, program.dims[site].index(name), 0).reshape(length, -1))
    if not local:
        return None
    return Groups(name, np.concatenate(local, axis=1), np.concatenate(common))


def group_of(data: Observations, number: int) -> Observations:
    """Return one group of a capture, as a capture with a leading axis of length 1."""
    axis, length = data.dims[0]

    def cut(array: jax.Array) -> jax.Array:
        # Arrays that all groups share have a leading axis of length 1, or none.
        has_axis = array.ndim == len(data.dims) and array.shape[0] == length
        return array[number : number + 1] if has_axis else array

    return dataclasses.replace(jax.tree.map(cut, data), dims=((axis, 1), *data.dims[1:]))


Starts = tuple[np.ndarray, np.ndarray]
"""Coordinates of a group, (start, local), and common ones, (start, common)."""


@dataclasses.dataclass(frozen=True, eq=False)
class GroupModel:
    """The model of one group, compiled once for all groups of all captures of a layout."""

    program: Program
    local: np.ndarray
    common: np.ndarray

    def find_modes(
        self,
        part: Observations,
        where: str,
        starts: Starts,
        common: np.ndarray,
        movable: np.ndarray,
    ) -> Modes:
        """The modes of one group over its own coordinates and the movable common ones."""
        whole, size = self._potential(part), self.local.size
        moving = np.concatenate([self.local, self.common[movable]])

        def potential(x: np.ndarray) -> tuple[float, np.ndarray]:
            at = common.copy()
            at[movable] = x[size:]
            value, gradient = whole(self._join(x[:size], at))
            return value, gradient[moving]

        local, start_common = starts
        points = np.concatenate([local, start_common[:, movable]], axis=1)
        modes = distinct_modes([find_mode(potential, point) for point in points])
        if modes is None:
            raise FitError(
                f"none of {len(points)} starts reached a peak of the posterior",
                where=where,
                hint="check its readings against the prior predictive, mark them valid=False, or "
                "give narrower priors",
            )
        return modes

    def expand(
        self, part: Observations, local: np.ndarray, common: np.ndarray, sd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient, Hessian and mixed derivatives of the potential in a group's coordinates."""
        potential, z = self._potential(part), self._join(local, common)
        dtype = part.brightness.dtype
        hessian = np.nan_to_num(central_difference_hessian(potential, z, sd, dtype, self.local))
        own, mixed = symmetrize(hessian[:, self.local]), hessian[:, self.common]
        return np.nan_to_num(potential(z)[1][self.local]), own, mixed

    def _potential(self, part: Observations) -> ValueAndGradient:
        return NumpyPotential(self.program.value_and_gradient, part, part.brightness.dtype)

    def _join(self, local: np.ndarray, common: np.ndarray) -> np.ndarray:
        z = np.zeros(self.program.size, local.dtype)
        z[self.local], z[self.common] = local, common
        return z


def find_group_model(model: Model, groups: Groups, data: Observations) -> GroupModel | None:
    """The model of one group; None where it differs between groups, as by a prior for each."""
    first = group_of(data, 0)
    try:
        program = compile_program(model, first)
    except (TypeError, ValueError):  # arrays of the wrong length for one group
        return None
    single = find_groups(program, first)
    if single is None or single.local.shape != (1, groups.local.shape[1]):
        return None
    if single.common.size != groups.common.size:
        return None
    return GroupModel(program, single.local[0], single.common)


# --- The map between w and the coordinates of the program -----------------------------------------


class ReparamInputs(eqx.Module):
    """The capture and the expansion point, which is in no program: moving it compiles nothing."""

    data: Observations
    common: Float[Array, " common"]
    factor: Float[Array, "common common"]
    local: Float[Array, "group local"]
    gradient: Float[Array, "group local"]
    hessian: Float[Array, "group local local"]
    mixed: Float[Array, "group local common"]


@dataclasses.dataclass(frozen=True, eq=False)
class HierarchicalReparam(AbstractDensity[ReparamInputs]):
    """The map between the coordinates w and those of a program."""

    program: Program
    groups: Groups

    @property
    @override
    def key(self) -> str:
        return self.program.key and f"{self.program.key} hierarchical"

    @property
    def size(self) -> int:
        """Length of w: common coordinates first, then each group's."""
        return self.program.size

    @override
    def potential(self, w: Float[Array, " size"], given: ReparamInputs) -> Float[Array, ""]:
        z, log_volume = self.forward(w, given)
        return self.program.potential(z, given.data) - log_volume

    def forward(
        self, w: Float[Array, " size"], given: ReparamInputs
    ) -> tuple[Float[Array, " size"], Float[Array, ""]]:
        """Coordinates of the program, and the log volume of the map, up to a constant."""
        split = self.groups.common.size
        common = given.common + given.factor @ w[:split]
        mean, lower = self._conditional(common, given)
        noise = w[split:].reshape(self.groups.local.shape)
        local = mean + solve_triangular(lower, noise[..., None], trans=1, lower=True)[..., 0]
        log_volume = -jnp.sum(jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1)))
        return self._join(common, local), log_volume

    def inverse(self, z: Float[Array, " size"], given: ReparamInputs) -> Float[Array, " size"]:
        """Return the coordinates w of a vector of the program."""
        common, local = z[self.groups.common], z[self.groups.local]
        mean, lower = self._conditional(common, given)
        noise = jnp.einsum("gji,gj->gi", lower, local - mean)
        first = jnp.linalg.solve(given.factor, common - given.common)
        return jnp.concatenate([first, noise.ravel()])

    def population_derivatives(
        self,
        common: Float[Array, " common"],
        local: Float[Array, "group local"],
        data: Observations,
    ) -> tuple[Float[Array, "group local"], Float[Array, "group local"]]:
        """Return gradient and Hessian of the groups' minus log prior, given common coordinates."""
        # The coordinates of a group are taken as independent under their prior, which affects the
        # efficiency of sampling only.

        def gradient(local: Array) -> Array:
            return jax.grad(lambda x: self._group_prior(self._join(common, x), data))(local)

        return jax.jvp(gradient, (local,), (jnp.ones_like(local),))

    @functools.cached_property
    def forward_jit(self) -> JitOnce:
        """Compiled `forward`, without the volume."""
        return self.once("forward", lambda w, given: self.forward(w, given)[0])

    @functools.cached_property
    def inverse_jit(self) -> JitOnce:
        """Compiled `inverse`."""
        return self.once("inverse", self.inverse)

    @functools.cached_property
    def forward_chains(self) -> JitOnce:
        """Apply `forward_jit` to chains of draws, (chain, draw, size), one after the other."""

        def chains(w: Array, given: ReparamInputs) -> Array:
            return jax.lax.map(
                lambda chain: jax.lax.map(lambda x: self.forward(x, given)[0], chain), w
            )

        return self.once("forward_chains", chains)

    @functools.cached_property
    def population_jit(self) -> JitOnce:
        """Compiled `population_derivatives`."""
        return self.once("population_derivatives", self.population_derivatives)

    def _group_prior(self, z: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Return minus the log prior density of the coordinates of all groups."""
        terms, _ = self.program.log_terms(z, data)
        own = [n for n in self.program.supports if self.groups.axis in self.program.dims[n]]
        return -sum((terms[name] for name in own), jnp.zeros((), z.dtype))

    def _conditional(
        self, common: Float[Array, " common"], given: ReparamInputs
    ) -> tuple[Float[Array, "group local"], Float[Array, "group local local"]]:
        """Mean of every group, and Cholesky factor of its precision, given what is common."""
        gradient, curvature = self.population_derivatives(common, given.local, given.data)
        diagonal = jnp.maximum(curvature, 0.0)[..., None] * jnp.eye(
            curvature.shape[-1], dtype=curvature.dtype
        )
        lower = jnp.linalg.cholesky(given.hessian + diagonal)
        slope = given.gradient + given.mixed @ (common - given.common) + gradient
        step = cho_solve((lower, True), slope[..., None])[..., 0]
        return given.local - step, lower

    def _join(self, common: Array, local: Array) -> Array:
        z = jnp.zeros(self.size, local.dtype)
        return z.at[self.groups.common].set(common).at[self.groups.local].set(local)


# --- The expansion point --------------------------------------------------------------------------


TYPICAL_DRAWS = 200
"""Number of prior draws whose median is the first guess of the common coordinates."""

FEWEST_STARTS, MOST_STARTS, ALL_STARTS = 4, 16, 256
"""Fewest and most starts of each group; number of starts that all groups share."""


class GroupModes(NamedTuple):
    """The modes of every group, and the common coordinates at which they were found."""

    common: np.ndarray
    movable: np.ndarray
    of_group: list[Modes]
    starts: int
    failures: int


@dataclasses.dataclass(frozen=True, eq=False)
class ReparamSearch:
    """The search for the expansion point of one capture."""

    alone: GroupModel
    reparam: HierarchicalReparam
    data: Observations
    progress: Progress

    def run(self, key: Array) -> tuple[ReparamInputs, NumpyPotential, GroupModes]:
        """Alternate between expansion and joint optimization until the mode stays in place.

        Returns:
            The map with its expansion point, the potential there, and the modes it began at.
        """
        groups, size, dtype = self.reparam.groups, self.reparam.size, self.dtype
        modes = self.group_modes(key)
        common, local = modes.common, np.stack([each.z[0] for each in modes.of_group])
        factor = np.eye(common.size)
        rounds = 4  # of joint optimization at most, each around the end of the one before
        for number in range(rounds):
            given, potential = self.expand(common, local, factor, modes)
            w = scipy.optimize.minimize(
                finite_potential(potential),
                np.zeros(size),
                jac=True,
                method="L-BFGS-B",
                options={"maxiter": 300, "maxcor": 20, "gtol": 1e-4},
            ).x
            z = np.asarray(self.reparam.forward_jit(jnp.asarray(w, dtype), given), float)
            common, local = z[groups.common], z[groups.local]
            factor = _common_factor(potential, w, factor, dtype)
            self.progress("joining the patches", (number + 1) / rounds)
            if number and np.linalg.norm(w) < 0.1 * np.sqrt(w.size):
                break
        return *self.expand(common, local, factor, modes), modes

    @property
    def dtype(self) -> np.dtype:
        return self.data.brightness.dtype

    @functools.cached_property
    def parts(self) -> list[Observations]:
        """The groups, each as a capture of its own."""
        return [group_of(self.data, number) for number in range(self.reparam.groups.count)]

    def expand(
        self, common: np.ndarray, local: np.ndarray, factor: np.ndarray, modes: GroupModes
    ) -> tuple[ReparamInputs, NumpyPotential]:
        """The map around a point, from the derivatives of the readings without the population."""
        prior_gradient, prior_curvature = self.population(common, local)
        gradients, hessians, mixed = [], [], []
        for number, (part, each) in enumerate(zip(self.parts, modes.of_group, strict=True)):
            sd = np.sqrt(np.diagonal(each.covariance[0]))
            gradient, hessian, cross = self.alone.expand(part, local[number], common, sd)
            values, vectors = np.linalg.eigh(hessian - np.diag(prior_curvature[number]))
            gradients.append(gradient - prior_gradient[number])
            hessians.append((vectors * np.maximum(values, 0.0)) @ vectors.T)
            # Derivatives by hyperparameters belong to the population.
            mixed.append(cross * modes.movable)
        arrays = (common, factor, local, *map(np.stack, (gradients, hessians, mixed)))
        given = ReparamInputs(self.data, *(jnp.asarray(x, self.dtype) for x in arrays))
        return given, NumpyPotential(self.reparam.value_and_gradient, given, self.dtype)

    def group_modes(self, key: Array) -> GroupModes:
        """Search each group with its own common coordinates, then with those of all groups."""
        groups = self.reparam.groups
        drawn = from_prior(self.reparam.program, key, TYPICAL_DRAWS, self.data)
        starts = int(np.clip(ALL_STARTS // groups.count, FEWEST_STARTS, MOST_STARTS))
        common = np.median(drawn[:, groups.common], axis=0).astype(drawn.dtype)
        movable = ~self.hyperparameters(drawn[0])
        size = groups.local.shape[1]

        def from_draws(number: int) -> Starts:
            return drawn[:starts, groups.local[number]], drawn[:starts, groups.common]

        own = self.find_modes(from_draws, common, movable, (0.0, 0.8))
        common[movable] = _weighted_medians(
            np.stack([each.z[0, size:] for each in own]),
            np.stack([np.diagonal(each.covariance[0])[size:] for each in own]),
        )

        def from_modes(number: int) -> Starts:
            fresh = drawn[starts : starts + FEWEST_STARTS, groups.local[number]]
            local = np.concatenate([own[number].z[:, :size].astype(fresh.dtype), fresh])
            return local, np.tile(common, (len(local), 1))

        shared = self.find_modes(from_modes, common, np.zeros(common.size, bool), (0.8, 0.2))
        return GroupModes(common, movable, shared, starts, sum(each.failures for each in own))

    def find_modes(
        self,
        starts: Callable[[int], Starts],
        common: np.ndarray,
        movable: np.ndarray,
        stage: tuple[float, float],
    ) -> list[Modes]:
        """The modes of every group; the stage is where progress begins, and how far it goes."""
        axis, program = self.reparam.groups.axis, self.alone.program

        def of_group(number: int) -> Modes:
            # A thread starts with the settings of the process, not with those of this fit.
            with jax.enable_x64(self.dtype == jnp.float64):
                where, part = f"fit: {axis} {number}", self.parts[number]
                return self.alone.find_modes(part, where, starts(number), common, movable)

        # Compiled before the threads start: only this thread knows the deadline.
        program.value_and_gradient.program(jnp.zeros(program.size, self.dtype), self.parts[0])
        found: list[Modes] = []
        with ignore_line_search_warnings(), ThreadPoolExecutor(THREADS) as pool:
            for modes in pool.map(of_group, range(len(self.parts))):
                found.append(modes)
                done = stage[0] + stage[1] * len(found) / len(self.parts)
                self.progress("searching for modes", done)
        return found

    def population(self, common: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient and curvature of minus the groups' log prior, each (group, local)."""
        g, z = (jnp.asarray(x, self.dtype) for x in (common, local))
        gradient, curvature = self.reparam.population_jit(g, z, self.data)
        return np.asarray(gradient, float), np.asarray(curvature, float)

    def hyperparameters(self, z: np.ndarray) -> np.ndarray:
        """Return True for common coordinates on which the prior of a group depends."""
        common, local = z[self.reparam.groups.common], z[self.reparam.groups.local]
        before = np.stack(self.population(common, local))
        steps = 0.5 * np.eye(common.size)
        moved = [np.stack(self.population(common + step, local)) for step in steps]
        return np.array([bool(np.any(after != before)) for after in moved], bool)


def _weighted_medians(values: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Return medians of columns, weighted by inverse variance, which outliers do not affect."""
    medians = []
    for column, variance in zip(values.T, variances.T, strict=True):
        order = np.argsort(column)
        share = np.cumsum(1.0 / variance[order])
        medians.append(column[order][np.searchsorted(share, 0.5 * share[-1])])
    return np.array(medians)


def _common_factor(
    potential: ValueAndGradient, w: np.ndarray, factor: np.ndarray, dtype: np.dtype
) -> np.ndarray:
    """Return a Cholesky factor of the common coordinates' covariance from their Hessian."""
    size = len(factor)
    if not size:
        return factor
    rows = central_difference_hessian(potential, w, np.ones(size), dtype, range(size))
    inverse = np.linalg.inv(factor)  # from w to the coordinates of the program
    hessian = inverse.T @ symmetrize(np.nan_to_num(rows[:, :size])) @ inverse
    values, vectors = np.linalg.eigh(hessian)
    widest = 3.0  # standard deviation that is taken from the Hessian
    return np.linalg.cholesky((vectors / np.maximum(values, widest**-2)) @ vectors.T)
