"""The page of a map: what became of the pixels comes first, and coverage where truth is known."""

import base64
import html
import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from cases import each
from synthetic_maps import make_maps
from synthetic_results import make_result

import polar_bayes as pb
from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.reporting.maps import count_cases
from polar_bayes.reporting.report import render
from polar_bayes.reporting.text import count_percent, map_headline

EVIL = "<script>alert(1)</script>"
SHAPE = (10, 20)
MEANS = {
    "roughness": np.full(SHAPE, 0.5),
    "subsurface_fraction": np.linspace(0.2, 0.4, 200).reshape(SHAPE),
    "concentration_scale": np.full(SHAPE, 300.0),
}


def mixed(**asked: object) -> xr.Dataset:
    """Of 200 pixels 160 are good: 100 by weights, 50 by a fitted proposal, 10 by NUTS."""
    status, approach = np.full(200, Status.GOOD), np.full(200, MethodUsed.IMPORTANCE)
    approach[100:150], approach[150:160] = MethodUsed.ADAPTED, MethodUsed.NUTS
    status[160:195], approach[160:195] = Status.MASKED, MethodUsed.NONE
    status[195:197], approach[195:197] = Status.TOO_FEW_VIEWS, MethodUsed.NONE
    status[197:199], approach[197:199] = Status.NOT_TRUSTED, MethodUsed.LAPLACE
    status[199], approach[199] = Status.NOT_CONVERGED, MethodUsed.NONE
    flags = {"status": status.reshape(SHAPE), "approach": approach.reshape(SHAPE)}
    return make_maps(MEANS, **flags, **asked)


def truth(name: str = "leaf") -> xr.Dataset:
    spread = ((np.arange(200) * 37 % 200 + 0.5) / 200).reshape(SHAPE)
    return xr.Dataset({"true_roughness": (("y", "x"), spread)}, attrs={"name": name})


def text_of(page: str) -> str:
    """What a reader sees, and nothing of the style."""
    body = re.sub(r"<[^>]*>", " ", page.partition("<body>")[2])
    return html.unescape(" ".join(body.split()))


@pytest.fixture(scope="module")
def page() -> str:
    maps = mixed(scene="paper", model="per_material", priors={"roughness": "Beta(2, 3)"})
    bare = make_maps(MEANS, width=0.5, method="laplace")
    return render(maps, truth=truth(), uncorrected=bare)


def test_the_verdict_says_what_became_of_the_pixels(page: str) -> None:
    text = text_of(page)
    for said in (
        "160 of 165 pixels that were read have an answer (97%).",
        "Of 200 pixels 160 are good (80%): 100 by weighted draws of normal approximations, "
        "50 by a proposal fitted to its own draws and corrected by weights and 10 by sampling",
        "35 pixels are masked: no reading there is valid.",
        "2 pixels are read in fewer than 2 views and not fitted.",
        "1 pixel is not converged",
        "2 pixels are not trusted: Pareto k is above 0.7",
    ):
        assert said in text
    assert text.index("160 of 165") < text.index("5% below")


def test_tables_count_pixels_by_status_and_approach(page: str) -> None:
    text = text_of(page)
    assert "masked no valid reading 35 18%" in text
    assert "not trusted numbers that no check confirms, by the approach in the next table 2" in text
    assert "nuts sampling (NUTS) 10 5.0% 10" in text
    assert "laplace the normal approximation as it is 2 1.0% 0" in text


@pytest.mark.thorough
def test_parameters_are_described_over_the_good_pixels(page: str) -> None:
    # Good are the first 160 of 200 values from 0.2 to 0.4; the width of 95% is 0.95.
    assert "subsurface_fraction 0.28 0.21 0.35 0.29 0.95" in text_of(page)


def test_provenance_is_there(page: str) -> None:
    text = text_of(page)
    assert "Map report: leaf" in text
    assert "10 x 20 pixels. Scene paper, model per_material" in text
    assert "roughness Beta(2, 3)" in text


def test_coverage_stands_beside_that_of_a_map_that_was_not_corrected(page: str) -> None:
    text = text_of(page)
    assert "corrected within of all read uncorrected within of all read" in text
    assert "roughness roughness r 50% 49.4%" in text
    assert "48.0% (too few)" in text
    assert (
        "Without the correction: the 95% intervals hold the truth less often than they say" in text
    )
    left = "Left out: 35 masked and 5 read without an answer."
    assert f"Corrected: 160 pixels with an answer are counted. {left}" in text
    assert "Uncorrected: 200 pixels with an answer are counted. None is left out." in text
    assert "concentration_scale 95%" not in text


@pytest.mark.thorough
def test_without_a_truth_nothing_is_said_of_coverage() -> None:
    page = render(mixed())
    assert 'id="coverage"' not in page
    assert "hold the truth" not in page
    assert "Map report: map" in page


@pytest.mark.thorough
def test_what_is_named_like_markup_is_text() -> None:
    page = render(
        mixed(scene=EVIL, model=EVIL, priors={EVIL: EVIL}, settings={EVIL: EVIL}), truth=truth(EVIL)
    )
    assert "<script" not in page
    assert "Map report: &lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "default-src 'none'" in page


@pytest.mark.thorough
def test_every_parameter_is_drawn_four_at_a_time_and_a_few_wavelengths() -> None:
    colors = (400.0, 500.0, 600.0, 700.0)
    names = ("refractive_index", "roughness", "subsurface_fraction", "angle_zero", "dark_level")
    means = {name: np.full((3, 4), 0.5) for name in names}
    means["refractive_index"] = np.full((3, 4, 4), 1.5)
    page = render(make_maps(means, wavelengths=colors))
    pictures = re.findall(r'<img.*? src="data:image/svg\+xml;base64,([^"]*)" alt="([^"]*)"', page)
    said = [alternative for _, alternative in pictures]
    first = "Maps of roughness, subsurface_fraction, refractive_index and angle_zero at 400 nm"
    assert said[0] == f"{first}, with Pareto k, approach and status"
    assert [words.split(",")[0] for words in said[1:]] == [
        "Maps of refractive_index at 600 nm",
        "Maps of refractive_index at 700 nm",
        "Maps of dark_level",
    ]
    assert all(b"<svg" in base64.b64decode(source) for source, _ in pictures)


@pytest.mark.thorough
def test_a_map_that_was_not_checked_says_so_and_an_empty_one_fails() -> None:
    unchecked = text_of(render(mixed(method="laplace")))
    assert "The approximation was taken as it is (method='laplace')" in unchecked
    for status, said in (
        (Status.NOT_CONVERGED, "No pixel has an answer: do not use these maps."),
        (Status.MASKED, "No pixel was read: these maps are empty."),
    ):
        page = render(make_maps(MEANS, status=np.full(SHAPE, status)), truth=truth())
        assert said in page
        assert 'class="verdict failed"' in page
        assert not re.search(r"\bnan\b", text_of(page))


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
    assert [path.name for path in (tmp_path / "report").iterdir()] == ["index.html"]
    assert page.read_text() == render(mixed(), truth=truth())


def test_arguments_that_do_not_apply_are_refused(tmp_path: Path) -> None:
    fit, maps = make_result(wavelengths=(), views=2, draws=10, variables=("dop",)), mixed()
    for asked, says in (
        ((fit, {"truth": truth()}), "report: truth: it goes with maps only"),
        ((fit, {"uncorrected": maps}), "report: uncorrected: it goes with maps only"),
        ((maps, {"uncorrected": maps}), "it is compared with the truth only; give truth="),
        ((maps, {"truth": truth(), "uncorrected": maps}), "it was corrected as well"),
        (
            (maps, {"truth": truth(), "uncorrected": maps.isel(y=slice(3))}),
            "it is of another image",
        ),
        ((maps, {"truth": xr.Dataset()}), "it knows the truth of no parameter"),
        ((xr.Dataset(), {}), "it holds no fit"),
    ):
        with pytest.raises(pb.PolarBayesError, match=re.escape(says)) as error:
            pb.report(asked[0], tmp_path / "report", **asked[1])
        assert "\n" not in str(error.value)
    assert not (tmp_path / "report").exists()
