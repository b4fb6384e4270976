"""The commands that import pictures say what the Python interface says."""

from pathlib import Path

import numpy as np
import pictures
import pytest
from pictures import BALL, LAMP

import polar_bayes as pb
from polar_bayes.cli import main

ANGLES = (0.0, 60.0, 120.0)
SPHERE = ["--sphere", str(BALL.row), str(BALL.column), str(BALL.radius)]
LIGHT = ["--light", str(LAMP.x), str(LAMP.y), str(LAMP.z)]
FULL = ["--saturation-level", "1000"]


def test_frames_behind_a_polarizer(inputs, tmp_path, capsys) -> None:
    paths = {angle: inputs / f"ball{angle:.0f}.npy" for angle in ANGLES}
    files = [word for angle, path in paths.items() for word in ("--frame", str(angle), str(path))]
    out = tmp_path / "ball.nc"
    noise = ["--gain", "0.2", "--read-noise", "2", "--relative-error", "0", "--dark-level", "1"]
    words = [*files, *SPHERE, *LIGHT, *FULL, *noise, "--bin", "2", "--window", "1"]
    words += ["--wavelength", "550", "--name", "ball", "--transfer", "1.8"]
    assert main(["import", "polarizer", *words, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    stated = {"gain": 0.2, "read_noise": 2.0, "relative_error": 0.0}
    detector = pb.importers.Detector(saturation_level=1000.0, dark=1.0, transfer=1.8, **stated)
    known = {"shape": BALL, "light": LAMP, "detector": detector, "bin": 2, "window": 1}
    raw = [np.load(path) for path in paths.values()]
    wanted = pb.from_polarizer(raw, ANGLES, wavelength=550.0, name="ball", **known)
    found = pb.load_capture(out)
    assert found.drop_attrs().equals(wanted.drop_attrs())
    assert f"{wanted.attrs['masked_outside']} outside" in said
    assert "1 view x 20 x 24 pixels" in said


@pytest.mark.thorough
def test_a_mosaic_with_another_layout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    frame = rng.integers(300, 600, pictures.SHAPE).astype(np.uint16)
    np.save(tmp_path / "frame.npy", frame)
    np.save(tmp_path / "normals.npy", pictures.ball_normals())
    np.savetxt(tmp_path / "rim.csv", rim(), header="row column", comments="")
    layout = ["--layout", "0", "45", "135", "90"]
    out = tmp_path / "ball.nc"
    command = ["import", "mosaic", str(tmp_path / "frame.npy"), *FULL, *layout, "--out", str(out)]
    asked = {
        "layout": ((0, 45), (135, 90)),
        "detector": pb.importers.Detector(saturation_level=1000.0),
    }
    for words, known in (
        (
            ["--normals", str(tmp_path / "normals.npy"), "--highlight", "15", "25"],
            {"shape": pictures.ball_normals(), "light": pb.importers.Highlight(15.0, 25.0)},
        ),
        (
            ["--rim", str(tmp_path / "rim.csv"), "--light-position", "5", "6", "90"],
            {"shape": BALL, "light": pb.importers.Position(5.0, 6.0, 90.0)},
        ),
        (
            [*SPHERE, "--surroundings", "--view-position", "0", "0", "70"],
            {
                "shape": BALL,
                "light": pb.importers.Surroundings(),
                "view": pb.importers.Position(0.0, 0.0, 70.0),
            },
        ),
    ):
        assert main([*command, *words]) == 0
        wanted, found = pb.from_mosaic(frame, **known, **asked), pb.load_capture(out)
        np.testing.assert_allclose(found["q"], wanted["q"], atol=1e-9)
        np.testing.assert_allclose(found["light_zenith"], wanted["light_zenith"], atol=1e-6)
    assert "outside" in capsys.readouterr().out


def rim() -> np.ndarray:
    around = np.linspace(0.0, 6.0, 9)
    row = BALL.row + BALL.radius * np.sin(around)
    return np.stack([row, BALL.column + BALL.radius * np.cos(around)], axis=-1)
