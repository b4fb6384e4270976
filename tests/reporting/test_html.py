"""The page stands alone, tells the truth first, and runs nothing that a capture smuggles in."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from cases import each
from pages import EVIL, Page
from synthetic_results import edit_provenance, make_result, replace

import polar_bayes as pb
from polar_bayes.diagnostics import convergence, criticism
from polar_bayes.diagnostics.checked import checks_made
from polar_bayes.diagnostics.compare import compare_without
from polar_bayes.diagnostics.convergence import Verdict, summary, verdict
from polar_bayes.diagnostics.criticism import criticize
from polar_bayes.diagnostics.view import FitView, view_of
from polar_bayes.errors import FitError, PolarBayesError
from polar_bayes.reporting import fit_page
from polar_bayes.reporting.report import render, report
from polar_bayes.reporting.text import interval, join, numbers, overconfidence, percent
from polar_bayes.results import load

SMALL = {"wavelengths": (), "views": 12, "draws": 150, "variables": ("dop",)}


@pytest.fixture(scope="module")
def page() -> Page:
    return Page(render(make_result(wavelengths=(450.0, 550.0), views=20, discrepancy=True)))


@pytest.fixture(scope="module")
def small() -> tuple[xr.DataTree, Page]:
    result = make_result(**SMALL)
    return result, Page(render(result))


@pytest.mark.thorough
def test_a_method_of_ones_own_has_its_own_name(small) -> None:
    result = edit_provenance(make_result(**SMALL, method="laplace"), method="my <b>own</b>")
    page = Page(render(result))
    assert "my <b>own</b>" in page.text
    assert "Laplace" not in page.text
    assert "The method raised no alarm." in page.text


def test_it_stands_alone(page: Page) -> None:
    assert page.open == []
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(page.tags)
    assert all(value.startswith("data:image/svg+xml;base64,") for value in page.values("src"))
    assert all(value.startswith(("#", "data:text/csv;")) for value in page.values("href"))
    assert not [name for _, name, _ in page.attributes if name.startswith("on")]
    assert not page.values("srcset") + page.values("action") + page.values("style")


def test_its_anchors_and_labels_lead_somewhere(page: Page) -> None:
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    assert {value[1:] for value in page.values("href") if value.startswith("#")} <= set(ids)
    assert set(page.values("aria-labelledby")) <= set(ids)
    assert page.tags.count("img") == len([alt for alt in page.values("alt") if alt])


def test_the_verdict_comes_first(page: Page) -> None:
    assert page.text.index("The fit converged.") < page.text.index("parameter mean sd")
    assert "The data determine" in page.text


def test_every_number_of_the_table_is_the_tree_s(small) -> None:
    result, page = small
    row = summary(result).loc["refractive_index"]
    for column in ("mean", "sd", "q2.5", "q97.5"):
        assert numbers([row[column]], row["sd"])[0] in page.text


def test_every_section_of_a_sampled_fit(small) -> None:
    for words in ("Convergence", "R-hat", "leave-one-out", "Each line is one chain", "Each dot"):
        assert words in small[1].text


@pytest.mark.thorough
@each(
    ("method", "absent", "present"),
    [
        ("laplace", ["R-hat"], ["Approximation", "Pareto k-hat", "What the prior said"]),
        (
            "point",
            ["R-hat", "prior said", "95%", "Pareto", "Convergence", "Each dot", "band", "sd "],
            ["Least squares met its tolerance", "standard error", "not determined"],
        ),
    ],
)
def test_sections_that_do_not_apply_are_left_out(method, absent, present) -> None:
    text = Page(render(make_result(**SMALL, method=method))).text
    assert [words for words in absent if words in text] == []
    assert [words for words in present if words not in text] == []


def test_a_failed_fit_says_so_first_and_claims_nothing_about_the_material() -> None:
    result = make_result(**SMALL)
    draws = result["posterior"].to_dataset()["roughness"].to_numpy().copy()
    draws[0] += 1.0
    text = Page(render(replace(result, "posterior", "roughness", draws))).text
    assert "did not converge: do not use these numbers" in text
    assert "R-hat above 1.01: roughness" in text
    assert "The data determine" not in text


@pytest.mark.thorough
@each("method", ["nuts", "laplace"])
def test_a_fit_without_a_single_finite_draw_still_has_a_page(method: str) -> None:
    result = make_result(**SMALL, method=method)
    for group in ("posterior", "posterior_predictive", "noise_free", "log_likelihood"):
        result[group] = xr.DataTree(result[group].to_dataset() * np.nan)
    text = Page(render(result)).text
    assert "do not use these numbers" in text
    assert "Not finite: roughness 100% of its draws" in text


@pytest.fixture(scope="module")
def evil_page() -> str:
    """Names that are markup, endless, or made of spaces."""
    names = (EVIL, "a" * 200, "b c " * 60)
    result = make_result(**{**SMALL, "views": 6}, materials=names, discrepancy=True)
    return render(
        edit_provenance(
            result,
            capture={EVIL: EVIL, "name": EVIL + "n" * 300},
            scene=EVIL,
            priors={EVIL: EVIL},
            problems=[EVIL],
        )
    )


def test_capture_metadata_is_text_and_nothing_else(evil_page: str) -> None:
    page = Page(evil_page)
    assert "script" not in page.tags
    assert not [name for _, name, _ in page.attributes if name.startswith("on")]
    assert f"Fit report: {EVIL}nnn" in page.text
    assert "default-src 'none'" in evil_page


def test_the_fit_without_discrepancy_is_called_overconfident(page: Page) -> None:
    assert "narrower by 60%. That is overconfident" in page.text
    assert "Do not quote the numbers without the discrepancy term" in page.text


@pytest.mark.thorough
def test_it_is_not_called_narrower_where_it_is_not() -> None:
    result = make_result(**SMALL, discrepancy=True)
    plain = result["without_discrepancy"].to_dataset()
    for name, factor in (("roughness", 4.0), ("refractive_index", 0.9)):
        plain[name] = plain[name].mean() + factor * (plain[name] - plain[name].mean())
    plain["absorption"] = plain["absorption"] + 10.0 * float(plain["absorption"].std())
    result["without_discrepancy"] = xr.DataTree(plain)
    said = overconfidence(
        view_of(result), compare_without(result, "discrepancy"), "the discrepancy term"
    )
    assert "intervals of subsurface fraction, absorption and refractive index are" in said[0]
    assert "of roughness is not narrower, as it happens" in said[1]
    assert said[2].startswith("The two fits disagree on absorption: ")
    assert said[3] == "Do not quote the numbers without the discrepancy term."


@pytest.mark.thorough
def test_a_comparison_that_failed_is_told() -> None:
    failed = {"without_discrepancy": "Fit: no mode was found; add views"}
    result = edit_provenance(make_result(**SMALL), comparisons_failed=failed)
    text = Page(render(result)).text
    assert "Without the discrepancy term This comparison failed, so nothing is said of it" in text
    assert "no mode was found; add views." in text


def test_it_says_whether_intervals_can_be_trusted(small) -> None:
    result, page = small
    assert (
        "Nothing speaks against the intervals in what was checked: chains (R-hat, effective sample "
        "sizes, divergences), priors, "
    ) in page.text
    assert "such intervals contain the truth, if the scene is the right one." in page.text
    scattered = Page(render(make_result(**{**SMALL, "draws": 250}, noise=4.0))).text
    assert "Nothing speaks against" not in scattered
    assert "The fit converged, but the readings speak against the model" in scattered
    assert "problem (fails)" in scattered
    doubted = Page(render(_in_conflict(result))).text
    assert "Trust the intervals with care: the cautions say what" in doubted
    assert "The fit converged. Mind the cautions." in doubted


def _in_conflict(result: xr.DataTree) -> xr.DataTree:
    """The result with a parameter in the tail of its prior, far enough for a caution."""
    return edit_provenance(result.copy(), prior_probability={"roughness": [0.997]})


def test_one_rule_judges_pit_values(monkeypatch: pytest.MonkeyPatch, small) -> None:
    """Verdict, first screen, section and card follow the level of the check, whatever the band."""
    levels = {"passed": 0.5, "caution": 0.01, "problem": 0.001}
    for level, p_value in levels.items():
        monkeypatch.setattr(criticism, "_uniformity", lambda pit, p=p_value: p)
        text, card = Page(render(small[0])).text, repr(pb.show(small[0]))
        is_passed = level == "passed"
        uniform = "distributed as the model expects (the check leave-one-out, p = 0.5)" in text
        assert uniform == is_passed
        for shown in (text, card):
            assert ("Nothing speaks against the intervals" in shown) == is_passed
            assert ("PIT values of dop are not uniform" in shown) != is_passed
            assert ("do not use these intervals" in shown) == (level == "problem")
        assert ("Trust the intervals with care" in text) == (level == "caution")


def test_what_is_said_to_be_checked_was_checked(small) -> None:
    """Checks for which there was nothing, or that were not computed, are not in the list."""
    table = criticize(small[0])
    made, missing = checks_made("nuts", table)
    assert made[0].startswith("chains")
    assert "outliers" in made
    assert "residuals over the wavelength" not in made  # there is one wavelength only
    assert missing == ()
    table.loc["outliers", "level"] = "not computed"
    made, missing = checks_made("laplace", table)
    assert made[0].startswith("the approximation")
    assert "outliers" not in made
    assert missing == ("outliers",)


def test_a_note_is_told_and_changes_nothing(monkeypatch: pytest.MonkeyPatch, small) -> None:
    def with_note(fit: FitView) -> pd.DataFrame:
        table = criticize(fit).copy()
        table.loc["bounds", ["level", "sentence"]] = "note", "No light from the body is seen."
        return table

    def verdict_with_note(fit: FitView) -> Verdict:
        return dataclasses.replace(verdict(fit), findings=("No light is seen.",))

    monkeypatch.setattr(fit_page, "criticize", with_note)
    monkeypatch.setattr(convergence, "verdict", verdict_with_note)
    for shown in (Page(render(small[0])).text, repr(pb.show(small[0]))):
        assert "The fit converged. " in f"{shown} ".replace("\n", " ")
        assert "Note: No light is seen." in shown
        assert "Nothing speaks against the intervals" in shown


def test_the_first_screen_tells_the_index_the_trust_and_the_next_views(small) -> None:
    result, page = small
    first = page.text.partition("parameter mean sd")[0]
    row = summary(result).loc["refractive_index"]
    assert f"The refractive index n is {numbers([row['mean']], row['sd'])[0]} (95% int" in first
    assert first.index("The refractive index n is") < first.index("Nothing speaks against")
    assert "What to measure next is not worked out here" in first
    told = result.copy()
    told["next_views"] = xr.Dataset(
        {
            "interval_width": (("step", "parameter"), [[0.4, 0.2], [0.1, 0.2]]),
            **{name: ("pick", [70.0]) for name in ("view_zenith", "light_zenith")},
            **{name: ("pick", [180.0]) for name in ("view_azimuth", "light_azimuth")},
        },
        coords={"parameter": ["refractive_index", "absorption"]},
    )
    assert (
        "Measure next at zenith 70, azimuth 180: the 95% interval of n is expected to narrow from "
        "0.4 to 0.1."
    ) in Page(render(told)).text
    told["next_views"] = told["next_views"].to_dataset().assign_coords(parameter=["a", "b"])
    assert "the 95% intervals are expected to narrow by 0% to 75%." in Page(render(told)).text


@pytest.mark.thorough
def test_no_comparison_without_one(small) -> None:
    assert "Without the discrepancy" not in small[1].text
    assert "trusting the instrument" not in small[1].text


def test_the_folder_holds_page_and_result_and_nothing_else(tmp_path: Path) -> None:
    result, folder = make_result(**SMALL), tmp_path / "deep" / "er"
    folder.mkdir(parents=True)
    report(make_result(**SMALL, seed=5), folder)  # an older report is replaced
    assert report(result, folder) == folder / "index.html"
    assert sorted(path.name for path in folder.iterdir()) == ["index.html", "result.nc"]
    assert (folder / "index.html").read_text().startswith("<!DOCTYPE html>")
    # What was written gives the same numbers and the same page, byte for byte.
    read = load(folder / "result.nc")
    pd.testing.assert_frame_equal(summary(read), summary(result))
    assert render(read) == (folder / "index.html").read_text()


@pytest.mark.thorough
def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(PolarBayesError, match="it could not be written") as error:
            report(make_result(**SMALL, method="point"), place)
        assert "\n" not in str(error.value)
        assert str(place) in str(error.value)


@each("wrong", [None, xr.DataTree(), "fit.nc"])
def test_what_is_no_result_leaves_no_folder(tmp_path: Path, wrong: object) -> None:
    with pytest.raises(FitError, match="it holds no fit"):
        report(wrong, tmp_path / "report")
    assert not (tmp_path / "report").exists()


@pytest.mark.thorough
def test_two_readings() -> None:
    assert "Predictive checks" in Page(render(make_result(**{**SMALL, "views": 2}))).text


def test_numbers_as_text() -> None:
    assert numbers([1.48283, 0.04031], 0.0403) == ["1.483", "0.040"]
    assert numbers([-0.001], 1.0) == ["0.00"]
    assert numbers([np.nan, 1234.5], 300.0)[1] == "1234"
    assert numbers([0.5], np.nan) == ["0.500"]
    assert interval(1.4, 1.5) == "[1.400, 1.500]"
    assert percent(0.084) == "8.4%"
    assert percent(0.12) == "12%"
    assert join(["a", "b", "c"]) == "a, b and c"
