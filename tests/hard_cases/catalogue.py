"""Where the optics goes wrong if nobody takes care: the states of `catalogue.toml` as arrays."""

import itertools
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Material(NamedTuple):
    """Material parameters, in the order of the scenes."""

    roughness: float
    subsurface_fraction: float
    absorption: float
    refractive_index: float


WAVELENGTH = 550.0
_STATES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
DIRECTIONS, UNRESOLVED, ORDINARY = (
    _STATES[name] for name in ("directions", "unresolved", "ordinary")
)
MATERIALS = {name: Material(*state) for name, state in _STATES["materials"].items()}
INSTRUMENTS = {
    name: {key: np.array(x) if isinstance(x, list) else x for key, x in state.items()}
    for name, state in _STATES["instruments"].items()
}
EFFECTS: dict[str, dict[str, float | list]] = _STATES["effects"]
SPANS: dict[str, tuple[float, float, bool]] = _STATES["spans"]


class Cases(NamedTuple):
    """Named cases with their directions (case, 3) and materials (case, 4)."""

    names: list[str]
    directions: np.ndarray
    materials: np.ndarray


def every_case(dtype: type, *, exact: bool = False) -> Cases:
    """Every direction with every material, in one precision; `exact`: as they were given."""
    directions = DIRECTIONS | ({} if exact and dtype == np.float32 else UNRESOLVED)
    pairs = [
        (f"{direction} / {material}", directions[direction], MATERIALS[material])
        for direction, material in itertools.product(directions, MATERIALS)
    ]
    names, angles, materials = zip(*pairs, strict=True)
    return Cases(list(names), np.array(angles, dtype), np.array(materials, dtype))


class EffectCases(NamedTuple):
    """Named cases with their directions (case, 3) and all their parameters, each (case,)."""

    names: list[str]
    directions: np.ndarray
    parameters: dict[str, np.ndarray]


def every_effect(dtype: type, count: int) -> EffectCases:
    """Every direction with every effect, on the ordinary material and on two more by turns.

    The cases are repeated up to a count: operations of one shape compile once.
    """
    directions = DIRECTIONS | UNRESOLVED
    others = [name for name in MATERIALS if name != "ordinary"]
    rows = []
    for turn, (direction, effect) in enumerate(itertools.product(directions, EFFECTS)):
        # Steps without a common factor: each direction and each effect meets every material.
        for material in ("ordinary", *(others[(turn * step) % len(others)] for step in (5, 7))):
            values = ORDINARY | EFFECTS[effect] | MATERIALS[material]._asdict()
            values = {
                name: values[value[0]] * value[1] if isinstance(value, list) else value
                for name, value in values.items()
            }
            name = f"{direction} / {material} / {effect}"
            rows.append((name, directions[direction], values))
    rows = [rows[i % len(rows)] for i in range(max(count, len(rows)))]
    names, angles, values = zip(*rows, strict=True)
    parameters = {name: np.array([one[name] for one in values], dtype) for name in values[0]}
    return EffectCases(list(names), np.array(angles, dtype), parameters)


def random_directions(count: int, generator: np.random.Generator) -> np.ndarray:
    """Half of them grazing, down to 1e-5 degrees; four in ten in or near the mirror direction."""

    def zeniths() -> np.ndarray:
        grazing = 90.0 - 10.0 ** generator.uniform(-5.0, 1.0, count)
        return np.where(generator.random(count) < 0.5, grazing, generator.uniform(0, 90.0, count))

    view, light = zeniths(), zeniths()
    kind = generator.random(count)
    near = np.abs(view - 10.0 ** generator.uniform(-6.0, 0.0, count))
    light = np.where(kind < 0.3, view, np.where(kind < 0.4, near, light))
    turn = generator.uniform(-180.0, 360.0, count)
    return np.stack([view, light, np.where(generator.random(count) < 0.6, 180.0, turn)], axis=1)


def random_parameter(name: str, count: int, generator: np.random.Generator) -> np.ndarray:
    """Values of one parameter all over its span, its ends and its states of the catalogue."""
    low, high, logarithmic = SPANS[name]
    share = generator.random(count)
    drawn = low * (high / low) ** share if logarithmic else low + (high - low) * share
    states = [getattr(m, name) for m in MATERIALS.values()] if name in Material._fields else []
    states += [e[name] for e in EFFECTS.values() if isinstance(e.get(name), float)]
    special = generator.choice(np.array([low, high, *states]), count)
    return np.where(generator.random(count) < 1 / 3, special, drawn)
