"""Table, front and advice of studies whose numbers are known."""

import numpy as np
import pytest
from synthetic_accuracy import ROWS, make_accuracy

import polar_bayes as pb
from polar_bayes.benchmark.advice import accuracy_table, accuracy_view, pareto_front


def test_the_table_has_the_worst_parameter_of_every_row():
    table = pb.summary(make_accuracy())
    assert list(table.index) == ["point", "laplace", "laplace, draws x 4", "nuts", "nuts long"]
    np.testing.assert_allclose(table["error"], [0.9, 0.4, 0.4, 0.05, 0.02])
    assert set(table["worst"]) == {"subsurface_fraction"}
    np.testing.assert_allclose(table["interval"], table["error"] / 2)
    # Twice the standard error of the reference, 0.012.
    assert list(table["resolved"]) == [True, True, True, True, False]


@pytest.mark.thorough
def test_the_larger_of_mean_and_sd_counts():
    study = make_accuracy()
    study["accuracy"]["sd_error"][1, 0] = -0.7
    assert accuracy_view(study).errors.loc["laplace", "roughness"] == 0.7


def test_the_front_holds_what_nothing_beats():
    seconds = np.array([1.0, 2.0, 2.0, 3.0, np.nan, 0.5])
    error = np.array([0.5, 0.1, 0.2, 0.1, 0.0, np.nan])
    assert list(pareto_front(seconds, error)) == [True, True, False, False, False, False]


@pytest.mark.thorough
def test_two_rows_that_are_alike_are_both_on_the_front():
    assert pareto_front(np.array([1.0, 1.0]), np.array([0.2, 0.2])).all()


def test_a_cheap_method_is_advised_for_all_but_what_it_gets_wrong():
    assert pb.benchmark.accuracy_sentences(make_accuracy()) == [
        "laplace is within 0.08 sd here and 6 times faster than nuts, but for "
        "subsurface_fraction; use nuts for it."
    ]


@pytest.mark.thorough
def test_without_first_times_the_next_ones_count():
    assert (
        "60 times faster than nuts"
        in pb.benchmark.accuracy_sentences(make_accuracy(fresh=False))[0]
    )


@pytest.mark.thorough
def test_a_cheap_method_that_is_good_for_all_is_advised_without_reserve():
    rows = ROWS | {("laplace", "as given"): ([0.08, 0.06, 0.02], 3.0, 0.1)}
    assert pb.benchmark.accuracy_sentences(make_accuracy(rows)) == [
        "laplace is within 0.08 sd here and 6 times faster than nuts; use it."
    ]


@pytest.mark.thorough
def test_times_that_hardly_differ_are_alike():
    rows = ROWS | {("nuts long", "as given"): ([0.02, 0.01, 0.01], 31.0, 9.0)}
    rows |= {("nuts", "as given"): ([0.05, 0.02, 0.02], 30.0, 9.0)}
    rows |= {("laplace", "as given"): ([0.4, 0.3, 0.3], 30.0, 9.0)}
    assert pb.benchmark.accuracy_sentences(make_accuracy(rows)) == [
        "nuts is within 0.05 sd here and as fast as nuts long; use it."
    ]


@pytest.mark.thorough
def test_a_smaller_tolerance_asks_for_more():
    assert pb.benchmark.accuracy_sentences(make_accuracy(), tolerance=0.03) == [
        "nuts is within 0.03 sd here and 3.3 times faster than nuts long, but for "
        "subsurface_fraction; use nuts long for it."
    ]


def test_where_nothing_is_good_enough_the_nearest_is_named():
    assert pb.benchmark.accuracy_sentences(make_accuracy(), tolerance=0.001) == [
        "No method is within 0.001 sd here; nuts long comes nearest, and is off by 0.02 sd for "
        "subsurface_fraction."
    ]


def test_a_doubtful_reference_is_told_with_the_advice():
    _, said = pb.benchmark.accuracy_sentences(make_accuracy(doubts="its R-hat is 1.300"))
    assert said.startswith(
        "Use this advice with care, since the reference is in doubt: its R-hat is 1.300."
    )


@pytest.mark.thorough
def test_rows_without_an_answer_are_neither_advised_nor_on_the_front():
    rows = {("laplace", "as given"): ([np.nan] * 3, np.nan, np.nan)}
    study = make_accuracy(rows)
    assert not pb.summary(study)["on_front"].any()
    assert pb.benchmark.accuracy_sentences(study) == ["No method has an answer here."]


def test_what_holds_no_study_is_refused():
    study = make_accuracy()["accuracy"].to_dataset()
    with pytest.raises(pb.FitError, match="accuracy/mean_error: it is missing; give the tree as"):
        accuracy_table(study.drop_vars("mean_error"))


@pytest.mark.thorough
def test_a_tolerance_of_nothing_is_refused():
    with pytest.raises(pb.FitError, match="tolerance is 0"):
        pb.benchmark.accuracy_sentences(make_accuracy(), tolerance=0.0)


def test_a_study_survives_a_file(tmp_path):
    study = make_accuracy()
    pb.save(study, tmp_path / "accuracy.nc")
    again = pb.load(tmp_path / "accuracy.nc")
    assert pb.summary(again).equals(pb.summary(study))
    with pytest.raises(pb.FitError, match="it holds no fit"):
        pb.load(tmp_path / "accuracy.nc", "fit")
    pb.save(study["accuracy"].to_dataset(), tmp_path / "other.nc")
    with pytest.raises(pb.FitError, match="it holds no accuracy"):
        pb.load(tmp_path / "other.nc", "accuracy")
