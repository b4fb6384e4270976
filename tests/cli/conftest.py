"""A plate as a file, which commands read, and its scene as another."""

from pathlib import Path

import numpy as np
import pytest
from plates import plate_capture

import polar_bayes as pb

PLATE_SCENE = """
setup = "goniometer"

[scene]
surface = "SmoothSurface()"
subsurface = "Unpolarized()"
mixing = "StokesMixing()"

[links]
q = "StokesLink(stated_errors=True)"
"""
"""Three parameters, a perfect instrument and normal noise, which compile in seconds."""


@pytest.fixture(scope="package")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("plate") / "plate.nc"
    capture = plate_capture(np.linspace(20.0, 75.0, 20), 0.01, seed=2)
    pb.save_capture(capture.assign_attrs(setup="goniometer"), file)
    return file


@pytest.fixture(scope="package")
def plate_scene(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("scene") / "plate.toml"
    file.write_text(PLATE_SCENE)
    return str(file)
