"""Parameters of scenes as readers see them: symbol, meaning, unit."""

from typing import NamedTuple


class Quantity(NamedTuple):
    """How a parameter is written.

    Args:
        symbol: The paper's or the field's letter; empty where there is none.
        meaning: In words.
        unit: As xarray and ArviZ show it.
    """

    symbol: str
    meaning: str
    unit: str = "1"


NOTATION: dict[str, Quantity] = {
    "roughness": Quantity("r", "roughness"),
    "subsurface_fraction": Quantity("beta", "subsurface fraction"),
    "absorption": Quantity("a", "absorption relative to scattering"),
    "refractive_index": Quantity("n", "refractive index"),
    "roughness_across": Quantity("", "roughness across the direction of `roughness`"),
    "roughness_azimuth": Quantity("", "azimuth along which `roughness` is meant", "degree"),
    "albedo": Quantity("A", "albedo of the body"),
    "polarized_fraction": Quantity("", "share of scattering that polarizes"),
    "cauchy_a": Quantity("A", "Cauchy's A"),
    "cauchy_b": Quantity("B", "Cauchy's B", "micrometer^2"),
    "sellmeier_strength": Quantity("B", "Sellmeier's strength"),
    "sellmeier_resonance": Quantity("C", "Sellmeier's squared resonance", "micrometer^2"),
    "coat_refractive_index": Quantity("", "refractive index of the coat"),
    "coat_absorbance": Quantity("", "absorbance of the coat at normal incidence"),
    "film_refractive_index": Quantity("", "refractive index of the film"),
    "film_thickness": Quantity("", "thickness of the film", "nm"),
    "refractive_index_level": Quantity("", "level of n over wavelength"),
    "refractive_index_amplitude": Quantity("", "departure of n from its level"),
    "refractive_index_length": Quantity("", "length over which n changes", "nm"),
    "absorption_level": Quantity("", "level of a over wavelength"),
    "absorption_amplitude": Quantity("", "departure of log a from its level"),
    "absorption_length": Quantity("", "length over which a changes", "nm"),
    "normal_tilt_x": Quantity("", "lean of the normal towards azimuth 0", "degree"),
    "normal_tilt_y": Quantity("", "lean of the normal towards azimuth 90", "degree"),
    "angle_zero": Quantity("", "offset of both zenith angles", "degree"),
    "beam_overlap_zenith": Quantity("", "zenith where the beam fills the sample", "degree"),
}


POPULATION = {
    "_location": "population median of",
    "_spread": "population spread of",
}


def notation(name: str) -> Quantity:
    """The row of a parameter, or of its population, or one made of its name."""
    for ending, words in POPULATION.items():
        if name.endswith(ending) and name.removesuffix(ending) in NOTATION:
            _, meaning, unit = NOTATION[name.removesuffix(ending)]
            return Quantity("", f"{words} {meaning}", unit if ending == "_location" else "1")
    return NOTATION.get(name, Quantity("", name.replace("_", " ")))
