"""What fits hold, and their netCDF files: one tree a file, whole or not at all.

A schema says which groups, variables, attributes and provenance are read, and of what type each is.
What nobody reads is not looked at, so trees that ArviZ made, or that a user has edited, pass
wherever their parts fit together. Functions behind the door trust what they are given. The tables
stand beside the loaders: `polar_bayes.inference.files`, `calibration.files` and
`budget.accuracy_files`.
"""

import dataclasses
import fnmatch
import math
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from polar_bayes.capture.files import is_result, open_netcdf, read_netcdf, write_netcdf
from polar_bayes.errors import FitError, OutputError
from polar_bayes.inference.result import GEOMETRY, PROVENANCE, provenance_of
from polar_bayes.paths import existing_file, replacing

# --- What a kind of tree holds: a table, and the check of a tree against it -----------------------


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
            hint = f"give the tree that {self.made_by} returned"
            raise FitError(f"it holds no {self.kind}", where=source, hint=hint)
        for place, what in self._departures(tree):
            hint = f"give the tree as {self.made_by} returned it"
            raise FitError(what, where=f"{source}: {place}", hint=hint)

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


# --- What fits hold, and their netCDF files: one tree a file, whole or not at all -----------------


OF_ALL: Mapping[str, Spec] = {
    "method?": TEXT,
    "model?": TEXT,
    "scene?": TEXT,
    "scene_parts?": TEXT,
    "seed?": FINITE,
    "priors?": {EACH: TEXT},
    "links?": {EACH: TEXT},
    "versions?": {EACH: ANY},
    "timings?": {EACH: FINITE},
}
"""Provenance that every kind of tree may have."""

_STEP = {"name": TEXT, "taken": FLAG, "why": TEXT, "seconds": FINITE, "monte_carlo?": FINITE}
OF_FIT: Mapping[str, Spec] = {
    **OF_ALL,
    "settings?": {EACH: ANY},
    "model_settings?": {EACH: ANY},
    "model_source?": TEXT,
    "bounds?": {EACH: BOUNDS},
    "declared?": {EACH: ANY},
    "fixed?": {EACH: ANY},
    "swapped?": [TEXT],
    "largest_view_zenith?": FINITE,
    "machine?": {EACH: ANY},
    "counts?": {"at_margin?": {EACH: COUNT}, EACH: COUNT},
    "problems?": [TEXT],
    "capture?": {EACH: ANY},
    "comparisons_failed?": {EACH: TEXT},
    "standard_errors?": {EACH: [OPTIONAL]},
    "modes?": {"weights?": [FINITE]},
    "k_hat?": FINITE,
    "effective_draws?": FINITE,
    "auto?": {"tolerance": FINITE, "met": FLAG, "chosen": TEXT, "steps": [_STEP]},
}

STATISTICS = (
    "acceptance_rate",
    "diverging",
    "log_weight",
    "loss",
    "reached_max_treedepth",
    "step_size",
)
"""What is read of `sample_stats`; samplers of other packages have more."""

_EFFECT, _PARAMETER, _ROW = ("effect",), ("parameter",), ("row",)
_COSTS = ("operations", "compile_seconds", "run_seconds")
_OF_LEDGER = {
    **dict.fromkeys(("effect", "path", "reason", "kept", "forced"), _EFFECT),
    **dict.fromkeys(("largest_move", "rms_move", "change", *_COSTS), _EFFECT),
    **dict.fromkeys(("shift", "sd_ratio"), (*_EFFECT, *_PARAMETER)),
    **dict.fromkeys(("parameter", "judged"), _PARAMETER),
}
LEDGER = Group(
    labeled=False,
    names=tuple(_OF_LEDGER),
    variables=_OF_LEDGER,
    kinds={
        **dict.fromkeys(("effect", "path", "parameter", "reason"), TEXTS),
        **dict.fromkeys(("kept", "forced", "judged"), FLAGS),
    },
    attributes={
        **{f"{which}_{cost}": OPTIONAL for which in ("full", "chosen") for cost in _COSTS},
        "combined_change": OPTIONAL,
        "tolerance": FINITE,
    },
)
"""The group `effects`: a ledger of `polar_bayes.choose_effects`."""

_OF_ACCURACY = {
    **dict.fromkeys(("mean_error", "sd_error", "low_error", "high_error"), (*_ROW, *_PARAMETER)),
    "wasserstein": (*_ROW, *_PARAMETER),
    **dict.fromkeys(("method", "override", "problems", "r_hat", "k_hat", "effective_draws"), _ROW),
    **dict.fromkeys(("gradients", "densities", "seconds_first", "seconds_again"), _ROW),
    "peak_memory": _ROW,
    "parameter": _PARAMETER,
}
ACCURACY = Group(
    labeled=False,
    names=tuple(_OF_ACCURACY),
    variables=_OF_ACCURACY,
    kinds=dict.fromkeys(("method", "override", "parameter", "problems"), TEXTS),
    attributes={
        "reference": TEXT,
        "reference_draws": COUNT,
        "reference_effective_draws": FINITE,
        "reference_error": FINITE,
        "reference_doubts": TEXT,
    },
)
"""The group `accuracy`: a study of `polar_bayes.accuracy`."""

_FLAGS = ("valid", "saturated", "diverging", "reached_max_treedepth")
_OF_READINGS = Group(DRAWS, tied=True, like=Like("observed_data", {"": DRAWS}))
FIT = Schema(
    kind="fit",
    made_by="polar_bayes.fit or load_result",
    command="`polar-bayes fit`",
    groups={
        "posterior": Group(DRAWS, needed=True, tied=True),
        "unconstrained_posterior": Group(DRAWS, tied=True, labeled=False),
        "prior": Group(DRAWS),
        "sample_stats": Group(
            DRAWS, others=False, tied=True, kinds=dict.fromkeys(_FLAGS, FLAGS), names=STATISTICS
        ),
        "log_prior": Group(DRAWS, tied=True, labeled=False),
        "observed_data": Group(never=DRAWS, marks={"saturation_level?": FINITE}),
        "posterior_predictive": _OF_READINGS,
        "noise_free": _OF_READINGS,
        "log_likelihood": _OF_READINGS,
        "prior_predictive": Group(DRAWS, like=Like("observed_data", {"": DRAWS})),
        "constant_data": Group(
            kinds=dict.fromkeys(_FLAGS, FLAGS),
            names=(*GEOMETRY, *_FLAGS, "true_*"),
            inside=dict.fromkeys((*GEOMETRY, *_FLAGS), "observed_data"),
        ),
        "without_discrepancy": Group(DRAWS, labeled=False),
        "without_instrument": Group(DRAWS, labeled=False),
        "effects": LEDGER,
        "accuracy": ACCURACY,
    },
    provenance=OF_FIT,
)
"""What is read of a fit."""


def check_fit(result: xr.DataTree, source: str = "result") -> None:
    """Refuse what is no fit, or does not hold together."""
    FIT.check(result, source)


def load_result(path: str | os.PathLike[str]) -> xr.DataTree:
    """A result from a netCDF file.

    Args:
        path: A file that `save_result` wrote.

    Returns:
        The tree, in memory; the file is closed.

    Raises:
        CaptureError: The file is not there.
        FitError: It was damaged, or is not a result; the group and variable that is wrong.
    """
    return load_tree(path, FIT)


def load_tree(path: str | os.PathLike[str], schema: Schema) -> xr.DataTree:
    """A tree of one kind from a netCDF file."""
    file = existing_file(path, schema.kind)
    hint = f"give the file that {schema.command} or save_result wrote"
    broken = FitError("it cannot be read as netCDF", where=str(file), hint=hint)
    tree = read_netcdf(xr.DataTree, file, broken)
    if not schema.describes(tree) or PROVENANCE not in tree.attrs:
        raise FitError(f"it holds no {schema.kind}", where=str(file), hint=hint)
    schema.check(tree, str(file))
    return tree


def holds(path: str | os.PathLike[str], schema: Schema) -> bool:
    """Whether a file holds a tree of one kind; its numbers are not read."""
    try:
        with open_netcdf(xr.DataTree, existing_file(path, schema.kind)) as tree:
            return schema.describes(tree)
    except Exception:  # the libraries below raise nearly every type for a broken file
        return False


def save_result(result: xr.DataTree | xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a result to a netCDF-4 file, beside its place first and then moved there.

    A checksum goes with it, which `load_result` verifies.

    Args:
        result: A tree that `polar_bayes.fit`, `calibrate` or `accuracy` returned, or a dataset of
            another function of this package.
        path: The file; an older one is replaced and its mode kept.

    Raises:
        FitError: It is neither, or netCDF cannot hold it.
        OutputError: The file cannot be written, or is none that may be replaced.
    """
    if not isinstance(result, xr.DataTree | xr.Dataset):
        what = f"a {type(result).__name__} is no result"
        raise FitError(what, where="save_result", hint="give what polar_bayes.fit returned")
    with replacing(path, is_result) as unfinished:
        try:
            write_netcdf(result, unfinished)
        except (OSError, RuntimeError, OutputError):
            raise
        except Exception as error:  # xarray raises nearly every type for what it cannot encode
            what = f"netCDF cannot hold it ({error or type(error).__name__})"
            hint = "store numbers and text only"
            raise FitError(what, where="save_result", hint=hint) from error
