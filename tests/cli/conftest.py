"""A plate as a file, which commands read, and its scene as another."""

import shutil
from pathlib import Path

import numpy as np
import pictures
import pytest
import xarray as xr
from PIL import Image
from plate_images import plate_image
from plates import plate_capture
from synthetic_calibrations import make_calibration
from synthetic_maps import make_maps

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


@pytest.fixture(scope="package")
def inputs(plate: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an input of every kind, in which no command may change anything."""
    folder = tmp_path_factory.mktemp("inputs")
    shutil.copytree(Path(__file__).parents[1] / "cases", folder, dirs_exist_ok=True)
    for name in ("x.nc", "y.nc"):
        shutil.copy(plate, folder / name)
    (folder / "broken.nc").write_bytes(plate.read_bytes()[:2000])
    (folder / "t.csv").write_text("angle;perp;parallel\n20;47;36\n30;51;33\n40;58;27\n")
    frames = pictures.frames((0.0, 60.0, 120.0))
    for angle, frame in zip((0, 60, 120), np.rint(frames).astype(np.uint16), strict=True):
        np.save(folder / f"ball{angle}.npy", frame)
    Image.new("L", (48, 40)).save(folder / "curved.png", icc_profile=b"a tone curve")
    for angle in (0, 45, 90):
        Image.fromarray(np.full((4, 4), 10 + angle, np.uint8)).save(folder / f"g{angle}.png")
    (folder / "other").mkdir()
    pb.save(make_calibration(count=60), folder / "sbc.nc")
    narrow = make_calibration(count=60, narrow={"roughness": 0.4}, method="laplace")
    pb.save(narrow, folder / "laplace.nc")
    shutil.copy(folder / "laplace.nc", folder / "other")
    mean = {"roughness": np.full((4, 5), 0.5)}
    truth = xr.Dataset({"true_roughness": 0.5}, attrs={"name": "leaf"})
    bare = make_maps(mean, method="laplace")
    images = {"map": make_maps(mean), "bare": bare, "leaf": truth, "plates": plate_image(3, 4)}
    for name, image in images.items():
        image.to_zarr(folder / f"{name}.zarr", consolidated=False)
    return folder
