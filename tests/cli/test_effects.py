"""The ledger of effects, printed, written, and kept by a fit."""

import json

import pytest
import xarray as xr

import polar_bayes as pb
from polar_bayes.cli import main

FEW = """
setup = "goniometer"

[scene]
surface = "SmoothSurface()"
instrument = "Instrument((AngleZero(), BeamOverlap()))"
"""
"""A plate with two effects, which is quick to compile."""


def test_effects_prints_the_ledger_and_writes_it(plate, tmp_path, capsys) -> None:
    scene, out = tmp_path / "plate.toml", tmp_path / "ledger.nc"
    scene.write_text(FEW)
    words = ["effects", str(plate), "--scene", str(scene), "--keep", "BeamOverlap"]
    assert main([*words, "--out", str(out)]) == 0
    head, *rows, space, sentences = capsys.readouterr().out.splitlines()
    assert head.split()[:2] == ["data", "shift"]
    assert not space
    assert f"of {len(rows)} effects are kept" in sentences
    kept = next(row for row in rows if row.startswith("BeamOverlap"))
    assert "kept: by your choice" in kept
    with xr.open_dataset(out) as ledger:
        assert ledger.sizes["effect"] == len(rows)


@pytest.mark.thorough
def test_effects_as_json_are_what_a_fit_of_the_chosen_scene_keeps(plate, tmp_path, capsys) -> None:
    assert main(["effects", str(plate), "--tolerance", "0.2", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["tolerance"] == 0.2
    assert not said["effects"]["BeamOverlap"]["kept"]
    out = tmp_path / "fit.nc"
    words = ["fit", str(plate), "--choose-effects", "--tolerance", "0.2", "--method", "point"]
    assert main([*words, "--out", str(out)]) in (0, 2)
    assert "effects are kept" in capsys.readouterr().err
    result = pb.load(out)
    kept = result["effects"]["kept"]
    assert {
        name: bool(row) for name, row in zip(kept["effect"].values, kept.values, strict=True)
    } == {name: row["kept"] for name, row in said["effects"].items()}
    assert "beam_overlap_zenith" not in result["posterior"]
