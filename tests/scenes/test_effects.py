"""What is kept, what is dropped, what the user forces, and where the ledger goes."""

import dataclasses
import pickle

import linear
import numpy as np
import pytest
import xarray as xr
from cases import each
from plates import LINKS, plate_capture
from synthetic_results import make_result

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of
from polar_bayes.reporting.report import render
from polar_bayes.scenes.effects import ledger_sentences, ledger_table

MATERIAL = ("body", "slope")
TINY = pb.methods.Laplace(chains=2, draws=50)


LINEAR = {"scene": linear.SCENE, "links": linear.LINKS, "model": linear.model}


def straight(q, **options):
    """A choice in the linear model, whose readings are these."""
    capture = plate_capture(np.linspace(20.0, 75.0, len(q)), 0.1, seed=0).assign(q=("view", q))
    return pb.choose_effects(capture, **{**LINEAR, "parameters": MATERIAL, **options})


@pytest.fixture(scope="module")
def q() -> np.ndarray:
    """Readings that pull at both tight parameters alike."""
    x = np.linspace(0.0, 1.0, 15)
    column = linear.columns(x)
    noise = np.random.default_rng(3).normal(0.0, 0.01, x.size)
    return 0.2 + 0.3 * x + 0.5 * column["gain"] + noise


def exact(q, *gone):
    """Largest change of the material's two parameters without some of the columns."""
    names = ["body", "slope", "angle_zero", "dark_level", "gain"]
    mean, covariance = linear.posterior(q, names)
    sd = np.sqrt(np.diagonal(covariance))[:2]
    less, narrower = linear.posterior(q, [name for name in names if name not in gone])
    shift = np.abs(less[:2] - mean[:2]) / sd
    return max(shift.max(), np.abs(np.sqrt(np.diagonal(narrower))[:2] / sd - 1.0).max())


def test_what_moves_nothing_is_dropped_and_what_moves_is_kept(
    chosen: pb.scenes.ChosenScene,
) -> None:
    ledger = chosen.ledger
    assert ledger["kept"].sel(effect="BeamOverlap").item() is False
    np.testing.assert_array_equal(ledger["kept"], ledger["change"] > ledger.attrs["tolerance"])
    terms = () if chosen.instrument is None else chosen.instrument.terms
    assert [type(term).__name__ for term in terms] == list(
        ledger["effect"].where(ledger["kept"], drop=True).to_numpy()
    )
    assert ledger["judged"].all()
    assert ledger.attrs["combined_change"] <= 0.1


def test_a_row_says_what_the_rule_saw(chosen: pb.scenes.ChosenScene) -> None:
    row = chosen.ledger.sel(effect="BeamOverlap")
    assert row["largest_move"] == 0.0
    assert row["reason"].item() == (
        "alone no parameter changes by more than 0.001 sd; not fitted then: beam_overlap_zenith"
    )
    for name in ("operations", "compile_seconds", "run_seconds", "shift", "change"):
        assert {"units", "long_name"} <= set(chosen.ledger[name].attrs)
    assert chosen.ledger.attrs["full_operations"] >= chosen.ledger.attrs["chosen_operations"] > 0


def test_the_table_and_the_sentences(chosen: pb.scenes.ChosenScene) -> None:
    table = ledger_table(chosen.ledger)
    assert list(table.columns) == ["data", "shift", "sd", "operations", "time", "result"]
    assert list(table.index) == list(chosen.ledger["effect"].to_numpy())
    assert table["result"].str.match("kept: |dropped: ").all()
    first, second, last = ledger_sentences(chosen.ledger)
    assert first.endswith(f"of {len(table)} effects are kept.")
    assert second.startswith("Leaving out the others together")
    assert last.endswith(" ms.")


def test_two_that_are_light_alone_and_heavy_together_do_not_both_go(q: np.ndarray) -> None:
    first, second = exact(q, "angle_zero"), exact(q, "dark_level")
    both = exact(q, "angle_zero", "dark_level")
    assert max(first, second) < 0.7 * both, "the readings do not pose the question"
    ledger = straight(q, tolerance=0.5 * (max(first, second) + both)).ledger
    heavier = "AngleZero" if first > second else "DarkLevel"
    assert ledger["kept"].sel(effect=heavier)
    assert ledger["kept"].sel(effect=["AngleZero", "DarkLevel"]).sum() == 1
    said = ledger["reason"].sel(effect=heavier).item()
    assert said.startswith("without all other effects that may be dropped, ")
    assert ledger.attrs["combined_change"] == pytest.approx(min(first, second), rel=1e-3)
    looser = straight(q, tolerance=1.1 * both).ledger
    assert not looser["kept"].sel(effect=["AngleZero", "DarkLevel"]).any()
    assert looser.attrs["combined_change"] == pytest.approx(both, rel=1e-3)


def test_what_the_user_keeps_stays_and_what_the_user_drops_goes(q: np.ndarray) -> None:
    drop_gain = {"keep": "AngleZero", "drop": ["instrument.terms[2]"], "tolerance": 1e6}
    choice = straight(q, **drop_gain)
    assert [type(term) for term in choice.instrument.terms] == [pb.instrument.AngleZero]
    reasons = choice.ledger["reason"]
    assert reasons.sel(effect="AngleZero").item().startswith("by your choice; ")
    assert reasons.sel(effect="DolpGain").item().startswith("by your choice; ")
    assert choice.ledger["forced"].to_numpy().tolist() == [True, False, True]
    assert "By your choice DolpGain is left out." in ledger_sentences(choice.ledger)


@pytest.mark.thorough
def test_the_rule_asks_what_the_rest_changes_beside_what_the_user_drops(q: np.ndarray) -> None:
    choice = straight(q, drop="DolpGain", tolerance=1e6)
    names = ["body", "slope", "angle_zero", "dark_level"]
    (mean, covariance), (less, _) = linear.posterior(q, names), linear.posterior(q, names[:2])
    shift = (less - mean[:2]) / np.sqrt(np.diagonal(covariance))[:2]
    found = choice.ledger["combined_shift"].sel(parameter=names[:2])
    np.testing.assert_allclose(found, shift, atol=1e-3)
    assert np.isnan(choice.ledger["combined_shift"].sel(parameter="gain"))


def test_a_parameter_that_the_user_names_is_not_given_up(q: np.ndarray) -> None:
    ledger = straight(q, parameters=["dark_level"], tolerance=1e6).ledger
    assert ledger["kept"].to_numpy().tolist() == [False, True, False]
    reason = ledger["reason"].sel(effect="DarkLevel").item()
    assert "no judged parameter is left without it" in reason


@each(
    ("options", "message"),
    [
        ({"keep": "Fog"}, "keep='Fog': the scene has no such effect; give one of AngleZero"),
        (
            {"keep": "DarkLevel", "drop": "DarkLevel"},
            "DarkLevel: the effect is in both keep and drop",
        ),
        ({"tolerance": 0.0}, "choose_effects: tolerance is 0.0; give posterior"),
        ({"scene": "camer"}, "scene='camer': no such scene"),
        ({"parameters": ["fog"]}, "parameters: 'fog': the scene with everything on has no such"),
        ({"priors": {"fog": None}}, r"priors\['fog'\]: no such parameter in this model"),
    ],
)
def test_a_mistake_is_named(q: np.ndarray, options: dict, message: str) -> None:
    with pytest.raises(pb.PolarBayesError, match=message):
        straight(q, **options)


@pytest.mark.thorough
def test_a_scene_without_effects_is_returned_as_it_is(plate: xr.Dataset) -> None:
    bare = pb.Scene(pb.SmoothSurface())
    choice = pb.choose_effects(plate, scene=bare, links=LINKS)
    assert repr(choice) == repr(bare)
    assert "no effect" in ledger_sentences(choice.ledger)[0]


@pytest.mark.thorough
def test_the_ledger_belongs_to_its_scene_alone_and_can_be_saved(chosen, full, tmp_path) -> None:
    assert dataclasses.replace(chosen, coat=pb.ClearCoat()).ledger is None
    known = chosen.known_to([pb.input_quantities.LightZenith()])
    assert known.ledger is known.perfectly_known.ledger is chosen.ledger
    for term in known.terms:
        assert known.without(type(term)).ledger is None
    assert full.ledger is None
    assert repr(chosen).startswith("Scene(")
    again = pickle.loads(pickle.dumps(chosen))
    assert again.ledger.identical(chosen.ledger)
    assert again == chosen
    chosen.ledger.to_netcdf(tmp_path / "ledger.nc")
    with xr.open_dataset(tmp_path / "ledger.nc") as opened:
        assert opened.load().identical(chosen.ledger)


@pytest.mark.thorough
def test_a_fit_keeps_the_ledger(chosen: pb.scenes.ChosenScene, plate: xr.Dataset, tmp_path) -> None:
    result = pb.fit(plate, scene=chosen, links=LINKS, method=TINY)
    pb.save(result, tmp_path / "fit.nc")
    ledger = pb.load(tmp_path / "fit.nc")["effects"].to_dataset()
    assert ledger_table(ledger).equals(ledger_table(chosen.ledger))
    assert ledger_sentences(ledger) == ledger_sentences(chosen.ledger)
    assert provenance_of(result)["scene_parts"].startswith("Scene(")
    plain = pb.fit(plate, scene=dataclasses.replace(chosen), links=LINKS, method=TINY)
    assert "effects" not in plain.children
    xr.testing.assert_equal(plain["posterior"].to_dataset(), result["posterior"].to_dataset())


@pytest.mark.thorough
def test_the_report_shows_the_ledger(chosen: pb.scenes.ChosenScene) -> None:
    result = make_result(wavelengths=(), views=12, draws=100, variables=("dop",))
    assert 'id="effects"' not in render(result)
    result["effects"] = xr.DataTree(chosen.ledger)
    page = render(result)
    assert page.index('<section id="effects">') < page.index('<section id="provenance">')
    assert '<a href="#effects">' in page
    assert all(sentence in page for sentence in ledger_sentences(chosen.ledger))
    for name, result in ledger_table(chosen.ledger)["result"].items():
        assert f"<code>{name}</code>" in page
        assert result in page
