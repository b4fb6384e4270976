"""Damaged captures, results and tables: mutations by a seed, and the contract they may break."""

import json
import math

import numpy as np
import xarray as xr

from polar_bayes.capture.schema import count

ODD_NAMES = [
    "../x", "<script>alert(1)</script>", "a\nb", "Öl 油", "", " ", "true_", "true_\N{SNOWMAN}",
    "DOP", "dop ", "view", "wavelength", "y", "material", "_FillValue", "\ud800", "x" * 1000, 7,
    None, ("a",),
]  # fmt: skip
ODD_NUMBERS = [
    math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 1.0, 1.0 + 1e-15, 89.999999, 90.0, 180.0, 361.0,
    1e-320, 1e-31, 1e30, 1e300, -1e300, 2.0**63,
]  # fmt: skip
ODD_ATTRIBUTES = [
    None, True, 3, 10**30, math.nan, math.inf, "radian", "", "two\nlines", "\0", "\ud800",
    b"\xff", (), [1, 2], ["a"], [[1], [1, 2]], {"a": 1}, np.arange(3), np.array("x"),
    np.float32(0.1), np.bool_(True), np.datetime64("2020-01-01"), 1j, object(), print,
    np.array([None]), "not JSON", "[1]", "{", "[" * 5000,
]  # fmt: skip
ODD_JSON = [
    None, True, -1, 10**30, 0.5, math.nan, math.inf, "", "two\nlines", "<b>", [], [1], ["a", None],
    [[1, 2]], {}, {"a": 1}, {"": [None]},
]  # fmt: skip
ODD_TYPES = ["U3", "S3", "object", "complex64", "bool", "M8[ns]", "m8[ns]", "int8", "uint64"]
ODD_TYPES += ["float16", "float32", "longdouble"]


def pick(random, options):
    return options[random.integers(len(options))]


def any_variable(capture, random):
    return pick(random, list(capture.variables))


# --- mutations of a capture: each takes a dataset and gives another ---------------------------


def drop(capture, random):
    return capture.drop_vars(any_variable(capture, random))


def rename(capture, random):
    return capture.rename({any_variable(capture, random): pick(random, ODD_NAMES)})


def add(capture, random):
    return capture.assign({pick(random, ODD_NAMES): capture[any_variable(capture, random)]})


def swap(capture, random):
    one, other = any_variable(capture, random), any_variable(capture, random)
    return capture.assign({one: capture[other], other: capture[one]})


def retype(capture, random):
    name = any_variable(capture, random)
    values = np.asarray(capture[name].values)
    return capture.assign({name: (capture[name].dims, values.astype(pick(random, ODD_TYPES)))})


def renumber(capture, random):
    name = any_variable(capture, random)
    values = np.array(capture[name].values, dtype=np.float64)
    values.ravel()[random.integers(values.size)] = pick(random, ODD_NUMBERS)
    return capture.assign({name: (capture[name].dims, values)})


def fill(capture, random):
    name = any_variable(capture, random)
    return capture.assign({name: xr.full_like(capture[name], pick(random, ODD_NUMBERS), float)})


def transpose(capture, random):
    return capture.transpose(*random.permutation(list(capture.sizes)))


def rename_dim(capture, random):
    dim = pick(random, list(capture.sizes))
    return capture.swap_dims(
        {dim: pick(random, ["x", "y", "view", "patch", "angle", "<b>", "wavelength"])}
    )


def select(capture, random):
    dim = pick(random, list(capture.sizes))
    return capture.isel({dim: pick(random, [0, slice(0), slice(1), [0, 0], slice(None, None, -1)])})


def widen(capture, random):
    name = any_variable(capture, random)
    return capture.assign({name: capture[name].expand_dims({pick(random, ["patch", "t", "y"]): 2})})


def annotate(capture, random):
    capture = capture.copy()
    owner = capture if random.random() < 0.3 else capture[any_variable(capture, random)]
    names = ["units", "saturation_level", "name", "long_name", *owner.attrs, *ODD_NAMES]
    owner.attrs[pick(random, names)] = pick(random, ODD_ATTRIBUTES)
    return capture


def label(capture, random):
    dim = pick(random, list(capture.sizes))
    values = [pick(random, [*ODD_NUMBERS, *ODD_NAMES]) for _ in range(capture.sizes[dim])]
    cells = np.empty(len(values), dtype=object)
    cells[:] = values
    kind = pick(random, [object, str])
    return capture.assign_coords(
        {dim: (dim, np.array([str(v) for v in values]) if kind is str else cells)}
    )


MUTATIONS = (
    drop, rename, add, swap, retype, renumber, renumber, fill, transpose, rename_dim, select, widen,
    annotate, annotate, label,
)  # fmt: skip


def mutate(capture, random):
    """Make one to three mutations; those that xarray itself refuses are left out."""
    return _mutated(capture, random, MUTATIONS, random.integers(1, 4))


def _mutated(data, random, mutations, count):
    for _ in range(count):
        try:
            data = pick(random, mutations)(data, random)
        except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError):
            continue
    return data


# --- mutations of a result: each takes a tree and gives another -------------------------------


def narrow(group, random):
    name = any_variable(group, random)
    return group.assign({name: group[name].isel({pick(random, group[name].dims): 0}, drop=True)})


GROUP_MUTATIONS = (
    drop, rename, add, swap, retype, renumber, fill, rename_dim, select, widen, label, narrow,
    narrow,
)  # fmt: skip
"""Those of captures that a reader of results notices: not the order of dims, nor attributes."""


def edit_group(tree, random):
    name = pick(random, sorted(tree.children))
    changed = pick(random, GROUP_MUTATIONS)(tree[name].to_dataset(), random)
    return tree.assign({name: xr.DataTree(changed)})


def drop_group(tree, random):
    name = pick(random, sorted(tree.children))
    return tree.filter(lambda node: node.name != name)


def swap_groups(tree, random):
    one, other = (pick(random, sorted(tree.children)) for _ in range(2))
    return tree.assign({one: xr.DataTree(tree[other].to_dataset())})


def edit_provenance(tree, random):
    whole = place = json.loads(tree.attrs["polar_bayes"])
    while True:
        key = pick(random, sorted(place) if isinstance(place, dict) else range(len(place)))
        inner = place[key]
        if not isinstance(inner, dict | list) or not inner or random.random() < 0.5:
            break
        place = inner
    if random.random() < 0.3:
        del place[key]
    else:
        place[key] = pick(random, ODD_JSON)
    return tree.copy().assign_attrs(polar_bayes=json.dumps(whole))


def annotate_tree(tree, random):
    return tree.copy().assign_attrs(polar_bayes=pick(random, ODD_ATTRIBUTES))


TREE_MUTATIONS = (
    edit_provenance, edit_provenance, edit_provenance, annotate_tree, drop_group, swap_groups,
    *(edit_group,) * 8,
)  # fmt: skip


def mutate_tree(tree, random):
    """Make one or two mutations of a result; those that xarray itself refuses are left out."""
    return _mutated(tree, random, TREE_MUTATIONS, random.integers(1, 3))


def assert_inside_contract(capture):
    """The contract once more, in other words than the schema's."""
    dims = next(capture[name].dims for name in ("dop", "q", "intensity") if name in capture)
    seen = capture["valid"].values if "valid" in capture else ...
    for name in ("view_zenith", "light_zenith"):
        assert ((capture[name] >= 0.0) & (capture[name] < 90.0)).all()
    for name in ("view_azimuth", "light_azimuth"):
        assert (abs(capture[name]) <= 360.0).all()
    bounds = {"dop": (0.0, 1.0), "q": (-1.0, 1.0), "u": (-1.0, 1.0), "intensity": (0.0, 1e30)}
    for name, (low, high) in bounds.items():
        if name in capture:
            assert capture[name].dims == dims
            values = capture[name].values[seen]
            assert ((values >= low) & (values <= high)).all()
        if f"{name}_error" in capture:
            assert (capture[f"{name}_error"].values[seen] > 0.0).all()
    for variable in capture.variables.values():
        assert isinstance(variable.attrs["units"], str)
        assert isinstance(variable.attrs["long_name"], str)
        assert all(type(value) in (str, int, float) for value in variable.attrs.values())
    assert all(type(value) in (str, int, float) for value in capture.attrs.values())
    with_counter = count(capture)
    assert 0 <= with_counter["masked"] < with_counter["views"]


# --- damaged tables ---------------------------------------------------------------------------

PIECES = [
    "nan", "inf", "1e999", "-1e999", "1e-999", "0x1", "1_0", "1,5", "1.5.2", "--1", "", "x", "\0",
    "\n", "\r", "\t", ";", ",", " ", "#", '"', "\N{SNOWMAN}", "\x85", "\u2028", "<script>",
    "9" * 400, "e", "E5", ".", "__import__('os').system('true')",
]  # fmt: skip


def table_text(random):
    """A good table in one of the forms that are read."""
    separator = pick(random, ["\t", ",", ";", " ", "\t\t", ", "])
    comma = separator in "\t; " and random.random() < 0.3
    rows = [["angle", "s", "p"]] if random.random() < 0.5 else []
    for angle in range(20, 80, 10):
        rows.append([str(angle), *(f"{value:.2f}" for value in random.uniform(1.0, 90.0, 2))])
    text = pick(random, ["\n", "\r\n"]).join(separator.join(row) for row in rows)
    return text.replace(".", ",") if comma else text


def damage_text(text, random):
    content = bytearray(text, "utf-8")
    for _ in range(random.integers(0, 4)):
        place = int(random.integers(len(content) + 1))
        match random.integers(4):
            case 0:
                content[place:place] = pick(random, PIECES).encode()
            case 1:
                del content[place : place + int(random.integers(1, 9))]
            case 2:
                content = content[: max(place, 1)]
            case 3 if place < len(content):
                content[place] ^= 1 << int(random.integers(8))
    return bytes(content)
