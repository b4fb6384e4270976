"""`polar-bayes report` of a calibration: told by what the file holds."""

from pathlib import Path

import pytest
from synthetic_calibrations import make_calibration

import polar_bayes as pb
from polar_bayes.cli import main

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.fixture
def files(tmp_path: Path) -> Path:
    pb.save(make_calibration(count=60), tmp_path / "sbc.nc")
    narrow = make_calibration(count=60, narrow={"roughness": 0.4}, method="laplace")
    pb.save(narrow, tmp_path / "laplace.nc")
    return tmp_path


def test_a_calibration_has_a_page(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["report", str(files / "sbc.nc"), "--out", str(files / "report")]
    assert main(words) == 0
    page = files / "report" / "index.html"
    assert capsys.readouterr().out == f"report: {page}\n"
    assert "Calibration report: leaf" in page.read_text()
    assert main([*words, "--compare", str(files / "laplace.nc")]) == 0
    assert "by laplace intervals are too narrow" in page.read_text()
