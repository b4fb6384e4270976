"""Methods by name; each name is one algorithm with one set of defaults in every verb.

The table loads no method, and no JAX.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType


@dataclasses.dataclass(frozen=True)
class MethodEntry:
    """Properties of a method that are known before it is loaded.

    Args:
        settings: Its class in `polar_bayes.methods`, whose default values are those of the name.
        label: What reports call the method.
        subject: What headlines call the thing that it computes.
        fits_one: Whether it fits one capture.
        fits_many: Whether it gives draws of each of many captures, in maps and calibrations.
    """

    settings: str
    label: str
    subject: str
    fits_one: bool = True
    fits_many: bool = True


METHODS: Mapping[str, MethodEntry] = MappingProxyType(
    {
        "point": MethodEntry("Point", "least squares", "Least squares", fits_many=False),
        "laplace": MethodEntry("Laplace", "Laplace approximation", "The approximation"),
        "importance": MethodEntry(
            "Importance", "importance sampling from mixtures at all modes", "The weighted draws"
        ),
        "nuts": MethodEntry("Nuts", "NUTS", "The fit"),
        "auto": MethodEntry(
            "Auto", "the cheapest method that its own diagnostics accept", "The fit"
        ),
        "corrected-laplace": MethodEntry(
            "CorrectedLaplace",
            "Laplace approximation, checked and corrected by importance weights",
            "The approximation",
            fits_one=False,
        ),
    }
)

FIT_DEFAULT, MAP_DEFAULT = "auto", "corrected-laplace"


def method_names(*, one: bool = False, many: bool = False) -> tuple[str, ...]:
    """Return the names of methods with certain abilities."""
    return tuple(
        name for name, entry in METHODS.items() if entry.fits_one >= one and entry.fits_many >= many
    )
