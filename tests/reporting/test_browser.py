"""Every kind of report in a real browser, on a phone and on a screen, and on paper."""

import csv
import functools
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from browsers import WIDTHS, browser, faults, open_page, printed
from cases import each
from pages import EVIL
from reporting.test_pages import odd
from selenium import webdriver
from selenium.webdriver.common.by import By
from synthetic_accuracy import make_accuracy
from synthetic_calibrations import make_calibration
from synthetic_maps import make_maps
from synthetic_results import SMALL, edit_provenance, make_result, pool

import polar_bayes as pb
from polar_bayes.diagnostics.convergence import summary


def evil_fit():
    """Names that are markup, endless, or made of spaces, wherever there is a name."""
    own = {"model_source": f"</code></pre>{EVIL}", "priors": {EVIL: EVIL * 20}}
    return edit_provenance(
        odd(), **own, comparisons_failed={EVIL: EVIL, "without_instrument": EVIL}
    )


REPORTS = {
    "fit": lambda: make_result(views=12, draws=120, discrepancy=True),
    "laplace": lambda: make_result(**SMALL, method="laplace"),
    "point": lambda: make_result(**SMALL, method="point"),
    "hierarchical": lambda: pool(
        make_result(**SMALL, materials=("leaf", "fruit", "stone")), "roughness"
    ),
    "map": lambda: make_maps({"roughness": np.eye(9), "absorption": np.eye(9)}, scene=EVIL),
    "calibration": lambda: make_calibration(count=60, capture=EVIL),
    "accuracy": make_accuracy,
    "comparison": lambda: {EVIL: make_result(**SMALL), "b": make_result(**SMALL, method="point")},
    "evil": evil_fit,
}


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    with browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The page of each report, which is made when it is first asked for."""
    folder = tmp_path_factory.mktemp("reports")
    return functools.cache(lambda name: pb.report(REPORTS[name](), folder / name))


HARDEST = ("evil", "map", "accuracy")


@pytest.mark.parametrize(
    "name",
    [*HARDEST, *(pytest.param(x, marks=pytest.mark.thorough) for x in REPORTS if x not in HARDEST)],
)
@each("width", WIDTHS)
def test_a_report_opens_without_a_fault(driver, reports, name: str, width: int) -> None:
    open_page(driver, reports(name), width)
    assert faults(driver) == []
    assert driver.execute_script("return document.scripts.length") == 0
    assert driver.execute_script("return document.images.length") > 0


@pytest.mark.thorough
@each("name", [name for name in REPORTS if name != "evil"])
def test_the_verdict_is_on_the_first_screen_of_a_phone(driver, reports, name: str) -> None:
    open_page(driver, reports(name), WIDTHS[0])
    place = driver.find_element(By.CSS_SELECTOR, "#verdict h2").rect["y"]
    assert place < 500


@pytest.mark.thorough
@each("name", ["fit", "comparison"])
def test_a_table_scrolls_in_its_own_box(driver, reports, name: str) -> None:
    open_page(driver, reports(name), WIDTHS[0])
    boxes = driver.execute_script(
        "return [...document.querySelectorAll('table')].map(t => [t.parentElement.className,"
        " t.parentElement.getBoundingClientRect().right])"
    )
    assert boxes
    assert all("scroll" in kind and right <= WIDTHS[0] for kind, right in boxes)


@pytest.mark.thorough
def test_a_table_comes_down_as_a_file_without_network(driver, reports, tmp_path: Path) -> None:
    driver.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)}
    )
    open_page(driver, reports("fit"), WIDTHS[1])
    driver.find_element(By.CSS_SELECTOR, "a[download='parameter.csv']").click()
    file = tmp_path / "parameter.csv"
    end = time.monotonic() + 20.0
    while not file.exists() and time.monotonic() < end:
        time.sleep(0.1)
    with file.open(encoding="utf-8", newline="") as opened:
        rows = list(csv.DictReader(opened))
    expected = summary(REPORTS["fit"]())
    assert [row["parameter"] for row in rows] == list(expected.index)
    assert [float(row["mean"]) for row in rows] == expected["mean"].tolist()  # every digit


@pytest.mark.thorough
@each("name", ["fit", "comparison"])
def test_a_report_can_be_printed(driver, reports, name: str) -> None:
    open_page(driver, reports(name), WIDTHS[1])
    assert printed(driver).startswith(b"%PDF")
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    size = {"width": 680, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)  # what A4 leaves
    hidden = driver.execute_script(
        "return ['nav', '.csv'].map(s => getComputedStyle(document.querySelector(s)).display)"
    )
    cut = driver.execute_script(
        "return [...document.querySelectorAll('table')].filter("
        "t => t.getBoundingClientRect().right > document.documentElement.clientWidth).length"
    )
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert hidden == ["none", "none"]
    assert cut == 0


@pytest.mark.thorough
def test_a_fault_is_found(driver, tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(
        '<!DOCTYPE html><body><img alt="gone" src="gone.png"><a href="#nowhere">x</a>'
        '<div style="width:2000px">wide</div><script>console.error("oh")</script>'
    )
    open_page(driver, page, WIDTHS[0])
    found = " ".join(faults(driver))
    for words in ("no picture: gone", "dead link: #nowhere", "scrolls sideways", "oh"):
        assert words in found


@pytest.mark.thorough
def test_cards_run_nothing_in_a_notebook(driver, tmp_path: Path) -> None:
    page = tmp_path / "cards.html"
    cards = [pb.show(REPORTS["evil"]()), pb.setups.SETUPS["goniometer"].scene, pb.PRIORS]
    text = "".join(card._repr_html_() for card in cards)
    page.write_text(
        f'<!DOCTYPE html><meta name="viewport" content="width=device-width"><body>{text}'
    )
    open_page(driver, page, WIDTHS[1])
    assert faults(driver) == []
    assert driver.execute_script("return document.scripts.length + document.images.length") == 0
