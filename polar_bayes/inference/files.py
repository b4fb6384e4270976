"""The schema of results, and their netCDF files, each of which holds one tree.

A schema lists the groups, variables, attributes and provenance that this package reads, with the
type of each. Everything else in a tree is ignored, so trees that ArviZ made, or that a user has
edited, pass wherever their parts fit together. Functions trust a tree that has passed its schema.
The schemas of calibrations and accuracy studies are in `polar_bayes.calibration.verdict` and
`polar_bayes.benchmark.accuracy`.
"""

import dataclasses
import fnmatch
import math
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import NamedTuple, TypeGuard

import numpy as np
import xarray as xr

from polar_bayes.capture.schema import dims_text
from polar_bayes.errors import FitError
from polar_bayes.inference.result import PROVENANCE, Provenance, provenance_of
from polar_bayes.observation.data import ANGLES
from polar_bayes.priors import short_numbers

Problems = Iterator[tuple[str, str]]
"""Places at which a tree violates its schema, each with a description."""

# --- JSON: provenance and attributes --------------------------------------------------------------


class Leaf(NamedTuple):
    """A type of JSON values: its name, and a test of values."""

    name: str
    holds: Callable[[object], bool]


CHOSEN_BY = {
    "capture": ", which the capture names",
    "caller": ", which the caller gave",
    "comparison": ", chosen by a comparison of scenes",
    "default": ", by default, since neither the capture nor the caller named one",
}


def _is_number(value: object) -> TypeGuard[float]:
    is_real = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return is_real and not (isinstance(value, int) and abs(value) >= 2**64)


def _is_finite(value: object) -> TypeGuard[float]:
    return _is_number(value) and abs(value) < 2**64 and math.isfinite(value)


def _is_pair(value: object, holds: Callable[[object], bool]) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(holds, value))


ANY = Leaf("anything", lambda _: True)
TEXT = Leaf("text", lambda value: isinstance(value, str))
FLAG = Leaf("true or false", lambda value: isinstance(value, bool))
FINITE = Leaf("a finite number", _is_finite)
COUNT = Leaf("a count", lambda value: _is_finite(value) and value >= 0 and value % 1 == 0)
NUMBER = Leaf("a number", _is_number)
POSITIVE = Leaf("a number above 0", lambda value: _is_finite(value) and value > 0)
BOUNDS = Leaf(
    "a least and a largest value",
    lambda value: _is_pair(value, lambda bound: bound is None or _is_finite(bound)),
)
SHARES = Leaf("a share below and a share above", lambda value: _is_pair(value, _is_finite))
INDEX_BY_EYE = Leaf(
    "an index with its range, and a polarization",
    lambda value: isinstance(value, list) and len(value) == 4 and all(map(_is_finite, value)),
)
OPTIONAL = Leaf("a number or null", lambda value: value is None or _is_number(value))

type Spec = Leaf | Mapping[str, Spec] | list[Spec]
"""A leaf; the keys of a mapping, with `?` where one may be missing or null; or a list whose only
entry is the type of each item."""

EACH = "*"
"""Key that represents every key of a mapping that the specification does not name."""


def _check_json(value: object, spec: Spec, where: str) -> Problems:
    """Yield the places at which a JSON value violates its specification."""
    if isinstance(spec, Leaf):
        if not spec.holds(value):
            yield where, f"it is {value!r}, not {spec.name}"
    elif isinstance(spec, list):
        if not isinstance(value, list):
            yield where, f"it is {value!r}, not a list"
            return
        for number, item in enumerate(value):
            yield from _check_json(item, spec[0], f"{where}[{number}]")
    elif isinstance(value, Mapping):
        yield from _check_mapping(value, spec, where)
    else:
        yield where, f"it is {value!r}, not a mapping"


def _check_mapping(value: Mapping[str, object], spec: Mapping[str, Spec], where: str) -> Problems:
    for key in spec:
        if key != EACH and not key.endswith("?") and key not in value:
            yield f"{where}.{key}", "it is missing"
    for name, item in value.items():
        optional = f"{name}?"
        key = name if name in spec else optional if optional in spec else EACH
        if key in spec and not (item is None and key == optional):
            yield from _check_json(item, spec[key], f"{where}.{name}")


RENAMED = {
    "approach": "method",
    "effective_draws": "ess",
    "k_hat": "pareto_k",
    "reference_effective_draws": "reference_ess",
}
"""Names of diagnostics in version 0.1, and the present names."""


def in_present_names[Result: (xr.DataTree, xr.Dataset)](result: Result) -> Result:
    """Rename the diagnostics of a result that an earlier version may have written."""
    if isinstance(result, xr.DataTree):
        for node in result.subtree:
            node.dataset = _renamed(node.to_dataset())
        return result
    return _renamed(result)


def _renamed(data: xr.Dataset) -> xr.Dataset:
    is_table = not {"status", "seconds_first"}.isdisjoint(data)  # a map, calibration or study
    new = RENAMED if is_table else {}
    found = data.rename({name: new[name] for name in new if name in data})
    found.attrs = {new.get(str(name), str(name)): value for name, value in data.attrs.items()}
    if isinstance(stated := found.attrs.get(PROVENANCE), str):
        for old in ("effective_draws", "k_hat"):
            stated = stated.replace(f'"{old}":', f'"{RENAMED[old]}":')
        found.attrs[PROVENANCE] = stated.replace("effective_draws=", "ess=")  # of Nuts
    return found


# --- Groups and variables -------------------------------------------------------------------------

DRAWS = ("chain", "draw")
Variables = Mapping[str, xr.Variable]

NUMBERS, FLAGS, TEXTS = "biuf", "biu", "OSUT"
"""Kinds of NumPy types; text is read from files as objects."""

LARGEST = np.float64(1e150)
"""No finite number of a result is larger: variances are sums of squares."""

_KIND_NAMES = {NUMBERS: "real numbers of 64 bits", FLAGS: "integers or truth values", TEXTS: "text"}


class Like(NamedTuple):
    """The variables of another group, with suffixes of their names and the dims these add."""

    group: str
    endings: Mapping[str, tuple[str, ...]]
    required: bool = False


@dataclasses.dataclass(frozen=True)
class Group:
    """The schema of one group."""

    dims: tuple[str, ...] = ()  # of every variable that `variables` does not list
    extra_dims: bool = True  # whether variables may have further dims
    never: tuple[str, ...] = ()  # dims that no variable may have
    required: bool = False  # whether a tree without it, or with an empty one, is refused
    tied: bool = False  # whether chains and draws are those of the posterior
    labeled: bool = True  # whether dims have the labels that they have in other groups
    kinds: Mapping[str, str] = dataclasses.field(default_factory=dict)  # numbers by default
    variables: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)  # required
    names: tuple[str, ...] | None = None  # patterns of the variables that are read; None: all
    like: Like | None = None
    inside: Mapping[str, str] = dataclasses.field(default_factory=dict)  # groups with all its dims
    attributes: Mapping[str, Spec] = dataclasses.field(default_factory=dict)
    variable_attributes: Mapping[str, Spec] = dataclasses.field(default_factory=dict)

    def read(self, node: xr.DataTree) -> Variables:
        """Return the variables that are read, and the coordinates that `variables` lists."""
        names = [*node.data_vars, *(key for key in self.variables if key in node.coords)]
        patterns = self.names or ("*",)
        return {
            name: node.variables[name]
            for name in names
            if any(fnmatch.fnmatchcase(str(name), pattern) for pattern in patterns)
        }

    def check(
        self, variables: Variables, attributes: Mapping[Hashable, object], where: str
    ) -> Problems:
        """Yield the places at which a group violates this schema."""
        yield from _check_json(attributes, self.attributes, where)
        for name in self.variables:
            if name not in variables:
                yield f"{where}/{name}", "it is missing"
        for name, variable in variables.items():
            names = (name, *variable.dims)
            if odd := [each for each in names if not isinstance(each, str)]:
                yield where, f"{odd[0]!r} is no name"
            else:
                yield from self._check_variable(name, variable, f"{where}/{name}")
        sizes = [variables[name].size for name in self.variables if name in variables]
        if self.required and not (all(sizes) and any(x.size for x in variables.values())):
            yield where, "it is empty"

    def _check_variable(self, name: str, variable: xr.Variable, where: str) -> Problems:
        kinds, dims = self.kinds.get(name, NUMBERS), set(variable.dims)
        if variable.dtype.kind not in kinds or variable.dtype.str.endswith("f16"):
            yield where, f"it holds {variable.dtype}, not {_KIND_NAMES[kinds]}"
        expected = self.variables.get(name, self.dims)
        is_closed = name in self.variables or not self.extra_dims
        if not dims >= set(expected) or (is_closed and dims != set(expected)):
            yield where, f"its dims are {dims_text(variable.dims)}, not {dims_text(expected)}"
        if odd := [dim for dim in self.never if dim in dims]:
            yield where, f"it has the dim {odd[0]}"
        if variable.dtype.kind == "f" and _is_too_large(variable.values):
            yield where, f"it holds a number above {LARGEST:g}, whose square overflows"
        yield from _check_json(variable.attrs, self.variable_attributes, where)

    def check_dims(self, own: Variables, read: Mapping[str, Variables], where: str) -> Problems:
        """Yield variables whose dims disagree with those of the groups `like` and `inside`."""
        for name, group in self.inside.items():
            for other, variable in read.get(group, {}).items() if name in own else ():
                if not set(own[name].dims) <= set(variable.dims):
                    what = f"{group}/{other} has not its dims {dims_text(own[name].dims)}"
                    yield f"{where}/{name}", what
        like = self.like or Like("", {})
        for name, variable in read.get(like.group, {}).items():
            for ending, added in like.endings.items():
                key, expected = f"{name}{ending}", (*added, *variable.dims)
                if key in own and set(own[key].dims) != set(expected):
                    what = f"its dims are {dims_text(own[key].dims)}, not {dims_text(expected)}"
                    yield f"{where}/{key}", what
                if key not in own and like.required:
                    yield f"{where}/{key}", "it is missing"


@dataclasses.dataclass(frozen=True)
class Schema:
    """The schema of one kind of tree."""

    kind: str
    made_by: str
    command: str
    groups: Mapping[str, Group]
    provenance: Mapping[str, Spec]

    def describes(self, tree: object) -> bool:
        """Return whether a tree has the required groups; only fits have a posterior."""
        if not isinstance(tree, xr.DataTree):
            return False
        required = {name for name, group in self.groups.items() if group.required}
        is_fit = "posterior" in tree.children
        return required <= set(tree.children) and ("posterior" in required) == is_fit

    def check(self, tree: xr.DataTree, source: str) -> None:
        """Raise a `FitError` if a tree violates this schema."""
        if not self.describes(tree):
            hint = f"give the tree that {self.made_by} returned"
            raise FitError(f"it holds no {self.kind}", where=source, hint=hint)
        for where, what in self._problems(tree):
            hint = f"give the tree as {self.made_by} returned it"
            raise FitError(what, where=f"{source}: {where}", hint=hint)

    def _problems(self, tree: xr.DataTree) -> Problems:
        yield from _check_json(provenance_of(tree), self.provenance, PROVENANCE)
        read: dict[str, Variables] = {}
        for name, group in self.groups.items():
            if name in tree.children:
                node = tree.children[name]
                yield from _check_node(node, name)
                read[name] = group.read(node)
                yield from group.check(read[name], node.attrs, name)
        for name, variables in read.items():
            yield from self.groups[name].check_dims(variables, read, name)
        yield from self._check_lengths(read)
        yield from _check_labels(
            {name: tree.children[name] for name in read if self.groups[name].labeled}
        )

    def _check_lengths(self, read: Mapping[str, Variables]) -> Problems:
        """Check that dims of groups have one length, except chains and draws of untied groups."""
        sizes: dict[str, tuple[str, int]] = {}
        for name, variables in read.items():
            for dim, size in {d: n for x in variables.values() for d, n in x.sizes.items()}.items():
                if dim in DRAWS and not self.groups[name].tied:
                    continue
                first, expected = sizes.setdefault(str(dim), (name, size))
                if size != expected:
                    yield name, f"its {dim} has {size} entries, that of {first} {expected}"


def _is_too_large(values: np.ndarray) -> bool:
    """Return whether a finite number is too large; predictions may fill half of the memory."""
    least, most = (end.reduce(values, None, initial=0.0) for end in (np.fmin, np.fmax))
    if -LARGEST <= least and most <= LARGEST:
        return False
    return bool(np.any(np.abs(values[np.isfinite(values)]) > LARGEST))


def _check_node(node: xr.DataTree, where: str) -> Problems:
    """Check for groups that xarray cannot handle, such as a failed edit leaves."""
    try:
        node.to_dataset()
    except ValueError as error:
        yield where, f"its variables do not fit together ({error})"
    for name, variable in node.variables.items():
        if len(set(variable.dims)) < variable.ndim:
            yield f"{where}/{name}", f"its dims are {dims_text(variable.dims)}, one of them twice"


def _check_labels(labeled: Mapping[str, xr.DataTree]) -> Problems:
    """Check that dims of groups have the same labels, and that wavelengths are lengths."""
    seen: dict[Hashable, tuple[str, xr.Variable | None]] = {}
    for name, node in labeled.items():
        for dim in (dim for dim in node.dims if dim not in DRAWS):
            found = node.variables[dim] if dim in node.coords else None
            first, expected = seen.setdefault(dim, (name, found))
            is_same = expected is found if expected is None else expected.equals(found)
            if not is_same:
                yield f"{name}/{dim}", f"its labels are not those of {first}"
    name, found = seen.get("wavelength", ("", None))
    if found is not None and (
        found.dtype.kind not in "iuf" or not np.all(np.isfinite(found) & (found > 0))
    ):
        yield f"{name}/wavelength", "a label is no length in nm"


# --- Fits -----------------------------------------------------------------------------------------


COMMON_PROVENANCE: Mapping[str, Spec] = {
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
"""Provenance that results of every kind may have."""

_ALTERNATIVE: Mapping[str, Spec] = {
    **dict.fromkeys(("part", "alternative", "path", "failed?"), TEXT),
    **{"defines": [TEXT], "log_bayes_factor?": FINITE, "shift?": {EACH: [FINITE]}},
}
_STEP = {"name": TEXT, "taken": FLAG, "why": TEXT, "seconds": FINITE, "monte_carlo?": FINITE}
_FIT_PROVENANCE: Mapping[str, Spec] = {
    **COMMON_PROVENANCE,
    "settings?": {EACH: ANY},
    "method_parts?": TEXT,
    "model_settings?": {EACH: ANY},
    "model_source?": TEXT,
    "known?": {EACH: POSITIVE},
    "bounds?": {EACH: BOUNDS},
    "declared?": {EACH: ANY},
    "fixed?": {EACH: ANY},
    "scene_chosen_by?": TEXT,
    "capture_cautions?": [TEXT],
    "scene_cautions?": [TEXT],
    "indices_by_eye?": {EACH: INDEX_BY_EYE},
    "swapped?": [TEXT],
    "largest_view_zenith?": FINITE,
    "machine?": {EACH: ANY},
    "counts?": {"at_margin?": {EACH: COUNT}, EACH: COUNT},
    "problems?": [TEXT],
    "capture?": {EACH: ANY},
    "comparisons_failed?": {EACH: TEXT},
    "prior_probability?": {EACH: [NUMBER]},
    "tails?": {"pareto_k": NUMBER, "ess": POSITIVE, "shares": {EACH: [SHARES]}},
    "alternatives?": [_ALTERNATIVE],
    "alternatives_failed?": TEXT,
    "standard_errors?": {EACH: [OPTIONAL]},
    "modes?": {"weights?": [FINITE], "unvisited?": FINITE},
    "pareto_k?": FINITE,
    "ess?": FINITE,
    "rounds?": NUMBER,
    "auto?": {"tolerance?": FINITE, "met": FLAG, "chosen": TEXT, "steps": [_STEP]},
}

STATISTICS = (
    "acceptance_rate",
    "diverging",
    "log_weight",
    "loss",
    "reached_max_treedepth",
    "step_size",
)
"""Variables of `sample_stats` that are read; samplers of other packages store more."""

_EFFECT, _PARAMETER, _ROW = ("effect",), ("parameter",), ("row",)
COSTS = ("operations", "compile_seconds", "run_seconds")
_OF_LEDGER = {
    **dict.fromkeys(("effect", "path", "reason", "kept", "forced"), _EFFECT),
    **dict.fromkeys(("largest_move", "rms_move", "change", *COSTS), _EFFECT),
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
        **{f"{which}_{cost}": OPTIONAL for which in ("full", "chosen") for cost in COSTS},
        "combined_change": OPTIONAL,
        "tolerance": FINITE,
    },
)
"""The group `effects`: the table of `polar_bayes.choose_effects`."""

_OF_ACCURACY = {
    **dict.fromkeys(("mean_error", "sd_error", "low_error", "high_error"), (*_ROW, *_PARAMETER)),
    "wasserstein": (*_ROW, *_PARAMETER),
    **dict.fromkeys(("method", "override", "problems", "r_hat", "pareto_k", "ess"), _ROW),
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
        "reference_ess": FINITE,
        "reference_error": FINITE,
        "reference_doubts": TEXT,
    },
)
"""The group `accuracy`: a study of `polar_bayes.accuracy`."""

_OF_SCENES = {
    **dict.fromkeys(("elpd", "se", "elpd_diff", "dse", "weight", "unreliable"), ("scene",)),
    **dict.fromkeys(("scene", "parts", "criticism", "seconds"), ("scene",)),
    **dict.fromkeys(("mean", "sd", "low", "high"), ("scene", "parameter")),
    **dict.fromkeys(("parameter", "between_share"), ("parameter",)),
}
SCENES = Group(
    labeled=False,
    dims=("scene",),
    extra_dims=False,
    names=(*_OF_SCENES, "index_bound"),  # which earlier versions did not write
    variables=_OF_SCENES,
    kinds=dict.fromkeys(("scene", "parameter", "parts", "criticism"), TEXTS),
    attributes={"left_out": TEXT, "lifted?": TEXT, "undecided?": TEXT},
)
"""The group `scenes`: the comparison behind a fit with scene="auto"."""

_FLAGS = ("valid", "saturated", "diverging", "reached_max_treedepth")
_OF_READINGS = Group(DRAWS, tied=True, like=Like("observed_data", {"": DRAWS}))
FIT = Schema(
    kind="fit",
    made_by="polar_bayes.fit or load",
    command="`polar-bayes fit`",
    groups={
        "posterior": Group(DRAWS, required=True, tied=True),
        "unconstrained_posterior": Group(DRAWS, tied=True, labeled=False),
        "prior": Group(DRAWS),
        "sample_stats": Group(
            DRAWS, extra_dims=False, tied=True, kinds=dict.fromkeys(_FLAGS, FLAGS), names=STATISTICS
        ),
        "log_prior": Group(DRAWS, tied=True, labeled=False),
        "observed_data": Group(never=DRAWS, variable_attributes={"saturation_level?": FINITE}),
        "posterior_predictive": _OF_READINGS,
        "noise_free": _OF_READINGS,
        "log_likelihood": _OF_READINGS,
        "prior_predictive": Group(DRAWS, like=Like("observed_data", {"": DRAWS})),
        "constant_data": Group(
            kinds=dict.fromkeys(_FLAGS, FLAGS),
            names=(*ANGLES, *_FLAGS, "true_*"),
            inside=dict.fromkeys((*ANGLES, *_FLAGS), "observed_data"),
        ),
        "without_discrepancy": Group(DRAWS, labeled=False),
        "without_instrument": Group(DRAWS, labeled=False),
        "effects": LEDGER,
        "scenes": SCENES,
        "accuracy": ACCURACY,
    },
    provenance=_FIT_PROVENANCE,
)


def check_fit(result: xr.DataTree, source: str = "result") -> None:
    """Raise a `FitError` if a tree is not a fit or its parts are inconsistent."""
    FIT.check(result, source)


def choice_sentences(result: xr.DataTree) -> list[str]:
    """State what a fit used, and who chose it.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        Sentences on the set-up, the links, the readings set aside, and the priors that follow from
        what the capture states of its incident levels and angles.

    Raises:
        FitError: It is no fit, or does not hold together.
    """
    check_fit(result)
    provenance = provenance_of(result)
    chosen_by = "comparison" if "scenes" in result.children else provenance.get("scene_chosen_by")
    by = CHOSEN_BY.get(str(chosen_by), "")
    links = (f"{name} by {link}" for name, link in provenance.get("links", {}).items())
    counts, limit = provenance.get("counts", {}), provenance.get("largest_view_zenith", 90.0)
    views, masked, used = (counts.get(name) or 0 for name in ("views", "masked", "used"))
    sentences = [
        f"Set-up: {provenance.get('scene')}{by}.",
        f"Links: {'; '.join(links)}.",
        f"Readings: {used} of {views} are used; {masked} are masked, and "
        f"{views - masked - used} are set aside beyond {limit:g} degrees.",
    ]
    priors, capture = provenance.get("priors", {}), provenance.get("capture") or {}
    follows = (
        ("channel_gain_ratio", "incident_levels", "Incident levels"),
        ("angle_zero", "angle_set_by", "Angles set by"),
    )
    for name, attribute, words in follows:
        if name in priors and attribute in capture:
            said = f"{words}: {capture[attribute]}; the prior of {name} is "
            said += f"{short_numbers(priors[name])}."
            sentences.append(said)
    return sentences


def auto_sentences(result: xr.DataTree) -> list[str]:
    """State what `method="auto"` tried, what it selected, and why.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A sentence for each method that was tried, in order; none for a fit by a method of one's
        own choice.

    Raises:
        FitError: It is no fit, or does not hold together.
    """
    check_fit(result)
    return sentences_of_auto(provenance_of(result))


def sentences_of_auto(provenance: Provenance) -> list[str]:
    """State what `method="auto"` tried, from the provenance of a validated fit."""
    summary = provenance.get("auto")
    if not summary:
        return []
    sentences = []
    for step in summary["steps"]:
        name = f"{step['name']} ({step['seconds']:.1f} s)"
        if step["taken"]:
            error, tolerance = step.get("monte_carlo"), summary.get("tolerance")
            within = "an unknown number of" if error is None else f"{error:.2g}"
            limit = "" if tolerance is None else f"; the tolerance is {tolerance:g}"
            sentences.append(
                f"{name} was selected: its means and standard deviations are expected within "
                f"{within} posterior sd{limit}."
            )
        else:
            sentences.append(f"{name} was rejected: {step['why']}.")
    if not summary["met"]:
        met, hint = "passed its own diagnostics", "more seconds"
        if summary.get("tolerance") is not None:
            met, hint = "met the tolerance", "more seconds or a larger tolerance"
        sentences.append(
            f"No method {met}; the numbers are those of {summary['chosen']}, which came nearest. "
            f"Give {hint}, or do not rely on them."
        )
    return sentences
