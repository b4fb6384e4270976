"""Calibrations side by side, and in which way each strays."""

import pytest
from synthetic_calibrations import make_calibration

import polar_bayes as pb


@pytest.fixture(scope="module")
def compared():
    calibrations = {
        "laplace": make_calibration(
            narrow={"roughness": 0.6}, shifted={"refractive_index": 0.5}, failed=(2, 9)
        ),
        "importance": make_calibration(),
    }
    return pb.calibration.compare_calibrations(calibrations)


def test_each_parameter_by_each_method(compared) -> None:
    assert list(compared.index.names) == ["parameter", "method"]
    assert len(compared) == 6
    assert compared["passes"].to_dict() == {
        (label, method): method == "importance" or label == "subsurface_fraction"
        for label, method in compared.index
    }
    said = compared["deviation"].xs("laplace", level="method")
    assert said["roughness"].startswith(
        "intervals are too narrow (p = 0.0001); 50%, 80%, 95% inter"
    )
    assert "; the truths scatter 1.6" in said["roughness"]
    assert said["refractive_index"].startswith("the posterior is too high (p = 0.0001)")
    assert (compared.xs("laplace", level="method")["failed"] == 2).all()


def test_scores_are_compared_fit_by_fit(compared) -> None:
    """The exact posterior has the best expected score; where both are exact none is better."""
    for label in ("roughness", "refractive_index"):
        row = compared.loc[(label, "importance")]
        assert row["score_change"] < -2.0 * row["score_change_error"]
    assert compared.loc[("subsurface_fraction", "importance"), "score_change"] == 0.0
    others = pb.calibration.compare_calibrations(
        {"a": make_calibration(), "b": make_calibration(seed=1)}
    )
    assert others.xs("b", level="method")["score_change"].isna().all()


@pytest.mark.thorough
def test_sentences_name_what_fails_and_what_mends_it(compared) -> None:
    said = pb.calibration.comparison_sentences(compared)
    assert said[0] == "Of 3 parameters 2 fail by laplace, none fails by importance."
    assert said[1].startswith("roughness: by laplace intervals are too narrow (p = 0.0001); 50%")
    assert "; by importance all tests pass (95% intervals hold 9" in said[1]
    assert len(said) == 3


@pytest.mark.thorough
def test_a_shift_alone_is_not_called_a_width() -> None:
    for shift in (-1.0, -0.4, 0.4, 1.0):
        tree = make_calibration(shifted={"roughness": shift}, count=4000)
        way = pb.calibration.compare_calibrations({"a": tree})["deviation"].iloc[0]
        shape, *others = way.split("; ")
        assert shape == f"the posterior is too {'high' if shift > 0.0 else 'low'} (p = 0.0001)"
        assert not any("scatter" in each for each in others)


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(pb.FitError, match="nothing to compare"):
        pb.calibration.compare_calibrations({})
    few = make_calibration(names=("roughness",))
    with pytest.raises(pb.FitError, match="b: it has other parameters than a; calibrate the same"):
        pb.calibration.compare_calibrations({"a": make_calibration(), "b": few})
