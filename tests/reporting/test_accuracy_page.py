"""The page and the figure of an accuracy study."""

import numpy as np
import pytest
from clipping import clipped
from matplotlib.text import Text
from synthetic_accuracy import ROWS, make_accuracy

import polar_bayes as pb

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.mark.thorough
def test_every_rung_as_given_is_named_and_nothing_is_cut_off():
    figure = pb.plots.plot_accuracy(make_accuracy())
    assert len(figure.axes) == 2
    for axes in figure.axes:
        named = {text.get_text() for text in axes.texts}
        assert named == {method for method, override in ROWS if override == "as given"}
    assert not clipped(figure)


@pytest.mark.thorough
def test_names_that_lie_close_do_not_cover_each_other():
    rows = {
        (f"method {at}", "as given"): ([0.1, 0.1, 0.1], 1.0 + 0.02 * at, 1.0) for at in range(4)
    }
    figure = pb.plots.plot_accuracy(make_accuracy(rows), times=["seconds_first"])
    figure.draw_without_rendering()
    boxes = [Text.get_window_extent(name) for name in figure.axes[0].texts]  # without its line
    for at, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:at])


@pytest.mark.thorough
def test_the_front_falls_from_left_to_right():
    (axes,) = pb.plots.plot_accuracy(make_accuracy(), times=["seconds_again"]).axes
    front = next(line for line in axes.lines if line.get_drawstyle() == "steps-post")
    seconds, error = front.get_data()
    assert (np.diff(seconds) > 0).all()
    assert (np.diff(error) < 0).all()
    assert error[-1] == pytest.approx(0.02)


@pytest.mark.thorough
def test_without_first_times_one_panel_is_drawn():
    assert len(pb.plots.plot_accuracy(make_accuracy(fresh=False)).axes) == 1


@pytest.mark.thorough
def test_a_column_that_is_no_time_is_refused():
    with pytest.raises(pb.FitError, match="there is no time gradients"):
        pb.plots.plot_accuracy(make_accuracy(), times=["gradients"])
