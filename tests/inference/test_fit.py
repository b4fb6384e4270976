"""What a fit returns, refuses and records."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
import xarray as xr
from cases import each
from numpyro import distributions as dist
from plate_images import plate_image
from plates import LINKS, ON_PLATE, PLATE, plate_capture

import polar_bayes as pb
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.result import provenance_of
from polar_bayes.scenes.neighbors import STOPPED

SHORT = pb.methods.Nuts(chains=2, warmup=100, draws=100, most_draws=100, block=50)
GROUPS = {
    "posterior", "sample_stats", "log_likelihood", "log_prior", "posterior_predictive",
    "noise_free", "prior", "prior_predictive", "observed_data", "constant_data",
}  # fmt: skip


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 80.0, 12), 0.02, seed=3)


@pytest.fixture(scope="module")
def heard() -> list[tuple[str, float]]:
    """What `short` reports while it is fitted."""
    return []


@pytest.fixture(scope="module")
def short(capture: xr.Dataset, heard: list) -> xr.DataTree:
    return pb.fit(capture, **ON_PLATE, method=SHORT, seed=7, progress=lambda *at: heard.append(at))


def test_every_group_is_there_with_labels_and_every_stage_is_reported(short, heard) -> None:
    assert set(short.children) == GROUPS
    assert dict(short["posterior"].sizes) == {"chain": 2, "draw": 100}
    assert short["posterior_predictive"]["q"].dims == ("chain", "draw", "view")
    assert short["log_likelihood"]["q"].dims == ("chain", "draw", "view")
    assert short["posterior"]["refractive_index"].attrs["units"] == "1"
    assert {stage for stage, _ in heard} >= {"searching for modes", "sampling"}
    assert all(0.0 <= fraction <= 1.0 for _, fraction in heard)


def test_provenance_says_enough_to_repeat_the_fit(short: xr.DataTree, capture: xr.Dataset) -> None:
    said = provenance_of(short)
    assert said["seed"] == 7
    assert said["swapped"] == ["scene", "links"]
    assert set(said["versions"]) >= {"polar_bayes", "jax", "numpyro", "arviz"}
    settings = pb.methods.Nuts(**said["settings"])
    again = pb.fit(capture, **ON_PLATE, method=settings, seed=said["seed"])
    xr.testing.assert_equal(short["posterior"].to_dataset(), again["posterior"].to_dataset())


@pytest.mark.thorough
@each(("change", "seed"), [({"threads": 1}, 7), ({}, 8)])
def test_threads_do_not_change_a_bit_and_another_seed_does(short, capture, change, seed) -> None:
    settings = dataclasses.replace(SHORT, **change)
    other = pb.fit(capture, **ON_PLATE, method=settings, seed=seed)
    assert short["posterior"].equals(other["posterior"]) == (seed == 7)


@pytest.mark.thorough
def test_a_fit_that_is_too_short_says_so(short: xr.DataTree) -> None:
    verdict = pb.verdict(short)
    assert not verdict.passed
    assert provenance_of(short)["goals_reached"] is False
    assert any("ESS" in problem or "effective" in problem for problem in verdict.problems)


def test_the_global_precision_is_left_alone(capture: xr.Dataset) -> None:
    with jax.enable_x64(False):
        result = pb.fit(capture, **ON_PLATE, method="laplace", seed=1)
        assert jnp.zeros(()).dtype == jnp.float32
    assert result["posterior"]["refractive_index"].dtype == np.float64


@pytest.mark.thorough
def test_single_precision_finds_the_same_posterior(capture: xr.Dataset) -> None:
    double = pb.fit(capture, **ON_PLATE, seed=1)
    single = pb.fit(capture, **ON_PLATE, seed=1, precision="single")
    assert single["posterior"]["refractive_index"].dtype == np.float32
    for name in ("refractive_index", "subsurface_fraction"):
        one, two = (tree["posterior"][name].to_numpy() for tree in (double, single))
        # Two chains of at least 450 effective draws: four Monte Carlo errors of a difference.
        assert abs(one.mean() - two.mean()) < 4.0 * np.sqrt(2.0 / 450.0) * one.std()


@pytest.mark.thorough
@each(("belief", "trusted"), [(dist.Normal(0.0, 1.0), True), (dist.StudentT(1.5, 0.0, 1.0), False)])
def test_laplace_says_where_it_is_not_to_be_trusted(capture, belief, trusted):
    """Tails heavier than normal have importance weights without a variance: Pareto k above 0.7."""

    def tails(data, scene, priors, links) -> None:
        del scene, priors, links
        numpyro.sample("x", belief)
        with numpyro.plate("view", data.shape[-1]):
            numpyro.sample("q", dist.Normal(0.0, 1.0), obs=data.readings["q"])

    result = pb.fit(capture, model=tails, **ON_PLATE, method="laplace", seed=1)
    verdict = pb.verdict(result)
    assert verdict.converged  # the readings are not judged: they stand for no scene
    assert any("Pareto k" in caution for caution in verdict.cautions) != trusted


def test_views_that_are_masked_or_beyond_the_limit_are_counted_and_do_not_matter(capture) -> None:
    poisoned = capture.assign(valid=("view", np.arange(12) != 4)).copy(deep=True)
    poisoned["q"][4] = np.nan
    before = poisoned.copy(deep=True)
    result = pb.fit(poisoned, **ON_PLATE, method="laplace", largest_view_zenith=60.0, seed=1)
    counts = provenance_of(result)["counts"]
    assert counts["masked"] == 1
    assert counts["used"] == int((capture["view_zenith"] <= 60.0).sum()) - 1
    assert np.isfinite(result["posterior"]["refractive_index"]).all()
    assert np.isnan(result["observed_data"]["q"][4])
    assert (result["log_likelihood"]["q"][..., 4] == 0.0).all()
    xr.testing.assert_equal(before, poisoned)


def test_polarization_of_full_frames_does_not_count() -> None:
    """Saturated frames tell that there is light, not how it is polarized."""
    capture = pb.simulate("glass", scene="camera", seed=0)
    full = capture["saturated"]
    assert full.any()
    damaged = capture.assign({name: capture[name].where(~full, 0.0) for name in ("q", "u")})
    fits = [pb.fit(each, scene="camera", method="laplace") for each in (capture, damaged)]
    one, other = (fit["posterior"].to_dataset() for fit in fits)
    xr.testing.assert_equal(one, other)
    masked = capture.assign(valid=~full)
    links = {"q": pb.links.StokesLink()}  # without the intensity, nothing of the view is fitted
    one, other = (
        pb.fit(each, scene="camera", links=links, method="laplace")["posterior"].to_dataset()
        for each in (damaged, masked)
    )
    xr.testing.assert_allclose(one, other, rtol=1e-6)
    dazzled = capture.assign(saturated=xr.ones_like(full))
    with pytest.raises(pb.CaptureError, match="only 0 of its views are not saturated"):
        pb.fit(dazzled, scene="camera", links=links, method="laplace")


@pytest.mark.thorough
def test_two_views_have_a_proper_posterior() -> None:
    """A scene can match two readings exactly; a noise of zero must not swallow the posterior."""
    capture = plate_capture(np.array([40.0, 70.0]), 0.02, seed=4)
    capture["intensity"] = ("view", [0.02, 0.06])
    links = {**LINKS, "intensity": pb.links.StudentTLink()}
    result = pb.fit(capture, scene=PLATE, links=links, method="laplace", seed=1)
    assert pb.verdict(result).passed
    scale = result["posterior"]["intensity_scale"].to_numpy()
    prior = result["prior"]["intensity_scale"].to_numpy()
    # Two readings and a free exposure say little about their noise: within the prior's range.
    assert np.quantile(prior, 0.005) < np.median(scale) < np.quantile(prior, 0.995)


@each(
    ("settings", "says"),
    [
        ({"model": "per_leaf"}, r"model='per_leaf': no such model; give one of per_material"),
        (
            {"method": "magic"},
            r"method='magic': no such method; give one of point, laplace, importance",
        ),
        (
            {"scene": "moon"},
            r"scene='moon': no such scene; give one of paper, polarimeter, camera, picture, gonio",
        ),
        ({"scene": 3}, r"a int is not a scene"),
        ({"links": pb.links.BetaLink()}, r"no polarization that these links describe"),
        ({"links": {"q": pb.links.BetaLink()}}, r"BetaLink does not describe q; it describes dop"),
        ({"links": {"u": pb.links.StokesLink()}}, r"the capture has no variable u"),
        ({"links": "beta"}, r"a str is not a link; give a link such as BetaLink\(\)"),
        ({"priors": {"n": dist.Normal()}}, r"no such parameter in this model; .*refractive_index"),
        ({"priors": {"refractive_index": dist.Normal(1.5, 0.1)}}, r"allows values outside 1 to"),
        ({"precision": "half"}, r"precision is 'half'; give 'double' or 'single'"),
        ({"seed": -1}, r"seed is -1; give an integer"),
        ({"largest_view_zenith": 95.0}, r"largest_view_zenith is 95.0; give degrees"),
        ({"largest_view_zenith": 22.0}, r"only 1 valid view up to 22 degrees; measure at two"),
    ],
)
def test_what_cannot_be_fitted_is_refused_with_the_mend(capture, settings, says):
    with pytest.raises(pb.PolarBayesError, match=says) as caught:
        pb.fit(capture, **ON_PLATE | settings)
    assert "\n" not in str(caught.value)


def test_an_image_is_refused_with_the_way_out() -> None:
    with pytest.raises(pb.CaptureError, match="average a region"):
        pb.fit(plate_image(2, 2), **ON_PLATE)


@pytest.mark.thorough
def test_a_comparison_that_fails_is_told_and_costs_nothing(capture, monkeypatch):
    hold = Problem.hold

    def fails_without_gain(problem: Problem, values: dict[str, float]) -> Problem:
        if "channel_gain_ratio" in values:
            raise pb.FitError("no peak", where="fit", hint="nothing")
        return hold(problem, values)

    monkeypatch.setattr(Problem, "hold", fails_without_gain)
    result = pb.fit(capture, scene="goniometer", method="laplace", seed=1)
    assert "without_discrepancy" in result.children
    assert "without_instrument" not in result.children
    assert provenance_of(result)["comparisons_failed"] == {
        "without_instrument": "fit: no peak; nothing"
    }


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("at", "scene"), [("comparing", "goniometer"), ("comparing alternatives", "paper")]
)
def test_who_stops_a_comparison_keeps_the_fit(at: str, scene: str, tmp_path: Path) -> None:
    kept: list[xr.DataTree] = []

    def stop(stage: str, _: float) -> None:
        if stage == at:
            raise KeyboardInterrupt

    views = pb.simulation.Protocol(views=16, wavelengths=())
    capture = pb.simulate("glass", scene=scene, protocol=views, seed=1)
    given = {"scene": scene, "method": "laplace", "seed": 1}
    result = pb.fit(capture, **given, progress=stop, keep=kept.append)
    whole = pb.fit(capture, **given)
    for stopped in (result, *kept):
        xr.testing.assert_equal(stopped["posterior"].to_dataset(), whole["posterior"].to_dataset())
        assert provenance_of(stopped)["alternatives_failed"] == STOPPED
    reasons = provenance_of(kept[0]).get("comparisons_failed", {})
    assert set(reasons.values()) == ({STOPPED} if scene == "goniometer" else set())
    pb.save(kept[0], tmp_path / "kept.nc")
    assert STOPPED in " ".join(pb.verdict(pb.load(tmp_path / "kept.nc")).sentences)
