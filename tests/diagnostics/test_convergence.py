"""The verdict: every way to fail is named, with its number and its remedy."""

import json
import re

import arviz_stats
import numpy as np
import pytest
from cases import each
from scipy import stats
from synthetic_calibrations import make_calibration
from synthetic_results import edit_provenance, make_result, replace

import polar_bayes as pb
from polar_bayes.diagnostics.approximation import smoothed_weights
from polar_bayes.diagnostics.convergence import json_summary, summary, verdict
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


def deep(count):
    """Trees that reach their greatest depth: they cost time, and bias nothing."""
    reached = np.arange(1000).reshape(4, 250) < count
    return lambda tree: replace(tree, "sample_stats", "reached_max_treedepth", reached)


def weighted(log_weight):
    return lambda tree: replace(tree, "sample_stats", "log_weight", log_weight)


EVEN = np.random.default_rng(0).normal(0.0, 0.01, (4, 1000))
LAPLACE = {"method": "laplace", "draws": 1000}
WEIGHTED = "The effective sample size of the weighted draws is 399 \\(at least 400\\)"
EDGE = "readings of dop lie at the edge"
MASKED = "40 of 100 readings are marked valid=False"
JUDGED: list[tuple] = [
    # A layout, what is done to the result, the list that tells of it, and the words.
    ({}, {}, None, "R-hat"),
    ({}, stuck, "problems", "R-hat above 1.01: roughness.*sample longer"),
    ({"discrepancy": True}, unmoved, "problems", "exposure nan"),
    ({"draws": 60}, {}, "problems", "ESS below 400.*most_draws"),
    # Chains of a user's method are judged as those of NUTS.
    ({"draws": 60}, {"method": "independence sampler"}, "problems", "Bulk ESS below 400"),
    ({}, diverged, "problems", "^1 of 1000 draws diverged.*target_acceptance"),
    *(
        ({"method": method}, {"problems": ["it never ended"]}, "problems", "^It never ended.$")
        for method in ("nuts", "laplace", "point")
    ),
    ({}, {"method": "importance", "ess": 399.0}, "problems", WEIGHTED),
    ({}, {"method": "importance", "ess": 401.0}, None, "weighted draws"),
    ({}, {"scene_chosen_by": "default"}, "cautions", "^No set-up was stated, so 'paper' was used"),
    ({}, {"capture_cautions": ["Swapped."]}, "cautions", "^Swapped.$"),
    ({}, {"modes": {"weights": [0.9, 0.1]}}, "cautions", "another mode, of weight 0.1"),
    ({}, {"counts": {"views": 100, "masked": 40}}, "cautions", MASKED),
    (
        {},
        {"counts": {"views": 8, "at_margin": {"dop": 3}}},
        "cautions",
        f"3 {EDGE}",
    ),
    # A mirror has a degree of polarization of 1 at Brewster's angle.
    (
        {},
        {"counts": {"views": 40, "at_margin": {"dop": 2}}},
        "findings",
        f"2 of 40 {EDGE}",
    ),
    ({}, deep(5), None, "of 1000 draws reached"),
    ({}, deep(50), "findings", "50 of 1000 draws reached"),
    ({"method": "point"}, {}, "cautions", "^No standard error: exposure;"),
    (LAPLACE, weighted(0.0 * EVEN), None, "Pareto k"),
    *((LAPLACE, weighted(x + EVEN), "cautions", "") for x in (np.nan, np.inf, -np.inf)),
    # A few weights of zero are no reason to worry.
    (LAPLACE, weighted(np.where(np.arange(1000) < 3, -np.inf, EVEN)), None, "Pareto k"),
]


@each(("layout", "change", "where", "words"), JUDGED, ids=lambda part: str(part)[:40])
def test_what_is_wrong_is_named_with_its_remedy_and_what_is_right_is_not(
    layout, change, where, words
) -> None:
    tree = make_result(**layout)
    judged = verdict(edit_provenance(tree, **change) if isinstance(change, dict) else change(tree))
    assert judged.passed == (where != "problems")
    assert bool(judged.cautions) == (where == "cautions") or where == "problems"
    told = "\n".join(getattr(judged, where or "findings"))
    assert bool(re.search(words, told)) == (where is not None)


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


def test_another_mode_is_no_caution_where_weighted_draws_of_it_agree_with_the_chains() -> None:
    modes = {"weights": [0.8, 0.2]}
    tails = {"pareto_k": 0.4, "ess": 900.0, "shares": {}}
    tree = edit_provenance(make_result(), modes=modes, tails=tails)
    assert not verdict(tree).cautions
    assert "the draws are of both" in verdict(tree).findings[0]
    unknown = edit_provenance(tree, tails=tails | {"pareto_k": 0.9})
    assert "another mode, of weight 0.2" in verdict(unknown).cautions[0]
    visited = edit_provenance(unknown, modes=modes | {"unvisited": 0.0})
    assert not verdict(visited).cautions
    missed = edit_provenance(unknown, modes=modes | {"unvisited": 0.2})
    assert "another mode, of weight 0.2" in verdict(missed).cautions[0]


def log_weights(width: float) -> np.ndarray:
    """Of draws from a normal of that width, for a standard normal."""
    z = np.random.default_rng(3).normal(0.0, width, (4, 1000))
    return stats.norm.logpdf(z) - stats.norm.logpdf(z, scale=width)


@each(("width", "trusted"), [(0.3, False), (2.0, True)])
def test_k_hat_has_the_right_sign(width: float, trusted: bool) -> None:
    """A standard normal: draws from a narrower one have unbounded weights, from a wider not."""
    tree = weighted(log_weights(width))(make_result(**LAPLACE))
    _, pareto_k = smoothed_weights(tree)
    # Of a normal seen through a narrower one k tends to 1 - width^2; a wider one bounds weights.
    assert pareto_k == pytest.approx(1.0 - width**2, abs=0.2) if not trusted else pareto_k < 0.2
    judged = verdict(tree)
    assert judged.passed
    assert bool(judged.cautions) == (not trusted)
    assert trusted or "Pareto k" in judged.cautions[0]


def test_a_guide_is_judged_by_its_weights_as_laplace_is() -> None:
    tree = weighted(log_weights(0.3))(make_result(**LAPLACE))
    caution, unjudged, lost = verdict(edit_provenance(tree, method="variational")).cautions
    assert "residuals were not judged" in unjudged
    assert "Leave-one-out cannot be approximated" in lost
    assert "Pareto k of the guide's draws is" in caution
    # Weights of draws that were chosen by weight are another matter.
    assert not verdict(edit_provenance(tree, method="importance")).cautions


def test_proposals_that_were_adapted_for_long_are_told() -> None:
    few, many = (
        verdict(edit_provenance(make_result(**LAPLACE), method="importance", rounds=rounds))
        for rounds in (3, 4)
    )
    assert not few.cautions
    (caution,) = many.cautions
    assert "adapted in 4 rounds" in caution


def test_a_point_fit_has_standard_errors_and_no_chains() -> None:
    table = summary(make_result(method="point"))
    assert np.isfinite(table["mean"]).all()
    assert table.loc["refractive_index[550]", "sd"] == pytest.approx(0.08)
    assert np.isnan(table.loc["exposure", "sd"])
    assert table[["q2.5", "q97.5", "r_hat", "ess_bulk", "ess_tail"]].isna().all(axis=None)


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


def test_a_laplace_fit_says_how_far_it_is_off_from_its_own_weighted_draws() -> None:
    """The posterior is wider by a fifth than the approximation, and half a sd higher."""
    tree = make_result(**LAPLACE)
    draws = posterior_of(tree, "roughness")
    z = (draws - draws.mean()) / draws.std()
    judged = verdict(weighted(stats.norm.logpdf(z, 0.5, 1.2) - stats.norm.logpdf(z))(tree))
    (told,) = [text for text in judged.cautions if text.startswith("Importance weights correct")]
    shift, change = re.search(r"roughness \(mean by (.*?) sd, sd (.*?)%\)", told).groups()
    assert 0.3 < float(shift) < 0.5
    assert -25.0 < float(change) < -8.0
    assert "use method='importance' or 'nuts'" in told


def test_a_set_up_that_nobody_stated_is_a_caution_of_every_kind_of_result() -> None:
    calibration = edit_provenance(make_calibration(), scene_chosen_by="default", scene="paper")
    assert "No set-up was stated, so 'paper' was used" in pb.verdict(calibration).cautions[0]
    assert not pb.verdict(edit_provenance(calibration, scene_chosen_by="argument")).cautions
