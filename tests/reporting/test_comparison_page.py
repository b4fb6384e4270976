"""The page of several fits: which predicts best, where they disagree, and how they were made."""

from pathlib import Path

import numpy as np
import pytest
from pages import EVIL, Page
from synthetic_results import edit_provenance, make_result, replace

import polar_bayes as pb
from polar_bayes.cli import main
from polar_bayes.errors import FitError
from polar_bayes.reporting.report import render

SMALL = {"wavelengths": (), "views": 16, "draws": 150, "variables": ("dop",)}


def worse(by: float, **asked):
    result = make_result(**SMALL, **asked)
    density = result["log_likelihood"].to_dataset()["dop"]
    return replace(result, "log_likelihood", "dop", density - by * (1 + density["view"] % 3))


@pytest.fixture(scope="module")
def page() -> Page:
    first = make_result(**SMALL)
    other = edit_provenance(worse(1.0), model="hierarchical", priors={"roughness": "Beta(1, 9)"})
    return Page(render({"plain": first, "other": other}))


def test_the_verdict_names_the_better_fit_first(page: Page) -> None:
    assert "plain predicts the readings best." in page.text
    assert "other predicts left-out readings worse than plain" in page.text
    assert page.text.index("predicts the readings best") < page.text.index("fit elpd difference")


@pytest.mark.thorough
def test_fits_that_cannot_be_told_apart_are_not_ranked() -> None:
    text = Page(render({"a": make_result(**SMALL), "b": worse(1e-3)})).text
    assert "The readings do not tell which of these fits predicts best." in text
    assert "b predicts them about as well as a." in text


def test_several_fits_by_name_have_the_figure_of_their_comparison() -> None:
    fits = {"a": make_result(**SMALL), "b": worse(1.0)}
    compared = pb.plots.plot_comparison(pb.diagnostics.compare_fits(fits))
    assert len(pb.plot(fits).axes) == len(compared.axes)
    with pytest.raises(FitError, match="compare_fits: b: it holds no fit"):
        pb.plot({**fits, "b": 3})


def test_what_differs_is_listed_and_nothing_else(page: Page) -> None:
    rows = page.text.partition("What differs asked for plain other")[2].partition("Only what")[0]
    assert "model per_material hierarchical" in rows
    assert "priors roughness Normal(loc=0.2, scale=0.05) Beta(1, 9)" in rows
    assert "seed" not in rows


@pytest.mark.thorough
def test_intervals_that_do_not_overlap_are_named() -> None:
    moved = make_result(**SMALL)
    draws = moved["posterior"].to_dataset()["roughness"].to_numpy() + 5.0
    moved = replace(moved, "posterior", "roughness", draws)
    text = Page(render({"a": make_result(**SMALL), "b": moved})).text
    assert "do not overlap for roughness (a and b)" in text


def test_a_failed_fit_is_named_first() -> None:
    broken = edit_provenance(make_result(**SMALL), problems=["no mode was reached"])
    text = Page(render({"a": make_result(**SMALL), "b": broken})).text
    assert "Do not use the numbers of b" in text
    assert "b: No mode was reached." in text


@pytest.mark.thorough
def test_names_are_text_and_nothing_else() -> None:
    odd = edit_provenance(make_result(**SMALL), scene=EVIL, priors={EVIL: EVIL})
    page = Page(render({EVIL: odd, "b": make_result(**SMALL, method="point")}))
    assert page.open == []
    assert "script" not in page.tags
    assert not [name for _, name, _ in page.attributes if name.startswith("on")]


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
