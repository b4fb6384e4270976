"""Shared by every test: double precision, and where measured data by others may be found."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def measured() -> Path:
    """Folder of real measurements, which is not part of the project."""
    folder = Path(os.environ.get("POLAR_BAYES_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no measured data: set POLAR_BAYES_DATA to the folder that holds them")
    return folder
