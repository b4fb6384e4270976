"""The commands as a user types them: output, files, exit status, and one line for a mistake."""

import json
from pathlib import Path

import numpy as np
import pytest

import polar_bayes as pb
from polar_bayes.cli import main
from polar_bayes.methods import method

pytestmark = pytest.mark.usefixtures("without_comparisons")


def test_simulate_writes_what_fit_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "leaf.nc"
    words = ["simulate", "--preset", "leaf", "--scene", "picture", "--views", "8", "--seed", "3"]
    assert main([*words, "--out", str(file)]) == 0
    assert capsys.readouterr().out.startswith(str(file))
    capture = pb.load_capture(file)
    assert dict(capture.sizes) == {"view": 8, "wavelength": 3}
    assert main([*words, "--mirror", "--out", str(file)]) == 0
    capture = pb.load_capture(file)
    np.testing.assert_array_equal(capture["view_zenith"], capture["light_zenith"])


@pytest.mark.thorough
def test_the_table_has_a_row_per_parameter(plate, tmp_path, capsys) -> None:
    out = tmp_path / "fit.nc"
    assert main(["fit", str(plate), "--method", "importance", "--out", str(out)]) == 0
    table, meanings = capsys.readouterr().out.split("\n\n")
    header, *rows = table.splitlines()
    assert header.split() == ["mean", "sd", "2.5%", "97.5%", "R-hat", "ESS"]
    names = [row.split()[0] for row in rows]
    assert names[:2] == ["subsurface_fraction", "refractive_index"]
    assert {line.split(":")[0] for line in meanings.splitlines()} == {
        name.split("[")[0] for name in names[2:]
    }
    assert out.exists()


@pytest.mark.thorough
def test_a_fit_whose_diagnostics_fail_is_written_and_exits_with_2(
    plate: Path, plate_scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    short = pb.methods.Nuts(chains=2, warmup=50, draws=50, most_draws=50, block=50)
    monkeypatch.setattr(method, "make_method", lambda name: short)
    out = tmp_path / "fit.nc"
    assert main(["fit", str(plate), "--scene", plate_scene, "--out", str(out)]) == 2
    assert "problem: " in capsys.readouterr().err
    assert out.exists()


def test_a_table_of_readings_becomes_a_capture(tmp_path, capsys) -> None:
    table, out = tmp_path / "leaf.csv", tmp_path / "leaf.nc"
    table.write_text("theta,dop,time\n10,.02,7\n20,.04,8\n")
    words = ["import", "table", str(table), "--column", "view_zenith", "theta", "--out", str(out)]
    assert main(words) == 1
    assert "column time: a capture has no variable 'time'" in capsys.readouterr().err
    directions = {"view_azimuth": 180, "light_zenith": 45, "light_azimuth": 0}
    for name, degrees in directions.items():
        words += ["--constant", name, str(degrees)]
    words += ["--ignore", "time", "--setup", "camera"]
    assert main([*words, "--constant", "light_zenith", "30"]) == 1
    assert "--constant names light_zenith twice" in capsys.readouterr().err
    assert main(words) == 0
    counts, readings, setup = capsys.readouterr().out.splitlines()
    assert counts == f"{out}: 2 views, 0 masked, 0 saturated"
    assert readings.startswith("Readings: dop (no errors stated); 2 views from 10 to 20 degrees")
    assert setup == "Set-up: camera, which its fits take by default."
    assert pb.load_capture(out).attrs["setup"] == "camera"


@pytest.mark.thorough
def test_the_command_line_says_what_python_can(plate, tmp_path, capsys) -> None:
    """Priors, links and settings by call; a scene file of the result; both recorded."""
    out, again, file = (tmp_path / name for name in ("fit.nc", "again.nc", "plate.toml"))
    words = ["fit", str(plate), "--prior", "angle_zero=Normal(0,3)", "--method", "Point(starts=4)"]
    main([*words, "--link", "q=StokesLink(stated_errors=True)", "--out", str(out)])
    capsys.readouterr()
    assert main(["scene", "--from", str(out)]) == 0
    text = capsys.readouterr().out
    assert 'method = "Point(starts=4)"' in text
    assert 'angle_zero = "Normal(loc=0, scale=3)"' in text
    assert main(["scene", "--from", str(out), "--out", str(file)]) == 0
    main(["fit", str(plate), "--scene", str(file), "--out", str(again)])
    assert pb.load(again)["posterior"].equals(pb.load(out)["posterior"])
    assert pb.scenes.scene_text(pb.load(again)) == text == file.read_text()
    main(["fit", str(plate), "--scene", str(file), "--method", "laplace", "--out", str(again)])
    assert 'method = "Laplace()"' in pb.scenes.scene_text(pb.load(again))
    words = ["simulate", "--scene", str(file), "--name", "mine", "--out", str(tmp_path / "s.nc")]
    assert main(words) == 0
    capture = pb.load_capture(tmp_path / "s.nc")
    assert (capture.attrs["name"], capture.attrs["setup"]) == ("mine", "goniometer")
    assert float(capture["view_zenith"].max()) == 85.0  # the file says what a fit uses: 78


def test_a_fit_says_what_it_chose_and_what_is_unlikely(plate, plate_scene, tmp_path, capsys):
    """On the error stream; a capture whose q has the wrong sign is cautioned at every door."""
    table, capture, out = tmp_path / "t.csv", tmp_path / "t.nc", str(tmp_path / "fit.nc")
    read = pb.load_capture(plate)
    rows = zip(read["view_zenith"].values, -read["q"].values, strict=True)
    table.write_text("\n".join(["angle,q,q_error", *(f"{a:.2f},{q:.4f},.01" for a, q in rows)]))
    words = ["import", "table", str(table), "--angle", "angle", "--out", str(capture)]
    assert main(words) == 0
    told = capsys.readouterr()
    assert "Set-up: not stated, so a fit takes 'polarimeter'" in told.out
    assert "caution: q is negative at 20 of 20 mirror angles" in told.err
    words = ["fit", str(capture), "--scene", plate_scene, "--largest-view-zenith", "70"]
    main([*words, "--method", "laplace", "--json", "--out", out])
    told = capsys.readouterr()
    assert "q is negative" in " ".join(json.loads(told.out)["cautions"])
    assert "Set-up: custom, which the caller gave." in told.err
    assert "Links: --link 'q=StokesLink(" in told.err
    assert "Readings: 18 of 20 are used; 0 are masked, and 2 are set aside beyond 70" in told.err
    assert pb.inference.choice_sentences(pb.load(out))[0] in told.err


def test_combine_puts_captures_side_by_side(plate, tmp_path, capsys) -> None:
    """Labels are the captures' names; those of one name are numbered."""
    other, both = tmp_path / "other.nc", tmp_path / "both.nc"
    pb.save_capture(pb.load_capture(plate).isel(view=slice(12)).assign_attrs(name="thin"), other)
    assert main(["combine", str(plate), str(other), "--out", str(both)]) == 0
    counts, *labels = capsys.readouterr().out.splitlines()
    assert counts == f"{both}: 20 views x 2 materials, 8 masked, 0 saturated"
    assert labels == [f"plate: {plate}", f"thin: {other}"]
    capture = pb.load_capture(both)
    assert capture["material"].values.tolist() == ["plate", "thin"]
    assert capture.attrs["setup"] == "goniometer"
    words = ["combine", str(plate), str(plate), "--dim", "patch", "--out", str(both)]
    assert main(words) == 0
    assert "20 views x 2 patches" in capsys.readouterr().out
    assert pb.load_capture(both)["patch"].values.tolist() == ["plate 1", "plate 2"]


def test_an_interrupt_ends_with_one_word(plate, tmp_path, capsys, monkeypatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pb, "fit", interrupted)
    assert main(["fit", str(plate), "--out", str(tmp_path / "fit.nc")]) == 130
    assert "stopped" in capsys.readouterr().err
