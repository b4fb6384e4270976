"""Random damage to trees of results: every part may be missing, of another type, shape or value."""

import json
import math

import numpy as np
import xarray as xr

ODD_JSON = [
    None, True, -1, 10**30, 0.5, math.nan, math.inf, "", "two\nlines", "<b>", [], [1], ["a", None],
    [[1, 2]], {}, {"a": 1}, {"": [None]},
]  # fmt: skip
ODD_ATTRIBUTES = ["", "not JSON", "[1]", "{", "[" * 5000, 3, math.nan, np.arange(3), b"\xff", None]
ODD_NUMBERS = [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-300, 1e300, 1e19]
ODD_TYPES = ["U3", "object", "complex64", "M8[ns]", "bool", "int8", "float32", "float64"]
ODD_NAMES = ["posterior", "roughness", "view", "wavelength", "x", "dop", "<b>", "a\nb", "fits"]


def pick(random, options):
    """One of several."""
    return options[random.integers(len(options))]


def _edit(tree, group, change):
    """Replace the dataset of one group; what xarray itself refuses is no mutation."""
    tree[group] = xr.DataTree(change(tree[group].to_dataset()))


def _variable(dataset, random):
    return pick(random, sorted(map(str, dataset.variables)))


def _provenance(tree, random):
    said = json.loads(tree.attrs["polar_bayes"])
    place = said
    while True:
        keys = sorted(place) if isinstance(place, dict) else range(len(place))
        key = pick(random, list(keys))
        inner = place[key]
        if not isinstance(inner, dict | list) or not inner or random.random() < 0.5:
            break
        place = inner
    if random.random() < 0.3:
        del place[key]
    else:
        place[key] = pick(random, ODD_JSON)
    tree.attrs["polar_bayes"] = json.dumps(said)


def _attribute(tree, random):
    if random.random() < 0.4:
        tree.attrs["polar_bayes"] = pick(random, ODD_ATTRIBUTES)
        return
    node = tree[pick(random, sorted(tree.children))]
    owner = node if random.random() < 0.3 else node[_variable(node.to_dataset(), random)]
    names = ["units", "long_name", "symbol", "saturation_level", "flag_meanings", *owner.attrs]
    owner.attrs[pick(random, names)] = pick(random, ODD_ATTRIBUTES)


def _drop_group(tree, random):
    del tree[pick(random, sorted(tree.children))]


def _swap_groups(tree, random):
    one, other = (pick(random, sorted(tree.children)) for _ in range(2))
    tree[one] = xr.DataTree(tree[other].to_dataset())


def _drop(tree, random):
    _edit(tree, pick(random, sorted(tree.children)), lambda x: x.drop_vars(_variable(x, random)))


def _rename(tree, random):
    new = pick(random, ODD_NAMES)
    _edit(
        tree, pick(random, sorted(tree.children)), lambda x: x.rename({_variable(x, random): new})
    )


def _retype(tree, random):
    kind = pick(random, ODD_TYPES)

    def change(dataset):
        name = _variable(dataset, random)
        values = np.asarray(dataset[name].values).astype(kind)
        return dataset.assign({name: (dataset[name].dims, values, dataset[name].attrs)})

    _edit(tree, pick(random, sorted(tree.children)), change)


def _renumber(tree, random):
    whole, number = random.random() < 0.5, pick(random, ODD_NUMBERS)

    def change(dataset):
        name = _variable(dataset, random)
        values = np.array(dataset[name].values, float)
        values.ravel()[... if whole else random.integers(values.size)] = number
        return dataset.assign({name: (dataset[name].dims, values, dataset[name].attrs)})

    _edit(tree, pick(random, sorted(tree.children)), change)


def _dims(tree, random):
    def change(dataset):
        dim = pick(random, sorted(map(str, dataset.dims)))
        match random.integers(6):
            case 0:
                return dataset.rename({dim: pick(random, ODD_NAMES)})
            case 1:
                return dataset.isel({dim: pick(random, [0, slice(0), slice(1), [0, 0]])})
            case 2:
                return dataset.transpose(*random.permutation(list(dataset.dims)))
            case 3:
                name = _variable(dataset, random)
                return dataset.assign({name: dataset[name].expand_dims({"t": 2})})
            case 4:
                name = _variable(dataset, random)
                own = pick(random, [*dataset[name].dims])
                return dataset.assign({name: dataset[name].isel({own: 0}, drop=True)})
            case _:
                labels = pick(random, [["a"], [math.nan], [0.0], [None], [2], [-1.5], [10**19]])
                cells = np.empty(dataset.sizes[dim], object)
                cells[:] = labels * dataset.sizes[dim]
                kept = cells if random.random() < 0.3 else np.array(cells.tolist())
                return dataset.assign_coords({dim: (dim, kept)})

    _edit(tree, pick(random, sorted(tree.children)), change)


MUTATIONS = (
    _provenance, _provenance, _provenance, _attribute, _drop_group, _swap_groups, _drop, _rename,
    _retype, _retype, _renumber, _dims, _dims,
)  # fmt: skip


def mutate(tree, random):
    """A copy with one or two mutations; those that xarray itself refuses are left out."""
    for _ in range(random.integers(1, 3)):
        changed = tree.copy(deep=True)
        try:
            pick(random, MUTATIONS)(changed, random)
        except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError):
            continue
        tree = changed
    return tree
