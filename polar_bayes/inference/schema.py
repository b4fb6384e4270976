"""What a kind of tree holds: a table, and the check of a tree against it.

A schema says which groups, variables, attributes and provenance are read, and of what type each is.
What nobody reads is not looked at, so trees that ArviZ made, or that a user has edited, pass
wherever their parts fit together. Functions behind the door trust what they are given. The tables
stand beside the loaders: `polar_bayes.inference.files`, `calibration.files` and
`budget.accuracy_files`.
"""

import dataclasses
import fnmatch
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.inference.result import PROVENANCE, provenance_of

DRAWS = ("chain", "draw")

Departures = Iterator[tuple[str, str]]
"""Where a tree departs from its schema, and what is wrong there."""

# --- types of JSON values ---------------------------------------------------------------------


class Leaf(NamedTuple):
    """A type of value: its name, and whether a value is of it."""

    name: str
    holds: Callable[[Any], bool]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _is_finite(value: Any) -> bool:
    return _is_number(value) and abs(value) < 2**64 and math.isfinite(value)


def _are_bounds(value: Any) -> bool:
    is_pair = isinstance(value, list) and len(value) == 2
    return is_pair and all(bound is None or _is_finite(bound) for bound in value)


ANY = Leaf("anything", lambda _: True)
TEXT = Leaf("text", lambda value: isinstance(value, str))
FLAG = Leaf("true or false", lambda value: isinstance(value, bool))
FINITE = Leaf("a finite number", _is_finite)
COUNT = Leaf("a count", lambda value: _is_finite(value) and value >= 0 and value % 1 == 0)
BOUNDS = Leaf("a least and a largest value", _are_bounds)
OPTIONAL = Leaf("a number or null", lambda value: value is None or _is_number(value))

type Spec = Leaf | Mapping[str, Spec] | list[Spec]
"""A leaf; keys of a mapping, with `?` where one may be missing or null; or the type of each item
of a list, as its only entry."""

EACH = "*"
"""Stands for every key of a mapping that its table does not name."""


def _mismatches(value: Any, spec: Spec, place: str) -> Departures:
    """Where a JSON value is not of its type."""
    if isinstance(spec, Leaf):
        if not spec.holds(value):
            yield place, f"it is {value!r}, not {spec.name}"
    elif isinstance(spec, list):
        if not isinstance(value, list):
            yield place, f"it is {value!r}, not a list"
            return
        for number, item in enumerate(value):
            yield from _mismatches(item, spec[0], f"{place}[{number}]")
    elif isinstance(value, Mapping):
        yield from _of_mapping(value, spec, place)
    else:
        yield place, f"it is {value!r}, not a mapping"


def _of_mapping(value: Mapping[str, Any], spec: Mapping[str, Spec], place: str) -> Departures:
    known = {key.removesuffix("?"): key for key in spec if key != EACH}
    for name, key in known.items():
        if name not in value and not key.endswith("?"):
            yield f"{place}.{name}", "it is missing"
    for name, item in value.items():
        key = known.get(name, EACH)
        if key in spec and not (item is None and key.endswith("?")):
            yield from _mismatches(item, spec[key], f"{place}.{name}")


# --- groups and variables ---------------------------------------------------------------------

Variables = Mapping[str, xr.Variable]

NUMBERS, FLAGS, TEXTS = "biuf", "biu", "OSUT"
"""Kinds of NumPy types; text is read from files as objects."""


class Like(NamedTuple):
    """That a group has variables in the shape of those of another group."""

    group: str
    endings: Mapping[str, tuple[str, ...]]
    needed: bool = False


@dataclasses.dataclass(frozen=True)
class Group:
    """What is read of a group."""

    dims: tuple[str, ...] = ()
    others: bool = True
    never: tuple[str, ...] = ()
    needed: bool = False
    tied: bool = False
    labeled: bool = True
    kinds: Mapping[str, str] = dataclasses.field(default_factory=dict)
    variables: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    names: tuple[str, ...] | None = None
    like: Like | None = None
    inside: Mapping[str, str] = dataclasses.field(default_factory=dict)
    attributes: Mapping[str, Spec] = dataclasses.field(default_factory=dict)
    marks: Mapping[str, Spec] = dataclasses.field(default_factory=dict)

    def is_read(self, name: str) -> bool:
        """Whether a variable is read, by its name."""
        return self.names is None or any(fnmatch.fnmatchcase(name, each) for each in self.names)


@dataclasses.dataclass(frozen=True)
class Schema:
    """What is read of a kind of tree."""

    kind: str
    made_by: str
    command: str
    groups: Mapping[str, Group]
    provenance: Mapping[str, Spec]

    def describes(self, tree: object) -> bool:
        """Whether a tree has the groups of this kind; a fit that has others, too, is a fit."""
        if not isinstance(tree, xr.DataTree):
            return False
        needed = {name for name, group in self.groups.items() if group.needed}
        return needed <= set(tree.children) and ("posterior" in needed) == (
            "posterior" in tree.children
        )

    def check(self, tree: xr.DataTree, source: str) -> None:
        """Refuse a tree that does not hold what this kind holds."""
        if not self.describes(tree):
            mend = f"give the tree that {self.made_by} returned"
            raise FitError(f"it holds no {self.kind}", where=source, mend=mend)
        for place, what in self._departures(tree):
            mend = f"give the tree as {self.made_by} returned it"
            raise FitError(what, where=f"{source}: {place}", mend=mend)

    def _departures(self, tree: xr.DataTree) -> Departures:
        yield from _mismatches(provenance_of(tree), self.provenance, PROVENANCE)
        read: dict[str, Variables] = {}
        for name, group in self.groups.items():
            if name in tree.children:
                yield from _unreadable(tree.children[name], name)
                yield from _repeated(tree.children[name], name)
                read[name] = _variables(group, tree.children[name])
                yield from _of_group(group, read[name], tree.children[name].attrs, name)
        for name, variables in read.items():
            yield from _unlike(self.groups[name], variables, read, name)
        yield from self._lengths(read)
        labeled = {name: tree.children[name] for name in read if self.groups[name].labeled}
        yield from _labels(labeled)

    def _lengths(self, read: Mapping[str, Variables]) -> Departures:
        """Dims that groups share have one length everywhere, but for the draws of others."""
        sizes: dict[str, tuple[str, int]] = {}
        for name, variables in read.items():
            for dim, size in {d: n for x in variables.values() for d, n in x.sizes.items()}.items():
                if dim in DRAWS and not self.groups[name].tied:
                    continue
                first, expected = sizes.setdefault(str(dim), (name, size))
                if size != expected:
                    yield name, f"its {dim} has {size} entries, that of {first} {expected}"


def _unreadable(node: xr.DataTree, place: str) -> Departures:
    """A group whose variables do not fit together, as an edit that xarray broke off leaves it."""
    try:
        node.to_dataset()
    except ValueError as error:
        yield place, f"its variables do not fit together ({error})"


def _repeated(node: xr.DataTree, place: str) -> Departures:
    """Dims of one variable with one name, which xarray allows and cannot handle."""
    for name, variable in node.variables.items():
        if len(set(variable.dims)) < variable.ndim:
            yield f"{place}/{name}", f"its dims are {_listed(variable.dims)}, one of them twice"


def _variables(group: Group, node: xr.DataTree) -> Variables:
    """The variables of a group that are read, and the coordinates that its table names."""
    names = [*node.data_vars, *(key for key in group.variables if key in node.coords)]
    return {name: node.variables[name] for name in names if group.is_read(str(name))}


def _of_group(
    group: Group, variables: Variables, attributes: Mapping[Any, Any], place: str
) -> Departures:
    yield from _mismatches(attributes, group.attributes, place)
    for name in group.variables:
        if name not in variables:
            yield f"{place}/{name}", "it is missing"
    for name, variable in variables.items():
        names = (name, *variable.dims)
        if odd := [each for each in names if not isinstance(each, str)]:
            yield place, f"{odd[0]!r} is no name"
        else:
            yield from _of_variable(group, name, variable, f"{place}/{name}")
    sizes = [variables[name].size for name in group.variables if name in variables]
    if group.needed and not (all(sizes) and any(x.size for x in variables.values())):
        yield place, "it is empty"


def _labels(labeled: Mapping[str, xr.DataTree]) -> Departures:
    """Dims that groups share have the same labels everywhere; wavelengths are lengths."""
    seen: dict[Any, tuple[str, xr.Variable | None]] = {}
    for name, node in labeled.items():
        for dim in (dim for dim in node.dims if dim not in DRAWS):
            found = node.variables[dim] if dim in node.coords else None
            first, expected = seen.setdefault(dim, (name, found))
            is_same = found is expected or (
                found is not None and expected is not None and expected.equals(found)
            )
            if not is_same:
                yield f"{name}/{dim}", f"its labels are not those of {first}"
    name, found = seen.get("wavelength", ("", None))
    if found is not None and (
        found.dtype.kind not in "iuf" or not np.all(np.isfinite(found) & (found > 0))
    ):
        yield f"{name}/wavelength", "a label is no length in nm"


def _of_variable(group: Group, name: str, variable: xr.Variable, place: str) -> Departures:
    kinds, dims = group.kinds.get(name, NUMBERS), set(variable.dims)
    if variable.dtype.kind not in kinds:
        yield place, f"it holds {variable.dtype}, not {_WORDS[kinds]}"
    expected = group.variables.get(name, group.dims)
    is_closed = name in group.variables or not group.others
    if not dims >= set(expected) or (is_closed and dims != set(expected)):
        yield place, f"its dims are {_listed(variable.dims)}, not {_listed(expected)}"
    if odd := [dim for dim in group.never if dim in dims]:
        yield place, f"it has the dim {odd[0]}"
    yield from _mismatches(variable.attrs, group.marks, place)


_WORDS = {NUMBERS: "real numbers", FLAGS: "whole numbers or truth values", TEXTS: "text"}


def _unlike(group: Group, own: Variables, read: Mapping[str, Variables], place: str) -> Departures:
    """Where the dims of a group are not those that other groups ask for."""
    for name, other in group.inside.items():
        for host, variable in read.get(other, {}).items() if name in own else ():
            if not set(own[name].dims) <= set(variable.dims):
                yield (
                    f"{place}/{name}",
                    f"{other}/{host} has not its dims {_listed(own[name].dims)}",
                )
    like = group.like or Like("", {})
    for name, variable in read.get(like.group, {}).items():
        for ending, besides in like.endings.items():
            key, expected = f"{name}{ending}", (*besides, *variable.dims)
            if key in own and set(own[key].dims) != set(expected):
                yield (
                    f"{place}/{key}",
                    f"its dims are {_listed(own[key].dims)}, not {_listed(expected)}",
                )
            if key not in own and like.needed:
                yield f"{place}/{key}", "it is missing"


def _listed(dims: Any) -> str:
    return f"({', '.join(map(str, dims))})"
