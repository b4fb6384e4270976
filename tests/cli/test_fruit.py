"""A real frame of fruit, from the camera's file to a map: both kinds of light, with their signs."""

from pathlib import Path

import numpy as np
import pytest
from fruit import APPLE, ORANGE, mean_stokes, regions

import polar_bayes as pb
from polar_bayes.cli import main

SPHERES = [
    word
    for ball in (APPLE, ORANGE)
    for word in ("--sphere", str(ball.row), str(ball.column), str(ball.radius))
]
SURFACE, BODY = ("highlight", "underside"), ("shoulders",)


@pytest.fixture(scope="module")
def frame(measured: Path) -> Path:
    file = measured / "fruit_mosaic" / "fruits_IMX250MZR.png"
    if not file.is_file():
        pytest.skip(f"no fruit frame: {file.name} is not among the measured data")
    return file


def imported(frame: Path, out: Path, *words: str) -> Path:
    command = ["import", "mosaic", str(frame), *SPHERES, "--surroundings", "--name", "fruit"]
    assert main([*command, *words, "--out", str(out)]) == 0
    return out


def test_light_from_the_surface_is_s_and_light_from_below_is_p(frame, tmp_path, capsys) -> None:
    """Fresnel's laws, seen by the camera: no model is fitted. Errors are below .01."""
    capture = pb.load_capture(imported(frame, tmp_path / "f.nc", "--bin", "16", "--window", "1"))
    assert "outside" in capsys.readouterr().out
    assert capture.attrs["masked_outside"] == int((~capture["valid"]).sum())
    found = {name: mean_stokes(capture, where) for name, where in regions(capture).items()}
    for name, (q, _, error, count) in found.items():
        assert count > 30
        if name.endswith(SURFACE):
            assert q > 8.0 * error, name
        else:  # the apple is so dark that little comes from below
            assert q < (-8.0 if name.startswith("orange") else -1.5) * error, name
    # The white body of an orange is brighter than that of a dark apple: less of its light is the
    # surface's, wherever there is some.
    for region in ("highlight", "underside", "shoulders"):
        assert found[f"orange: {region}"][0] < found[f"apple: {region}"][0]


@pytest.mark.thorough
def test_the_highlights_say_that_the_lamp_itself_is_polarized(frame: Path, tmp_path: Path) -> None:
    """Unpolarized light has a degree of at most .16 at that angle, however much is mirrored."""
    capture = pb.load_capture(imported(frame, tmp_path / "f.nc", "--bin", "16", "--window", "1"))
    spot = regions(capture)["apple: highlight"]
    q, u, _, _ = mean_stokes(capture, spot)
    assert np.hypot(q, u) > 0.3
    assert float(capture["view_zenith"].isel(view=0).values[spot].max()) < 30.0


@pytest.mark.thorough
def test_the_map_of_the_fruit_separates_surface_from_body(frame, tmp_path, capsys) -> None:
    """From file to map to report by commands; every region on its side of every other kind."""
    capture = imported(frame, tmp_path / "f.nc", "--bin", "32", "--window", "2")
    store = tmp_path / "f.zarr"
    assert main(["map", str(capture), "--draws", "128", "--out", str(store)]) == 0
    maps = pb.maps.open_map(store)
    counts = pb.maps.count_pixels(maps)
    # Beside a polarized lamp many pixels are contradicted, which have an answer nevertheless.
    answered = counts["good"] + counts["contradicted"]
    assert answered > 0.9 * (sum(counts.values()) - counts["masked"])
    share = maps["subsurface_fraction"].values
    found = {name: np.nanmedian(share[where]) for name, where in regions(maps).items()}
    for fruit in ("apple", "orange"):
        for region in SURFACE:
            assert found[f"{fruit}: {region}"] < found[f"{fruit}: shoulders"] - 0.2, found
    assert main(["report", str(store), "--out", str(tmp_path / "report")]) == 0
    assert "subsurface" in (tmp_path / "report" / "index.html").read_text()
