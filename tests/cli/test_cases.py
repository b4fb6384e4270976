"""Tables of the kinds that people keep, by the commands that a user types.

The tables of `tests/cases` are made by formula: a light of 1000, 1% noise, each of one index.
"""

import json
from pathlib import Path

import pytest
from cases import each

import polar_bayes as pb
from polar_bayes.cli import main

CASES = Path(__file__).parents[1] / "cases"

BARE = """
setup = "goniometer"
method = "laplace"

[scene]
surface = "SmoothSurface()"
"""
"""A plate and nothing else, which is quick to fit."""

BEYOND = {
    "high_index": (
        "Brewster's angle means an index near 3.83 (3.15 to 4.86)",
        "--prior 'refractive_index=TruncatedNormal(3.8, 0.9, low=1)'",
        3.87,
    ),
    "index_2_03": (
        "Brewster's angle means an index near 2.03 (1.78 to 2.33)",
        "--prior 'refractive_index=TruncatedNormal(2.0, 0.3, low=1)'",
        2.03,
    ),
}
"""What is said of each, the option that allows its index, and that index."""

LEVELS = {"high_index": "problem", "index_2_03": "caution"}


def imported(name: str, folder: Path) -> Path:
    """The capture of a table."""
    out = folder / f"{name}.nc"
    words = ["--table", str(CASES / f"{name}.csv"), "--angle", "angle", "--s", "Is", "--p", "Ip"]
    assert main(["import", "goniometer", *words, "--out", str(out)]) == 0
    return out


def fitted(capture: Path, *words: str) -> int:
    """Exit status of a fit by a file with the bare plate."""
    scene, out = capture.with_suffix(".toml"), capture.with_name("fit.nc")
    scene.write_text(BARE)
    return main(["fit", str(capture), "--scene", str(scene), "--json", *words, "--out", str(out)])


@each("name", BEYOND)
def test_an_index_beyond_the_prior_is_one_sentence_at_import(name, tmp_path, capsys):
    imported(name, tmp_path)
    means, option, _ = BEYOND[name]
    (caution,) = capsys.readouterr().err.splitlines()
    assert caution == (
        f"caution: {means}, but the default prior of refractive_index ends at 2: give {option}."
    )


@each("name", ["clean_plate", "slide_back_0"])
def test_an_index_that_the_prior_allows_is_none(name, tmp_path, capsys):
    imported(name, tmp_path)
    told = capsys.readouterr()
    assert "Brewster's angle by eye" in told.out
    assert not told.err


@each("name", BEYOND)
def test_a_fit_says_that_its_prior_excludes_the_index(name, tmp_path, capsys):
    """Also one that is read from its file, without the capture."""
    capture = imported(name, tmp_path)
    means, option, _ = BEYOND[name]
    status = fitted(capture)
    said = capsys.readouterr().err
    sentence = f"{means}, but the prior of refractive_index ends at 2: give {option}."
    assert f"{LEVELS[name]}: {sentence}" in said
    assert status == 2 or LEVELS[name] == "caution"
    row = pb.diagnostics.criticize(pb.load(tmp_path / "fit.nc", "fit")).loc["index"]
    assert row["level"] == LEVELS[name]
    assert "priors={'refractive_index': TruncatedNormal(" in row["sentence"]


def test_the_option_that_the_sentence_names_mends_the_fit(tmp_path, capsys):
    capture = imported("high_index", tmp_path)
    _, option, index = BEYOND["high_index"]
    capsys.readouterr()
    assert fitted(capture, *option.replace("'", "").split(" ", 1)) == 0
    told = capsys.readouterr()
    found = json.loads(told.out)["parameters"]["refractive_index"]
    assert found["q2.5"] < index < found["q97.5"]
    assert "Brewster's angle means" not in told.err


@pytest.mark.thorough
@pytest.mark.parametrize("name", BEYOND)
def test_with_all_that_a_goniometer_leaves_unknown(name, tmp_path, capsys):
    """The set-up of the import, with its instrument; chains where the index is allowed."""
    capture, out = imported(name, tmp_path), str(tmp_path / "fit.nc")
    means, option, index = BEYOND[name]
    words = ["fit", str(capture), "--json", "--out", out]
    capsys.readouterr()
    status = main([*words, "--method", "importance"])
    assert f"{LEVELS[name]}: {means}" in capsys.readouterr().err
    assert status == 2 or LEVELS[name] == "caution"
    assert main([*words, *option.replace("'", "").split(" ", 1)]) == 0
    found = json.loads(capsys.readouterr().out)["parameters"]["refractive_index"]
    assert found["q2.5"] < index < found["q97.5"]


@pytest.mark.thorough
def test_no_scene_wins_by_bending_the_index_until_the_prior_allows_it(tmp_path, capsys):
    """Also where nobody stated a beam, so that a sky is a candidate."""
    capture = imported("high_index", tmp_path)
    loose = pb.load_capture(capture)
    for name in ("setup", "incident_levels"):
        del loose.attrs[name]
    pb.save_capture(loose, capture)
    capsys.readouterr()
    main(["scenes", str(capture), "--json"])
    said = json.loads(capsys.readouterr().out)
    assert "Scenes were compared with refractive_index by TruncatedNormal" in said["sentences"][1]
    remaining = [scene for scene in said["scenes"].values() if scene["weight"] > 0.0]
    assert all(3.8 < float(scene["refractive_index"].split()[0]) < 3.95 for scene in remaining)
