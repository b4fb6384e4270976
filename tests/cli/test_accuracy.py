"""The study and the automatic choice from the command line."""

import json

import pytest
from synthetic_accuracy import make_accuracy

import polar_bayes as pb
from polar_bayes.cli import main

pytestmark = pytest.mark.usefixtures("unpainted")


@pytest.fixture
def studied(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Stands in for the study, and holds what it was asked."""
    asked: dict[str, object] = {}

    def accuracy(capture, partial=None, **settings):
        asked.clear()
        asked.update(settings)
        if partial is not None:
            partial(make_accuracy())
        return make_accuracy()

    monkeypatch.setattr(pb, "accuracy", accuracy)
    return asked


def test_it_prints_table_and_advice_and_writes_the_study(plate, tmp_path, capsys, studied):
    out = tmp_path / "accuracy.nc"
    assert main(["accuracy", str(plate), "--out", str(out)]) == 0
    told = capsys.readouterr()
    first, refined = told.out.split(f"\nIt is refined now, which takes minutes; {out} holds what")
    assert first.splitlines()[0] == "First answer, by a rough reference:"
    assert first.splitlines()[2].split()[:2] == ["error", "worst"]
    advice = " ".join(pb.benchmark.accuracy_sentences(make_accuracy()))
    assert advice in refined.splitlines()
    assert "worst: the parameter that has it" in refined
    assert refined.splitlines()[-1].startswith(f"Next: polar-bayes fit {plate} --method NAME")
    assert ": off by " in told.err
    assert set(studied["methods"]) == set(pb.methods.STUDY_METHODS)
    assert "overrides" not in studied
    assert pb.summary(pb.load(out)).equals(pb.summary(make_accuracy()))
    report = tmp_path / "report"
    assert main(["report", str(out), "--out", str(report)]) == 0
    assert "Error against time" in (report / "index.html").read_text()


@pytest.mark.thorough
def test_rungs_and_dials_are_chosen_and_json_is_json(plate, tmp_path, capsys, studied):
    words = ["accuracy", str(plate), "--out", str(tmp_path / "a.nc"), "--json", "--no-overrides"]
    assert main([*words, "--method", "laplace", "--method", "nuts", "--tolerance", "0.001"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert set(said["rows"]) == set(pb.summary(make_accuracy()).index)
    assert said["advice"].startswith("No method is within 0.001 sd")
    assert list(studied["methods"]) == ["laplace", "nuts"]
    assert studied["overrides"] == ()


@pytest.mark.thorough
def test_the_automatic_choice_says_what_it_did(plate, tmp_path, capsys, monkeypatch) -> None:
    asked: dict[str, object] = {}
    fit = pb.fit

    def quick(capture, **settings):
        asked.update(settings)
        del settings["tolerance"], settings["seconds"]
        return fit(capture, **settings | {"method": "point"})

    monkeypatch.setattr(pb, "fit", quick)
    monkeypatch.setattr(pb.inference, "auto_sentences", lambda result: ["point (0.1 s) was taken."])
    words = ["fit", str(plate), "--out", str(tmp_path / "fit.nc"), "--method", "auto"]
    assert main([*words, "--tolerance", "0.2", "--seconds", "30"]) in (0, 2)
    assert "point (0.1 s) was taken." in capsys.readouterr().err
    assert (asked["method"], asked["tolerance"], asked["seconds"]) == ("auto", 0.2, 30.0)
