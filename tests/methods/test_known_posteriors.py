"""Every rung on posteriors that are known."""

import jax
import numpy as np
import pytest
from cases import each
from toy_models import capture, deep_funnel, funnel, least_squares, line, of_line, problem, squared

import polar_bayes as pb
from polar_bayes.benchmark.run import labeled, sample_point
from polar_bayes.errors import FitError
from polar_bayes.methods.auto import expected_error
from polar_bayes.methods.importance import tail_shares
from polar_bayes.numerics.mcse import draws_needed, quantile
from polar_bayes.progress import no_progress


def test_a_problem_tells_what_is_estimated_and_from_what():
    table = problem(line).describe()
    assert list(table.index) == ["level", "slope"]
    assert (table["size"] == 1).all()
    assert (table["prior"] == "Normal").all()
    assert (table["low"] == -np.inf).all()
    assert table.attrs == {"used": {"q": 6}, "measured": {"q": 6}}


def test_a_study_compares_every_method_that_is_tested_here():
    methods = pb.methods.STUDY_METHODS
    assert set(methods) == {"point", "laplace", "importance", "nuts", "nuts short", "nuts long"}
    tested = (pb.methods.Point, pb.methods.Laplace, pb.methods.Importance, pb.methods.Nuts)
    assert {type(method) for method in methods.values()} == set(tested)


def run(method, problem, seed: int = 0):
    return method.run(problem, jax.random.split(jax.random.key(seed))[1], no_progress)


@pytest.mark.thorough
def test_gradients_of_a_warm_up_are_counted_as_they_were_made():
    here = problem(line)
    method = pb.methods.Nuts(chains=2, warmup=60, draws=50, most_draws=50, block=50)
    found = run(method, here)
    climbing = here.initialize().metadata["gradients"]
    before = sum(found.stats["warmup_steps"][:, 0])
    assert before >= 60 * 2  # a draw takes one step at least
    assert found.gradients == climbing + before + found.stats["n_steps"].sum()


@pytest.mark.thorough
def test_draws_about_a_point_fit_are_about_the_line_of_least_squares():
    here = problem(line)
    found = sample_point(run(pb.methods.Point(starts=2), here), jax.random.key(1))
    _, draws = labeled(here, found.z)
    expected = least_squares(capture()["q"].to_numpy())
    np.testing.assert_allclose(draws.mean(axis=(1, 2)), expected, atol=0.02)


@pytest.mark.thorough
def test_both_modes_are_weighed_alike():
    here = problem(squared)
    found = run(pb.methods.Importance(), here)
    assert not found.problems
    _, draws = labeled(here, found.z)
    share = float(np.mean(draws[-1] > 0.0))  # the root is the last in the alphabet
    assert abs(share - 0.5) < 5.0 * 0.5 / np.sqrt(min(found.ess, draws[0].size))


@pytest.mark.thorough
def test_chains_that_missed_a_mode_are_told():
    here = problem(squared)
    both = run(pb.methods.Importance(), here)
    assert here.initialize().missed_mode_weight(both.z) == 0.0
    at = here.program.unravel(np.arange(here.program.size))["root"]
    one = both.z.copy()
    one[..., int(at)] = np.abs(one[..., int(at)])
    assert here.initialize().missed_mode_weight(one) == pytest.approx(0.5, abs=0.02)
    # One chain that saw only one of them is enough.
    some = both.z.copy()
    some[0] = one[0]
    assert here.initialize().missed_mode_weight(some) > 0.4
    assert problem(line).initialize().missed_mode_weight(both.z) == 0.0


def test_weighted_draws_find_what_chains_left_out():
    here = problem(squared)
    both = here.constrain(run(pb.methods.Importance(), here).z)
    key = jax.random.key(5)
    told = tail_shares(here, both, key)["tails"]
    assert told["pareto_k"] < 0.7
    for below, above in told["shares"]["root"] + told["shares"]["other"]:
        # Five standard errors of 2.5%, of both methods.
        error = np.sqrt(0.025 * 0.975 * (1.0 / told["ess"] + 1.0 / 1000.0))
        assert max(abs(below - 0.025), abs(above - 0.025)) < 5.0 * error
    one = tail_shares(here, both | {"root": np.abs(both["root"])}, key)["tails"]
    ((below, above),) = one["shares"]["root"]
    assert below == pytest.approx(0.5, abs=0.1)
    assert above < 0.05


@pytest.mark.thorough
def test_weights_that_do_not_reach_all_of_a_posterior_are_a_problem():
    here, once = problem(deep_funnel), pb.methods.Importance(draws=4096, rounds=1)
    found = [run(once, here, seed) for seed in range(6)]
    # The estimate of k is random, too.
    assert np.median([each.pareto_k for each in found]) > 0.7
    for draws in found:
        told = any("Pareto k" in problem for problem in draws.problems)
        assert told == (draws.pareto_k > 0.7)


@pytest.mark.thorough
def test_further_rounds_follow_a_posterior_that_is_not_normal():
    here, seeds = problem(funnel), range(4)
    once, found = (
        [run(pb.methods.Importance(draws=1024, rounds=rounds), here, seed) for seed in seeds]
        for rounds in (1, 6)
    )
    effective = [sum(each.ess for each in some) for some in (once, found)]
    assert effective[1] > 2.0 * effective[0]
    assert min(each.pareto_k for each in once) > 0.7
    assert max(each.pareto_k for each in found) < 0.7


def test_the_expected_error_is_the_one_that_is_seen():
    """Over 40 seeds the error of a mean stays within what is expected, and is not far below."""
    mean, covariance = of_line(capture()["q"].to_numpy())
    sd, seen, expected = np.sqrt(np.diagonal(covariance)), [], []
    here = problem(line)
    for seed in range(40):
        found = run(pb.methods.Importance(draws=1024), here, seed)
        _, draws = labeled(here, found.z)
        seen.append(np.max(np.abs(draws.mean(axis=(1, 2)) - mean) / sd))
        expected.append(expected_error(found, here))
    # 1% of fits exceed it: of 40, four or more in one of ten thousand runs.
    assert np.sum(np.array(seen) > expected) < 4
    assert np.max(seen) > 0.3 * np.mean(expected)


@pytest.mark.thorough
def test_as_many_draws_are_needed_as_the_tolerance_says():
    assert quantile(1) == pytest.approx(2.5758, abs=1e-4)
    assert draws_needed(0.1, 3) == int(np.ceil((quantile(6) / 0.1) ** 2))
    assert draws_needed(0.05, 3) == pytest.approx(4 * draws_needed(0.1, 3), abs=4)
    rungs = pb.methods.Auto(tolerance=0.1).candidates(problem(line))
    assert rungs["importance"].draws == 16 * draws_needed(0.1, 2)


def test_draws_that_are_no_numbers_have_an_infinite_error():
    here = problem(line)
    found = run(pb.methods.Laplace(draws=1000), here)
    found.z[0, 0, 0] = np.nan
    assert np.isposinf(expected_error(found, here))


@pytest.mark.thorough
def test_draws_are_scaled_and_settings_kept():
    assert pb.methods.Laplace(draws=500).scale_draws(2.0) == pb.methods.Laplace(draws=1000)
    chains = pb.methods.Nuts(warmup=77).scale_draws(2.0)
    assert (chains.draws, chains.most_draws, chains.ess) == (1000, 16000, 900.0)
    assert chains.warmup == 77
    assert pb.methods.Point().scale_draws(2.0) is None


@each(
    ("make", "said"),
    [
        (lambda: pb.methods.Importance(draws=10), "draws is 10"),
        (lambda: pb.methods.Importance(rounds=0), "rounds is 0"),
        (lambda: pb.methods.Laplace(draws=10), "draws is 10"),
        (lambda: pb.methods.CorrectedLaplace(draws=100), "draws is 100; give 64, 128, 256 or so"),
        (lambda: pb.methods.CorrectedLaplace(draws=32), "draws is 32; give 64, 128, 256 or so"),
        (lambda: pb.methods.CorrectedLaplace(candidates=2), "candidates is 2; give at least 8"),
        (lambda: pb.methods.Nuts(chains=1), "Nuts: chains is 1; give at least 2"),
        (lambda: pb.methods.Nuts(draws=10), "Nuts: draws is 10; give at least 50"),
        (lambda: pb.methods.Nuts(draws=600, most_draws=500), "most_draws is 500; give at least 60"),
        (lambda: pb.methods.Nuts(target_acceptance=1.0), "Nuts: target_acceptance is 1.0"),
    ],
)
def test_settings_out_of_range_are_refused(make, said):
    with pytest.raises(FitError, match=said):
        make()
