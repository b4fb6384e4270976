"""The page of a calibration: verdict first, failed fits counted, every figure explained."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from clipping import clipped
from synthetic_calibrations import make_calibration

import polar_bayes as pb
from polar_bayes.calibration import verdict
from polar_bayes.reporting.plots_calibration import parameter_ranks
from polar_bayes.reporting.report import render

pytestmark = pytest.mark.usefixtures("unpainted")

FAILED = (3, 50, 77)


@pytest.fixture(scope="module")
def good() -> xr.DataTree:
    return make_calibration(failed=FAILED)


@pytest.fixture(scope="module")
def broken() -> xr.DataTree:
    """Roughness is told too narrowly, and the index too high."""
    wrong = {"narrow": {"roughness": 0.7}, "shifted": {"refractive_index": 0.4}}
    return make_calibration(**wrong, failed=FAILED, method="laplace")


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
    "method", {"laplace": "method='nuts'", "importance": "method='nuts'", "nuts": "longer"}.items()
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


def test_a_page_checks_its_calibration_once_and_computes_its_table_once(monkeypatch):
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
