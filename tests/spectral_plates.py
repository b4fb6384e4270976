"""Captures of a smooth plate in several colors, and tabulated indices of real materials."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from plates import at_mirror
from textbook import plate_q

FRACTION = 0.02
VIEWS = np.linspace(30.0, 78.0, 12)

TABLE = Path(__file__).parent / "reference" / "refractive_index_dielectrics.csv"


def tabulated() -> dict[str, dict[float, float]]:
    """Index by material and wavelength (nm)."""
    with TABLE.open() as file:
        return {
            row["material"]: {float(key[1:]): float(row[key]) for key in row if key[1:].isdigit()}
            for row in csv.DictReader(file)
        }


def spectral_plate(index, *, error, seed, views=VIEWS):
    """A plate with normal errors of q in every color.

    Args:
        index: Index by wavelength (nm), or wavelengths and indices (these may repeat).
        error: Standard error of every reading.
        seed: Of the errors.
        views: Zeniths of viewer and light, degree.
    """
    if isinstance(index, Mapping):
        index = (np.array(list(index)), np.array(list(index.values())))
    wavelengths, values = (np.asarray(part, float) for part in index)
    q = plate_q(values[:, None], FRACTION, np.radians(views))
    noise = np.random.default_rng(seed).normal(0.0, error, q.shape)
    found = at_mirror(
        views,
        q=(("view", "wavelength"), np.clip(q + noise, -1.0, 1.0).T),
        q_error=(("view", "wavelength"), np.full(q.T.shape, error)),
    )
    return found.assign_coords(wavelength=wavelengths).assign_attrs(name="plate")
