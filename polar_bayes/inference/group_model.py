"""One patch of a capture by itself: its peaks, and the shape of its density around a point.

Given the parameters that all patches share, the patches of a capture know nothing of each other.
Everything that makes many patches cheap rests on that: each can be climbed alone, and each has a
small curvature of its own.
"""

import dataclasses
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.errors import FitError
from polar_bayes.inference.optimize import (
    Modes,
    ValueAndGradient,
    climb,
    distinct,
    quiet_line_search,
)
from polar_bayes.inference.program import Model, Program, compile_program
from polar_bayes.observation.data import Observations

# --- Which coordinates of a program belong to which patch of a capture ----------------------------


SHARED_AXES = ("wavelength", "view")


@dataclasses.dataclass(frozen=True, eq=False)
class Groups:
    """Positions in the flat vector of a program."""

    axis: str
    local: np.ndarray
    common: np.ndarray

    @property
    def count(self) -> int:
        """How many groups there are."""
        return len(self.local)


def find_groups(program: Program, data: Observations) -> Groups | None:
    """The groups of a capture with a leading axis."""
    leading = [(name, length) for name, length in data.dims if name not in SHARED_AXES]
    if len(leading) != 1:
        return None
    name, length = leading[0]
    local, common = [], []
    for site, positions in program.unravel(jnp.arange(float(program.size))).items():
        flat = np.asarray(positions).astype(int)
        if name not in program.dims[site]:
            common.append(flat.ravel())
            continue
        # Plates stand outermost first; what an event adds, or a bijection leaves, follows.
        sizes = [program.plates[dim] for dim in program.dims[site]]
        per_plate = flat.reshape(*sizes, -1)
        local.append(np.moveaxis(per_plate, program.dims[site].index(name), 0).reshape(length, -1))
    if not local:
        return None
    nothing = np.zeros(0, int)
    return Groups(name, np.concatenate(local, axis=1), np.concatenate(common or [nothing]))


def group_of(data: Observations, number: int) -> Observations:
    """One group of a capture, as a capture with a leading axis of length 1."""
    length = data.dims[0][1]

    def cut(array: jax.Array) -> jax.Array:
        # What is shared by all groups has a leading axis of length 1, or none.
        has_axis = array.ndim == len(data.dims) and array.shape[0] == length
        return array[number : number + 1] if has_axis else array

    dims = ((data.dims[0][0], 1), *data.dims[1:])
    return dataclasses.replace(jax.tree.map(cut, data), dims=dims)


# --- One patch of a capture by itself: its peaks, and the shape of its density around a point -----


Starts = tuple[np.ndarray, np.ndarray]
"""Coordinates of a patch, (start, local), and common ones, (start, common)."""


@dataclasses.dataclass(frozen=True, eq=False)
class GroupModel:
    """The model of one patch, compiled once for all patches of all captures."""

    program: Program
    groups: Groups


def find_group_model(model: Model, groups: Groups, data: Observations) -> GroupModel | None:
    """The model told for one patch, where it can be: not where a prior names every patch."""
    first = group_of(data, 0)
    try:
        program = compile_program(model, first)
    except (TypeError, ValueError):  # arrays of the wrong length for one patch
        return None
    alone = find_groups(program, first)
    if alone is None:
        return None
    same_local = alone.local.shape == (1, groups.local.shape[1])
    same = same_local and alone.common.size == groups.common.size
    return GroupModel(program, alone) if same else None


class GroupProgram:
    """The patches of one capture, each by itself."""

    def __init__(self, group_model: GroupModel, data: Observations, threads: int = 2) -> None:
        self._program, self._groups = group_model.program, group_model.groups
        self._parts = [group_of(data, number) for number in range(data.dims[0][1])]
        self._dtype = data.brightness.dtype
        self._threads = threads

    @property
    def common(self) -> np.ndarray:
        """Where common coordinates stand in the vector of one patch."""
        return self._groups.common

    def potential(self, patch: int) -> ValueAndGradient:
        """Minus the log density of one patch and what is common, with its gradient."""

        def potential(z: np.ndarray) -> tuple[float, np.ndarray]:
            at = jnp.asarray(z, self._dtype)
            value, gradient = self._program.value_and_gradient(at, self._parts[patch])
            return float(value), np.asarray(gradient, float)

        return potential

    def peaks(
        self,
        starts: Callable[[int], Starts],
        common: np.ndarray,
        movable: np.ndarray,
        tell: Callable[[float], None],
    ) -> list[Modes]:
        """The peaks of every patch over its own coordinates and the movable common ones."""

        def climb_one(patch: int) -> Modes:
            # A thread starts with the settings of the process, not with those of this fit.
            with jax.enable_x64(self._dtype == jnp.float64):
                return self._climb(patch, starts(patch), common, movable)

        # Compiled before the threads start: a deadline reaches this thread only.
        z = jnp.zeros(self._program.size, self._dtype)
        self._program.value_and_gradient.program(z, self._parts[0])
        found: list[Modes] = []
        with quiet_line_search(), ThreadPoolExecutor(self._threads) as pool:
            for modes in pool.map(climb_one, range(len(self._parts))):
                found.append(modes)
                tell(len(found) / len(self._parts))
        return found

    def expand(
        self, patch: int, local: np.ndarray, common: np.ndarray, spread: Iterable[float]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient and second derivatives of the potential, by central differences."""
        potential, z = self.potential(patch), self._join(local, common)
        mine = self._groups.local[0]
        # As in `modes.curvature`: truncation and rounding are then of one size.
        step_of = np.finfo(self._dtype).eps ** 0.25
        rows = []
        for index, sd in zip(mine, spread, strict=True):
            shift = np.zeros_like(z)
            shift[index] = step_of * min(max(sd, 1e-6), 1.0)
            rows.append((potential(z + shift)[1] - potential(z - shift)[1]) / (2 * shift[index]))
        hessian = np.nan_to_num(np.stack(rows))
        own = 0.5 * (hessian[:, mine] + hessian[:, mine].T)
        return np.nan_to_num(potential(z)[1][mine]), own, hessian[:, self._groups.common]

    def _climb(self, patch: int, starts: Starts, common: np.ndarray, movable: np.ndarray) -> Modes:
        whole, size = self.potential(patch), self._groups.local.shape[1]
        moving = np.concatenate([self._groups.local[0], self._groups.common[movable]])

        def potential(x: np.ndarray) -> tuple[float, np.ndarray]:
            at = common.copy()
            at[movable] = x[size:]
            value, gradient = whole(self._join(x[:size], at))
            return value, gradient[moving]

        local, start_common = starts
        points = np.concatenate([local, start_common[:, movable]], axis=1)
        modes = distinct([climb(potential, point) for point in points])
        if modes is None:
            raise FitError(
                f"none of {len(points)} starts reached a peak of the posterior",
                where=f"fit: {self._parts[0].dims[0][0]} {patch}",
                hint="check its readings against the prior predictive, mark them valid=False, or "
                "give narrower priors",
            )
        return modes

    def _join(self, local: np.ndarray, common: np.ndarray) -> np.ndarray:
        z = np.zeros(self._program.size, local.dtype)
        z[self._groups.local[0]], z[self._groups.common] = local, common
        return z
