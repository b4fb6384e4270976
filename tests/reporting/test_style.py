"""Every figure is a figure of its own, in the style that its reader has chosen."""

import hashlib
import importlib

import matplotlib
import matplotlib.style
import numpy as np
import pytest
from cases import each
from matplotlib import rcParams
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from synthetic_accuracy import make_accuracy
from synthetic_calibrations import make_calibration
from synthetic_maps import make_maps
from synthetic_results import SMALL, make_result, pool

import polar_bayes as pb
from polar_bayes.reporting.report import report

DRAWN = {
    "plot_accuracy": lambda: pb.plots.plot_accuracy(make_accuracy()),
    "plot_calibration": lambda: pb.plots.plot_calibration(make_calibration()),
    "plot_comparison": lambda: pb.plots.plot_comparison(compared()),
    "plot_maps": lambda: pb.plots.plot_maps(make_maps({"roughness": np.eye(4)})),
    "plot_pairs": lambda: pb.plots.plot_pairs(make_result(**SMALL)),
    "plot_pit": lambda: pb.plots.plot_pit(make_result(**SMALL)),
    "plot_prior_posterior": lambda: pb.plots.plot_prior_posterior(make_result(**SMALL)),
    "plot_ranks": lambda: pb.plots.plot_ranks(make_result(**SMALL)),
    "plot_readings": lambda: pb.plots.plot_readings(make_result(**SMALL), "dop"),
    "plot_residuals": lambda: pb.plots.plot_residuals(make_result(**SMALL), "dop"),
    "plot_shrinkage": lambda: pb.plots.plot_shrinkage(pooled(), "roughness"),
    "plot_spectrum": lambda: pb.plots.plot_spectrum(make_result(views=12, draws=150), "absorption"),
}


def compared():
    return pb.diagnostics.compare_fits(
        {"a": make_result(**SMALL), "b": make_result(**SMALL, method="point")}
    )


def pooled():
    return pool(make_result(**SMALL, materials=("leaf", "fruit", "stone")), "roughness")


def test_every_public_plot_is_tested_here() -> None:
    assert set(DRAWN) == {name for name in pb.plots.__all__ if name.startswith("plot_")}


@each("draw", DRAWN.values(), ids=DRAWN)
def test_a_plot_takes_the_chosen_style_and_pyplot_does_not_know_it(draw) -> None:
    with matplotlib.style.context("dark_background"):
        before = dict(rcParams)
        figure = draw()
        assert isinstance(figure, Figure)
        assert figure.axes
        assert figure._repr_png_().startswith(b"\x89PNG")  # as a notebook shows it
        assert dict(rcParams) == before
    assert not hasattr(figure, "number")  # which pyplot gives to its own
    assert to_hex(figure.get_facecolor()) == "#000000"
    labels = [text for a in figure.axes for text in (a.xaxis.label, a.yaxis.label, a.title)]
    assert {to_hex(text.get_color()) for text in labels if text.get_text()} <= {"#ffffff"}


@pytest.mark.thorough
def test_single_settings_are_taken_too() -> None:
    with matplotlib.rc_context({"xtick.labelsize": 5.0, "axes.grid": True}):
        axes = DRAWN["plot_readings"]().axes[0]
    assert axes.get_xticklabels()[0].get_fontsize() == 5.0
    assert axes.get_xgridlines()[0].get_visible()


@pytest.mark.thorough
def test_a_style_of_arviz_is_taken() -> None:
    importlib.import_module("arviz_plots")  # which registers its styles
    with matplotlib.style.context("arviz-variat"):
        figure = DRAWN["plot_pairs"]()
        expected = to_hex(rcParams["figure.facecolor"])
    assert to_hex(figure.get_facecolor()) == expected
    assert figure._repr_png_()


@pytest.mark.thorough
def test_names_stay_text_in_every_style() -> None:
    result = make_result(**SMALL, materials=("$x_{", "b"))
    with matplotlib.rc_context({"text.parse_math": True}):
        assert pb.plots.plot_readings(result, "dop")._repr_png_()


@pytest.mark.thorough
def test_a_report_is_the_same_in_every_style(tmp_path) -> None:
    result = make_result(**SMALL, method="point")
    with matplotlib.style.context("dark_background"):
        dark = report(result, tmp_path / "dark")
    plain = report(result, tmp_path / "plain")
    seen = {hashlib.sha256(page.read_bytes()).hexdigest() for page in (dark, plain)}
    assert len(seen) == 1
