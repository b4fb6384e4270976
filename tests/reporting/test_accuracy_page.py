"""The page and the figure of an accuracy study."""

import numpy as np
import pytest
from clipping import clipped
from matplotlib.text import Text
from pages import Page
from synthetic_accuracy import ROWS, make_accuracy
from synthetic_results import make_result

import polar_bayes as pb
from polar_bayes.reporting.report import render
from polar_bayes.reporting.text import reference_sentence


@pytest.fixture(scope="module")
def page() -> Page:
    return Page(render(make_accuracy()))


def test_it_stands_alone_and_its_anchors_lead_somewhere(page):
    assert page.open == []
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(page.tags)
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    assert set(page.values("aria-labelledby")) <= set(ids)
    assert "<leaf>" in page.text


def test_the_advice_comes_first_and_the_reference_with_it(page):
    assert page.text.index("use nuts for it") < page.text.index("Error against time")
    assert "10,000 draws of NUTS with an effective sample size of 5,000" in page.text
    assert "is at most 0.012 posterior sd." in page.text


@pytest.mark.thorough
def test_an_error_that_the_reference_cannot_tell_is_marked(page):
    row = page.text[page.text.index("nuts long") :]
    assert "< 0.024" in row


def test_a_doubtful_reference_is_said_in_red():
    study = make_accuracy(doubts="its R-hat is 1.3")
    assert "verdict failed" in render(study)
    assert reference_sentence(study).endswith("Against it speaks: its R-hat is 1.3.")


@pytest.mark.thorough
def test_the_report_lies_beside_its_file(tmp_path):
    page = pb.report(make_accuracy(), tmp_path / "report")
    again = pb.load(page.parent / "accuracy.nc")
    assert page.read_text() == render(again)
    with pytest.raises(pb.FitError, match="it goes with calibrations only"):
        pb.report(make_accuracy(), tmp_path / "other", comparisons={})


def test_a_fit_that_holds_a_study_shows_it():
    result = make_result()
    result["accuracy"] = make_accuracy()["accuracy"]
    text = Page(render(result)).text
    assert "Accuracy against time" in text
    assert "use nuts for it" in text


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
