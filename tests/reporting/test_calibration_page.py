"""The page of a calibration: verdict first, failed fits counted, every figure explained."""

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from cases import each
from clipping import clipped
from pages import EVIL, Page
from synthetic_calibrations import NAMES, make_calibration
from synthetic_results import make_result

import polar_bayes as pb
from polar_bayes.calibration import verdict
from polar_bayes.reporting.plots_calibration import parameter_ranks
from polar_bayes.reporting.report import render

FAILED = (3, 50, 77)


@pytest.fixture(scope="module")
def good() -> xr.DataTree:
    return make_calibration(failed=FAILED)


@pytest.fixture(scope="module")
def broken() -> xr.DataTree:
    """Roughness is told too narrowly, and the index too high."""
    wrong = {"narrow": {"roughness": 0.7}, "shifted": {"refractive_index": 0.4}}
    return make_calibration(**wrong, failed=FAILED, method="laplace")


@pytest.fixture(scope="module")
def page(good: xr.DataTree, broken: xr.DataTree) -> Page:
    return Page(render(good, comparisons={"laplace": broken}))


def test_it_stands_alone_and_its_anchors_lead_somewhere(page: Page) -> None:
    assert page.open == []
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(page.tags)
    assert all(value.startswith("data:image/svg+xml;base64,") for value in page.values("src"))
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    assert {value[1:] for value in page.values("href") if value.startswith("#")} <= set(ids)
    assert set(page.values("aria-labelledby")) <= set(ids)


def test_the_verdict_comes_first(page: Page, broken: xr.DataTree) -> None:
    assert page.text.index("Calibrated.") < page.text.index("Parameters were drawn")
    assert (
        "The ranks, coverage and spread of 3 parameters in 400 simulations pass a joint"
        in page.text
    )
    text = Page(render(broken)).text
    assert "Not calibrated." in text
    assert "roughness: intervals are too narrow (p = " in text
    assert "refractive_index: the posterior is too high (p = " in text
    table = pb.summary(broken)
    for label in ("roughness", "refractive_index"):
        said = f"the true {label.replace('_', ' ')} in {table.loc[label, 'held_95']:.1%}"
        assert said in text
    assert "0.0001 (fails)" in text


def test_every_number_of_the_table_is_the_tree_s(page: Page, good: xr.DataTree) -> None:
    for _, row in pb.summary(good).iterrows():
        held = f"{row['held_80']:.1%} ({100 * row['held_80_low']:.1f}"
        assert held in page.text
        assert f"{row['crps']:.3g}" in page.text


@pytest.mark.thorough
def test_readings_have_a_section_of_their_own(good: xr.DataTree) -> None:
    assert "Status of the fits" in Page(render(good)).text
    assert 'id="readings"' not in render(good)
    tree = make_calibration(failed=FAILED, readings={"dop": 0.7})
    page = Page(render(tree))
    assert page.open == []
    assert "Parameters are calibrated, predicted readings are not." in page.text
    assert "fail a joint test of their own that a right model fails 5% of the time" in page.text
    assert "degree of polarization, left out" in page.text
    assert "predictions are too narrow" in page.text
    assert "0.0001 (fails)" in page.text
    assert "3 of 400" in page.text
    assert any("Distribution of the ranks of readings" in x for x in page.values("alt"))


@pytest.mark.thorough
def test_failed_fits_are_counted_everywhere(page: Page) -> None:
    for said in (
        "3 of 400 fits: not converged.",
        "3 of 400 fits have no answer.",
        "all tests pass 3 of 400",
        "not converged no answer was reached; NaN 3 0.8% 0",
        "none no numbers 3 0.8% 0",
        "Pareto k above 0.7 39 of 397 fits that know it (9.8%)",
        "effective draws: median 302",
    ):
        assert said in page.text
    text = Page(render(make_calibration(failed=tuple(range(60))))).text
    assert "Calibrated, but 15% of the fits failed." in text
    assert 'class="verdict failed"' in render(make_calibration(failed=tuple(range(60))))


def test_every_figure_says_how_to_read_it(page: Page) -> None:
    assert page.tags.count("img") == page.tags.count("figcaption") == 4
    assert all(page.values("alt"))
    for said in (
        "in at most one of twenty right calibrations",
        "intervals are too narrow",
        "in at least 19 of 20 calibrations",
        "Dots belong on the dashed lines at 50, 80 and 95%",
        "estimates shrink towards the prior",
        "Band and dots are those of importance; the others are drawn over it.",
    ):
        assert said in page.text


@pytest.mark.thorough
def test_the_comparison_says_which_parameter_and_how(page: Page) -> None:
    assert "Of 3 parameters none fails by importance, 2 fail by laplace." in page.text
    assert "by laplace intervals are too narrow (p = 0.0001); " in page.text
    assert "score against importance" in page.text
    assert "subsurface_fraction: " not in page.text


@pytest.mark.thorough
def test_many_parameters_stay_readable() -> None:
    names = tuple(f"parameter_{at}" for at in range(15))
    page = Page(render(make_calibration(names=names, count=60)))
    assert page.tags.count("img") == 8
    alternatives = page.values("alt")
    assert all(any(f"{name}" in said for said in alternatives) for name in names)
    assert page.text.count("The same of parameter_12, parameter_13 and parameter_14.") == 4


@pytest.mark.thorough
def test_wavelengths_are_parameters_of_their_own() -> None:
    colors = (450.0, 650.0)
    page = Page(render(make_calibration(names=NAMES[:1], wavelengths=colors, count=60)))
    assert "roughness[450] roughness, 450 nm" in page.text
    assert "2 parameters in 60 simulations" in page.text


@pytest.mark.thorough
def test_a_check_that_is_broken_on_purpose_says_so() -> None:
    page = Page(render(make_calibration(count=60, truth={"priors": "Uniform(0, 1)"})))
    assert "differs on purpose from what was fitted, in its priors" in page.text


@pytest.fixture(scope="module")
def evil_page() -> str:
    names = ("a" * 60, "x")
    own = {"capture": EVIL, "scene": EVIL, "priors": {EVIL: EVIL * 20}, "versions": {"a": EVIL}}
    asked = {"names": names, "count": 40, "failed": (1,)}
    return render(
        make_calibration(**asked, **own, method=EVIL),
        comparisons={EVIL + "2": make_calibration(**asked)},
    )


def test_names_are_text_and_nothing_else(evil_page: str) -> None:
    page = Page(evil_page)
    assert "script" not in page.tags
    assert not [name for _, name, _ in page.attributes if name.startswith("on")]
    assert f"Calibration report: {EVIL}" in page.text
    assert "default-src 'none'" in evil_page


@pytest.mark.thorough
def test_every_table_scrolls_in_a_box_of_its_own(evil_page: str) -> None:
    tables = re.findall(r"<div class=\"scroll[^>]*>\s*<table id", evil_page)
    assert len(tables) == evil_page.count("<table") == 4


@pytest.mark.thorough
def test_a_calibration_without_an_answer_has_a_page() -> None:
    text = Page(render(make_calibration(count=30, failed=tuple(range(30))))).text
    assert "Not calibrated" in text
    assert "100% of the fits failed" in text
    assert not re.search(r"\bnan\b", text)


def test_the_folder_holds_page_and_calibration(tmp_path: Path, broken: xr.DataTree) -> None:
    page = pb.report(broken, tmp_path / "report")
    assert sorted(path.name for path in page.parent.iterdir()) == ["calibration.nc", "index.html"]
    read = pb.load(page.parent / "calibration.nc")
    assert render(read) == page.read_text()


def test_arguments_that_do_not_apply_are_refused(tmp_path: Path, good: xr.DataTree) -> None:
    fit = make_result(wavelengths=(), views=2, draws=10, variables=("dop",))
    for asked, says in (
        (
            (fit, {"comparisons": {"laplace": good}}),
            "comparisons: it goes with calibrations only",
        ),
        ((good, {"truth": xr.Dataset()}), "report: truth: it goes with maps only"),
        (
            (good, {"comparisons": {"laplace": fit}}),
            "comparisons, laplace: it is no calibration",
        ),
        ((good, {"comparisons": {"importance": good}}), "give it another name"),
        ((good, {"comparisons": {f"{at}": good for at in range(5)}}), "too many for one figure"),
        (
            (good, {"comparisons": {"other": make_calibration(names=NAMES[:1])}}),
            "it has other parameters than importance",
        ),
    ):
        with pytest.raises(pb.FitError, match=re.escape(says)) as error:
            pb.report(asked[0], tmp_path / "report", **asked[1])
        assert "\n" not in str(error.value)
    assert not (tmp_path / "report").exists()


# --- figures --------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_row_for_each_parameter(broken: xr.DataTree) -> None:
    figure = pb.plots.plot_calibration(broken)
    assert clipped(figure) == []
    assert len(figure.axes) == 9
    some = pb.plots.plot_calibration(broken, parameters=["refractive_index"])
    assert len(some.axes) == 3
    with pytest.raises(pb.FitError, match="no parameter gloss; give some of roughness, "):
        pb.plots.plot_calibration(broken, parameters=["gloss"])
    with pytest.raises(pb.FitError, match="it holds no calibration; give the tree"):
        pb.plots.plot_calibration(xr.DataTree())


@pytest.mark.thorough
def test_positive_parameters_of_many_sizes_have_logarithmic_axes() -> None:
    tree = make_calibration(names=("concentration_scale",), count=60)
    for group, name in (("truth", "concentration_scale"), ("marginals", "concentration_scale")):
        tree[group][name].to_numpy()[...] = 10.0 ** (8.0 * tree[group][name].to_numpy() - 1.0)
    figure = pb.plots.plot_calibration(tree)
    axes = figure.axes[2]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    figure.canvas.draw()
    labels = [label.get_text() for label in (*axes.get_xticklabels(), *axes.get_yticklabels())]
    assert any(labels)
    assert not any("$" in label or "{" in label for label in labels)  # numbers, no formulas


@pytest.mark.thorough
def test_dots_mark_where_the_curve_leaves_its_band(broken: xr.DataTree) -> None:
    figure = pb.plots.plot_calibration(broken)
    marked = [any(line.get_marker() == "o" for line in axes.lines) for axes in figure.axes[::3]]
    assert marked == [not part.passes for part in parameter_ranks(broken).values()]
    assert np.sum(marked) == 2


@each(
    "method",
    {"laplace": "method='nuts'", "importance": "method='nuts'", "nuts": "longer"}.items(),
)
def test_where_half_of_the_fits_fail_a_better_method_is_named(method) -> None:
    name, advice = method
    failed = make_calibration(count=40, failed=tuple(range(20)), method=name)
    told = " ".join(pb.verdict(failed).sentences)
    assert "20 of 40 fits have no answer, and count as misses of every interval above." in told
    assert "Half of the fits or more have failed" in told
    assert advice in told
    few = " ".join(pb.verdict(make_calibration(count=40, failed=(1,), method=name)).sentences)
    assert "1 of 40 fits have no answer" in few
    assert "Half of the fits" not in few


def test_a_page_checks_its_calibration_once_and_computes_its_table_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tree, checked, rows = make_calibration(readings={"dop": 1.0}), [], []
    check, row = verdict.check_calibration, verdict._parameter_row

    def counted_row(scalar, *arguments):
        rows.append(scalar.label)
        return row(scalar, *arguments)

    def counted_check(calibration) -> None:
        checked.append(calibration is tree)
        check(calibration)

    monkeypatch.setattr(verdict, "check_calibration", counted_check)
    monkeypatch.setattr(verdict, "_parameter_row", counted_row)
    render(tree)
    assert checked == [True]
    assert sorted(rows) == sorted(set(rows))
