"""The command that compares scenes: what it prints, and what it writes."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from synthetic_results import make_result

import polar_bayes as pb
from polar_bayes.cli import fits, main
from polar_bayes.progress import Progress
from polar_bayes.scenes import comparison


@pytest.fixture(autouse=True)
def one_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simplest scene alone: what the command does, not what it finds."""
    monkeypatch.setattr(comparison, "MAX_FITS", 1)
    monkeypatch.setattr(comparison, "MAX_ALTERNATIVES", 0)


@pytest.mark.usefixtures("unpainted")
def test_a_report_says_what_it_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages: list[str] = []

    @contextlib.contextmanager
    def shown() -> Iterator[Progress]:
        yield lambda stage, _: stages.append(stage)

    monkeypatch.setattr(fits, "stages", shown)
    pb.save(make_result(), tmp_path / "fit.nc")
    words = ["report", str(tmp_path / "fit.nc"), "--no-next-views", "--out", str(tmp_path / "page")]
    assert main(words) == 0
    assert stages == ["reading the result", "drawing the report"]


def test_scenes_are_compared_and_what_remains_is_written(plate, tmp_path, capsys) -> None:
    out = tmp_path / "fit.nc"
    words = ["scenes", str(plate), "--method", "laplace", "--json", "--out", str(out)]
    assert main(words) in (0, 2)
    said = json.loads(capsys.readouterr().out)
    assert {"mirror", "mirror + back face"} <= set(said["scenes"])
    assert sum(row["weight"] for row in said["scenes"].values()) == pytest.approx(1.0)
    fitted = f"{len(said['scenes'])} scenes were fitted, from simple to complex."
    assert said["sentences"][0] == fitted
    result = pb.load(out, "fit")
    assert pb.scenes.scene_sentences(result) == said["sentences"]
