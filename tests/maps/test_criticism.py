"""What would be a problem in a fit is no good pixel of a map: priors, noise, residuals, bounds."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from cases import each
from numpyro import distributions as dist
from numpyro.distributions import transforms
from plate_images import ASKED, mapped, planned, plate_image
from scipy import stats
from textbook import plate_q

import polar_bayes as pb
from polar_bayes.inference.batching import Status
from polar_bayes.maps.criticism import Criticism
from polar_bayes.maps.residuals import direction_kernels, residual_tail, standardize
from polar_bayes.observation.distributions import MeanConcentrationBeta, SensorStudentT
from polar_bayes.physics.geometry import Geometry
from polar_bayes.reporting.report import render

METHOD = pb.methods.CorrectedLaplace(sampler=None)
KNOWN = {**ASKED, "method": METHOD}
FITS = {"known": KNOWN, "inferred": {**KNOWN, "model": "per_material"}}
"""Whether stated errors are used unchanged, or pixels infer a factor on them."""

VIEWS = np.concatenate([np.linspace(20.0, 45.0, 9), np.linspace(64.0, 80.0, 9)])
ERROR = 0.01
MOST_FALSE = 1e-3
"""Probability with which a right program fails a test of a rate."""

KINDS = {
    "right": {},
    "errors ten times too small": {"error": 10.0 * ERROR},
    "errors fifty times too small": {"error": 50.0 * ERROR},
    "an index of 3": {"index": 3.0},
    "a smooth error": {"smooth": 0.06},
    "bare": {"fraction": 0.0},
    "bare, errors ten times too large": {"fraction": 0.0, "error": 0.1 * ERROR},
    "errors ten times too large": {"error": 0.1 * ERROR},
}
PIXELS = 25


def kinds_image() -> xr.Dataset:
    """A row of pixels of each kind, all with the same stated errors."""
    rng = np.random.default_rng(0)
    zenith = np.radians(VIEWS)
    rows = []
    for kind in KINDS.values():
        made = {"index": 1.5, "fraction": 0.3, "error": ERROR, "smooth": 0.0} | kind
        q = plate_q(np.array(made["index"]), np.array(made["fraction"]), zenith)
        q = q + made["smooth"] * np.sin(5.0 * zenith)
        rows.append(q + made["error"] * rng.normal(size=(PIXELS, VIEWS.size)))
    image = plate_image(len(KINDS), PIXELS, noise=ERROR, views=VIEWS)
    image = image.drop_vars([name for name in image if str(name).startswith("true_")])
    return image.assign(q=(("y", "x", "view"), np.clip(rows, -1.0, 1.0)))


def row_of(errors: str, kind: str) -> tuple[xr.Dataset, np.ndarray]:
    """The pixels of a kind, and the flags of those that are contradicted."""
    row = mapped_kinds(errors).isel(y=list(KINDS).index(kind))
    return row, row["criticism"].values[row["status"].values == Status.CONTRADICTED]


@functools.cache
def mapped_kinds(errors: str) -> xr.Dataset:
    return pb.fit_pixels(kinds_image(), **FITS[errors])


@pytest.fixture
def known() -> xr.Dataset:
    return mapped_kinds("known")


# --- Wrong pixels ---------------------------------------------------------------------------------


@each(
    ("errors", "kind", "check", "share"),
    [
        ("known", "errors ten times too small", Criticism.RESIDUALS_PROBLEM, 1.0),
        ("known", "an index of 3", Criticism.PRIORS_PROBLEM, 1.0),
        ("known", "an index of 3", Criticism.BOUNDS_CAUTION, 1.0),
        ("known", "a smooth error", Criticism.RESIDUALS_PROBLEM, 1.0),
        ("inferred", "errors fifty times too small", Criticism.NOISE_PROBLEM, 0.9),
        ("inferred", "an index of 3", Criticism.PRIORS_PROBLEM, 0.9),
        ("inferred", "a smooth error", Criticism.RESIDUALS_PROBLEM, 0.9),
    ],
    quick=4,
)
def test_a_wrong_pixel_is_contradicted(errors, kind, check, share):
    _, flags = row_of(errors, kind)
    assert np.sum(flags & check != 0) >= share * PIXELS


@pytest.mark.thorough
def test_errors_ten_times_too_small_are_named_where_their_prior_does_not_allow_it() -> None:
    row, _ = row_of("inferred", "errors ten times too small")
    factor = row["stokes_error_factor_quantile"].sel(quantile=0.5)
    is_flagged = row["criticism"] & (Criticism.NOISE_CAUTION | Criticism.NOISE_PROBLEM) != 0
    assert is_flagged.any()
    assert (is_flagged == (factor > float(pb.PRIORS["stokes_error_factor"].icdf(0.98)))).all()


# --- Right ones, and perfect ones -----------------------------------------------------------------


FINE = [kind for kind in KINDS if "bare" in kind or "large" in kind or kind == "right"]


@each("errors", FITS, quick=1)
@each("kind", FINE)
def test_what_is_right_bare_or_better_than_stated_is_good(errors: str, kind: str) -> None:
    """Truths are chosen, so that only residuals can be wrong by chance: in one pixel of 250."""
    _, flags = row_of(errors, kind)
    assert flags.size <= stats.binom.ppf(1.0 - MOST_FALSE, PIXELS, 0.004)
    assert (flags & (Criticism.PRIORS_PROBLEM | Criticism.NOISE_PROBLEM) == 0).all()


def image_of_known_errors() -> xr.Dataset:
    noise = np.exp(np.random.default_rng(6).uniform(np.log(0.005), np.log(0.03), (25, 25)))
    return plate_image(25, 25, noise=noise, views=VIEWS)


def image_of_inferred_errors() -> xr.Dataset:
    factor = np.exp(np.log(1.5) + 0.7 * np.random.default_rng(6).normal(size=(40, 40)))
    image = plate_image(40, 40, noise=ERROR * factor, views=VIEWS, seed=8)
    return image.assign(q_error=xr.full_like(image["q_error"], ERROR))


@pytest.mark.thorough
@each(
    ("errors", "make"), [("known", image_of_known_errors), ("inferred", image_of_inferred_errors)]
)
def test_few_of_the_pixels_that_are_drawn_from_the_priors_are_contradicted(errors, make) -> None:
    maps = pb.fit_pixels(make(), **FITS[errors])
    counts, table = pb.maps.count_pixels(maps), pb.maps.count_criticism(maps)
    answered = counts["good"] + counts["contradicted"]
    assert answered > 0.95 * maps["status"].size
    assert counts["contradicted"] <= stats.binom.ppf(1.0 - MOST_FALSE, answered, 3 * 0.004)
    for check in ("priors", "noise", "residuals"):
        most = stats.binom.ppf(1.0 - MOST_FALSE, answered, 0.004)
        assert table.loc[check, "problem"] <= most, check
    assert table.loc["any", "not computed"] == 0


def linear(views, groups, size, missing=0.0, count=20_000):
    """Pixels whose readings are smooth in the parameters, fitted where these are near zero."""
    rng = np.random.default_rng(1)
    x = np.linspace(-1.0, 1.0, views.size)
    design = np.polynomial.chebyshev.chebval(x, rng.normal(size=(4, groups, size)))
    design = np.moveaxis(np.asarray(design), -1, 1)
    e = rng.normal(size=(count, groups, views.size))
    e += np.einsum("gvk,pk->pgv", design, rng.normal(size=(count, size)))
    e[rng.random(e.shape) < missing] = np.nan
    geometry = Geometry(views, np.full(views.size, 180.0), views, np.zeros(views.size))
    return e, np.broadcast_to(design, (count, *design.shape)), direction_kernels(geometry)


@each(
    ("views", "groups", "size", "missing"),
    [(6, 1, 2, 0.0), (6, 1, 4, 0.0), (18, 1, 2, 0.3), (12, 3, 5, 0.1)],
)
def test_residuals_of_noise_alone_are_a_problem_once_in_250(views, groups, size, missing):
    scores, changes, kernels = linear(np.linspace(20.0, 80.0, views), groups, size, missing)
    p_value = residual_tail(scores, changes, kernels, np.ones(len(scores)))
    p_value = p_value[np.isfinite(p_value)]
    assert p_value.size > 0.9 * len(scores)
    for level in (0.02, 0.004):
        most = stats.binom.ppf(1.0 - MOST_FALSE, p_value.size, level)
        assert 0 < np.sum(p_value < level) <= most


def test_fewer_than_six_readings_are_not_judged() -> None:
    pixels = linear(np.linspace(20.0, 80.0, 5), 1, 2, count=10)
    assert np.isnan(residual_tail(*pixels, np.ones(10))).all()


NOISES = {
    "normal": dist.Normal(1.0, 0.2),
    "student": dist.StudentT(4.0, 1.0, 0.2),
    "beta": MeanConcentrationBeta(jnp.array(0.03), jnp.array(60.0)),
    "logit": dist.TransformedDistribution(dist.Normal(-1.0, 0.5), transforms.SigmoidTransform()),
    "sensor": SensorStudentT(5.0, 0.6, 0.2, jnp.array(False), jnp.array(1.0)),
}


@each("name", NOISES)
def test_normal_scores_of_readings_are_normal(name: str) -> None:
    with jax.enable_x64(True):
        value = jax.jit(lambda key: NOISES[name].sample(key, (5000,)))(jax.random.key(3))
        value = value[value < 1.0] if name == "sensor" else value
        noise = dist.MaskedDistribution(NOISES[name].expand(value.shape), jnp.array(True))
        found = standardize(noise, value)
    assert found is not None
    scores = found.standard.scores()
    scores = scores[np.isfinite(scores)]
    assert scores.size > 4500
    assert stats.kstest(scores, "norm").pvalue > MOST_FALSE


def test_noise_of_a_kind_that_is_not_known_is_not_judged() -> None:
    assert standardize(dist.Laplace(0.0, 1.0), jnp.zeros(3)) is None


# --- How a map tells it ---------------------------------------------------------------------------


def test_a_map_counts_what_the_checks_found(known: xr.Dataset) -> None:
    counts, table = pb.maps.count_pixels(known), pb.maps.count_criticism(known)
    assert list(table.index) == ["priors", "noise", "residuals", "bounds", "any"]
    assert table.loc["any", "problem"] == counts["contradicted"] > 0
    assert table.loc["priors", "problem"] >= PIXELS
    sentence = pb.maps.criticism_sentences(known)[0]
    assert sentence.startswith(
        f"{counts['contradicted']} pixels are contradicted by their readings"
    )
    assert f"{table.loc['priors', 'problem']} by priors" in sentence
    verdict = pb.verdict(known)
    assert not verdict.passed
    assert sentence in verdict.cautions
    assert sentence in " ".join(str(pb.show(known)).split())
    page = render(known)
    assert sentence in page
    assert "correlated errors of neighboring views" in page


def test_an_older_map_was_not_checked(known: xr.Dataset) -> None:
    older = known.drop_vars("criticism")
    assert pb.maps.count_criticism(older).empty
    assert pb.maps.criticism_sentences(older) == []
    assert "correlated errors of neighboring views" not in render(older)


def test_a_contradicted_pixel_counts_in_no_region(known: xr.Dataset) -> None:
    rows = known.isel(y=[0, 1])
    found = pb.maps.region_means(rows, np.ones((2, PIXELS), int))
    assert found["pixels"].item() == int((rows["status"] == Status.GOOD).sum()) < 2 * PIXELS


@pytest.mark.thorough
def test_a_method_without_modes_says_that_residuals_were_not_checked() -> None:
    image = kinds_image().isel(y=[0], x=slice(2))
    maps = pb.fit_pixels(image, **{**KNOWN, "method": pb.methods.Nuts()})
    assert (maps["criticism"] & Criticism.RESIDUALS_NOT_COMPUTED != 0).all()
    assert pb.maps.count_criticism(maps).loc["residuals", "not computed"] == 2
    assert "The residuals of 2 pixels were not checked" in pb.maps.criticism_sentences(maps)[-1]


@pytest.mark.thorough  # `test_blocks.py` compares every variable of maps that are cut otherwise
def test_blocks_chunks_and_stores_give_the_same_flags(known: xr.Dataset, tmp_path: Path) -> None:
    image = kinds_image()
    image.to_zarr(tmp_path / "image.zarr", consolidated=False)
    others = (
        mapped(image, planned(image, METHOD), block=30),
        pb.fit_pixels(image.chunk(y=3, x=10), **KNOWN).compute(),
        pb.maps.map_file(tmp_path / "image.zarr", tmp_path / "map.zarr", **KNOWN),
    )
    for other in others:
        for name in ("criticism", "status"):
            np.testing.assert_array_equal(other[name], known[name])
    assert pb.maps.criticism_sentences(others[-1]) == pb.maps.criticism_sentences(known)


def test_a_lost_chunk_of_flags_is_not_taken_for_good(known: xr.Dataset) -> None:
    lost = known.copy(deep=True)
    lost["criticism"][0] = -1
    assert pb.maps.count_pixels(lost)["not fitted"] == PIXELS
