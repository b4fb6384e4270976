"""A small plate with two faults of its instrument, weighed once for all tests."""

import numpy as np
import pytest
import xarray as xr
from plates import LINKS, plate_capture

import polar_bayes as pb

PLATE = pb.Scene(
    surface=pb.SmoothSurface(),
    subsurface=pb.Unpolarized(),
    mixing=pb.StokesMixing(),
    instrument=pb.instrument.Instrument(
        (pb.instrument.AngleZero(), pb.instrument.BeamOverlap(), pb.instrument.Leakage())
    ),
)


@pytest.fixture(scope="package")
def plate() -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 75.0, 12), 0.01, seed=2)


@pytest.fixture(scope="package")
def chosen(plate: xr.Dataset) -> pb.scenes.ChosenScene:
    """No brightness was recorded: the overlap of the beam cannot matter, the others do."""
    return pb.choose_effects(plate, scene=PLATE, links=LINKS)


@pytest.fixture(scope="package")
def full() -> pb.Scene:
    return PLATE
