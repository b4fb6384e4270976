"""Tables as files: every digit, and no text that a spreadsheet would run."""

import base64
import io

import numpy as np
import pandas as pd
import pytest
from cases import each
from pages import Page
from synthetic_accuracy import make_accuracy
from synthetic_calibrations import make_calibration
from synthetic_maps import make_maps
from synthetic_results import SMALL, make_result, pool

import polar_bayes as pb
from polar_bayes.reporting.page import csv_link

pytestmark = pytest.mark.usefixtures("unpainted")


def read(link: str) -> pd.DataFrame:
    kind, _, data = link.partition(",")
    assert kind == "data:text/csv;charset=utf-8;base64"
    return pd.read_csv(io.BytesIO(base64.b64decode(data)))


def test_numbers_keep_every_digit() -> None:
    table = pd.DataFrame({"mean": [0.1 + 0.2, np.nan], "verdict": ["a, b", 'say "c"']}, ["r", "n"])
    found = read(csv_link(table, "parameter"))
    assert found["mean"].tolist()[0] == 0.1 + 0.2
    assert found["verdict"].tolist() == ["a, b", 'say "c"']
    assert found["parameter"].tolist() == ["r", "n"]


@each("text", ["=1+2", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1"])
def test_no_text_is_a_formula(text: str) -> None:
    table = pd.DataFrame({text: [text, "plain"]}, [text, "b"])
    data = base64.b64decode(csv_link(table, "name").partition(",")[2]).decode()
    assert data.count(f'"\'{text}"') == 3


def test_a_row_of_two_names_has_two_columns() -> None:
    index = pd.MultiIndex.from_tuples([("r", "=a")], names=["parameter", "fit"])
    found = read(csv_link(pd.DataFrame({"mean": [1.0]}, index), "parameter"))
    assert found.columns.tolist() == ["parameter", "fit", "mean"]
    assert found["fit"].tolist() == ["'=a"]


@pytest.mark.thorough
@each(
    "make",
    [
        lambda: make_result(**SMALL, discrepancy=True),
        lambda: make_result(**SMALL, method="point"),
        lambda: pool(make_result(**SMALL, materials=("a", "b", "c")), "roughness"),
        lambda: make_calibration(count=60),
        make_accuracy,
        lambda: make_maps({"roughness": np.eye(5)}),
        lambda: {"a": make_result(**SMALL), "b": make_result(**SMALL, method="laplace")},
    ],
    ids=["fit", "point", "pooled", "calibration", "accuracy", "map", "comparison"],
)
def test_every_table_of_a_page_can_be_downloaded(tmp_path, make) -> None:
    page = Page(pb.report(make(), tmp_path).read_text())
    links = [value for value in page.values("href") if value.startswith("data:")]
    assert len(links) == page.tags.count("table")
    assert len(set(page.values("download"))) == len(links)
    for link in links:
        assert len(read(link))
