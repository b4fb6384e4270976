"""The page of several fits: which predicts best, where they disagree, and how they were made."""

from pathlib import Path

import numpy as np
import pytest
from synthetic_results import SMALL, make_result, worse

import polar_bayes as pb
from polar_bayes.cli import main
from polar_bayes.errors import FitError
from polar_bayes.reporting.report import render

pytestmark = pytest.mark.usefixtures("unpainted")


def test_several_fits_by_name_have_the_figure_of_their_comparison() -> None:
    fits = {"a": make_result(**SMALL), "b": worse(1.0)}
    compared = pb.plots.plot_comparison(pb.diagnostics.compare_fits(fits))
    assert len(pb.plot(fits).axes) == len(compared.axes)
    with pytest.raises(FitError, match="compare_fits: b: it holds no fit"):
        pb.plot({**fits, "b": 3})


def test_a_report_of_several_fits_is_one_page(tmp_path: Path) -> None:
    fits = {"a": make_result(**SMALL), "b": make_result(**SMALL, method="laplace")}
    page = pb.report(fits, tmp_path / "both")
    assert [path.name for path in (tmp_path / "both").iterdir()] == ["index.html"]
    assert page.read_text() == render(fits)


def test_the_command_compares_files(tmp_path: Path, capsys) -> None:
    for name, fit in {"a": make_result(**SMALL), "b": worse(1.0)}.items():
        pb.save(fit, tmp_path / f"{name}.nc")
    files = [str(tmp_path / "a.nc"), str(tmp_path / "b.nc")]
    assert main(["compare", *files, "--out", str(tmp_path / "both")]) == 0
    said = capsys.readouterr().out
    assert "b predicts left-out readings worse than a" in said
    assert (tmp_path / "both" / "index.html").exists()


@pytest.mark.thorough
def test_the_command_refuses_another_capture(tmp_path: Path, capsys) -> None:
    for name, seed in (("a", 0), ("b", 1)):
        pb.save(make_result(**SMALL, seed=seed), tmp_path / f"{name}.nc")
    files = [str(tmp_path / "a.nc"), str(tmp_path / "b.nc")]
    assert main(["compare", *files, "--out", str(tmp_path / "both")]) == 1
    assert "it is of another capture than a" in capsys.readouterr().err
    assert not (tmp_path / "both").exists()


@pytest.mark.thorough
def test_a_picture_needs_numbers() -> None:
    empty = make_result(**SMALL)
    empty["posterior"] = empty["posterior"] * np.nan
    compared = pb.diagnostics.compare_fits({"a": empty, "b": empty})
    with pytest.raises(FitError, match="there is nothing to draw"):
        pb.plots.plot_comparison(compared)
