"""Parameters that all pixels of an image share: one unknown of the whole image."""

import numpy as np
import pytest
import xarray as xr
from compilations import compilations
from numpyro import handlers
from plate_images import NAMES, NOISE, VIEWS, plate_image
from plates import LINKS, ON_PLATE, PLATE
from textbook import plate_q

import polar_bayes as pb
from polar_bayes.inference.batching import Status
from polar_bayes.maps import fit_map
from polar_bayes.maps.shared import SharedParameter
from polar_bayes.models.per_material import per_material

SHARED = ("stokes_error_factor",)
FACTOR = 1.6
SIDE = 15
HALVES = np.where(np.arange(SIDE) < SIDE // 2, 0.8, 2.4) * np.ones((SIDE, 1))
"""The noise of the right half is three times that of the left one."""


def noisy(factor: float | np.ndarray, seed: int = 4) -> xr.Dataset:
    """Plates whose readings scatter by a multiple of the stated errors."""
    stated = 0.02
    image = plate_image(SIDE, SIDE, noise=factor * stated, seed=seed)
    return image.assign(q_error=xr.full_like(image["q_error"], stated))


@pytest.fixture(scope="module")
def image() -> xr.Dataset:
    return noisy(FACTOR)


@pytest.fixture(scope="module")
def maps(image: xr.Dataset) -> xr.Dataset:
    return pb.fit_pixels(image, **ON_PLATE, shared=SHARED)


def test_the_noise_of_an_image_is_one_number(image: xr.Dataset, maps: xr.Dataset) -> None:
    row = pb.maps.shared_parameters(maps).loc["stokes_error_factor"]
    sd = np.log(row["q97.5"] / row["q2.5"]) / 3.92
    # Six readings less two parameters leave four degrees of freedom in each pixel, each of which
    # has an information of two about the log of a scale.
    assert sd == pytest.approx((2.0 * 4.0 * SIDE**2) ** -0.5, rel=0.25)
    assert abs(np.log(row["q50"] / FACTOR)) < 3.5 * sd  # once in 2,000 seeds
    assert row["pixels"] > 0.95 * SIDE**2
    assert row["disagreement"] < 3.1
    assert not pb.maps.shared_cautions(maps)
    # What is shared has no map, and pixels keep theirs.
    assert not any(name.startswith("stokes_error_factor") for name in maps.data_vars)
    assert (maps["status"] == Status.GOOD).all()


@pytest.mark.thorough
def test_pixels_know_as_much_as_if_the_noise_were_given(image, maps):
    held = handlers.condition(per_material, data={"stokes_error_factor": FACTOR})
    given = pb.fit_pixels(image, model=held, **ON_PLATE)
    for name in ("refractive_index", "subsurface_fraction"):
        ratio = maps[f"{name}_sd"] / given[f"{name}_sd"]
        # The scale differs from the truth by at most 3.5 of its sds of 2.4%.
        assert float(abs(ratio.median() - 1.0)) < 0.085


def test_pixels_that_disagree_are_told() -> None:
    maps = pb.fit_pixels(noisy(HALVES), **ON_PLATE, shared=SHARED)
    (sentence,) = pb.maps.shared_cautions(maps)
    assert "stokes_error_factor is shared by all pixels, and they do not agree" in sentence


@pytest.mark.thorough
def test_it_does_not_matter_how_the_image_is_cut(image, maps, tmp_path):
    paths = tmp_path / "image.zarr", tmp_path / "map.zarr"
    image.chunk(y=4, x=8).to_zarr(paths[0], consolidated=False)
    stored = pb.maps.map_file(*paths, **ON_PLATE, shared=SHARED)
    for name in maps.data_vars:
        np.testing.assert_array_equal(stored[name], maps[name], err_msg=str(name))
    resumed = pb.maps.map_file(*paths, **ON_PLATE, shared=SHARED, resume=True)
    xr.testing.assert_identical(resumed.load(), stored.load())
    page = pb.report(stored, tmp_path / "report").read_text()
    assert "Parameters that all pixels share" in page


@pytest.mark.thorough
def test_masked_pixels_say_nothing_about_what_is_shared(image: xr.Dataset) -> None:
    holes = image.assign(q=image["q"].where((image["y"] % 2 == 0) | (image["x"] % 3 > 0)))
    maps = pb.fit_pixels(holes, **ON_PLATE, shared=SHARED)
    masked = int((maps["status"] == Status.MASKED).sum())
    assert masked == int(holes["q"].isnull().all("view").sum())
    found = pb.maps.shared_parameters(maps).loc["stokes_error_factor"]
    assert found["pixels"] <= SIDE**2 - masked


@pytest.mark.parametrize(
    ("columns", "shared", "what"),
    [
        (SIDE, "refractive_index", "shared='refractive_index': an image cannot share it"),
        (SIDE, ("stokes_eror_factor",), "give names among stokes_error_factor"),
        (1, SHARED, f"only {SIDE} pixels have an answer"),
    ],
)
def test_what_cannot_be_shared_is_refused(image, columns: int, shared: object, what: str) -> None:
    with pytest.raises(pb.FitError, match=what):
        pb.fit_pixels(image.isel(x=slice(columns)), **ON_PLATE, shared=shared)


SETUP = pb.setups.Setup(PLATE, LINKS, priors=pb.setups.SETUPS["paper"].priors, shared=SHARED)


def test_a_setup_says_what_its_images_share(image, maps, monkeypatch):
    monkeypatch.setattr(fit_map, "SHARED_PIXELS", SIDE**2)
    found = pb.fit_pixels(image, scene=SETUP)
    xr.testing.assert_equal(found, maps)
    assert not pb.maps.shared_cautions(found)


@pytest.mark.thorough
def test_pixels_keep_their_own_where_nothing_should_be_shared(tmp_path, monkeypatch):
    """In a small image, where the caller says so, and where pixels disagree, which is told."""
    image = noisy(HALVES)
    small = pb.fit_pixels(image, scene=SETUP)
    monkeypatch.setattr(fit_map, "SHARED_PIXELS", SIDE**2)
    asked = pb.fit_pixels(image, scene=SETUP, shared=())
    image.to_zarr(tmp_path / "image.zarr", consolidated=False)
    paths = tmp_path / "image.zarr", tmp_path / "map.zarr"
    disagreeing = pb.maps.map_file(*paths, scene=SETUP).load()
    for maps in (small, asked, disagreeing):
        assert pb.maps.shared_parameters(maps).empty
        for name in ("stokes_error_factor", "refractive_index_sd"):
            np.testing.assert_array_equal(maps[name], asked[name])
    assert not pb.maps.shared_cautions(small) + pb.maps.shared_cautions(asked)
    (caution,) = pb.maps.shared_cautions(disagreeing)
    assert "one value should serve the whole image, but pixels do" in caution
    again = pb.maps.map_file(*paths, scene=SETUP, resume=True)
    xr.testing.assert_identical(again.load(), disagreeing)


ANGLE = "incidence_angle_offset"


def turned(degrees: float | np.ndarray, seed: int = 4) -> xr.Dataset:
    """Plates on a stage that stands some degrees further than stated."""
    image, rng = plate_image(SIDE, SIDE, seed=seed), np.random.default_rng(seed)
    index, fraction = (image[f"true_{name}"].to_numpy()[..., None] for name in NAMES)
    true = np.radians(VIEWS + np.broadcast_to(degrees, (SIDE, SIDE))[..., None])
    noise = NOISE * rng.normal(size=image["q"].shape)
    q = np.clip(plate_q(index, fraction, true) + noise, -1.0, 1.0)
    return image.assign(q=(image["q"].dims, q))


@pytest.mark.thorough
def test_an_image_determines_what_its_set_up_shares_as_far_as_pixels_agree(monkeypatch):
    monkeypatch.setattr(fit_map, "SHARED_PIXELS", SIDE**2)
    known, shared = (pb.physics.input_quantities.IncidenceAngle(),), (*SHARED, ANGLE)
    stage = pb.setups.Setup(PLATE, LINKS, known=known, shared=shared)
    row = pb.maps.shared_parameters(pb.fit_pixels(turned(1.0), scene=stage)).loc[ANGLE]
    sd = (row["q97.5"] - row["q2.5"]) / 3.92
    assert abs(row["q50"] - 1.0) < 3.5 * sd  # once in 2,000 seeds
    assert sd < 0.2  # the prior has .5

    halves = np.where(np.arange(SIDE) < SIDE // 2, -4.0, 4.0) * np.ones((SIDE, 1))
    image = turned(halves)
    maps = pb.fit_pixels(image, scene=stage)
    (caution,) = pb.maps.shared_cautions(maps)
    assert f"{ANGLE}: one value should serve the whole image, but pixels do not agree" in caution
    assert "intervals contain its standard uncertainty instead" in caution
    xr.testing.assert_equal(maps, pb.fit_pixels(image, scene=stage, shared=SHARED))
    assert maps["shared"].to_numpy().tolist() == [*SHARED, ANGLE]


def test_a_draw_at_the_end_of_its_support_has_a_score() -> None:
    """In single precision, a gain within 3e-8 of 1 is 1, where its coordinate is infinite."""
    gain, prior = SharedParameter("dolp_gain", 2.0, 0.5), pb.PRIORS["dolp_gain"]
    draws = np.float32([0.0, 1e-6, 0.5, 1.0 - 1e-6, 1.0])
    scores = gain.scores(prior, {"dolp_gain": draws})
    assert np.isfinite(scores).all()
    assert (np.diff(scores) > 0.0).all()


def test_another_number_of_draws_compiles_nothing() -> None:
    # Some pixels have as many draws as they need, and a block may have no pixel with any.
    gain, prior = SharedParameter("dolp_gain", 2.0, 0.5), pb.PRIORS["dolp_gain"]
    draws = np.random.default_rng(0).uniform(0.5, 0.99, 2000)
    whole = gain.scores(prior, {"dolp_gain": draws})
    with compilations() as compiled:
        for count in (1999, 1500, 1025, 0):
            part = gain.scores(prior, {"dolp_gain": draws[:count].reshape(1, count)})
            np.testing.assert_allclose(part[0], whole[:count], rtol=1e-12)
    assert not compiled
