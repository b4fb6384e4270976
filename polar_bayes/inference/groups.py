"""Which coordinates of a program belong to which patch of a capture.

Given the parameters that all patches share, the patches of a capture know nothing of each other.
Everything that makes many patches cheap rests on that: each can be climbed alone, and each has a
small curvature of its own.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

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
