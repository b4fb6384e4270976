"""The study of a posterior that is known: references, trials, dials, and processes of their own."""

import dataclasses
import json
from collections.abc import Iterator
from typing import override

import jax
import numpy as np
import pytest
import xarray as xr
from toy_models import capture, line, of_line, squared

import polar_bayes as pb
from polar_bayes.budget import dials, fresh
from polar_bayes.budget.accuracy import AS_GIVEN
from polar_bayes.budget.dials import AbstractDial
from polar_bayes.budget.fresh import run_fresh
from polar_bayes.budget.reference import run_reference
from polar_bayes.budget.trial import Trial, bench_of
from polar_bayes.budget.variants import parts_of
from polar_bayes.inference.bench import Bench
from polar_bayes.inference.method import AbstractMethod, Answer
from polar_bayes.inference.request import resolve

LINKS = {"q": pb.StokesLink()}
ROUGHLY = pb.Reference(error=0.05, longer=0)


@pytest.fixture(autouse=True, scope="module")
def compile_fast_rather_than_fast_code() -> Iterator[None]:
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@dataclasses.dataclass(frozen=True)
class Biased(AbstractMethod):
    """Draws of the exact posterior of the line, moved by so many standard deviations."""

    shift: float = 0.5
    draws: int = 4000

    @override
    def draw(self, bench: Bench) -> Answer:
        mean, covariance = of_line(np.asarray(bench.data.readings["q"]))
        sd = np.sqrt(np.diagonal(covariance))
        random = np.random.default_rng(0)
        z = random.multivariate_normal(mean + self.shift * sd, covariance, (4, self.draws // 4))
        return Answer("variational", z, {}, k_hat=0.6, effective_draws=float(self.draws))


@dataclasses.dataclass(frozen=True)
class Broken(AbstractMethod):
    """A method that never has an answer."""

    @override
    def draw(self, bench: Bench) -> Answer:
        raise pb.FitError("it cannot be", where="Broken", mend="nothing")


@dataclasses.dataclass(frozen=True)
class Stuck(AbstractDial):
    """A dial that cannot be turned."""

    @property
    @override
    def name(self) -> str:
        return "stuck"

    @override
    def turn(self, request, method):
        raise pb.FitError("it is rusty", where="Stuck", mend="oil it")


@pytest.fixture(scope="module")
def study() -> xr.DataTree:
    return pb.accuracy(
        capture(),
        model=line,
        links=LINKS,
        rungs={"biased": Biased(), "right": Biased(shift=0.0), "broken": Broken()},
        dials=(pb.DrawsDial(0.1), pb.FacetsDial(2.0), pb.PrecisionDial(), Stuck()),
        reference=ROUGHLY,
        fresh=False,
    )


def test_errors_are_in_sds_of_the_reference(study):
    found = study["accuracy"].to_dataset()
    mean, covariance = of_line(capture()["q"].to_numpy())
    sd = np.sqrt(np.diagonal(covariance))
    assert list(found["parameter"].to_numpy()) == ["level", "slope"]
    # Five standard errors of a reference that is known to 0.05, and 4000 draws.
    np.testing.assert_allclose(found["reference_mean"], mean, atol=5 * 0.05 * sd.max())
    np.testing.assert_allclose(found["reference_sd"] / sd, 1.0, atol=0.25)
    errors = found["mean_error"].to_numpy()
    np.testing.assert_allclose(errors[0], 0.5, atol=0.3)
    np.testing.assert_allclose(errors[1], 0.0, atol=0.3)
    np.testing.assert_allclose(errors[0] - errors[1], 0.5, atol=0.1)


def test_the_reference_states_its_own_error(study):
    told = study["accuracy"].attrs
    assert told["reference"] == "NUTS"
    assert 0.0 < told["reference_error"] < 0.05
    assert told["reference_r_hat"] < 1.01
    assert told["reference_doubts"] == ""
    assert told["reference_effective_draws"] > 400


def test_a_rung_that_fails_is_a_row_that_says_why(study):
    table = pb.accuracy_table(study)
    assert "it cannot be" in table.loc["broken", "problems"]
    assert np.isnan(table.loc["broken", "error"])
    assert not table.loc["broken", "on_front"]


def test_a_dial_that_fails_is_a_row_that_says_why(study):
    table = pb.accuracy_table(study)
    for rung in ("biased", "right", "broken"):
        assert "it is rusty" in table.loc[f"{rung}, stuck", "problems"]
        assert np.isnan(table.loc[f"{rung}, stuck", "error"])


def test_a_choice_of_effects_that_failed_is_not_tried_again(monkeypatch):
    tries = []

    def refuse(*arguments, **keywords):
        tries.append(arguments)
        raise pb.FitError("no peak", where="choose_effects", mend="nothing")

    monkeypatch.setattr(dials, "choose_effects", refuse)
    request = resolve(capture(), line, "nuts", "paper", None, LINKS, 90.0, 0, "double")
    for method in (pb.Laplace(), pb.Nuts()):
        with pytest.raises(pb.FitError, match="no peak"):
            pb.EffectsDial().turn(request, method)
    assert len(tries) == 1


def test_dials_turn_what_they_can_and_leave_the_rest_out(study):
    found = study["accuracy"].to_dataset()
    pairs = list(zip(found["rung"].to_numpy(), found["dial"].to_numpy(), strict=True))
    assert pairs[:3] == [("biased", AS_GIVEN), ("right", AS_GIVEN), ("broken", AS_GIVEN)]
    assert ("biased", "draws / 10") in pairs
    assert ("broken", "draws / 10") not in pairs  # it has no draws
    assert ("right", "single precision") in pairs
    table = pb.accuracy_table(study)
    assert table.loc["right, draws / 10", "effective_draws"] == 400


def test_without_processes_of_their_own_first_times_and_memory_are_not_told(study):
    table = pb.accuracy_table(study)
    assert table["seconds_first"].isna().all()
    assert table["peak_memory"].isna().all()
    assert (table.loc[["biased", "right"], "seconds_again"] > 0.0).all()
    about = json.loads(study.attrs["polar_bayes"])
    assert about["fresh_processes"] is False


def test_facets_are_turned_where_there_are_any():
    request = resolve(capture(), line, "nuts", "paper", None, LINKS, 90.0, 0, "double")
    turned, method = pb.FacetsDial(0.5).turn(request, pb.Nuts())
    before, after = (
        [part for _, part in parts_of(scene) if isinstance(part, pb.FacetQuadrature)]
        for scene in (request.scene, turned.scene)
    )
    assert len(before) == len(after) > 0
    for one, other in zip(before, after, strict=True):
        assert other.along == round(0.5 * one.along)
        assert other.across == round(0.5 * one.across)
    assert method == pb.Nuts()
    smooth = dataclasses.replace(request, scene=pb.Scene(pb.SmoothSurface()))
    assert pb.FacetsDial(0.5).turn(smooth, pb.Nuts()) is None
    single = dataclasses.replace(request, precision="single")
    assert pb.PrecisionDial().turn(single, pb.Nuts()) is None


def test_every_dial_has_a_name_of_its_own():
    every: list[AbstractDial] = [
        pb.DrawsDial(0.25), pb.DrawsDial(4.0), pb.FacetsDial(0.5), pb.FacetsDial(2.0),
        pb.EffectsDial(), pb.PrecisionDial(),
    ]  # fmt: skip
    names = [dial.name for dial in every]
    assert names[:3] == ["draws / 4", "draws x 4", "facets / 2"]
    assert len(set(names)) == len(names)


def test_chains_that_miss_a_mode_hand_the_reference_over():
    request = resolve(capture(), squared, "nuts", "paper", None, LINKS, 90.0, 0, "double")
    judge = run_reference(ROUGHLY, bench_of(request, jax.random.key(0)))
    assert judge.made_by == "tempered draws"
    assert not judge.doubts
    share = np.mean(judge.draws[judge.labels.index("root")] > 0.0)
    assert abs(share - 0.5) < 5 * 0.5 * 0.05


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"rungs": {}}, "there is no rung"),
        ({"rungs": {"mine": "nuts"}}, "a str is not a method"),
    ],
)
def test_what_cannot_be_studied_is_refused(asked, said):
    with pytest.raises(pb.FitError, match=said):
        pb.accuracy(capture(), model=line, links=LINKS, **asked)


def test_settings_out_of_range_are_refused():
    with pytest.raises(pb.FitError, match="error is 0"):
        pb.Reference(error=0.0)
    with pytest.raises(pb.FitError, match="factor is 0"):
        pb.DrawsDial(0.0)
    with pytest.raises(pb.FitError, match="factor is -1"):
        pb.FacetsDial(-1.0)


def test_a_process_of_its_own_finds_no_compiled_programs(monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/somewhere")
    told = fresh._environment()
    assert "JAX_COMPILATION_CACHE_DIR" not in told
    assert told["JAX_ENABLE_COMPILATION_CACHE"] == "false"


def test_a_trial_runs_in_a_process_of_its_own():
    request = resolve(capture(), line, "nuts", "paper", None, LINKS, 90.0, 0, "double")
    found = run_fresh(Trial(request, pb.Laplace(draws=50), 0))
    assert found.labels == ("level", "slope")
    assert found.draws.shape == (2, 4, 50)
    assert found.seconds_first > 0.0
    assert found.seconds_again > 0.0
    assert found.peak_memory >= found.memory_before > 50.0
    with pytest.raises(pb.FitError, match="it cannot be"):
        run_fresh(Trial(request, Broken(), 0))
