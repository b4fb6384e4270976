"""The study of a posterior that is known: references, trials, overrides, fresh processes."""

import dataclasses
import json
from typing import override

import jax
import numpy as np
import pytest
import xarray as xr
from cases import each
from toy_models import capture, line, of_line, problem, request_of, squared

import polar_bayes as pb
from polar_bayes.benchmark import run
from polar_bayes.benchmark.advice import AS_GIVEN
from polar_bayes.benchmark.reference import ReferenceRun, best_reference, run_reference
from polar_bayes.benchmark.run import AbstractOverride, Trial, run_in_subprocess, run_trial
from polar_bayes.inference.request import resolve
from polar_bayes.methods.method import AbstractMethod, PosteriorDraws
from polar_bayes.numerics.mcse import standard_errors
from polar_bayes.numerics.psis import resampled_chains
from polar_bayes.physics.variants import parts_of

LINKS = {"q": pb.links.StokesLink()}
ROUGHLY = pb.benchmark.Reference(error=0.05, longer=0)


@dataclasses.dataclass(frozen=True)
class Biased(AbstractMethod):
    """Draws of the exact posterior of the line, moved by so many standard deviations."""

    shift: float = 0.5
    draws: int = 4000

    @override
    def run(self, problem, key, progress) -> PosteriorDraws:
        mean, covariance = of_line(np.asarray(problem.data.readings["q"]))
        sd = np.sqrt(np.diagonal(covariance))
        random = np.random.default_rng(0)
        z = random.multivariate_normal(mean + self.shift * sd, covariance, (4, self.draws // 4))
        return PosteriorDraws("variational", z, {}, pareto_k=0.6, ess=float(self.draws))


@dataclasses.dataclass(frozen=True)
class Broken(AbstractMethod):
    """A method that never has an answer."""

    @override
    def run(self, problem, key, progress) -> PosteriorDraws:
        raise pb.FitError("it cannot be", where="Broken", hint="nothing")


@pytest.fixture(scope="module")
def partial() -> list[xr.DataTree]:
    return []


@dataclasses.dataclass(frozen=True)
class Stuck(AbstractOverride):
    """An override that cannot be changed."""

    name = "stuck"

    @override
    def apply(self, request, method):
        raise pb.FitError("it is rusty", where="Stuck", hint="oil it")


@pytest.fixture(scope="module")
def study(partial) -> xr.DataTree:
    overrides = (
        pb.benchmark.DrawsOverride(0.1),
        pb.benchmark.FacetsOverride(2.0),
        pb.benchmark.PrecisionOverride(),
        Stuck(),
    )
    methods = {"biased": Biased(), "right": Biased(shift=0.0), "broken": Broken()}
    asked = {"model": line, "links": LINKS, "reference": ROUGHLY, "fresh": False}
    return pb.accuracy(
        capture(), methods=methods, overrides=overrides, partial=partial.append, **asked
    )


def test_what_is_known_so_far_is_told_after_each_row(study, partial):
    whole = study["accuracy"].to_dataset()
    assert [tree["accuracy"].sizes["row"] for tree in partial] == [*range(1, whole.sizes["row"])]
    for tree in (partial[0], partial[-1]):
        known = tree["accuracy"].to_dataset()
        xr.testing.assert_identical(known, whole.isel(row=slice(known.sizes["row"])))
        assert pb.benchmark.accuracy_sentences(tree)


def test_errors_are_in_sds_of_the_reference_which_states_its_own(study):
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
    told = found.attrs
    assert told["reference"] == "NUTS"
    assert 0.0 < told["reference_error"] < 0.05
    assert told["reference_r_hat"] < 1.01
    assert told["reference_doubts"] == ""
    assert told["reference_ess"] > 400


def test_a_method_or_an_override_that_fails_is_a_row_that_says_why(study):
    table = pb.summary(study)
    rows = {"broken": "it cannot be"}
    rows |= {f"{method}, stuck": "it is rusty" for method in ("biased", "right", "broken")}
    for row, said in rows.items():
        assert said in table.loc[row, "problems"]
        assert np.isnan(table.loc[row, "error"])
    assert not table.loc["broken", "on_front"]


@pytest.mark.thorough
def test_a_choice_of_effects_that_failed_is_not_tried_again(monkeypatch):
    tries = []

    def refuse(*arguments, **keywords):
        tries.append(arguments)
        raise pb.FitError("no peak", where="choose_effects", hint="nothing")

    monkeypatch.setattr(run, "choose_effects", refuse)
    request = request_of(line)
    for method in (pb.methods.Laplace(), pb.methods.Nuts()):
        with pytest.raises(pb.FitError, match="no peak"):
            pb.benchmark.EffectsOverride().apply(request, method)
    assert len(tries) == 1


def test_dials_turn_what_they_can_and_leave_the_rest_out(study):
    found, table = study["accuracy"].to_dataset(), pb.summary(study)
    pairs = list(zip(found["method"].to_numpy(), found["override"].to_numpy(), strict=True))
    assert pairs[:3] == [("biased", AS_GIVEN), ("right", AS_GIVEN), ("broken", AS_GIVEN)]
    assert ("biased", "draws / 10") in pairs
    assert ("broken", "draws / 10") not in pairs  # it has no draws
    assert ("right", "single precision") in pairs
    assert table.loc["right, draws / 10", "ess"] == 400
    # Without processes of their own, first times and memory are not told.
    assert table[["seconds_first", "peak_memory"]].isna().all(axis=None)
    assert (table.loc[["biased", "right"], "seconds_again"] > 0.0).all()
    assert json.loads(study.attrs["polar_bayes"])["fresh_processes"] is False


@pytest.mark.thorough
def test_what_least_squares_does_not_estimate_is_left_out():
    plate = pb.simulate("glass", scene="goniometer", seed=0)
    request = resolve(plate, "per_material", "goniometer", None, None, None, 0, "double")
    chains, point = (
        run_trial(Trial(request, method)).labels
        for method in (pb.methods.Nuts(draws=100, most_draws=100), pb.methods.Point(starts=2))
    )
    assert set(point) < set(chains)
    assert {"stokes_error_factor", "discrepancy_amplitude"} <= set(chains) - set(point)
    assert {x for x in chains if x.startswith(("refractive_index", "subsurface"))} <= set(point)


@pytest.mark.thorough
def test_facets_are_turned_where_there_are_any():
    request = request_of(line)
    changed, method = pb.benchmark.FacetsOverride(0.5).apply(request, pb.methods.Nuts())
    before, after = (
        [part for _, part in parts_of(scene) if isinstance(part, pb.physics.FacetQuadrature)]
        for scene in (request.scene, changed.scene)
    )
    assert len(before) == len(after) > 0
    for one, other in zip(before, after, strict=True):
        assert other.along == round(0.5 * one.along)
        assert other.across == round(0.5 * one.across)
    assert method == pb.methods.Nuts()
    smooth = dataclasses.replace(request, scene=pb.Scene(pb.SmoothSurface()))
    assert pb.benchmark.FacetsOverride(0.5).apply(smooth, pb.methods.Nuts()) is None
    single = dataclasses.replace(request, precision="single")
    assert pb.benchmark.PrecisionOverride().apply(single, pb.methods.Nuts()) is None


def test_an_override_of_draws_turns_what_its_name_says_or_nothing():
    request = request_of(line)
    quarter = pb.benchmark.DrawsOverride(0.25)
    for name, method in pb.methods.STUDY_METHODS.items():
        changed = quarter.apply(request, method)
        assert (changed is None) == (name in ("point", "nuts short"))  # no draws, or too few
        if changed is not None:
            assert changed[1].num_draws == pytest.approx(0.25 * method.num_draws, abs=1)


@pytest.mark.thorough
def test_every_override_has_a_name_of_its_own():
    every: list[AbstractOverride] = [
        *(pb.benchmark.DrawsOverride(factor) for factor in (0.25, 4.0)),
        *(pb.benchmark.FacetsOverride(factor) for factor in (0.5, 2.0)),
        pb.benchmark.EffectsOverride(), pb.benchmark.PrecisionOverride(),
    ]  # fmt: skip
    names = [override.name for override in every]
    assert names[:3] == ["draws / 4", "draws x 4", "facets / 2"]
    assert len(set(names)) == len(names)


@pytest.mark.thorough
def test_where_chains_miss_a_mode_weighted_draws_are_the_reference():
    reference = run_reference(ROUGHLY, problem(squared), jax.random.key(1))
    assert reference.method == "weighted draws"
    assert not reference.doubts
    # Its own error is that of the weights, too.
    assert (reference.mean_error > 1.1 * standard_errors(reference.draws)[0]).all()
    share = np.mean(reference.draws[reference.labels.index("root")] > 0.0)
    assert abs(share - 0.5) < 5 * 0.5 * 0.05


def judged(biases: tuple[str, ...], error: float) -> ReferenceRun:
    errors = np.array([error, 0.5 * error])
    return ReferenceRun(("x", "y"), np.zeros((2, 4, 9)), "made", errors, errors, None, None, biases)


@pytest.mark.thorough
def test_noise_is_no_reason_to_take_a_biased_reference():
    noisy, biased = judged((), 0.03)._replace(noise="its error is 0.03"), judged(("R-hat",), 0.001)
    assert len(noisy.doubts) == len(biased.doubts) == 1
    assert best_reference([biased, noisy]) is noisy
    assert best_reference([judged(("R-hat", "a mode"), 0.001), biased]) is biased
    unknown = judged((), np.nan)
    assert best_reference([unknown, noisy]) is best_reference([noisy, unknown]) is noisy


@pytest.mark.thorough
def test_draws_chosen_by_weight_have_the_error_of_their_weights_too():
    """Over 60 choices the error that is told is that of weights and choice together."""
    random = np.random.default_rng(0)
    count, told, seen = 2000, [], []
    for _ in range(60):
        z = 1.5 * random.standard_normal((count, 1))
        weights = np.exp(-0.5 * z[:, 0] ** 2 * (1.0 - 1.0 / 1.5**2))
        weights /= weights.sum()
        chosen = z[resampled_chains(weights, 1.0 / np.sum(weights**2), random)]
        found = PosteriorDraws("importance", chosen, {}, weighted=(z, weights))
        mean, _ = found.standard_errors(lambda z: np.moveaxis(z, -1, 0))
        told.append(mean[0])
        seen.append(chosen.mean())
    # A standard normal, of which the weights alone lose 0.0197 and choosing as many as they are
    # worth at most 0.0245; the sd of 60 means is known to 9%.
    assert np.mean(told) == pytest.approx(np.hypot(0.0197, 0.0245), rel=0.05)
    assert np.std(seen) < (1.0 + 4 * 0.09) * np.mean(told)


@each(
    ("asked", "said"),
    [
        ({"methods": {}}, "there is no method"),
        ({"methods": {"mine": "nuts"}}, "a str is not a method"),
    ],
)
def test_what_cannot_be_studied_is_refused(asked, said):
    with pytest.raises(pb.FitError, match=said):
        pb.accuracy(capture(), model=line, links=LINKS, **asked)


def test_settings_out_of_range_are_refused():
    with pytest.raises(pb.FitError, match="error is 0"):
        pb.benchmark.Reference(error=0.0)
    with pytest.raises(pb.FitError, match="factor is 0"):
        pb.benchmark.DrawsOverride(0.0)
    with pytest.raises(pb.FitError, match="factor is -1"):
        pb.benchmark.FacetsOverride(-1.0)


@pytest.mark.thorough
def test_a_process_of_its_own_finds_no_compiled_programs(monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/somewhere")
    told = run._environment()
    assert "JAX_COMPILATION_CACHE_DIR" not in told
    assert told["JAX_ENABLE_COMPILATION_CACHE"] == "false"


@pytest.mark.thorough
def test_a_trial_runs_in_a_process_of_its_own():
    request = request_of(line)
    found = run_in_subprocess(Trial(request, pb.methods.Laplace(draws=50)))
    assert found.labels == ("level", "slope")
    assert found.draws.shape == (2, 4, 50)
    assert found.seconds_first > 0.0
    assert found.seconds_again > 0.0
    assert found.peak_memory >= found.memory_before > 50.0
    with pytest.raises(pb.FitError, match="it cannot be"):
        run_in_subprocess(Trial(request, Broken()))
