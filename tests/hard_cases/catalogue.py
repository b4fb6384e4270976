"""Where the optics goes wrong if nobody takes care, as data.

Every direction meets every material. A zenith of 90 degrees is outside the contract of a capture.
"""

import itertools
from typing import NamedTuple

import numpy as np

# view zenith, light zenith, azimuth of the light against the viewer's; degrees
DIRECTIONS = {
    "both on the normal": (0.0, 0.0, 180.0),
    "viewer on the normal": (0.0, 30.0, 180.0),
    "light on the normal": (30.0, 0.0, 180.0),
    "a hair off the normal": (1e-8, 1e-8, 180.0),
    "nearly on the normal": (1e-3, 2e-3, 180.0),
    "mirror direction": (45.0, 45.0, 180.0),
    "Brewster's angle for 1.5": (56.309932474020215, 56.309932474020215, 180.0),
    "light behind the viewer": (45.0, 45.0, 0.0),
    "nearly behind the viewer": (45.0, 45.0 + 1e-6, 1e-6),
    "out of the plane": (40.0, 60.0, 90.0),
    "facet at 45 degrees to the plane": (30.0, 49.106605350869096, 90.0),
    "azimuth the other way round": (60.0, 60.0, -180.0),
    "azimuth past a full turn": (50.0, 60.0, 530.0),
    "far from the mirror direction": (80.0, 10.0, 30.0),
    "mirror direction, grazing": (89.0, 89.0, 180.0),
    "mirror direction, beyond any instrument": (89.9, 89.9, 180.0),
    "light grazing from the side": (20.0, 89.9, 135.0),
    "viewer grazing, light high": (89.9, 5.0, 180.0),
    "both grazing, same side": (89.9, 89.8, 1.0),
    "close to 90": (89.999, 89.999, 180.0),
    "viewer alone close to 90": (89.999, 45.0, 170.0),
}

# Directions beyond 89.999 degrees, which single precision counts as 89.999.
UNRESOLVED = {
    "last number before 90 in single precision": (89.99999237, 89.99999237, 180.0),
    "a hair before 90": (89.9999999, 89.9999999, 180.0),
    "viewer a hair before 90": (89.9999999, 45.0, 170.0),
}


class Material(NamedTuple):
    """Material parameters, in the order of the scenes."""

    roughness: float
    subsurface_fraction: float
    absorption: float
    refractive_index: float


MATERIALS = {
    "ordinary": Material(0.1, 0.4, 0.3, 1.5),
    "no index step": Material(0.1, 0.4, 0.3, 1.0),
    "hardly an index step": Material(0.1, 0.4, 0.3, 1.0 + 1e-6),
    "small index step": Material(0.2, 0.4, 0.3, 1.001),
    "lowest index of the prior": Material(0.1, 0.4, 0.3, 1.2),
    "highest index of the prior": Material(0.1, 0.4, 0.3, 2.0),
    "diamond": Material(0.1, 0.4, 0.3, 2.42),
    "perfectly smooth": Material(0.0, 0.4, 0.3, 1.5),
    "perfectly smooth, surface alone": Material(0.0, 0.0, 0.3, 1.5),
    "at the floor of roughness": Material(1e-5, 0.4, 0.3, 1.5),
    "nearly smooth": Material(1e-3, 0.4, 0.3, 1.5),
    "slightly rough": Material(0.02, 0.4, 0.3, 1.5),
    "rough": Material(0.5, 0.4, 0.3, 1.5),
    "rougher than one": Material(1.7, 0.4, 0.3, 1.5),
    "surface alone": Material(0.1, 0.0, 0.3, 1.5),
    "surface alone, smoothish": Material(0.02, 0.0, 0.3, 1.5),
    "hardly any body": Material(0.02, 1e-12, 0.3, 1.5),
    "body alone": Material(0.1, 1.0, 0.3, 1.5),
    "body alone, smooth": Material(0.0, 1.0, 0.3, 1.5),
    "hardly any surface": Material(0.1, 1.0 - 1e-7, 0.3, 1.5),
    "no absorption": Material(0.1, 0.4, 0.0, 1.5),
    "absorption at its floor": Material(0.1, 0.4, 1e-4, 1.5),
    "strong absorption": Material(0.1, 0.4, 20.0, 1.5),
    "black": Material(0.1, 0.4, 1e6, 1.5),
    "everything at once": Material(0.0, 0.0, 0.0, 1.0),
}

# Instrument parameters: a perfect instrument, an ordinary one, and one far from perfect.
INSTRUMENTS = {
    "perfect": {
        "dolp_gain": 1.0,
        "channel_gain_ratio": 1.0,
        "leakage": 0.0,
        "dark_level": 0.0,
        "angle_zero": 0.0,
        "discrepancy_amplitude": 0.0,
        "discrepancy_weights": np.zeros(3),
    },
    "ordinary": {
        "dolp_gain": 0.9,
        "channel_gain_ratio": 1.1,
        "leakage": 0.02,
        "dark_level": 1e-3,
        "angle_zero": 0.2,
        "discrepancy_amplitude": 0.1,
        "discrepancy_weights": np.array([1.0, -0.5, 1.2]),
    },
    "hopeless": {
        "dolp_gain": 0.0,
        "channel_gain_ratio": 20.0,
        "leakage": 1.0,
        "dark_level": 10.0,
        "angle_zero": -3.0,
        "discrepancy_amplitude": 5.0,
        "discrepancy_weights": np.array([3.0, -3.0, 3.0]),
    },
}

# Parameters of all other effects, in ordinary states and where they go wrong. A name and a factor
# in place of a number mean so many times that parameter. Color is that of 550 nm.
WAVELENGTH = 550.0
ORDINARY: dict[str, float] = {
    "roughness_across": 0.3,
    "roughness_azimuth": 25.0,
    "albedo": 0.7,
    "polarized_fraction": 0.5,
    "coat_refractive_index": 1.45,
    "coat_absorbance": 0.2,
    "film_refractive_index": 1.38,
    "film_thickness": 230.0,
    "back_face_share": 0.7,
    "cauchy_a": 1.45,
    "cauchy_b": 0.005,
    "sellmeier_strength": 1.2,
    "sellmeier_resonance": 0.011,
    "light_degree": 0.6,
    "light_angle": 30.0,
    "beam_overlap_zenith": 80.0,
    "normal_tilt_x": 0.0,
    "normal_tilt_y": 0.0,
}
EFFECTS: dict[str, dict[str, float | tuple[str, float]]] = {
    "ordinary": {},
    "coat like the body": {"coat_refractive_index": ("refractive_index", 1.0)},
    "clear coat like the body": {
        "coat_refractive_index": ("refractive_index", 1.0),
        "coat_absorbance": 0.0,
    },
    "coat like air": {"coat_refractive_index": 1.0, "coat_absorbance": 0.0},
    "dense coat": {"coat_refractive_index": 2.4},
    "clear coat": {"coat_absorbance": 0.0},
    "black coat": {"coat_absorbance": 50.0},
    "no film": {"film_thickness": 0.0},
    "thick film": {"film_thickness": 1e4},
    "half-wave film": {"film_thickness": WAVELENGTH / (2.0 * 1.38)},
    "quarter-wave film without a reflection": {
        "film_refractive_index": 1.5**0.5,
        "film_thickness": WAVELENGTH / (4.0 * 1.5**0.5),
    },
    "film like the body": {"film_refractive_index": ("refractive_index", 1.0)},
    "film and coat like air": {
        "film_refractive_index": 1.0,
        "coat_refractive_index": 1.0,
        "coat_absorbance": 0.0,
    },
    "no light from the back": {"back_face_share": 0.0},
    "all light from the back": {"back_face_share": 1.0},
    "grooves as rough as their walls": {"roughness_across": ("roughness", 1.0)},
    "grooves a thousand times as steep as long": {"roughness_across": ("roughness", 1e3)},
    "grooves a thousandth as steep as long": {"roughness_across": ("roughness", 1e-3)},
    "grooves towards the viewer": {"roughness_azimuth": 0.0},
    "grooves across the viewer": {"roughness_azimuth": 90.0},
    "unpolarized beam": {"light_degree": 0.0},
    "s beam": {"light_degree": 1.0, "light_angle": 0.0},
    "p beam": {"light_degree": 1.0, "light_angle": 90.0},
    "diagonal beam": {"light_degree": 1.0, "light_angle": -45.0},
    "white, polarizing body": {"albedo": 1.0, "polarized_fraction": 1.0},
    "black, depolarizing body under absorbing air": {
        "albedo": 0.0,
        "polarized_fraction": 0.0,
        "coat_refractive_index": 1.0,
    },
    "leaning normal": {"normal_tilt_x": 3.0, "normal_tilt_y": -2.0},
    "normal a hair off": {"normal_tilt_x": 1e-9, "normal_tilt_y": -1e-9},
    "normal leaning to viewers at 30 degrees": {"normal_tilt_x": 30.0},
    "normal leaning to viewers at 45 degrees": {"normal_tilt_x": 45.0},
    "normal leaning beyond grazing light": {"normal_tilt_x": -30.0, "normal_tilt_y": 20.0},
    "normal lying on its side": {"normal_tilt_x": -90.0, "normal_tilt_y": 180.0},
    "colorless body like air": {"cauchy_a": 1.0, "cauchy_b": 0.0, "sellmeier_strength": 0.0},
}


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
                name: values[value[0]] * value[1] if isinstance(value, tuple) else value
                for name, value in values.items()
            }
            name = f"{direction} / {material} / {effect}"
            rows.append((name, directions[direction], values))
    rows = [rows[i % len(rows)] for i in range(max(count, len(rows)))]
    names, angles, values = zip(*rows, strict=True)
    parameters = {name: np.array([one[name] for one in values], dtype) for name in values[0]}
    return EffectCases(list(names), np.array(angles, dtype), parameters)


# Lowest and highest value of parameters drawn at random; True: uniform in the logarithm. A third
# of the draws take an end or a state of the catalogue.
SPANS: dict[str, tuple[float, float, bool]] = {
    "roughness": (1e-5, 10.0, True),
    "roughness_across": (1e-5, 10.0, True),
    "subsurface_fraction": (0.0, 1.0, False),
    "absorption": (1e-4, 1e6, True),
    "refractive_index": (1.0, 3.0, False),
    "roughness_azimuth": (-180.0, 180.0, False),
    "albedo": (0.0, 1.0, False),
    "polarized_fraction": (0.0, 1.0, False),
    "coat_refractive_index": (1.0, 3.0, False),
    "coat_absorbance": (1e-4, 100.0, True),
    "film_refractive_index": (1.0, 3.0, False),
    "film_thickness": (1.0, 1e4, True),
    "back_face_share": (0.0, 1.0, False),
    "cauchy_a": (1.0, 2.0, False),
    "cauchy_b": (0.0, 0.02, False),
    "sellmeier_strength": (0.0, 2.0, False),
    "sellmeier_resonance": (0.0, 0.02, False),
    "light_degree": (0.0, 1.0, False),
    "light_angle": (-180.0, 180.0, False),
    "beam_overlap_zenith": (45.0, 89.9, False),
    "normal_tilt_x": (-5.0, 5.0, False),
    "normal_tilt_y": (-5.0, 5.0, False),
}


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
