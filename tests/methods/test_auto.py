"""The automatic choice: what it takes, why it climbs, and what it says of it."""

import dataclasses
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import ClassVar, override

import jax
import numpy as np
import pytest
from cases import each
from plates import at_mirror, plate_capture
from toy_models import VIEWS, capture, deep_funnel, funnel, line, of_line, problem

import polar_bayes as pb
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.result import provenance_of
from polar_bayes.methods.method import AbstractMethod, PosteriorDraws
from polar_bayes.progress import no_progress
from polar_bayes.scenes import fit_request as fitting

ASKED, KEY = {"model": line, "links": {"q": pb.links.StokesLink()}}, jax.random.key(0)
DISCREPANCY = pb.instrument.Instrument((pb.instrument.Discrepancy(),))
SYSTEMATIC = ASKED | {"scene": pb.Scene(pb.SmoothSurface(), instrument=DISCREPANCY)}
"""A line, and one in a scene whose instrument is told apart by comparing."""


@pytest.fixture(autouse=True)
def few_prior_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "PRIOR_DRAWS", 20)


@dataclasses.dataclass(frozen=True)
class Made(AbstractMethod):
    """Independent draws of a normal posterior, with diagnostics as one likes.

    It takes some seconds and then says so, or is stuck for as long: reports nothing and does not
    end, as if it compiled or ran compiled code. Another method may fit the comparisons.
    """

    draws: int = 4000
    pareto_k: float = 0.1
    r_hat: float = np.nan
    problem: str = ""
    fails: str = ""
    takes: float = 0.0
    stuck: float = 0.0
    other: AbstractMethod | None = None
    seconds: float = np.inf
    released: ClassVar[threading.Event] = threading.Event()

    @override
    def run(self, problem, key, progress) -> PosteriorDraws:
        if self.fails:
            raise pb.FitError(self.fails, where="Made", hint="nothing")
        if self.stuck:
            self.released.wait(self.stuck)
        if self.takes:
            time.sleep(self.takes)
            progress("sampling", 0.5)
        z = np.random.default_rng(0).normal(size=(4, self.draws // 4, problem.program.size))
        return PosteriorDraws(
            "importance",
            z,
            {},
            [self.problem] if self.problem else [],
            pareto_k=self.pareto_k,
            r_hat=self.r_hat,
            ess=float(self.draws),
        )

    @override
    def deadline(self, problem) -> float:
        return time.perf_counter() + self.seconds

    @override
    def for_comparison(self, problem, draws) -> tuple[AbstractMethod, ...]:
        return (self.other or self,)


SLOW, STUCK = Made(takes=0.5), Made(stuck=60.0)


@pytest.fixture(scope="module", autouse=True)
def whoever_is_stuck_is_let_go() -> Iterator[None]:
    yield
    Made.released.set()


@dataclasses.dataclass(frozen=True)
class Given(pb.methods.Auto):
    """An automatic choice among given rungs."""

    given: tuple[tuple[str, AbstractMethod], ...] = ()

    @override
    def candidates(self, problem: Problem):
        return dict(self.given)


def fitted(*rungs, tolerance=0.1, **settings):
    given = tuple((f"rung {number}", rung) for number, rung in enumerate(rungs))
    method = Given(given=given, tolerance=tolerance, **settings)
    result = pb.fit(capture(), **ASKED, method=method)
    return result, provenance_of(result)


def test_the_first_rung_that_is_good_enough_is_taken():
    result, said = fitted(Made(), Made(fails="must not be tried"))
    assert said["auto"]["chosen"] == "rung 0"
    assert said["auto"]["met"]
    assert said["method"] == "importance"
    assert pb.verdict(result).converged
    (sentence,) = pb.inference.auto_sentences(result)
    assert "was selected: its means and standard deviations are expected within" in sentence


@pytest.mark.thorough
def test_what_a_method_says_of_its_draws_stays_with_the_result():
    result = pb.fit(capture(), **ASKED, method=Made(pareto_k=2.0))
    said = json.loads(result.attrs["polar_bayes"])  # with what is null
    assert (said["pareto_k"], said["ess"], said["r_hat"]) == (2.0, 4000.0, None)


@each(
    ("rung", "why"),
    [
        (Made(pareto_k=0.9), "its Pareto k is 0.90"),
        (Made(r_hat=1.2), "its R-hat is 1.200"),
        (Made(problem="it broke"), "it broke"),
        (Made(fails="no peak"), "no peak"),
    ],
)
def test_a_rung_that_fails_its_own_diagnostics_is_climbed_over(rung, why):
    result, said = fitted(rung, Made())
    assert said["auto"]["chosen"] == "rung 1"
    assert why in said["auto"]["steps"][0]["why"]
    assert why in pb.inference.auto_sentences(result)[0]
    assert pb.verdict(result).converged


def test_too_few_draws_are_mended_by_more_of_the_same():
    _, said = fitted(Made(draws=200), Made(fails="must not be tried"))
    steps = said["auto"]["steps"]
    assert [step["name"] for step in steps] == ["rung 0", "rung 0"]
    assert "Monte Carlo error" in steps[0]["why"]
    assert steps[1]["ess"] > 4 * steps[0]["ess"]
    assert steps[1]["taken"]


def test_where_nothing_is_good_enough_the_nearest_is_returned_and_flagged():
    result, said = fitted(Made(draws=400, pareto_k=0.9), Made(draws=60), tolerance=0.01)
    assert not said["auto"]["met"]
    assert said["auto"]["chosen"] == "rung 1"
    judged = pb.verdict(result)
    assert not judged.passed
    assert any(
        "no method met the tolerance of 0.01" in problem.lower() for problem in judged.problems
    )
    assert "No method met the tolerance" in pb.inference.auto_sentences(result)[-1]


@each(
    ("rung", "why"),
    [
        (Made(pareto_k=0.6), "its Pareto k is 0.60"),
        (Made(draws=300), "its effective sample size is 300"),
    ],
)
def test_without_a_tolerance_each_method_draws_once_as_much_as_it_has_to(rung, why):
    result, said = fitted(rung, Made(draws=500), Made(fails="must not be tried"), tolerance=None)
    assert [step["why"] for step in said["auto"]["steps"]] == [why, ""]
    assert pb.verdict(result).converged
    result, said = fitted(rung, tolerance=None)
    assert not said["auto"]["met"]
    assert "passed its own diagnostics" in pb.inference.auto_sentences(result)[-1]


def test_of_many_captures_those_that_the_cheapest_does_not_fit_are_left_to_the_next():
    q = np.stack([capture(seed)["q"] for seed in range(3)])
    image = at_mirror(VIEWS, q=(("y", "x", "view"), q[None])).assign_attrs(name="lines")
    first, second = Made(draws=600, pareto_k=0.6), Made(draws=500)
    for rungs, draws in (((first, second), 500), ((second, first), 500), ((first,), 600)):
        method = Given(given=tuple((str(rung), rung) for rung in rungs))
        maps = pb.fit_pixels(image, **ASKED, method=method)
        assert (maps["ess"] == draws).all()


@pytest.mark.thorough
def test_of_two_in_doubt_the_dearer_one_is_returned():
    _, said = fitted(Made(pareto_k=0.9), Made(pareto_k=np.nan, r_hat=1.2))
    assert (said["auto"]["chosen"], said["auto"]["met"]) == ("rung 1", False)


def test_after_its_time_nothing_begins():
    _, said = fitted(Made(pareto_k=0.9), Made(), seconds=1e-9)
    assert [step["why"] for step in said["auto"]["steps"]][1] == "the time was up"
    assert not said["auto"]["met"]


@pytest.mark.thorough
def test_only_the_first_is_let_off_the_time_though_it_had_no_answer():
    """Chains that report progress after the time are stopped."""
    with pytest.raises(pb.FitError, match=r"rung 0: .*no peak.*rung 1: .*the time was up"):
        fitted(Made(fails="no peak"), SLOW, seconds=0.3)
    # The first one always ends.
    assert fitted(SLOW, seconds=0.3)[1]["auto"]["met"]


def test_what_is_stuck_is_abandoned_and_the_best_answer_so_far_is_returned():
    """Neither compilation nor compiled programs can be interrupted."""
    rungs = (("rung 0", Made(pareto_k=0.9)), ("rung 1", STUCK), ("rung 2", Made()))
    here = problem(line)
    Given(given=rungs[:1]).run(here, KEY, no_progress)  # what judges draws is compiled
    begin = time.perf_counter()
    found = Given(given=rungs, tolerance=0.1, seconds=1.0).run(
        dataclasses.replace(here, start_time=begin), KEY, no_progress
    )
    assert time.perf_counter() - begin < 0.5 * STUCK.stuck
    said = found.metadata["auto"]
    assert [step["why"] for step in said["steps"]] == [
        "its Pareto k is 0.90",
        "abandoned when the time was up",
        "the time was up",
    ]
    assert (said["chosen"], said["met"]) == ("rung 0", False)
    assert "no method met the tolerance of 0.1 posterior sd within 1 s" in found.problems[-1]


@pytest.mark.thorough
def test_the_time_is_counted_from_when_the_fit_was_asked_for(monkeypatch: pytest.MonkeyPatch):
    at_once = fitting.make_problem

    def slowly(*asked: object):
        time.sleep(0.6)
        return at_once(*asked)

    fitted(Made())
    monkeypatch.setattr(fitting, "make_problem", slowly)
    _, said = fitted(Made(pareto_k=0.9), Made(), seconds=0.5)
    assert [step["why"] for step in said["auto"]["steps"]][1] == "the time was up"


@pytest.mark.thorough
def test_the_time_is_kept_on_a_busy_machine():
    """Two other processes want both cores, and two views are too few for the first rungs."""
    scene = pb.Scene(pb.SmoothSurface(), pb.Unpolarized(), pb.StokesMixing())
    links = {"q": pb.links.StokesLink(stated_errors=True)}
    hard = plate_capture(np.array([55.0, 57.0]), 0.01, 0)
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    seconds, begin = 5.0, time.perf_counter()
    try:
        result = pb.fit(hard, scene=scene, links=links, method="auto", seconds=seconds)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    took = time.perf_counter() - begin
    first, *others = provenance_of(result)["auto"]["steps"]
    assert "the time was up" in others[-1]["why"]
    assert took <= 1.2 * seconds + first["seconds"]


@pytest.mark.thorough
def test_comparisons_are_fitted_by_what_was_taken_and_in_the_time_that_is_left():
    taken, here = Made(), problem(line)
    auto = Given(given=(("rung 0", Made(pareto_k=0.9)), ("rung 1", taken)), seconds=600.0)
    found = auto.run(here, KEY, no_progress)
    assert auto.for_comparison(here, found) == (taken,)
    assert auto.deadline(here) == here.start_time + 600.0


def test_the_fit_beside_is_made_by_the_method_of_the_answer():
    """The instrument is told apart by comparing: never by choosing a method once more."""
    result = pb.fit(capture(), **SYSTEMATIC, method=Made(other=Made(draws=1000)))
    assert result["posterior"].sizes["draw"] == 1000
    assert result["without_discrepancy"].sizes["draw"] == 250
    assert result["without_instrument"].sizes["draw"] == 250


@pytest.mark.thorough
def test_comparisons_that_are_stuck_are_abandoned_and_told():
    late = pb.fit(capture(), method=Made(other=Made(draws=1000), seconds=-1.0), **SYSTEMATIC)
    said = provenance_of(late)["comparisons_failed"]
    assert set(said.values()) == {"the time was up"}
    begin = time.perf_counter()
    result = pb.fit(capture(), method=Made(other=STUCK, seconds=3.0), **SYSTEMATIC)
    assert time.perf_counter() - begin < 0.5 * STUCK.stuck
    assert "without_discrepancy" not in result.children
    said = provenance_of(result)["comparisons_failed"]
    assert said == dict.fromkeys(
        ("without_discrepancy", "without_instrument"), "abandoned when the time was up"
    )


@pytest.mark.thorough
def test_tolerances_that_weighted_draws_cannot_meet_are_left_to_chains():
    here = problem(line)
    assert list(pb.methods.Auto(tolerance=0.03).candidates(here)) == ["importance", "nuts"]
    assert list(pb.methods.Auto(tolerance=0.01).candidates(here)) == ["nuts"]


def test_without_a_tolerance_weights_adapt_for_few_rounds():
    here = problem(line)
    found = pb.methods.Auto(rounds=2).candidates(here)["importance"]
    assert found == pb.methods.Importance(rounds=2)
    draws = found.run(here, jax.random.key(0), no_progress)
    assert draws.metadata["rounds"] == 1  # of a normal posterior


def test_where_every_rung_fails_the_fit_is_refused():
    with pytest.raises(pb.FitError, match=r"rung 0: .*no peak.*rung 1: .*no draws"):
        fitted(Made(fails="no peak"), Made(fails="no draws"))


def test_a_normal_posterior_is_met_by_the_cheapest():
    result = pb.fit(capture(), **ASKED, method="auto", tolerance=0.2, seconds=600)
    said = provenance_of(result)["auto"]
    assert (said["chosen"], said["met"], said["tolerance"]) == ("importance", True, 0.2)
    mean, covariance = of_line(capture()["q"].to_numpy())
    table = pb.summary(result).loc[["level", "slope"]]
    sd = np.sqrt(np.diagonal(covariance))
    assert (np.abs(table["mean"] - mean) / sd < 0.2).all()
    assert (np.abs(table["sd"] / sd - 1.0) < 0.2).all()


@pytest.mark.thorough
def test_by_default_a_deep_funnel_is_left_to_chains_and_no_answer_is_trusted():
    result = pb.fit(capture(), **ASKED | {"model": deep_funnel})
    first, second = provenance_of(result)["auto"]["steps"]
    assert "Pareto k" in first["why"]
    assert "R-hat" in second["why"]
    assert not pb.verdict(result).converged


@pytest.mark.thorough
@each("seed", range(1, 4))
def test_of_a_funnel_no_draws_are_taken_that_are_worse_than_they_say(seed):
    """At 0.1 sd weighted draws once were, which had lost the wide end (Pareto k .5, error .12)."""
    for tolerance in (0.5, 0.1):
        method = pb.methods.Auto(tolerance, 600.0)
        result = pb.fit(capture(), **ASKED | {"model": funnel}, method=method, seed=seed)
        said = provenance_of(result)["auto"]
        error = abs(float(result["posterior"]["width"].mean())) / 3.0
        taken = [step["monte_carlo"] for step in said["steps"] if step["taken"]]
        assert all(error < expected < tolerance for expected in taken)
        assert said["met"] == bool(taken)


@each(
    ("asked", "said"),
    [
        ({"method": "nuts", "tolerance": 0.1}, "tolerance needs method='auto'"),
        ({"method": pb.methods.Auto(), "seconds": 3.0}, "seconds needs method='auto'"),
        ({"method": "auto", "tolerance": 0.0}, "tolerance is 0.0"),
        ({"method": "auto", "seconds": -1.0}, "seconds is -1.0"),
        ({"method": "magic"}, "no such method"),
    ],
)
def test_what_cannot_be_asked_is_refused(asked, said):
    with pytest.raises(pb.FitError, match=said):
        pb.fit(capture(), **ASKED, **asked)


def test_each_of_several_methods_is_tried_once_more_with_more_draws() -> None:
    _, said = fitted(Made(draws=200, r_hat=1.2), Made(draws=200), Made(fails="must not be tried"))
    assert [step["name"] for step in said["auto"]["steps"]] == ["rung 0", "rung 1", "rung 1"]
