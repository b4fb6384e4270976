"""The page of a map: what became of the pixels comes first, and coverage where truth is known."""

import html
import re
from pathlib import Path

import numpy as np
import pytest
from cases import each
from reporting.test_pages import MEANS, mixed, truth
from synthetic_maps import make_maps

import polar_bayes as pb
from polar_bayes.reporting.maps import count_cases
from polar_bayes.reporting.report import render
from polar_bayes.reporting.text import count_percent, map_headline

pytestmark = pytest.mark.usefixtures("unpainted")


def text_of(page: str) -> str:
    """Return the visible text of a page, without its style."""
    body = re.sub(r"<[^>]*>", " ", page.partition("<body>")[2])
    return html.unescape(" ".join(body.split()))


@pytest.mark.thorough
@each("name", ["roughness", "roughness_sd", "concentration_scale_quantile"])
@each("number", [np.nan, np.inf])
def test_a_pixel_that_is_called_good_without_numbers_is_not(name: str, number: float) -> None:
    maps = make_maps(MEANS)
    assert map_headline(count_cases(maps))[0].startswith("Every pixel")
    maps[name][{"y": 2, "x": slice(3, 10)}] = number
    assert pb.maps.count_pixels(maps) == dict.fromkeys(pb.maps.count_pixels(maps), 0) | {
        "good": 193,
        "not fitted": 7,
    }
    page = render(maps)
    for said in (
        "7 of 200 pixels are not fitted: this map has holes.",
        "Of 200 pixels 193 are good (96%)",
        "7 pixels are not fitted: they are called good without finite numbers, or were never",
    ):
        assert said in text_of(page)
        assert said in " ".join(str(pb.show(maps)).split())
    assert 'class="verdict failed"' in page
    assert "Every pixel" not in page


@pytest.mark.thorough
def test_a_status_without_a_meaning_is_refused() -> None:
    maps = make_maps(MEANS)
    maps["status"][1, 1] = 77
    with pytest.raises(pb.FitError, match="maps: status: 77 has no meaning there; copy the store"):
        pb.show(maps)


@pytest.mark.thorough
def test_shares_are_never_rounded_to_all_or_nothing() -> None:
    assert count_percent(99_999, 100_000) == "above 99.9%"
    assert count_percent(9_960, 10_000) == "above 99.5%"
    assert count_percent(1, 100_000) == "below 0.1%"
    assert count_percent(5, 5) == "100%"


def test_the_folder_holds_the_page(tmp_path: Path) -> None:
    page = pb.report(mixed(), tmp_path / "report", truth=truth())
    names = sorted(path.name for path in (tmp_path / "report").iterdir())
    assert names == ["explore.html", "index.html"]
    assert page.read_text() == render(mixed(), truth=truth())
