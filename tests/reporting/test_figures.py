"""Every figure draws for every kind of result, clips nothing and leaves matplotlib as it was."""

import functools

import matplotlib
import numpy as np
import pytest
from cases import each
from clipping import clipped
from matplotlib.figure import Figure
from synthetic_results import edit_provenance, make_result, replace

from polar_bayes.diagnostics.view import view_of
from polar_bayes.errors import FitError
from polar_bayes.reporting import plots_fit
from polar_bayes.reporting.plots_curves import curves, minus_center, plot_readings, plot_residuals

CASES = {
    "three wavelengths, four azimuths": {"azimuths": (180.0, 150.0, 120.0, 60.0)},
    "one wavelength": {"wavelengths": (550.0,)},
    "no wavelength": {"wavelengths": ()},
    "two views": {"wavelengths": (), "views": 2},
    "signed": {"variables": ("q",), "wavelengths": ()},
    "masked and set aside": {"masked": (0, 5, 6), "limit": 78.0},
    "all directions": {"azimuths": tuple(np.linspace(-170.0, 180.0, 40)), "wavelengths": ()},
    "materials": {"materials": ("leaf", "fr$ui_t^", "<script>"), "wavelengths": (450.0,)},
    "many wavelengths": {"wavelengths": tuple(range(400, 700, 25))},
    "unusual names": {"materials": ("\u53f6\u5b50", "a" * 300, "line\nbreak"), "wavelengths": ()},
    "laplace": {"method": "laplace", "discrepancy": True},
    "point": {"method": "point"},
}


@functools.cache
def result_of(case: str):
    return make_result(**{"draws": 50, "views": 10, **CASES[case]})


FIRST = (
    "three wavelengths, four azimuths", "masked and set aside", "unusual names", "laplace",
    "two views",
)  # fmt: skip


@pytest.mark.parametrize(
    "case", [x if x in FIRST else pytest.param(x, marks=pytest.mark.thorough) for x in CASES]
)
def test_readings_of_every_layout(case: str) -> None:
    result = result_of(case)
    for draw, name in ((plot_readings, "dop"), (plot_residuals, "intensity")):
        figure = draw(result, name if name in result["observed_data"].data_vars else "q")
        assert clipped(figure) == []
        assert figure.legends[0].get_texts()


@pytest.mark.thorough
@each(
    "draw",
    [
        plots_fit.plot_pairs,
        plots_fit.plot_ranks,
        plots_fit.plot_prior_posterior,
        plots_fit.plot_pit,
    ],
)
@each(
    "case",
    [
        "three wavelengths, four azimuths",
        "no wavelength",
        "two views",
        "materials",
        "unusual names",
        "laplace",
    ],
)
def test_parameters_and_checks_of_every_layout(case: str, draw) -> None:
    assert clipped(draw(result_of(case))) == []


def test_nothing_global_changes() -> None:
    before = dict(matplotlib.rcParams)
    result = result_of("one wavelength")
    plot_readings(result, "dop")
    plots_fit.plot_pairs(result)
    with pytest.raises(FitError):
        plot_readings(result, "u")
    assert dict(matplotlib.rcParams) == before


def test_saturated_masked_and_set_aside_views_are_marked() -> None:
    result = make_result(wavelengths=(), masked=(3,), limit=78.0, draws=100)
    saturated = np.zeros(40, "int8")
    saturated[20] = 1
    result = replace(result, "constant_data", "saturated", saturated)
    figure = plot_readings(result, "intensity")
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    for expected in ("saturated", "masked: not fitted", "set aside: beyond the angle limit"):
        assert expected in words
    lines = {line.get_marker(): line.get_xdata() for line in figure.axes[0].lines}
    assert len(lines["^"]) == 1
    assert len(lines["x"]) == 1 + 4  # one masked, four beyond 78 degrees


@pytest.mark.thorough
def test_bands_hold_their_share_of_new_readings() -> None:
    curve = curves(view_of(make_result(wavelengths=(), draws=1000)), "dop")[0]
    assert np.all(np.diff(curve.levels, axis=0) > 0.0)
    inside = (curve.levels[0] < curve.observed) & (curve.observed < curve.levels[-1])
    assert inside.mean() > 0.85
    moved = minus_center(curve)
    np.testing.assert_allclose(moved.observed + curve.center, curve.observed)


@pytest.mark.thorough
def test_no_band_where_the_scatter_is_not_known() -> None:
    """A masked view has no stated error, so its predicted scatter means nothing."""
    result = make_result(wavelengths=(), limit=70.0, draws=100)
    axes = plot_readings(result, "dop").axes[0]
    reach = max(path.vertices[:, 0].max() for band in axes.collections for path in band.get_paths())
    assert reach <= 70.0
    assert axes.lines[0].get_xdata().max() > 80.0


@pytest.mark.thorough
def test_a_point_fit_has_a_curve_and_no_bands() -> None:
    figure = plot_readings(result_of("point"), "dop")
    assert not figure.axes[0].collections


@each(
    ("draw", "needed"),
    [
        (plots_fit.plot_pairs, "two material parameters with draws"),
        (plots_fit.plot_ranks, "two chains"),
        (plots_fit.plot_prior_posterior, "draws of the prior"),
        (plots_fit.plot_pit, "two readings and 100 draws"),
    ],
)
def test_nothing_to_draw_is_an_error_of_one_line(draw, needed: str) -> None:
    with pytest.raises(FitError, match=f"nothing to draw; give a result that has {needed}"):
        draw(result_of("point"))


@pytest.mark.thorough
def test_parameters_that_do_not_move_are_left_out() -> None:
    result = make_result(draws=100, discrepancy=True)
    result = replace(result, "posterior", "roughness", np.full((4, 100), 0.2))
    result = replace(result, "posterior", "subsurface_fraction", np.full((4, 100), np.nan))
    names = [scalar.name for scalar in plots_fit.drawable(result)]
    assert "roughness" not in names
    assert "subsurface_fraction" not in names
    assert "discrepancy_weights" not in names
    assert clipped(plots_fit.plot_pairs(result)) == []


@pytest.mark.thorough
def test_figures_need_no_provenance() -> None:
    result = edit_provenance(make_result(draws=100, wavelengths=()))
    result.attrs.clear()
    for draw in (plots_fit.plot_pairs, plots_fit.plot_ranks, plots_fit.plot_pit):
        assert isinstance(draw(result), Figure)
    assert isinstance(plot_readings(result, "dop"), Figure)
