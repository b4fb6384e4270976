"""`polar-bayes report` of a calibration: told by what the file holds."""

from pathlib import Path

import pytest

from polar_bayes.cli import main

pytestmark = pytest.mark.usefixtures("unpainted")


def test_a_calibration_has_a_page(inputs: Path, tmp_path: Path, capsys) -> None:
    words = ["report", str(inputs / "sbc.nc"), "--out", str(tmp_path)]
    assert main(words) == 0
    page = tmp_path / "index.html"
    assert capsys.readouterr().out == f"report: {page}\n"
    assert "Calibration report: leaf" in page.read_text()
    assert main([*words, "--compare", str(inputs / "laplace.nc")]) == 0
    assert "by laplace intervals are too narrow" in page.read_text()
