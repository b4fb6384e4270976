"""The comparison of scenes, the stacked posterior, and what is said about them."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from cases import each
from numpyro import distributions as dist
from plates import LINKS, PLATE, plate_capture, plates

import polar_bayes as pb
from polar_bayes.scenes import comparison as selection
from polar_bayes.scenes.comparison import FitArguments, between_scenes, stacking_weights
from polar_bayes.scenes.library import SceneLibrary
from polar_bayes.scenes.sentences import SceneComparison, film_cautions
from polar_bayes.scenes.stacking import stack_fits

MIRROR = pb.Scene(pb.SmoothSurface())
SCENES = {"mirror": MIRROR, "with body": PLATE}


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 75.0, 14), 0.004, seed=2)


@pytest.fixture(scope="module")
def comparison(capture: xr.Dataset) -> SceneComparison:
    return pb.compare_scenes(capture, SCENES, links=LINKS)


def test_a_comparison_ends_when_its_time_is_up(capture: xr.Dataset) -> None:
    """The first scene is fitted whatever the time; the others are named."""
    stages: dict[str, float] = {}
    found = pb.compare_scenes(
        capture, SCENES, links=LINKS, seconds=1e-3, progress=lambda *each: stages.update([each])
    )
    assert list(found.table.index) == ["mirror"]
    assert found.left_out == {"with body": "the time was up"}
    assert "with body could not be fitted: the time was up." in pb.scenes.scene_sentences(found)
    assert next(iter(stages)) == "comparing scenes: mirror (1 of at most 2)"
    with pytest.raises(pb.FitError, match="seconds is 0; give a time above 0"):
        pb.compare_scenes(capture, SCENES, links=LINKS, seconds=0)


def test_the_scene_of_the_data_predicts_best(comparison: SceneComparison) -> None:
    assert comparison.table.index[0] == "with body"
    assert comparison.table["weight"].sum() == pytest.approx(1.0)
    assert comparison.weights["with body"] > 0.5
    low, high = comparison.intervals.loc[("refractive_index", "with body"), ["q2.5", "q97.5"]]
    assert low < 1.5 < high
    assert ("subsurface_fraction", "mirror") not in comparison.intervals.index


def test_a_prior_is_used_by_the_scenes_that_read_it(capture: xr.Dataset) -> None:
    priors = {"subsurface_fraction": dist.Beta(1.0, 9.0)}
    arguments = FitArguments(capture, "per_material", priors, LINKS, None, 0, "double")
    among = arguments.among(SCENES.values())
    assert among.request(PLATE).priors["subsurface_fraction"] is priors["subsurface_fraction"]
    assert "subsurface_fraction" not in among.request(MIRROR).priors
    with pytest.raises(pb.FitError, match="roughness"):
        dataclasses.replace(among, priors={"roughness": dist.HalfNormal(0.1)}).request(PLATE)


def test_scenes_of_a_capture_that_names_no_set_up_have_no_perfect_instrument(
    capture: xr.Dataset,
) -> None:
    def quantities(capture: xr.Dataset) -> set[str]:
        arguments = FitArguments(capture, "per_material", None, LINKS, None, 0, "double")
        return {type(term).__name__ for term in arguments.measured.request(PLATE).scene.terms}

    assert "setup" not in capture.attrs
    assert {"IncidenceAngle", "PolarizationLoss"} <= quantities(capture)
    assert quantities(capture.assign_attrs(setup="paper")) == set()


def test_a_stacked_posterior_is_a_fit_with_draws_of_every_scene(
    comparison: SceneComparison, tmp_path: Path
) -> None:
    weights = {"mirror": 0.25, "with body": 0.75}
    stacked = stack_fits(comparison.fits, weights)
    n = stacked["posterior"]["refractive_index"]
    each = {
        name: np.isin(n, fit["posterior"]["refractive_index"]).mean()
        for name, fit in comparison.fits.items()
    }
    assert each["mirror"] == pytest.approx(0.25, abs=0.02)
    assert each["with body"] == pytest.approx(0.75, abs=0.02)
    assert set(stacked["posterior"].data_vars) == {"refractive_index", "stokes_error_factor"}
    assert pb.verdict(stacked).converged
    pb.save(stacked, tmp_path / "fit.nc")
    assert "posterior" in pb.load(tmp_path / "fit.nc", "fit").children
    assert pb.summary(stacked).loc["refractive_index", "sd"] > 0.0


def test_the_share_between_scenes_follows_the_law_of_total_variance(
    comparison: SceneComparison,
) -> None:
    weights = comparison.table["weight"] * 0.0 + 0.5
    share = between_scenes(comparison.intervals, weights)
    stacked = stack_fits(comparison.fits, {"mirror": 0.5, "with body": 0.5})
    total = float(stacked["posterior"]["refractive_index"].var())
    means = comparison.intervals.loc["refractive_index", "mean"]
    between = 0.25 * float(means.iloc[0] - means.iloc[1]) ** 2
    assert share["refractive_index"] == pytest.approx(between / total, rel=0.1)
    assert list(share.index) == ["refractive_index"]


def test_weights_favor_the_better_and_share_between_equals() -> None:
    noise = np.random.default_rng(0).normal(size=(40, 1))
    alike = stacking_weights(np.hstack([noise, noise]))
    assert alike == pytest.approx([0.5, 0.5])
    better = stacking_weights(np.hstack([noise, noise - 1.0]))
    assert better[0] > 0.99


def said_of(comparison: SceneComparison, **changes: Any) -> str:
    """The sentences of a comparison with other entries."""
    return " ".join(pb.scenes.scene_sentences(dataclasses.replace(comparison, **changes)))


def test_sentences_name_the_scenes_and_why_others_went(comparison: SceneComparison) -> None:
    said = said_of(comparison)
    assert "with body" in said
    assert "2 scenes were fitted" in said
    assert list(pb.scenes.scene_table(comparison)["weight"]) == list(comparison.table["weight"])


def small_library(*_: object) -> SceneLibrary:
    """A mirror with a body or without."""
    return SceneLibrary(
        {"mirror": MIRROR.surface}, {"body": PLATE.subsurface}, pb.StokesMixing(), others={}
    )


@pytest.mark.thorough
def test_scenes_are_compared_with_an_index_that_the_prior_excludes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The fit keeps the prior that was stated, and its verdict says where that ends."""
    monkeypatch.setattr(selection, "scene_library", small_library)
    plate = plates([2.6], 0.01, np.arange(40.0, 82.0, 3.0)).isel(patch=0)
    plate.attrs["setup"] = "paper"  # a perfect instrument
    result = pb.fit(plate, scene="auto", method="laplace", links=LINKS)
    scenes = result["scenes"].to_dataset()
    assert np.allclose(scenes["mean"].sel(parameter="refractive_index"), 2.6, atol=0.1)
    assert float(result["posterior"]["refractive_index"].max()) < 2.0
    said = " ".join(pb.scenes.scene_sentences(result))
    assert "Scenes were compared with refractive_index by TruncatedNormal(loc=2.6" in said
    verdict = pb.verdict(result)
    assert not verdict.passed
    assert any("Brewster's angle means an index near 2.56" in each for each in verdict.problems)


@each("given", [{"refractive_index": dist.TruncatedNormal(1.5, 0.1, low=1.0)}, {}])
def test_a_prior_of_the_users_own_and_one_that_allows_the_index_stay(given) -> None:
    index = 2.6 if given else 1.5
    plate = plates([index], 0.01, np.arange(40.0, 82.0, 3.0)).isel(patch=0)
    arguments = FitArguments(plate, "per_material", given, LINKS, None, 0, "double")
    assert not selection.lifted_prior(arguments.among([MIRROR]), MIRROR)


def test_a_scene_that_may_have_escaped_a_bound_of_the_index_is_told(comparison) -> None:
    assert comparison.table["index_bound"].isna().all()
    said = said_of(comparison, table=comparison.table.assign(index_bound=[np.nan, 2.0]))
    assert "The index of mirror lies against 2, where its prior ends" in said
    assert "priors={'refractive_index': TruncatedNormal(2, 0.3, low=1)}" in said
    said = said_of(comparison, table=comparison.table.assign(index_bound=2.0))
    assert "lies against" not in said  # the verdict has the bound of the scene that was chosen


def test_the_bound_at_which_an_interval_ends_is_found(capture: xr.Dataset) -> None:
    narrow = {"refractive_index": dist.TruncatedNormal(1.9, 0.1, low=1.65)}
    found = pb.compare_scenes(capture, {"mirror": MIRROR}, links=LINKS, priors=narrow)
    assert list(found.table["index_bound"]) == [1.65]


def test_what_is_no_scene_is_refused(capture: xr.Dataset) -> None:
    with pytest.raises(pb.FitError, match="nothing to compare"):
        pb.compare_scenes(capture, {})
    with pytest.raises(pb.SceneError, match="is no scene"):
        pb.compare_scenes(capture, {"a": "goniometer"})  # type: ignore[dict-item]
    with pytest.raises(pb.FitError, match="no such method"):
        pb.fit(capture, scene="auto", method="none")
    with pytest.raises(pb.FitError, match="no width to compare"):
        pb.fit(capture, scene="auto", method="point")


def without_fits(monkeypatch: pytest.MonkeyPatch, gains: dict[str, float]) -> None:
    """Replace every fit by a gain for each part of its scene, and tables by the scenes."""

    def stand_in(name: str, requests: list, *_: Any) -> SimpleNamespace:
        total = sum(gain for part, gain in gains.items() if part in name)
        pointwise = total / 20 + 0.05 * (-1.0) ** np.arange(20) * len(name.split(" + "))
        view = SimpleNamespace(result={"posterior": xr.Dataset({"refractive_index": INDEX})})
        given = {"elpd": total, "pointwise": pointwise, "unexplained": False, "view": view}
        return SimpleNamespace(**given, request=requests[0])

    monkeypatch.setattr(selection, "_fitted", stand_in)
    monkeypatch.setattr(selection, "_comparison", lambda fits, *layers: [list(fits.done), *layers])


INDEX = (("chain", "draw"), 1.35 + 0.01 * np.random.default_rng(0).normal(size=(2, 50)))
BODY, ERRORS = "mirror + unpolarized body", "mirror + systematic errors"


@each(
    ("gain", "remaining"),
    [
        # Told apart from none, and as good as the systematic errors that stood in for it.
        (60.0, {"mirror + back face", f"{BODY} + back face"}),
        # Systematic errors are still better: it stands in for them.
        (20.0, {"mirror", BODY, ERRORS, f"{BODY} + systematic errors"}),
        # It is not told apart from none.
        (1.0, {"mirror", BODY, ERRORS, f"{BODY} + systematic errors"}),
    ],
)
def test_a_layer_remains_where_it_is_told_from_none_and_explains_what_errors_do(
    monkeypatch: pytest.MonkeyPatch, plate: xr.Dataset, gain: float, remaining: set[str]
) -> None:
    gains = {"systematic errors": 50.0, "back face": gain, "water film": -30.0}
    without_fits(monkeypatch, gains)
    tried, allowed, listed = pb.compare_scenes(plate.assign_attrs(setup="goniometer"))
    assert {"mirror + back face", "mirror + water film"} <= set(tried)
    assert set(allowed) == remaining
    assert listed == []


def test_a_film_that_is_as_good_as_none_is_said_and_does_not_remain(monkeypatch, plate) -> None:
    without_fits(monkeypatch, {"water film": -1.0, "back face": -10.0, "systematic errors": -3.0})
    _, allowed, listed = pb.compare_scenes(plate.assign_attrs(setup="goniometer"))
    assert not any("film" in name for name in allowed)
    assert listed == ["mirror + water film"]


def test_whose_index_it_is_is_said_where_a_film_is_not_decided(comparison) -> None:
    assert "The readings do not decide mirror." in said_of(comparison, undecided=("mirror",))
    film = {"mirror": "mirror + water film"}
    told = {
        "table": comparison.table.rename(index=film),
        "intervals": comparison.intervals.rename(index=film),
        "scenes": {"mirror + water film": MIRROR, "with body": PLATE},
        "undecided": ("mirror + water film",),
    }
    whose = "under a water film, the index of a bare scene is that of the outermost interface"
    assert whose in said_of(comparison, **told)
    # The verdict cautions where the film would move the index, and only there.
    with_film = dataclasses.replace(comparison, **told)
    own = with_film.intervals.xs("refractive_index").loc["with body"]
    for mean, is_moved in ((own["mean"], False), (own["q97.5"] + 0.01, True)):
        intervals = with_film.intervals.copy()
        intervals.loc[("refractive_index", "mirror + water film"), "mean"] = mean
        cautions = film_cautions(dataclasses.replace(with_film, intervals=intervals))
        assert len(cautions) == is_moved
        assert not is_moved or f"and {own['mean']:.3g} by with body; under a" in cautions[0]


@pytest.mark.thorough
def test_bodies_are_compared_at_once_and_a_worse_surface_not_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The order of the candidates, with a gain for each part in place of fits."""
    gains = {
        "sky": -50.0,
        "Lambertian body": 10.0,
        "unpolarized body": 12.0,
        "depolarizing body": 11.0,
        "systematic errors": 5.0,
        "leaning normal": 4.0,
    }

    without_fits(monkeypatch, gains)
    monkeypatch.setattr(selection, "_choose_layers", lambda *_, **__: ())
    tried: Any = pb.compare_scenes(pb.simulate(scene="camera").assign_attrs(setup="camera"))[0]
    first = ["", " + Lambertian body", " + systematic errors", " + leaning normal"]
    bodies = [" + unpolarized body", " + depolarizing body"]
    assert tried[:7] == ["rough surface", "sky", *(f"rough surface{x}" for x in first[1:] + bodies)]
    assert sum("sky" in name for name in tried) == 1
    last = next(at for at, name in enumerate(tried) if "GGX" in name)
    forward, alternatives = tried[:last], tried[last:]
    assert len(forward) <= selection.MAX_FITS
    assert forward[-1].startswith("rough surface + unpolarized body + systematic errors + ")
    assert len(alternatives) == selection.MAX_ALTERNATIVES
    assert alternatives[0].startswith("rough GGX surface + unpolarized body + systematic errors")
    assert [name.split(" + ")[1] for name in alternatives[1:3]] == [
        b[3:] for b in (first[1], bodies[1])
    ]
