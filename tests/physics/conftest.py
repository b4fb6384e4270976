"""Reference tables, read once."""

from pathlib import Path

import numpy as np
import pytest

REFERENCE = Path(__file__).parents[1] / "reference"


def read(name: str) -> np.ndarray:
    return np.loadtxt(REFERENCE / name, delimiter=",", skiprows=1)


@pytest.fixture(scope="session")
def fresnel_curves() -> np.ndarray:
    return read("fresnel_smooth_curves.csv")


@pytest.fixture(scope="session")
def plastic() -> np.ndarray:
    return np.load(REFERENCE / "pplastic.npz")["data"]


@pytest.fixture(scope="session")
def uniform_sky() -> np.ndarray:
    return read("mitsuba_uniform_sky.csv")


@pytest.fixture(scope="session")
def disc_source() -> np.ndarray:
    return read("mitsuba_disc_source.csv")


@pytest.fixture(scope="session")
def half_space() -> np.ndarray:
    return read("iad_semiinfinite_albedo.csv")


@pytest.fixture(scope="session")
def height_field_exit() -> np.ndarray:
    return read("eradiate_heightfield_exit.csv")


@pytest.fixture(scope="session")
def height_field_sky() -> np.ndarray:
    return read("eradiate_heightfield_uniform.csv")


@pytest.fixture(scope="session")
def thick_coats() -> np.ndarray:
    return read("coat_incoherent_inc_tmm.csv")


@pytest.fixture(scope="session")
def thin_films() -> np.ndarray:
    return read("thinfilm_coherent_tmm.csv")


@pytest.fixture(scope="session")
def transmittances() -> np.ndarray:
    return read("smith_walk_transmittance.csv")
