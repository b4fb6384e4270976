"""The verdict: every way to fail is named, with its number and its remedy."""

import json
import re

import arviz_stats
import numpy as np
import pytest
import xarray as xr
from cases import each
from scipy import stats
from synthetic_calibrations import make_calibration
from synthetic_results import edit_provenance, make_result, replace

import polar_bayes as pb
from polar_bayes.diagnostics.convergence import json_summary, laplace_pareto_k, summary, verdict
from polar_bayes.diagnostics.view import view_of


def posterior_of(tree, name):
    return tree["posterior"].to_dataset()[name].to_numpy().copy()


def _places(labels):
    """The variable of each label, and its position in that variable."""
    seen: dict[str, int] = {}
    for label in labels:
        name = label.split("[")[0]
        yield name, seen.get(name, 0)
        seen[name] = seen.get(name, 0) + 1


def test_table_agrees_with_arviz() -> None:
    tree = make_result(discrepancy=True)
    ours = summary(tree)
    theirs = arviz_stats.summary(tree, ci_prob=0.95, ci_kind="eti", round_to="none")
    theirs.index = [label.replace(".0]", "]") for label in theirs.index]
    # The summary takes its tails from ArviZ's default interval; Vehtari et al. define 5% and 95%.
    tails = arviz_stats.ess(tree, method="tail", prob=(0.05, 0.95))
    theirs["ess_tail"] = [tails[name].to_numpy().ravel()[at] for name, at in _places(theirs.index)]
    columns = {"eti95_lb": "q2.5", "eti95_ub": "q97.5"}
    theirs = theirs.rename(columns=columns).loc[ours.index, ours.columns]
    np.testing.assert_allclose(ours.to_numpy(float), theirs.to_numpy(float), rtol=1e-10)


@pytest.mark.thorough
def test_rows_are_named_material_parameters_come_first_and_vectors_last() -> None:
    assert list(summary(make_result(discrepancy=True, wavelengths=(450.0, 532.5))).index) == [
        *("roughness", "subsurface_fraction", "absorption[450]", "absorption[532.5]"),
        *("refractive_index[450]", "refractive_index[532.5]", "exposure"),
        *(f"discrepancy_weights[{i}]" for i in range(4)),
    ]
    named = make_result(materials=("leaf", "fruit"), wavelengths=(450.0,), views=6)
    assert "refractive_index[fruit, 450]" in summary(named).index
    twice = summary(make_result(wavelengths=(450.0, 450.0), views=6)).index
    assert twice.is_unique
    assert "refractive_index[450]#2" in twice


def test_a_good_fit_converges_without_a_word() -> None:
    judged = verdict(make_result())
    assert judged.passed
    assert judged.problems == judged.cautions == ()


def test_a_set_up_that_nobody_stated_and_an_unlikely_capture_are_cautions() -> None:
    tree = edit_provenance(make_result(), scene_chosen_by="default", capture_cautions=["Swapped."])
    judged = verdict(tree)
    assert judged.passed
    assert judged.cautions[0].startswith("No set-up was stated, so 'paper' was used")
    assert judged.cautions[1:] == ("Swapped.",)


def stuck(tree):
    draws = posterior_of(tree, "roughness")
    draws[0] += 5.0 * draws.std()
    return replace(tree, "posterior", "roughness", draws)


def unmoved(tree):
    return replace(tree, "posterior", "exposure", np.full_like(posterior_of(tree, "exposure"), 0.7))


def diverged(tree):
    diverging = np.zeros((4, 250), bool)
    diverging[2, 17] = True
    return replace(tree, "sample_stats", "diverging", diverging)


def of_a_user(tree):
    """Chains of a user's method are judged as those of NUTS."""
    return edit_provenance(tree, method="independence sampler")


@each(
    ("layout", "change", "words"),
    [
        ({}, stuck, "R-hat above 1.01: roughness.*sample longer"),
        ({"discrepancy": True}, unmoved, "exposure nan"),
        ({"draws": 60}, lambda tree: tree, "ESS below 400.*most_draws"),
        ({"draws": 60}, of_a_user, "Bulk ESS below 400"),
        ({}, diverged, "^1 of 1000 draws diverged.*target_acceptance"),
    ],
)
def test_what_is_wrong_with_chains_fails_and_is_named(layout, change, words) -> None:
    judged = verdict(change(make_result(**layout)))
    assert not judged.passed
    assert re.search(words, "\n".join(judged.problems))  # the first begins the text


def test_chains_that_each_stand_still_fail() -> None:
    tree = make_result()
    draws = posterior_of(tree, "exposure") * 0.0 + np.arange(4.0)[:, None]
    still = replace(tree, "posterior", "exposure", draws)
    for name, of_draws in tree["log_likelihood"].to_dataset().items():  # so do all their densities
        values = np.broadcast_to(of_draws.to_numpy()[:, :1], of_draws.shape)
        still = replace(still, "log_likelihood", str(name), values)
    assert not verdict(still).passed


@pytest.mark.thorough
def test_long_lists_are_cut() -> None:
    problems = verdict(make_result(draws=60, discrepancy=True)).problems
    problem = next(problem for problem in problems if problem.startswith("Bulk ESS"))
    assert re.search(r"and \d more;", problem)
    assert problem.count("[") <= 4


@pytest.mark.thorough
@each("method", ["nuts", "laplace", "point"])
@each("bad", [np.nan, np.inf])
def test_one_draw_that_is_not_finite_fails(method: str, bad: float) -> None:
    tree = make_result(method=method)
    draws = posterior_of(tree, "refractive_index")
    draws[0, 0, 1] = bad
    tree = replace(tree, "posterior", "refractive_index", draws)
    judged = verdict(tree)
    assert not judged.passed
    assert any("Not finite: refractive_index[550]" in problem for problem in judged.problems)
    assert np.isfinite(summary(tree).loc["refractive_index[650]", "mean"])


@each("method", ["nuts", "laplace", "point"])
def test_what_the_fit_noted_itself_fails(method: str) -> None:
    tree = edit_provenance(make_result(method=method), problems=["it never ended"])
    judged = verdict(tree)
    assert not judged.passed
    assert judged.problems == ("It never ended.",)


@pytest.mark.thorough
@each(
    ("change", "words"),
    [
        ({"modes": {"weights": [0.9, 0.1]}}, "another mode, of weight 0.1"),
        ({"counts": {"views": 100, "masked": 40}}, "40 of 100 readings are marked valid=False"),
        ({"counts": {"views": 8, "at_margin": {"dop": 3}}}, "3 readings of dop lie at the edge"),
    ],
)
def test_cautions_do_not_fail(change: dict, words: str) -> None:
    judged = verdict(edit_provenance(make_result(), **change))
    assert judged.passed
    assert any(words in caution for caution in judged.cautions)


def test_a_few_readings_at_the_edge_of_their_range_are_a_note() -> None:
    """A mirror has a degree of polarization of 1 at Brewster's angle."""
    judged = verdict(edit_provenance(make_result(), counts={"views": 40, "at_margin": {"dop": 2}}))
    assert not judged.cautions
    assert any("2 of 40 readings of dop lie at the edge" in note for note in judged.findings)


def test_tails_that_chains_may_have_missed_are_told() -> None:
    even = {name: [[0.025, 0.03]] for name in ("refractive_index", "roughness")}
    tails = {"pareto_k": 0.3, "ess": 800.0, "shares": even}
    tree = make_result(wavelengths=(), draws=1000)
    assert not verdict(edit_provenance(tree, tails=tails)).cautions
    heavy = tails | {"shares": even | {"roughness": [[0.02, 0.12]]}}
    (caution,) = verdict(edit_provenance(tree, tails=heavy)).cautions
    end = pb.summary(tree)["q97.5"]["roughness"]
    assert f"roughness above {end:.3g} (12.0%)" in caution
    assert "index" not in caution
    # Weights that do not reach the posterior themselves say nothing of chains.
    assert not verdict(edit_provenance(tree, tails=heavy | {"pareto_k": 0.9})).cautions


@pytest.mark.thorough
@each(
    ("method", "words"),
    [
        ("laplace", "only the heaviest is described here; use method='nuts'"),
        ("variational", "only the heaviest is described here; use method='nuts'"),
        ("nuts", "chains may not have visited them in proportion"),
        ("importance", "another explanation of the readings exists; add views"),
        ("mine", "another explanation of the readings exists; add views"),
    ],
)
def test_another_mode_is_told_as_the_method_sees_it(method: str, words: str) -> None:
    tree = make_result(draws=1000)
    judged = verdict(edit_provenance(tree, method=method, modes={"weights": [0.6, 0.4]}))
    (caution,) = judged.cautions
    assert words in caution
    assert ("only the heaviest" in caution) == (method in ("laplace", "variational"))
    assert ("use method='nuts'" in caution) == (method in ("laplace", "variational"))
    # Where weights reach the posterior, the draws have its share: a note is enough.
    reached = {"pareto_k": 0.3} if method == "importance" else {}
    judged = verdict(edit_provenance(tree, method=method, modes={"weights": [0.6, 0.4]}, **reached))
    assert (not judged.cautions) == bool(reached)
    assert any("the draws are of both" in note for note in judged.findings) == bool(reached)


@pytest.mark.thorough
def test_the_method_is_called_as_it_was_stated() -> None:
    tree = make_result(method="laplace")
    assert view_of(tree).method == "laplace"
    assert view_of(edit_provenance(tree, method="mine")).method == "mine"
    assert json_summary(edit_provenance(tree, method="mine"))["method"] == "mine"
    assert view_of(edit_provenance(tree, method=None)).method == "laplace"
    assert view_of(edit_provenance(make_result(), method=None)).method == "nuts"


@pytest.mark.thorough
def test_deep_trees_are_a_note_once_they_are_many() -> None:
    """They cost time, and bias nothing."""
    tree = make_result()
    deep = np.zeros((4, 250), bool)
    for count, is_told in ((5, False), (50, True)):
        deep[0, :count] = True
        judged = verdict(replace(tree, "sample_stats", "reached_max_treedepth", deep))
        assert not judged.cautions
        told = any(f"{count} of 1000 draws reached" in note for note in judged.findings)
        assert told == is_told


def test_another_mode_is_no_caution_where_weighted_draws_of_it_agree_with_the_chains() -> None:
    modes = {"weights": [0.8, 0.2]}
    tails = {"pareto_k": 0.4, "ess": 900.0, "shares": {}}
    tree = edit_provenance(make_result(), modes=modes, tails=tails)
    assert not verdict(tree).cautions
    assert "the draws are of both" in verdict(tree).findings[0]
    unknown = edit_provenance(tree, tails=tails | {"pareto_k": 0.9})
    assert "another mode, of weight 0.2" in verdict(unknown).cautions[0]


def laplace_tree(log_weight: np.ndarray) -> xr.DataTree:
    tree = make_result(method="laplace", draws=1000)
    return replace(tree, "sample_stats", "log_weight", log_weight)


@each(("width", "trusted"), [(0.3, False), (2.0, True)])
def test_k_hat_has_the_right_sign(width: float, trusted: bool) -> None:
    """A standard normal: draws from a narrower one have unbounded weights, from a wider not."""
    z = np.random.default_rng(3).normal(0.0, width, (4, 1000))
    log_weight = stats.norm.logpdf(z) - stats.norm.logpdf(z, scale=width)
    tree = laplace_tree(log_weight)
    pareto_k = laplace_pareto_k(tree)
    # Of a normal seen through a narrower one k tends to 1 - width^2; a wider one bounds weights.
    assert pareto_k == pytest.approx(1.0 - width**2, abs=0.2) if not trusted else pareto_k < 0.2
    judged = verdict(tree)
    assert judged.passed
    assert bool(judged.cautions) == (not trusted)
    assert trusted or "Pareto k" in judged.cautions[0]


def test_a_guide_is_judged_by_its_weights_as_laplace_is() -> None:
    z = np.random.default_rng(3).normal(0.0, 0.3, (4, 1000))
    tree = laplace_tree(stats.norm.logpdf(z) - stats.norm.logpdf(z, scale=0.3))
    caution, lost = verdict(edit_provenance(tree, method="variational")).cautions
    assert "Leave-one-out cannot be approximated" in lost
    assert "Pareto k of the guide's draws is" in caution
    # Weights of draws that were chosen by weight are another matter.
    assert not verdict(edit_provenance(tree, method="importance")).cautions


@pytest.mark.thorough
@each(("value", "cautious"), [(0.0, False), (np.nan, True), (np.inf, True), (-np.inf, True)])
def test_k_hat_of_weights_that_are_all_alike(value: float, cautious: bool) -> None:
    judged = verdict(laplace_tree(np.full((4, 1000), value)))
    assert bool(judged.cautions) == cautious


@pytest.mark.thorough
def test_a_few_weights_of_zero_are_no_reason_to_worry() -> None:
    log_weight = np.random.default_rng(0).normal(0.0, 0.01, (4, 1000))
    log_weight[0, :3] = -np.inf
    assert laplace_pareto_k(laplace_tree(log_weight)) < 0.7


def test_a_point_fit_has_standard_errors_and_no_chains() -> None:
    tree = make_result(method="point")
    table = summary(tree)
    assert np.isfinite(table["mean"]).all()
    assert table.loc["refractive_index[550]", "sd"] == pytest.approx(0.08)
    assert np.isnan(table.loc["exposure", "sd"])
    assert table[["q2.5", "q97.5", "r_hat", "ess_bulk", "ess_tail"]].isna().all(axis=None)
    judged = verdict(tree)
    assert judged.passed
    assert judged.cautions[0].startswith("No standard error: exposure;")


@each("method", ["nuts", "laplace", "point"])
def test_json_is_valid_json(method: str) -> None:
    tree = make_result(method=method)
    said = json.loads(json.dumps(json_summary(tree), allow_nan=False))
    columns = {"mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk", "ess_tail"}
    assert set(said["parameters"]["roughness"]) == columns
    assert said["converged"] is True
    assert (said["parameters"]["roughness"]["r_hat"] is None) == (method == "point")
    for key in ("method", "model", "scene", "seed", "counts", "timings", "problems", "cautions"):
        assert key in said


@each("method", ["importance"])
def test_weighted_draws_have_the_floor_of_chains(method: str) -> None:
    for effective, is_enough in ((399.0, False), (401.0, True)):
        judged = verdict(edit_provenance(make_result(method=method), ess=effective))
        told = "The effective sample size of the weighted draws is 399 (at least 400)"
        assert any(problem.startswith(told) for problem in judged.problems) != is_enough
        assert judged.passed == is_enough


def test_a_laplace_fit_says_how_far_it_is_off_from_its_own_weighted_draws() -> None:
    """The posterior is wider by a fifth than the approximation, and half a sd higher."""
    tree = make_result(method="laplace", draws=1000)
    draws = posterior_of(tree, "roughness")
    z = (draws - draws.mean()) / draws.std()
    log_weight = stats.norm.logpdf(z, 0.5, 1.2) - stats.norm.logpdf(z)
    judged = verdict(replace(tree, "sample_stats", "log_weight", log_weight))
    (told,) = [text for text in judged.cautions if text.startswith("Importance weights correct")]
    shift, change = re.search(r"roughness \(mean by (.*?) sd, sd (.*?)%\)", told).groups()
    assert 0.3 < float(shift) < 0.5
    assert -25.0 < float(change) < -8.0
    assert "use method='importance' or 'nuts'" in told


def test_a_set_up_that_nobody_stated_is_a_caution_of_every_kind_of_result() -> None:
    calibration = edit_provenance(make_calibration(), scene_chosen_by="default", scene="paper")
    assert "No set-up was stated, so 'paper' was used" in pb.verdict(calibration).cautions[0]
    assert not pb.verdict(edit_provenance(calibration, scene_chosen_by="argument")).cautions
