"""Table, front and advice of studies whose numbers are known."""

import numpy as np
import pytest
from cases import each
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


def test_the_front_holds_what_nothing_beats() -> None:
    seconds = np.array([1.0, 2.0, 2.0, 3.0, np.nan, 0.5])
    error = np.array([0.5, 0.1, 0.2, 0.1, 0.0, np.nan])
    assert list(pareto_front(seconds, error)) == [True, True, False, False, False, False]
    assert pareto_front(np.array([1.0, 1.0]), np.array([0.2, 0.2])).all()


GOOD = {("laplace", "as given"): ([0.08, 0.06, 0.02], 3.0, 0.1)}
ALIKE = {
    ("nuts long", "as given"): ([0.02, 0.01, 0.01], 31.0, 9.0),
    ("nuts", "as given"): ([0.05, 0.02, 0.02], 30.0, 9.0),
    ("laplace", "as given"): ([0.4, 0.3, 0.3], 30.0, 9.0),
}
LAPLACE = "laplace is within 0.08 sd here and {} times faster than nuts{}"
WEAK = ", but for subsurface_fraction; use {} for it."


@each(
    ("study", "asked", "said"),
    [
        ({}, {}, LAPLACE.format(6, WEAK.format("nuts"))),
        ({"fresh": False}, {}, LAPLACE.format(60, WEAK.format("nuts"))),
        ({"rows": ROWS | GOOD}, {}, LAPLACE.format(6, "; use it.")),
        (
            {"rows": ROWS | ALIKE},
            {},
            "nuts is within 0.05 sd here and as fast as nuts long; use it.",
        ),
        (
            {},
            {"tolerance": 0.03},
            "nuts is within 0.03 sd here and 3.3 times faster than nuts long"
            + WEAK.format("nuts long"),
        ),
        (
            {},
            {"tolerance": 0.001},
            "No method is within 0.001 sd here; nuts long comes nearest, and is off by 0.02 sd for "
            "subsurface_fraction.",
        ),
    ],
)
def test_the_cheapest_method_that_is_good_enough_is_advised(study, asked, said) -> None:
    """For all but what it gets wrong; first times count where they are known."""
    assert pb.benchmark.accuracy_sentences(make_accuracy(**study), **asked) == [said]


def test_a_doubtful_reference_is_told_with_the_advice():
    _, said = pb.benchmark.accuracy_sentences(make_accuracy(doubts="its R-hat is 1.300"))
    assert said.startswith(
        "Use this advice with care, since the reference is in doubt: its R-hat is 1.300."
    )


@pytest.mark.thorough
def test_rows_without_an_answer_are_neither_advised_nor_on_the_front():
    study = make_accuracy({("laplace", "as given"): ([np.nan] * 3, np.nan, np.nan)})
    assert not pb.summary(study)["on_front"].any()
    assert pb.benchmark.accuracy_sentences(study) == ["No method has an answer here."]


def test_what_holds_no_study_or_asks_for_nothing_is_refused():
    study = make_accuracy()["accuracy"].to_dataset()
    with pytest.raises(pb.FitError, match="accuracy/mean_error: it is missing; give the tree as"):
        accuracy_table(study.drop_vars("mean_error"))
    with pytest.raises(pb.FitError, match="tolerance is 0"):
        pb.benchmark.accuracy_sentences(make_accuracy(), tolerance=0.0)
