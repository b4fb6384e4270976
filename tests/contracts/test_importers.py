"""Contract of the importers: a valid capture that survives a file, or a refusal in one line."""

from pathlib import Path

import numpy as np
import pictures
import pytest
import xarray as xr
from cases import each
from pictures import FOUR

import polar_bayes as pb

CAMERA = {
    "shape": pictures.ball_normals(),
    "light": pictures.LAMP,
    "detector": pb.importers.Detector(saturation_level=pictures.FULL, gain=0.1, read_noise=2.0),
}
LINES = "view_zenith,dop\n10,.02\n20,.04\n"
ANGLES = {"view_azimuth": 180.0, "light_zenith": 45.0, "light_azimuth": 0.0}


def goniometer(folder: Path) -> xr.Dataset:
    del folder
    angles = np.arange(20.0, 81.0, 10.0)
    return pb.from_goniometer((angles, 2.0 + angles), (angles, 1.0 + 0.5 * angles))


def polarizer(folder: Path) -> xr.Dataset:
    del folder
    return pb.from_polarizer(pictures.frames(FOUR), FOUR, **CAMERA)


def mosaic(folder: Path) -> xr.Dataset:
    del folder
    return pb.from_mosaic(pictures.mosaic(pictures.frames(FOUR)), **CAMERA)


def table(folder: Path) -> xr.Dataset:
    (folder / "leaf.csv").write_text(LINES)
    return pb.from_table(folder / "leaf.csv", constants=ANGLES)


def ellipsometer(folder: Path) -> xr.Dataset:
    (folder / "e.csv").write_text("angle,psi,delta\n50,10,180\n60,6,0\n")
    return pb.from_ellipsometer(folder / "e.csv", angle="angle", psi="psi", delta="delta")


def one_channel(folder: Path) -> xr.Dataset:
    del folder
    return pb.from_goniometer(p=(np.arange(20.0, 81.0, 10.0), np.arange(1.0, 8.0)))


def color(folder: Path) -> xr.Dataset:
    del folder
    return pb.from_mosaic(pictures.frames(FOUR)[0], **CAMERA, color=(610.0, 530.0, 460.0))


IMPORTERS = {
    "goniometer": goniometer, "polarizer": polarizer, "mosaic": mosaic, "table": table,
    "ellipsometer": ellipsometer, "one channel": one_channel, "color": color,
}  # fmt: skip


@each("make", IMPORTERS.values(), ids=IMPORTERS)
def test_every_importer_makes_a_valid_capture_that_survives_a_file(make, tmp_path: Path) -> None:
    capture = make(tmp_path)
    xr.testing.assert_identical(pb.capture.validate(capture), capture)
    assert pb.capture.count(capture)["views"] > 0
    assert capture.attrs["source"]
    pb.save_capture(capture, tmp_path / "capture.nc")
    loaded = pb.load_capture(tmp_path / "capture.nc")
    xr.testing.assert_identical(loaded, capture.assign_attrs(name=loaded.attrs["name"]))


REFUSED = {
    "s": lambda: pb.from_goniometer((np.ones(3), np.ones(2)), (np.ones(3),) * 2),
    "angles": lambda: pb.from_polarizer(pictures.frames(FOUR), (0.0, 0.0, 0.0), **CAMERA),
    "frame": lambda: pb.from_mosaic(np.zeros((4, 4, 4)), **CAMERA),
    "transfer": lambda: pb.importers.Detector(transfer="rec709"),
    "no_such_table": lambda: pb.from_table("no_such_table.csv"),
}


@each(("where", "call"), REFUSED.items(), ids=REFUSED)
def test_every_importer_refuses_in_one_line_that_names_the_place(where, call) -> None:
    with pytest.raises(pb.CaptureError, match=f"{where}.*: ") as caught:
        call()
    assert str(caught.value).isprintable()
