"""Contract of the results: each kind has a card and a page, and survives a file."""

from pathlib import Path
from pkgutil import resolve_name

import numpy as np
import pytest
import xarray as xr
from cases import each
from pages import Page
from synthetic_accuracy import make_accuracy
from synthetic_calibrations import make_calibration
from synthetic_maps import make_maps
from synthetic_results import make_result

import polar_bayes as pb
from polar_bayes.reporting.report import render
from polar_bayes.results import KINDS

SMALL = {"wavelengths": (), "views": 12, "draws": 150, "variables": ("dop",)}
RESULTS = {
    "fit": lambda: make_result(**SMALL),
    "fit, Laplace": lambda: make_result(**SMALL, method="laplace"),
    "fit, point": lambda: make_result(**SMALL, method="point"),
    "calibration": make_calibration,
    "accuracy": make_accuracy,
    "map": lambda: make_maps({"roughness": np.linspace(0.0, 1.0, 12).reshape(3, 4)}),
}
FILES = {"fit": "result.nc", "calibration": "calibration.nc", "accuracy": "accuracy.nc"}
"""Files that a report writes next to its page; that of a map is too large."""

every_result = each(("name", "make"), RESULTS.items(), ids=RESULTS)


@every_result
def test_every_result_has_a_card_and_stays_what_it_is(name, make) -> None:
    result = make()
    before = result.copy(deep=True)
    card = pb.show(result)
    page = Page(card._repr_html_())
    assert page.open == []
    assert page.tags.count("table") == 1
    assert repr(card).splitlines()[0] in page.text
    assert result.identical(before)


@every_result
def test_every_result_has_a_table_a_verdict_and_a_figure(name, make) -> None:
    result = make()
    assert len(pb.summary(result)) > 0
    verdict = pb.verdict(result)
    assert verdict.passed == (not verdict.problems)
    assert all(sentence.endswith((".", "!")) for sentence in verdict.sentences)
    assert pb.plot(result).get_axes()


@every_result
def test_every_result_survives_a_file_and_has_the_same_card(name, make, tmp_path: Path) -> None:
    result = make()
    pb.save(result, tmp_path / "result.nc")
    found = pb.load(tmp_path / "result.nc", name.partition(",")[0])
    xr.testing.assert_equal(found, result)
    assert repr(pb.show(found)) == repr(pb.show(result))


@pytest.mark.usefixtures("unpainted")
@every_result
def test_every_result_has_a_page_that_stands_alone(name, make, tmp_path: Path) -> None:
    folder, result = tmp_path / "report", make()
    if name == "fit, point":
        pb.report(result, folder)  # an older report is replaced
    page = pb.report(result, folder)
    assert page == folder / "index.html"
    text = page.read_text()
    assert Page(text).open == []
    assert "<script" not in text
    assert "http://" not in text.replace("http://www.w3.org", "")
    # Beside it is the result itself, which makes the same page again, byte for byte.
    files = {path.name for path in folder.iterdir()} - {"index.html"}
    assert files == {FILES.get(name.partition(",")[0], "explore.html")}
    is_map = name == "map"  # which stays where it is
    assert render(result if is_map else pb.load(folder / files.pop())) == text


def test_one_kind_of_result_is_not_taken_for_another(tmp_path: Path) -> None:
    results = {name: RESULTS[name]() for name in ("fit", "calibration", "accuracy")}
    results["other"] = results["accuracy"]["accuracy"].to_dataset()
    for name, result in results.items():
        pb.save(result, tmp_path / f"{name}.nc")
        for kind in {"fit", "calibration", "accuracy"} - {name}:
            with pytest.raises(pb.FitError, match=rf"{name}.nc: it holds no {kind}; give the file"):
                pb.load(tmp_path / f"{name}.nc", kind)
    (tmp_path / "text.nc").write_text("nothing")
    with pytest.raises(pb.FitError, match="cannot be read as netCDF; give the file that polar_bay"):
        pb.load(tmp_path / "text.nc", "calibration")
    with pytest.raises(pb.CaptureError, match="there is no such file"):
        pb.load(tmp_path / "nowhere.nc")


@each("kind", [kind for kind in KINDS if kind.reports], ids=lambda kind: kind.name)
def test_every_kind_that_has_reports_has_page_card_and_figure(kind) -> None:
    reports = resolve_name(f"polar_bayes.reporting.{kind.reports}:REPORT")
    assert callable(reports.page)
    assert callable(reports.card)
    assert callable(reports.plot)


def test_a_kind_without_a_page_is_refused_by_name(tmp_path: Path) -> None:
    profile = xr.Dataset({"prior_beyond": 0.5})
    for make in (lambda: pb.report(profile, tmp_path), lambda: pb.plot(profile)):
        with pytest.raises(pb.FitError, match="a result of kind profile has no page; polar_bayes"):
            make()
