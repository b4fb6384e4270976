"""Model criticism: calm when the model is right, and loud when the readings say that it is not."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from plates import ON_PLATE, at_mirror, plates
from scipy import stats
from synthetic_results import SCALE, edit_provenance, make_result, replace
from textbook import plate_q

import polar_bayes as pb
from polar_bayes.diagnostics.criticism import QUESTIONS, criticize
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.inference.checks import PROBLEM
from polar_bayes.inference.result import provenance_of

SMALL = {"wavelengths": (), "variables": ("dop",), "draws": 250}


def _changed(change, **layout):
    """A right result whose readings of dop are changed before the density is computed."""
    tree = make_result(**{**SMALL, **layout})
    zenith = tree["constant_data"]["view_zenith"].to_numpy()
    observed = change(tree["observed_data"]["dop"].to_numpy().copy(), zenith)
    z = (observed - tree["noise_free"]["dop"].to_numpy()) / SCALE["dop"]
    tree = replace(tree, "observed_data", "dop", observed)
    return replace(tree, "log_likelihood", "dop", -0.5 * z**2)


@each("layout", [{"views": 16}, {"views": 40}, {"wavelengths": (450.0, 550.0)}], quick=1)
def test_right_models_rarely_have_a_problem(layout) -> None:
    """Eight checks at 0.4% each: more problems than expected of 40 fits have probability 0.001."""
    layout = {**SMALL, "views": 16, **layout}
    failed = sum(
        criticize(make_result(**layout, seed=seed))["level"].eq("problem").any()
        for seed in range(40)
    )
    assert failed <= stats.binom.isf(1e-3, 40, len(QUESTIONS) * PROBLEM)


def _wave(q, zenith):
    return q + 3.0 * SCALE["dop"] * np.sin(np.radians(zenith) * 9.0)


def _outlier(q, zenith):
    del zenith
    q[..., 11] += 9.0 * SCALE["dop"]
    return q


def _common(q, zenith):
    """An error that all wavelengths share."""
    return q + 2.0 * SCALE["dop"] * np.random.default_rng(0).standard_normal(zenith.size)


def _spoil(q, zenith):
    q[zenith.argmax()] += 5.0 * SCALE["dop"]
    return q


@each(
    ("check", "change", "layout", "level", "words"),
    [
        ("angle", _wave, {}, "problem", "p = "),
        ("outliers", _outlier, {}, "problem", "p = "),
        ("wavelength", _common, {"wavelengths": (450.0, 550.0, 650.0)}, "problem", "p = "),
        ("influence", _spoil, {"views": 6}, "caution", "dop at 85 degrees"),
    ],
)
def test_residuals_with_structure_are_told(check, change, layout, level, words) -> None:
    row = criticize(_changed(change, **layout)).loc[check]
    assert row["level"] == level
    assert (f"p = {row['p_value']:.2g}" if words == "p = " else words) in row["sentence"]


@pytest.mark.thorough
def test_residuals_of_a_few_mirror_views_are_flagged_as_seldom_as_is_stated() -> None:
    """Of 60 right captures of six readings a caution (2%) comes in six or more once in 800."""
    flagged = 0
    for seed in range(60):
        plate = plates([1.45 + 0.004 * seed], 0.03, seed=seed).isel(patch=0)
        fit = pb.fit(plate, **ON_PLATE, method="importance")
        flagged += criticize(fit).loc["angle", "level"] != "passed"
    assert flagged < 6


@pytest.mark.thorough
def test_outliers_of_noise_with_long_tails_are_flagged_as_seldom_as_is_stated() -> None:
    """Of 300 right captures as many cautions (2%) come once in a thousand."""
    zenith, cautions = np.linspace(20.0, 78.0, 12), {"outliers": 0, "influence": 0}
    tailed = ON_PLATE | {"links": {"q": pb.links.StokesLink(degrees_of_freedom=4.0)}}
    for seed in range(300):
        random = np.random.default_rng(seed)
        q = plate_q(random.uniform(1.4, 1.6), 0.02, np.radians(zenith))
        q = np.clip(q + 0.01 * random.standard_t(4.0, zenith.size), -1.0, 1.0)
        table = criticize(pb.fit(at_mirror(zenith, q=q), **tailed, method="importance"))
        for name in cautions:
            cautions[name] += table.loc[name, "level"] not in ("passed", "note")
    assert max(cautions.values()) <= stats.binom.isf(1e-3, 300, 0.02), cautions


@pytest.mark.thorough
@each("scene", ["polarimeter", "camera"])
def test_a_bare_surface_before_a_perfect_instrument_passes(scene) -> None:
    views = pb.simulation.Protocol(views=40, wavelengths=(), largest_view_zenith=78.0)
    bare = {"protocol": views, "parameters": {"subsurface_fraction": 0.0}}
    verdict = pb.verdict(pb.fit(pb.simulate("plastic", scene=scene, **bare, seed=0), scene=scene))
    assert verdict.passed
    assert not any("conflict" in caution for caution in verdict.cautions)
    assert "no light from the body" in " ".join(verdict.findings)


@pytest.mark.thorough
@each("seed", [0, 2, 5])
def test_an_approximation_of_a_right_plate_is_not_told_that_its_scene_lacks_something(seed) -> None:
    """Laplace's discrepancy is half as wide as the posterior's, and k is above 0.7 for seed 5."""
    views = pb.simulation.Protocol(views=30, wavelengths=())
    plate = pb.simulate("glass", scene="goniometer", protocol=views, seed=seed)
    assert pb.verdict(pb.fit(plate, method="laplace")).passed


def test_readings_that_scatter_otherwise_are_not_uniform() -> None:
    assert criticize(make_result(**SMALL, noise=3.0)).loc["leave-one-out", "level"] == "problem"


OUT = ("roughness", "subsurface_fraction", "absorption", "refractive_index", "exposure")


@each(
    ("below", "level", "words"),
    [
        ({}, "passed", ""),
        ({"refractive_index": [1.0 - 1e-6]}, "problem", "refractive_index 4.8 sd"),
        ({name: [float(stats.norm.cdf(2.3))] for name in OUT}, "problem", ""),
        # A fraction of one; one of zero is no conflict (below).
        ({"subsurface_fraction": [1.0 - 1e-7]}, "problem", "subsurface_fraction 5.2 sd"),
    ],
    ids=["as told", "one far out", "several somewhat out", "all light from the body"],
)
def test_parameters_far_out_in_their_priors_are_a_problem(below, level, words) -> None:
    tree = edit_provenance(make_result(**SMALL), bounds={"subsurface_fraction": [0.0, 1.0]})
    known = provenance_of(tree)["prior_probability"]
    row = criticize(edit_provenance(tree, prior_probability=known | below)).loc["priors"]
    assert row["level"] == level
    assert words in row["sentence"]


@each(
    ("name", "bounds", "groups", "sd", "level", "words"),
    [
        ("refractive_index", [1.2, 2.0], ["posterior"], 0.01, "caution", "refractive_index at 1.2"),
        # A half-normal prior reaches zero: a perfect instrument is nothing to be warned of.
        ("exposure", [0.0, None], ["posterior", "prior"], 0.2, "passed", ""),
    ],
)
def test_draws_against_a_bound_are_named_unless_the_prior_is_highest_there(
    name, bounds, groups, sd, level, words
) -> None:
    tree = edit_provenance(make_result(**SMALL), bounds={name: bounds})
    for group in groups:
        draws = _half_normal(sd, seed=1)(tree[group][name].shape)
        tree = replace(tree, group, name, bounds[0] + draws)
    row = criticize(tree).loc["bounds"]
    assert row["level"] == level
    assert words in row["sentence"]


def test_repeated_views_are_a_problem() -> None:
    tree = make_result(**SMALL, views=20)
    again = np.r_[np.arange(20), [3, 3, 7, 9]]
    repeated = tree.map_over_datasets(lambda group: group.isel(view=again, missing_dims="ignore"))
    row = criticize(repeated).loc["repeats"]
    assert row["level"] == "problem"
    assert row["sentence"].startswith("4 of 24 views repeat another in every digit")


def test_a_point_fit_is_not_criticized_and_says_so() -> None:
    result = make_result(**SMALL, method="point")
    assert set(criticize(result)["level"]) == {"not computed"}
    assert any("no draws to criticize" in text for text in pb.verdict(result).cautions)


def test_the_verdict_fails_though_the_chains_converged() -> None:
    found = pb.verdict(_changed(_wave))
    assert not found.passed
    assert found.converged
    assert any("structure over the angle" in text for text in found.problems)


# --- The simplest world: what is absent or perfect ------------------------------------------------


def _at(tree, name, draws, *, prior, below=0.5, high=None):
    """A result with another parameter: its draws, those of its prior, and where these are.

    It is at least 0. Draws, and those of the prior, are functions of a shape.
    """
    for group, values in (("posterior", draws), ("prior", prior)):
        dataset = tree[group].to_dataset()
        shape = tuple(dataset.sizes[dim] for dim in ("chain", "draw"))
        tree[group] = xr.DataTree(dataset.assign({name: (("chain", "draw"), values(shape))}))
    known = provenance_of(tree)
    return edit_provenance(
        tree,
        prior_probability=known["prior_probability"] | {name: [below]},
        bounds=known.get("bounds", {}) | {name: [0.0, high]},
    )


def _normal(mean, sd):
    return lambda shape: np.random.default_rng(0).normal(mean, sd, shape)


def _half_normal(scale, seed=0):
    return lambda shape: np.abs(np.random.default_rng(seed).normal(0.0, scale, shape))


FRACTION = {"name": "subsurface_fraction", "prior": _half_normal(0.3), "high": 1.0}


@each("below", [1e-3, 1e-9, 1e-30])
def test_a_fraction_of_zero_is_no_conflict(below) -> None:
    tree = _at(make_result(**SMALL), **FRACTION, draws=_half_normal(1e-3), below=below)
    table = criticize(tree)
    assert table.loc["priors", "level"] == "passed"
    assert table.loc["absent", "level"] == "note"
    assert "no light from the body" in table.loc["absent", "sentence"]
    assert "is the same without (within 0." in table.loc["absent", "sentence"]
    assert table.loc["bounds", "level"] == "passed"
    found = pb.verdict(tree)
    assert found.passed
    assert not found.cautions
    assert any("no light from the body" in text for text in found.findings)


def test_an_answer_that_leans_on_what_is_absent_says_what_it_would_be() -> None:
    """The index follows the fraction: without it, it is what the slope says."""
    tree = make_result(**SMALL)
    fraction = _half_normal(1e-3)(tree["posterior"]["refractive_index"].shape)
    rest = np.random.default_rng(5).normal(0.0, 1e-3, fraction.shape)
    tree = replace(tree, "posterior", "refractive_index", 1.5 - 10.0 * fraction + rest)
    tree = _at(tree, **FRACTION, draws=lambda shape: fraction, below=0.01)
    assert "refractive_index would be 1.5 " in criticize(tree).loc["absent", "sentence"]


@each(
    ("name", "below", "level"),
    [
        ("stokes_error_factor", 1e-9, "passed"),  # better than the prior
        ("stokes_error_factor", 1.0 - 1e-9, "problem"),
        ("concentration_scale", 1.0 - 1e-9, "passed"),  # large is good
        ("concentration_scale", 1e-9, "problem"),
    ],
)
def test_noise_is_a_problem_only_where_it_is_worse_than_its_prior(name, below, level) -> None:
    draws = _normal(2.0, 0.01)
    table = criticize(_at(make_result(**SMALL), name, draws, prior=draws, below=below))
    assert table.loc["noise", "level"] == level
    assert table.loc["priors", "level"] == "passed"


@each(
    ("factor", "level", "words"),
    [
        (0.1, "note", "scatter 0.0999 times [0.0981, 0.102] their stated errors"),
        (1.0, "passed", ""),
        (5.0, "note", "scatter 5 times [4.98, 5.02] their stated errors"),
    ],
)
def test_errors_stated_too_large_or_too_small_have_their_own_sentence(factor, level, words) -> None:
    draws = _normal(factor, 0.01 if factor > 1 else 0.001)
    tree = _at(make_result(**SMALL), "stokes_error_factor", draws, prior=_half_normal(2.0))
    row = criticize(tree).loc["noise"]
    assert row["level"] == level
    assert words in row["sentence"]
    assumed = edit_provenance(tree, capture={"errors": "assumed by the import"})
    words = words.replace("their stated errors", "the errors that were assumed by the import")
    assert words in criticize(assumed).loc["noise", "sentence"]


# --- Systematic errors ----------------------------------------------------------------------------


def _with_discrepancy(amplitude, shift=0.0, below=0.5):
    """A plate whose fit without smooth errors differs by so many sds."""
    tree = make_result(**SMALL, discrepancy=True)
    prior = _half_normal(0.12, seed=3)
    tree = _at(tree, "discrepancy_amplitude", amplitude, prior=prior, below=below)
    index = tree["posterior"]["refractive_index"]
    without = tree["without_discrepancy"].to_dataset()
    moved = without.assign(refractive_index=index + shift * index.std())
    tree["without_discrepancy"] = xr.DataTree(moved)
    return tree


@each(
    ("amplitude", "options", "levels", "words"),
    [
        # An answer that rests on smooth errors that nobody sees.
        (_half_normal(0.1), {"shift": -1.8}, ("problem",), "1.8 sd away"),
        (_half_normal(0.1), {"shift": -1.2}, ("passed", "note"), ""),
        # The fit without them is refuted by the readings, so that its answer is no witness.
        (_normal(0.15, 0.02), {"shift": 4.0}, ("passed",), ""),
        (_normal(0.6, 0.02), {"below": 1.0 - 1e-6}, ("problem",), "amplitude 0.6"),
    ],
)
def test_smooth_errors_that_are_seen_may_move_the_answer_but_not_be_large(
    amplitude, options, levels, words
):
    row = criticize(_with_discrepancy(amplitude, **options)).loc["systematic errors"]
    assert row["level"] in levels
    assert words in row["sentence"]


# --- Single readings ------------------------------------------------------------------------------


def test_a_reading_that_alone_knows_a_parameter_is_named_and_is_no_caution() -> None:
    """One view of six reaches the highlight, so to say: nobody can tell it from wrong."""
    tree = make_result(**SMALL, views=6)
    tree = replace(tree, "constant_data", "view_zenith", [10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    draws = tree["posterior"]["roughness"].to_numpy()
    score = (draws - draws.mean()) / draws.std()
    rng = np.random.default_rng(4)
    noise_free = np.zeros((*draws.shape, 6))
    noise_free[..., 3] = 0.9 * score * SCALE["dop"]
    noise = rng.normal(0.0, SCALE["dop"], noise_free.shape)
    tree = replace(tree, "noise_free", "dop", noise_free)
    tree = replace(tree, "posterior_predictive", "dop", noise_free + noise)
    tree = replace(tree, "observed_data", "dop", 0.5 * SCALE["dop"] * rng.standard_normal(6))
    assert criticize(tree).loc["influence", "level"] == "passed"
    remark = sensitivity(tree).loc["roughness", "remark"]
    assert "depends on dop at 40 degrees" in remark
    assert "depends on dop" not in sensitivity(tree).loc["absorption", "remark"]


def test_a_reading_within_its_stated_error_is_no_outlier() -> None:
    """The others scatter less than stated; one that keeps to its statement is no news."""
    tree = _changed(_outlier)
    assert criticize(tree).loc["outliers", "level"] == "problem"
    constants = tree["constant_data"].to_dataset()
    error = 0.0 * tree["observed_data"]["dop"] + 4.0 * SCALE["dop"]
    tree["constant_data"] = xr.DataTree(constants.assign(dop_error=error))
    assert criticize(tree).loc["outliers", "level"] == "passed"


# --- Other parts ----------------------------------------------------------------------------------

FILM = {"part": "nothing", "alternative": "water film", "path": "coat", "defines": []}
GGX = {"part": "Beckmann", "alternative": "GGX", "path": "surface.distribution", "defines": []}


@each(
    ("other", "name", "times", "shift", "level"),
    [
        (GGX, "refractive_index", 2.0, 9.0, "note"),
        (GGX, "refractive_index", 4.0, 2.5, "caution"),
        (GGX, "refractive_index", 4.0, 1.5, "passed"),
        (GGX, "refractive_index", 0.04, 9.0, "passed"),
        # No reading is evidence of a film: what counts is the mean over both, 2/3 * 3 sds away.
        (FILM, "refractive_index", 2.0, 3.0, "caution"),
        (FILM, "refractive_index", 2.0, 2.9, "note"),
        (FILM, "refractive_index", 0.25, 9.9, "caution"),
        (FILM, "refractive_index", 0.04, 99.0, "passed"),
        (FILM, "subsurface_fraction", 4.0, 2.5, "caution"),
        (FILM, "refractive_index", 4.0, 1.5, "note"),
        (FILM, "refractive_index", 2.0, 1.5, "passed"),
    ],
)
def test_an_undecided_part_is_a_caution_by_its_evidence_or_by_what_it_hides(
    other, name, times, shift, level
) -> None:
    row = {**other, "log_bayes_factor": float(np.log(times)), "shift": {name: [shift]}}
    found = criticize(edit_provenance(make_result(**SMALL), alternatives=[row]))
    assert found.loc["alternatives", "level"] == level
    sentence = found.loc["alternatives", "sentence"]
    moves, is_film = abs(shift) > 1.96, other is FILM and level != "passed"
    assert ("the index of a bare scene is" in sentence) == (is_film and moves)
    assert ("the answer is the same with it" in sentence) == (is_film and not moves)
