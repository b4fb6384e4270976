"""The page stands alone, tells the truth first, and runs nothing that a capture smuggles in."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from cases import each
from pages import Page
from synthetic_results import SMALL, make_result

import polar_bayes as pb
from polar_bayes.diagnostics import convergence, criticism
from polar_bayes.diagnostics.checked import checks_made
from polar_bayes.diagnostics.compare import compare_without
from polar_bayes.diagnostics.convergence import Verdict, summary, verdict
from polar_bayes.diagnostics.criticism import criticize
from polar_bayes.diagnostics.view import FitView, view_of
from polar_bayes.errors import PolarBayesError
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.reporting import fit_page
from polar_bayes.reporting.report import render, report
from polar_bayes.reporting.text import QUESTIONS, interval, join, numbers, overconfidence, percent

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.fixture(scope="module")
def small() -> xr.DataTree:
    return make_result(**SMALL)


def test_every_number_of_the_table_is_the_tree_s(small: xr.DataTree) -> None:
    text, row = Page(render(small)).text, summary(small).loc["refractive_index"]
    for column in ("mean", "sd", "q2.5", "q97.5"):
        assert numbers([row[column]], row["sd"])[0] in text


@pytest.mark.thorough
@each("method", ["nuts", "laplace"])
def test_a_fit_without_a_single_finite_draw_still_has_a_page(method: str) -> None:
    result = make_result(**SMALL, method=method)
    for group in ("posterior", "posterior_predictive", "noise_free", "log_likelihood"):
        result[group] = xr.DataTree(result[group].to_dataset() * np.nan)
    text = Page(render(result)).text
    assert "do not use these numbers" in text
    assert "Not finite: roughness 100% of its draws" in text


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


def test_one_rule_judges_pit_values(monkeypatch: pytest.MonkeyPatch, small) -> None:
    """Verdict, first screen, section and card follow the level of the check, whatever the band."""
    levels = {"passed": 0.5, "caution": 0.01, "problem": 0.001}
    for level, p_value in levels.items():
        monkeypatch.setattr(criticism, "_uniformity", lambda pit, p=p_value: p)
        text, card = Page(render(small)).text, repr(pb.show(small))
        is_passed = level == "passed"
        uniform = "distributed as the model expects (the check leave-one-out, p = 0.5)" in text
        assert uniform == is_passed
        for shown in (text, card):
            assert ("Nothing speaks against the intervals" in shown) == is_passed
            assert ("PIT values of dop are not uniform" in shown) != is_passed
            assert ("do not use these intervals" in shown) == (level == "problem")
        assert ("Use the intervals with care" in text) == (level == "caution")


def test_what_is_said_to_be_checked_was_checked(small) -> None:
    """Checks for which there was nothing, or that were not computed, are not in the list."""
    table = criticize(small)
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
    for shown in (Page(render(small)).text, repr(pb.show(small))):
        assert "The fit converged. " in f"{shown} ".replace("\n", " ")
        assert "Note: No light is seen." in shown
        assert "Nothing speaks against the intervals" in shown


def test_the_first_screen_tells_the_next_views(small) -> None:
    told = small.copy()
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
    views = told["next_views"].to_dataset()
    told["next_views"] = views.assign(
        interval_width=views["interval_width"][[0, 0]] * [[1.0], [0.99]]
    )
    assert "180: but 95% intervals of n narrow by 1.0% at most." in Page(render(told)).text
    told["next_views"] = views.assign_coords(parameter=["a", "b"])
    assert "the 95% intervals are expected to narrow by 0% to 75%." in Page(render(told)).text
    told["next_views"] = views.assign_attrs({PROVENANCE: '{"limits": [5.0, 75.0, 20.0]}'})
    assert (
        "from 0.4 to 0.1. Candidates had zeniths from 5 to 75 degrees, at least 20 degrees from "
        "the light; where light and viewer would collide, state their smallest angle by "
        "constraints=pb.design.Constraints(from_light=30), or polar-bayes identify --from-light 30."
    ) in Page(render(told)).text


def test_the_guide_asks_the_questions_of_the_first_screen() -> None:
    guide = (Path(__file__).parents[2] / "docs" / "reading_a_report.md").read_text()
    assert all(f"**{question}**" in guide for question in QUESTIONS)


@pytest.mark.thorough
def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(PolarBayesError, match="it could not be written") as error:
            report(make_result(**SMALL, method="point"), place)
        assert "\n" not in str(error.value)
        assert str(place) in str(error.value)


def test_numbers_as_text() -> None:
    assert numbers([1.48283, 0.04031], 0.0403) == ["1.483", "0.040"]
    assert numbers([-0.001], 1.0) == ["0.00"]
    assert numbers([np.nan, 1234.5], 300.0)[1] == "1234"
    assert numbers([0.5], np.nan) == ["0.500"]
    assert interval(1.4, 1.5) == "[1.400, 1.500]"
    assert percent(0.084) == "8.4%"
    assert percent(0.12) == "12%"
    assert join(["a", "b", "c"]) == "a, b and c"
