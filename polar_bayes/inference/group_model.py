"""The model of one group: the modes of each patch or material, and its density around a point.

Given the parameters that all groups share, the groups of a capture are independent. So each group
has a mode search and a Hessian of its own, which makes captures of many groups cheap.
"""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.errors import FitError
from polar_bayes.inference.optimize import (
    Modes,
    ValueAndGradient,
    central_difference_hessian,
    distinct_modes,
    find_mode,
    ignore_line_search_warnings,
    numpy_potential,
    symmetrize,
)
from polar_bayes.inference.program import Model, Program, compile_program
from polar_bayes.observation.data import Observations

SHARED_AXES = ("wavelength", "view")


@dataclasses.dataclass(frozen=True, eq=False)
class Groups:
    """Positions in the flat vector of a program: of each group, (group, local), and of the rest."""

    axis: str
    local: np.ndarray
    common: np.ndarray

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self.local)


def find_groups(program: Program, data: Observations) -> Groups | None:
    """The groups along the only leading axis of a capture; None without one."""
    leading = [(name, length) for name, length in data.dims if name not in SHARED_AXES]
    if len(leading) != 1:
        return None
    name, length = leading[0]
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
    """One group of a capture, as a capture with a leading axis of length 1."""
    axis, length = data.dims[0]

    def cut(array: jax.Array) -> jax.Array:
        # Arrays that all groups share have a leading axis of length 1, or none.
        has_axis = array.ndim == len(data.dims) and array.shape[0] == length
        return array[number : number + 1] if has_axis else array

    return dataclasses.replace(jax.tree.map(cut, data), dims=((axis, 1), *data.dims[1:]))


@dataclasses.dataclass(frozen=True, eq=False)
class GroupModel:
    """The model of one group, compiled once for all groups of all captures of a layout."""

    program: Program
    groups: Groups


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
    return GroupModel(program, single) if single.common.size == groups.common.size else None


Starts = tuple[np.ndarray, np.ndarray]
"""Coordinates of a group, (start, local), and common ones, (start, common)."""


class GroupProgram:
    """The groups of one capture, each by itself."""

    def __init__(self, group_model: GroupModel, data: Observations, threads: int = 2) -> None:
        self._program = group_model.program
        self._local, self._common = group_model.groups.local[0], group_model.groups.common
        self._parts = [group_of(data, number) for number in range(data.dims[0][1])]
        self._dtype = data.brightness.dtype
        self._threads = threads

    def find_modes(
        self,
        starts: Callable[[int], Starts],
        common: np.ndarray,
        movable: np.ndarray,
        progress: Callable[[float], None],
    ) -> list[Modes]:
        """The modes of every group over its own coordinates and the movable common ones."""

        def of_group(number: int) -> Modes:
            # A thread starts with the settings of the process, not with those of this fit.
            with jax.enable_x64(self._dtype == jnp.float64):
                return self._find_modes(number, starts(number), common, movable)

        # Compiled before the threads start: only this thread knows the deadline.
        z = jnp.zeros(self._program.size, self._dtype)
        self._program.value_and_gradient.program(z, self._parts[0])
        found: list[Modes] = []
        with ignore_line_search_warnings(), ThreadPoolExecutor(self._threads) as pool:
            for modes in pool.map(of_group, range(len(self._parts))):
                found.append(modes)
                progress(len(found) / len(self._parts))
        return found

    def expand(
        self, number: int, local: np.ndarray, common: np.ndarray, sd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient, Hessian and mixed derivatives of the potential in a group's coordinates."""
        potential, z = self._potential(number), self._join(local, common)
        rows = central_difference_hessian(potential, z, sd, self._dtype, self._local)
        hessian = np.nan_to_num(rows)
        own, mixed = symmetrize(hessian[:, self._local]), hessian[:, self._common]
        return np.nan_to_num(potential(z)[1][self._local]), own, mixed

    def _find_modes(
        self, number: int, starts: Starts, common: np.ndarray, movable: np.ndarray
    ) -> Modes:
        whole, size = self._potential(number), self._local.size
        moving = np.concatenate([self._local, self._common[movable]])

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
                where=f"fit: {self._parts[0].dims[0][0]} {number}",
                hint="check its readings against the prior predictive, mark them valid=False, or "
                "give narrower priors",
            )
        return modes

    def _potential(self, number: int) -> ValueAndGradient:
        return numpy_potential(self._program.value_and_gradient, self._parts[number], self._dtype)

    def _join(self, local: np.ndarray, common: np.ndarray) -> np.ndarray:
        z = np.zeros(self._program.size, local.dtype)
        z[self._local], z[self._common] = local, common
        return z
