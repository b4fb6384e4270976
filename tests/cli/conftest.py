"""A plate as a file, which commands read."""

from pathlib import Path

import numpy as np
import pytest
from plates import plate_capture

import polar_bayes as pb


@pytest.fixture(scope="package")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("plate") / "plate.nc"
    capture = plate_capture(np.linspace(20.0, 75.0, 20), 0.01, seed=2)
    pb.save_capture(capture.assign_attrs(setup="goniometer"), file)
    return file
