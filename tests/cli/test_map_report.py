"""Commands with a map: finished ones are resumed and reported, told by the end of their name."""

import sys
from pathlib import Path

import numpy as np
import pytest
from plate_images import plate_image
from synthetic_maps import make_maps

import polar_bayes as pb
from polar_bayes.cli import main
from polar_bayes.maps import store
from polar_bayes.maps.fit_map import blank
from polar_bayes.reporting.page import INSTALL

pytestmark = pytest.mark.usefixtures("unpainted")


def test_a_map_has_a_page(inputs: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    words = ["report", str(inputs / "map.zarr"), "--out", str(tmp_path)]
    assert main(words) == 0
    page, explorer = tmp_path / "index.html", tmp_path / "explore.html"
    assert capsys.readouterr().out == f"report: {page}\nmap to point at: {explorer}\n"
    assert "The page was made without the capture" in explorer.read_text()
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "bokeh", None)
        assert main(words) == 0
    told = capsys.readouterr().out.splitlines()[1]
    assert told == f"There is no map to point at, because Bokeh is not installed: {INSTALL}."
    assert "Map report: map" in page.read_text()
    words += ["--truth", str(inputs / "leaf.zarr"), "--uncorrected", str(inputs / "bare.zarr")]
    assert main(words) == 0
    assert "Map report: leaf" in page.read_text()
    assert "uncorrected" in page.read_text()


def test_a_finished_map_is_resumed_with_status_0(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(store, "fit_block", lambda block, plan: blank(block, plan).load())
    capture, out = tmp_path / "plates.zarr", tmp_path / "map.zarr"
    plate_image(3, 4).to_zarr(capture, consolidated=False)
    words = ["map", str(capture), "--out", str(out), "--scene", "picture"]
    for more in ([], ["--resume"]):
        assert main([*words, *more]) == 0
        assert capsys.readouterr().out == f"{out}: 12 not fitted\n"
    assert main(words) == 1
    assert f"{out}: it is there already; give another --out, or --resume" in capsys.readouterr().err
    plate_image(3, 4, seed=1)[["q"]].to_zarr(capture, mode="r+", consolidated=False)
    assert main([*words, "--resume"]) == 1
    assert "it was begun with another capture or other settings" in capsys.readouterr().err


def test_what_an_image_shares_is_told_with_its_interval(tmp_path) -> None:
    shared = {
        "stokes_error_factor": {
            "quantiles": {"0.025": 0.9, "0.5": 1.0, "0.975": 1.1},
            "pixels": 512,
            "disagreement": 5.2,
        }
    }
    maps = make_maps({"refractive_index": np.full((2, 2), 1.5)}, shared=shared)
    row = pb.maps.shared_parameters(maps).loc["stokes_error_factor"]
    assert row.tolist() == [0.9, 1.0, 1.1, 512, 5.2]
    page = pb.report(maps, tmp_path / "report").read_text()
    assert "stokes_error_factor is shared by all pixels, and they do not agree" in page
