"""Materials to simulate: plausible values, not measurements.

Refractive indices at 450, 550 and 650 nm follow published dispersion (water, BK7 glass and PMMA
to 0.002); a leaf absorbs blue and red and leaves green, a ripe fruit leaves red.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from polar_bayes.errors import CaptureError

REFERENCE_WAVELENGTHS = (450.0, 550.0, 650.0)


@dataclasses.dataclass(frozen=True)
class Material:
    """The truth about one material.

    Args:
        roughness: Microfacet roughness, unit 1.
        subsurface_fraction: Share of the subsurface, unit 1, range [0, 1].
        absorption: Absorption relative to scattering at the reference wavelengths, unit 1.
        refractive_index: At the reference wavelengths, unit 1.
    """

    roughness: float
    subsurface_fraction: float
    absorption: tuple[float, float, float]
    refractive_index: tuple[float, float, float]

    def at(self, wavelengths: np.ndarray) -> dict[str, np.ndarray]:
        """The parameters at any wavelengths, interpolated; the ends continue unchanged.

        Args:
            wavelengths: (wavelength,), unit nm.

        Returns:
            Scalars for what color does not change, (wavelength,) for the rest.
        """

        def spectral(values: tuple[float, ...]) -> np.ndarray:
            return np.interp(wavelengths, REFERENCE_WAVELENGTHS, values)

        return {
            "roughness": np.asarray(self.roughness),
            "subsurface_fraction": np.asarray(self.subsurface_fraction),
            "absorption": spectral(self.absorption),
            "refractive_index": spectral(self.refractive_index),
        }


PRESETS: Mapping[str, Material] = MappingProxyType(
    {
        "leaf": Material(0.20, 0.45, (1.20, 0.25, 0.90), (1.448, 1.440, 1.435)),
        "fruit": Material(0.12, 0.40, (1.00, 0.60, 0.15), (1.418, 1.410, 1.405)),
        "plastic": Material(0.10, 0.30, (0.30, 0.30, 0.30), (1.501, 1.494, 1.490)),
        "coating": Material(0.06, 0.20, (0.60, 0.50, 0.45), (1.524, 1.515, 1.510)),
        "glass": Material(0.03, 0.05, (0.20, 0.20, 0.20), (1.525, 1.519, 1.515)),
        "water": Material(0.05, 0.15, (0.15, 0.20, 0.60), (1.338, 1.334, 1.331)),
    }
)


def find_preset(name: str) -> Material:
    """The material of that name."""
    if not isinstance(name, str) or name not in PRESETS:
        raise CaptureError(
            "no such material", where=f"preset={name!r}", mend=f"give one of {', '.join(PRESETS)}"
        )
    return PRESETS[name]
