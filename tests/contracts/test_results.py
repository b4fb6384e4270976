"""Contract of the results: each kind has a card and a page, and survives a file."""

from pathlib import Path

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

SMALL = {"wavelengths": (), "views": 12, "draws": 150, "variables": ("dop",)}
RESULTS = {
    "fit by NUTS": (lambda: make_result(**SMALL), pb.load_result),
    "Laplace fit": (lambda: make_result(**SMALL, method="laplace"), pb.load_result),
    "point fit": (lambda: make_result(**SMALL, method="point"), pb.load_result),
    "calibration": (make_calibration, pb.calibration.load_calibration),
    "accuracy study": (make_accuracy, pb.benchmark.load_accuracy),
    "map": (
        lambda: make_maps({"roughness": np.linspace(0.0, 1.0, 12).reshape(3, 4)}),
        lambda path: xr.open_dataset(path).load(),
    ),
}
every_result = each(("make", "load"), RESULTS.values(), ids=RESULTS)


@every_result
def test_every_result_has_a_card_and_stays_what_it_is(make, load) -> None:
    del load
    result = make()
    before = result.copy(deep=True)
    card = pb.show(result)
    page = Page(card._repr_html_())
    assert page.open == []
    assert page.tags.count("table") == 1
    assert repr(card).splitlines()[0] in page.text
    assert result.identical(before)


@every_result
def test_every_result_survives_a_file_and_has_the_same_card(make, load, tmp_path: Path) -> None:
    result = make()
    pb.save_result(result, tmp_path / "result.nc")
    found = load(tmp_path / "result.nc")
    xr.testing.assert_equal(found, result)
    assert repr(pb.show(found)) == repr(pb.show(result))


@every_result
def test_every_result_has_a_page_that_stands_alone(make, load, tmp_path: Path) -> None:
    del load
    page = pb.report(make(), tmp_path / "report").read_text()
    assert Page(page).open == []
    assert "<script" not in page
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_one_kind_of_result_is_not_taken_for_another(tmp_path: Path) -> None:
    pb.save_result(make_calibration(), tmp_path / "calibration.nc")
    pb.save_result(make_result(**SMALL), tmp_path / "fit.nc")
    for load, name in (
        (pb.load_result, "calibration.nc"),
        (pb.benchmark.load_accuracy, "calibration.nc"),
        (pb.calibration.load_calibration, "fit.nc"),
        (pb.benchmark.load_accuracy, "fit.nc"),
    ):
        with pytest.raises(pb.FitError, match=name):
            load(tmp_path / name)
