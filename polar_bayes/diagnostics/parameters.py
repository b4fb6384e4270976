"""The scalar parameters of a fit: each with a label and an array of draws, the material first."""

import dataclasses
import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np
import xarray as xr

from polar_bayes.errors import one_line
from polar_bayes.inference.program import Program, Values
from polar_bayes.inference.result import posterior_of, shape_of
from polar_bayes.physics.scene import MATERIAL_PARAMETERS

SAMPLE_DIMS = ("chain", "draw")
MIN_DRAWS = 100
"""Fewest draws from which predictions are checked or weights are computed."""

APPROXIMATIONS = ("laplace", "variational")
"""Methods that draw from an approximation and store `log_weight`: log posterior minus log
approximation, up to a constant."""

WEIGHTED = ("importance",)
"""Methods whose draws are resampled from weighted draws."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scalar:
    """One number that a fit estimates."""

    label: str
    name: str
    index: Mapping[str, int]
    labels: Mapping[str, str]
    draws: np.ndarray

    @property
    def is_material(self) -> bool:
        """True for roughness, subsurface fraction, absorption and refractive index."""
        return self.name in MATERIAL_PARAMETERS


def with_entries[T](
    found: Iterable[Scalar], stated: Mapping[str, Iterable[T]]
) -> Iterator[tuple[Scalar, T]]:
    """Pair each scalar with its entry in a provenance mapping by name, where it has one."""
    entries = {name: iter(values) for name, values in stated.items()}
    for scalar in found:
        for entry in itertools.islice(entries.get(scalar.name, iter(())), 1):
            yield scalar, entry


def is_hyperparameter(name: str, names: Collection[str]) -> bool:
    """Return True for parameters of a population or of a process over wavelength."""
    ends = ("_location", "_spread", "_level", "_amplitude", "_length")
    return any(name.endswith(end) and name.removesuffix(end) in names for end in ends)


def scalars(group: xr.Dataset, sample_dims: Sequence[str] = SAMPLE_DIMS) -> list[Scalar]:
    """List every scalar of a group of draws, whose leading axes are the sample dims."""
    names = set(map(str, group.data_vars))
    ordered = sorted(group.data_vars, key=lambda name: _rank(str(name), group[name], names))
    found = [scalar for name in ordered for scalar in _entries(group[name], sample_dims)]
    seen: dict[str, int] = {}
    for position, scalar in enumerate(found):
        seen[scalar.label] = repeat = seen.get(scalar.label, 0) + 1
        if repeat > 1:
            found[position] = dataclasses.replace(scalar, label=f"{scalar.label}#{repeat}")
    return found


def _rank(name: str, variable: xr.DataArray, names: Collection[str]) -> tuple[int, int]:
    if name in MATERIAL_PARAMETERS:
        return 0, MATERIAL_PARAMETERS.index(name)
    if is_hyperparameter(name, names):
        return 1, 0
    # A vector that is one site, such as the weights of a discrepancy, is last.
    has_event = any(str(dim).startswith(f"{name}_") for dim in variable.dims)
    return (3 if has_event else 2), 0


def _entries(variable: xr.DataArray, sample_dims: Sequence[str]) -> Iterator[Scalar]:
    name = str(variable.name)
    dims = [str(dim) for dim in variable.dims if dim not in sample_dims]
    values = variable.transpose(*sample_dims, *dims).to_numpy().astype(float)
    texts = {dim: _coordinate(variable, dim) for dim in dims}
    for index in np.ndindex(values.shape[len(sample_dims) :]):
        labels = {dim: texts[dim][at] for dim, at in zip(dims, index, strict=True)}
        yield Scalar(
            label=f"{name}[{', '.join(labels.values())}]" if labels else name,
            name=name,
            index=dict(zip(dims, index, strict=True)),
            labels=labels,
            draws=values[(..., *index)],
        )


def _coordinate(variable: xr.DataArray, dim: str) -> list[str]:
    """Format the labels of one axis as text: 450 rather than 450.0."""
    values = variable[dim].to_numpy() if dim in variable.coords else np.arange(variable.sizes[dim])
    return [
        repr(float(value)).removesuffix(".0")
        if isinstance(value, np.floating)
        else one_line(str(value))
        for value in values
    ]


# --- Unconstrained coordinates --------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, order=True)
class Coordinate:
    """One unconstrained coordinate: its label in tables, its site, and its index in the site.

    `is_entry` is False where the site has fewer coordinates than numbers, such as a simplex.
    """

    index: int
    label: str
    site: str
    entry: int
    is_entry: bool


def label_coordinates(program: Program, capture: xr.Dataset) -> list[Coordinate]:
    """Label all unconstrained coordinates in their order."""
    found = []
    for site, positions in program.positions.items():
        flat = positions.ravel()
        is_entry = flat.size == np.prod(shape_of(program, site), initial=1)
        named = label_scalars(program, capture, {site: flat[None, None]}) if is_entry else []
        labels = {int(scalar.draws.item()): scalar.label for scalar in named}
        found += [
            Coordinate(index, labels.get(index, f"{site}[{entry}]"), site, entry, is_entry)
            for entry, index in enumerate(flat.tolist())
        ]
    return sorted(found)


def label_scalars(program: Program, capture: xr.Dataset, draws: Values) -> list[Scalar]:
    """Label scalars of chains of draws by the capture's own labels, such as wavelengths."""
    group = posterior_of(program, draws)
    labels = {str(dim): capture[dim] for dim in group.dims if dim in capture.coords}
    return scalars(group.assign_coords(labels))
