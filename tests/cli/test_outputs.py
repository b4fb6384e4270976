"""What commands must never write over, and what they refuse before anything is loaded."""

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest
from cases import each
from synthetic_results import make_result

import polar_bayes as pb
from polar_bayes.cli import main
from polar_bayes.cli import options as cli_options

ROOT = Path(__file__).parents[2]


def digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


@each("words", [("simulate",), ("fit", "x.nc"), ("map", "x.nc"), ("report", "x.nc"), ("demo",)])
@each("out", ["", "a\0b"])
def test_no_path_is_one_line(words, out, inputs, monkeypatch, capsys):
    monkeypatch.chdir(inputs)
    assert main([*words, "--out", out]) == 1
    told = capsys.readouterr().err
    assert "is not a path" in told
    assert told.count("\n") == 1


@pytest.mark.thorough
@each("name", ["index.html", "result.nc"])
def test_a_report_replaces_only_a_report(name, tmp_path):
    (tmp_path / name).write_text("mine")
    with pytest.raises(pb.OutputError, match=f"{name}: the file there holds something else"):
        pb.report(make_result(), tmp_path)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "mine")]


@pytest.mark.thorough
def test_a_report_is_made_again_in_its_folder_beside_what_is_there(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    page = pb.report(make_result(), tmp_path)
    page.chmod(0o640)
    first = digest(page)
    pb.report(pb.load(tmp_path / "result.nc"), tmp_path)
    assert digest(page) == first
    assert page.stat().st_mode & 0o777 == 0o640
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "index.html", "notes.txt", "result.nc",
    ]  # fmt: skip


@pytest.mark.thorough
@each("held", [{"capture.nc": "plate"}, {"fit.nc": "text"}, {"photo.png": "x"}])
def test_a_demo_writes_in_no_folder_of_anothers(held, plate, tmp_path, capsys):
    for name, kind in held.items():
        (tmp_path / name).write_bytes(plate.read_bytes() if kind == "plate" else b"mine")
    before = {file.name: digest(file) for file in tmp_path.iterdir()}
    assert main(["demo", "--out", str(tmp_path)]) == 1
    assert "it holds files that no demo made" in capsys.readouterr().err
    assert {file.name: digest(file) for file in tmp_path.iterdir()} == before


def test_names_of_options_are_those_of_the_tables():
    from polar_bayes.inference.request import MODELS
    from polar_bayes.methods.registry import method_names

    known = {
        cli_options.MODEL: MODELS,
        cli_options.SCENE: pb.setups.SETUPS,
        cli_options.MATERIAL: pb.simulation.PRESETS,
        cli_options.FIT_METHOD: method_names(one=True),
        cli_options.MANY_METHOD: method_names(many=True),
        cli_options.STUDY_METHOD: pb.methods.STUDY_METHODS,
    }
    for kind, table in known.items():
        assert kind.names == tuple(table), kind.kind


BEFORE_JAX = """
fit nowhere.nc --out o.nc
fit x.nc --method nutz --out o.nc
map x.nc --scene moon --out o.zarr
calibrate x.nc --method magic --out o.nc
accuracy x.nc --method magic --out o.nc
simulate --preset gold --out o.nc
fit t.csv --out o.nc
fit x.nc --out y.nc
"""
REFUSE = """
import contextlib, io, sys
from polar_bayes.cli import main
for command in sys.argv[1].strip().splitlines():
    with contextlib.redirect_stderr(io.StringIO()) as said:
        assert main(command.split()) == 1, command
    assert said.getvalue().count("\\n") == 1, said.getvalue()
    loaded = {"jax", "numpyro", "arviz", "matplotlib"} & set(sys.modules)
    assert not loaded, f"{command}: loaded {loaded} in vain"
"""


def test_what_is_known_before_jax_is_refused_before_jax(inputs):
    words = [sys.executable, "-c", REFUSE, BEFORE_JAX]
    done = subprocess.run(words, cwd=inputs, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
