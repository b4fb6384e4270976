"""Means and contrasts of regions, with what all pixels share counted once."""

import json
from pathlib import Path

import numpy as np
import numpyro
import pytest
import xarray as xr
from numpyro import distributions as dist
from numpyro import handlers
from PIL import Image
from plate_images import ASKED, plate_image
from synthetic_maps import make_maps

import polar_bayes as pb
from polar_bayes.cli import main
from polar_bayes.inference.batching import Status

SIDE, NOISE, SPREAD, ZERO = 16, 0.05, 0.1, 0.07
PRIORS = {"dark_level": dist.Normal(0.0, 0.3)}


def above_zero(data, scene, priors, links) -> None:
    """Readings of a level in each pixel, above a zero that all pixels share."""
    del scene, links
    level = numpyro.sample("level", dist.Normal(0.0, SPREAD))
    slope = numpyro.sample("slope", dist.Normal(0.0, 1.0))
    zero = numpyro.sample("dark_level", priors["dark_level"])
    with numpyro.plate("view", data.shape[-1]):
        mean = level + zero + slope * np.linspace(-1.0, 1.0, data.shape[-1])
        numpyro.sample("q", dist.Normal(mean, NOISE), obs=data.readings["q"])


def readings(level: np.ndarray, seed: int) -> xr.Dataset:
    """An image whose pixels have these levels."""
    image = plate_image(SIDE, SIDE, seed=seed)
    noise = NOISE * np.random.default_rng(seed).normal(size=image["q"].shape)
    return image.assign(q=(image["q"].dims, level[..., None] + ZERO + noise))


@pytest.fixture(scope="module")
def image() -> xr.Dataset:
    return readings(np.random.default_rng(1).normal(0.0, SPREAD, (SIDE, SIDE)), seed=2)


@pytest.fixture(scope="module")
def maps(image: xr.Dataset) -> xr.Dataset:
    asked = ASKED | {"model": above_zero, "priors": PRIORS}
    return pb.fit_pixels(image, shared="dark_level", **asked)


def quarters() -> np.ndarray:
    """Four regions, and a pixel in none of them."""
    labels = 1 + 2 * (np.arange(SIDE)[:, None] // (SIDE // 2)) + np.arange(SIDE) // (SIDE // 2)
    labels[0, 0] = 0
    return labels


def of_levels(image: xr.Dataset, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean and own variance of each region's levels given no zero; variance by the zero."""
    level = image["q"].mean("view").to_numpy()
    noise = NOISE**2 / image.sizes["view"]
    shrinkage = SPREAD**2 / (SPREAD**2 + noise)
    precision = level.size / (SPREAD**2 + noise) + 0.3**-2
    zero = level.sum() / (SPREAD**2 + noise) / precision
    mean = np.array([shrinkage * (level[labels == k].mean() - zero) for k in range(1, 5)])
    pixels = np.array([(labels == k).sum() for k in range(1, 5)])
    return mean, shrinkage * noise / pixels, shrinkage**2 / precision


def test_a_region_counts_what_is_shared_once(image: xr.Dataset, maps: xr.Dataset) -> None:
    labels = quarters()
    found = pb.maps.region_means(maps, labels)
    mean, own, common = of_levels(image, labels)
    assert found["region"].values.tolist() == [1, 2, 3, 4]
    assert found["pixels"].values.tolist() == [63, 64, 64, 64]
    sd = np.sqrt(own + common)
    # The spread of the slopes of 256 pixels is known to 4.4% (one sd), and to 3.5 times that but
    # once in 2,000 seeds. Their Monte Carlo errors move the zero by a third of its sd.
    np.testing.assert_allclose(found["level_sd"], sd, rtol=0.155)
    assert (abs(found["level"] - mean) < 3.5 / 3.0 * sd).all()
    low, high = found["level_interval"]
    np.testing.assert_allclose(high - low, 2.0 * 1.96 * found["level_sd"], rtol=1e-4)
    assert not found.attrs["cautions"]


def test_in_a_contrast_what_is_shared_cancels(image: xr.Dataset, maps: xr.Dataset) -> None:
    labels = quarters()
    found = pb.maps.region_means(maps, xr.DataArray(labels.T, dims=("x", "y")), against=4)
    mean, own, _ = of_levels(image, labels)
    assert found["region"].values.tolist() == [1, 2, 3]
    sd = np.sqrt(own[:3] + own[3])
    np.testing.assert_allclose(found["level_sd"], sd, rtol=0.05)
    # Means of 256 points in each of 64 pixels are known to a fraction of an sd of one pixel.
    assert (abs(found["level"] - (mean[:3] - mean[3])) < 0.1 * sd).all()


def test_pixels_that_are_alike_are_told() -> None:
    """Priors pull all of them the same way, which the mean of many shows."""
    alike = readings(np.full((SIDE, SIDE), 0.2), seed=3)
    held = handlers.condition(above_zero, data={"dark_level": ZERO})
    maps = pb.fit_pixels(alike, **ASKED | {"model": held})
    found = pb.maps.region_means(maps, np.full((SIDE, SIDE), "leaf"))
    noise = NOISE**2 / alike.sizes["view"]
    level = float(alike["q"].mean()) - ZERO
    pull = -noise / (SPREAD**2 + noise) * level
    # The squared sd of a pixel is known to some percent from 256 points.
    np.testing.assert_allclose(found["level_prior_pull"], pull, rtol=0.05)
    assert float(found["level_interval"][1, 0]) < 0.2
    (sentence,) = found.attrs["cautions"]
    assert sentence.startswith("level of region leaf: if its pixels are alike, their priors move")
    # A common error moves pixels, but not by how far their priors pull.
    error = maps["level_sd"].mean().item() * xr.ones_like(maps["level"]).expand_dims(shared=1)
    wider = np.hypot(maps["level_sd"], error[0])
    moved = maps.assign(level_sd=wider, level_slope=error).assign_attrs(maps.attrs)
    moved = pb.maps.region_means(moved, np.full((SIDE, SIDE), "leaf"))
    np.testing.assert_allclose(moved["level_prior_pull"], found["level_prior_pull"], rtol=1e-5)


def test_regions_of_a_store_and_pixels_without_an_answer(maps: xr.Dataset, tmp_path: Path) -> None:
    lost = maps.assign(status=maps["status"].where(maps["y"] > 0, Status.NOT_TRUSTED))
    lost.to_zarr(tmp_path / "map.zarr", consolidated=False)
    found = pb.maps.region_means(pb.maps.open_map(tmp_path / "map.zarr"), quarters() > 2)
    assert found["region"].values.tolist() == [True]
    assert found["pixels"].item() == 8 * SIDE
    whole = pb.maps.region_means(lost, quarters() < 3)
    assert (whole["pixels"].item(), whole["unanswered"].item()) == (7 * SIDE, SIDE)


def test_labels_that_do_not_fit_are_refused(maps, image, tmp_path):
    for labels, against, what in (
        (np.ones((SIDE, 3), int), None, "they are int64 of shape"),
        (np.ones((SIDE, SIDE)), None, "they are float64"),
        (np.zeros((SIDE, SIDE), bool), None, "no pixel is in a region"),
        (np.ones((SIDE, SIDE), int), 7, "no region has the label 7; give one of 1"),
    ):
        with pytest.raises(pb.FitError, match=what):
            pb.maps.region_means(maps, labels, against=against)
    with pytest.raises(pb.FitError, match="it holds no maps"):
        pb.maps.region_means(image, np.ones((SIDE, SIDE), bool))
    picture, array = tmp_path / "labels.tiff", tmp_path / "labels.npy"
    for file, make, what in (
        (picture, lambda: Image.new("RGB", (4, 3)).save(picture), "not gray values"),
        (picture, lambda: Image.new("F", (4, 3)).save(picture), "and type float32"),
        (picture, lambda: picture.write_text("no picture"), "cannot be read"),
        (array, lambda: np.save(array, np.ones((3, 4))), "and type float64"),
    ):
        make()
        with pytest.raises(pb.CaptureError, match=what):
            pb.maps.load_labels(file)


def test_the_command_reads_labels_from_a_picture(maps, tmp_path, capsys):
    store, picture = tmp_path / "map.zarr", tmp_path / "labels.png"
    maps.to_zarr(store, consolidated=False)
    Image.fromarray(np.uint8(quarters())).save(picture)
    np.testing.assert_array_equal(pb.maps.load_labels(picture), quarters())
    words = ["regions", str(store), str(picture), "--against", "4"]
    assert main([*words, "--json"]) == 0
    found = pb.maps.region_means(maps, quarters(), against=4)
    rows = json.loads(capsys.readouterr().out)["regions"]
    row, *_ = (row for row in rows if row["parameter"] == "level")
    assert (row["region"], row["pixels"]) == (1, 63)
    assert row["mean"] == pytest.approx(float(found["level"][0]), rel=1e-6)
    assert [row["q2.5"], row["q97.5"]] == pytest.approx(found["level_interval"][:, 0], rel=1e-6)
    assert main(words) == 0
    assert "level" in capsys.readouterr().out


def test_a_parameter_of_several_values_has_a_row_for_each() -> None:
    found = make_maps({"absorption": np.ones((3, 4, 2))}, wavelengths=(450.0, 550.0))
    table = pb.maps.region_table(pb.maps.region_means(found, np.ones((3, 4), int)))
    assert table["parameter"].tolist() == ["absorption[450.0]", "absorption[550.0]"]
    assert table["pixels"].tolist() == [12, 12]


def test_pixels_that_say_nothing_are_told(maps: xr.Dataset) -> None:
    """Their mean is that of as many priors, and looks certain."""
    ignorant = maps.assign(level=0.0 * maps["level"], level_sd=0.0 * maps["level_sd"] + SPREAD)
    ignorant["level"].attrs |= maps["level"].attrs
    ignorant["level_slope"] = 0.0 * maps["level_slope"]
    found = pb.maps.region_means(ignorant, quarters() == 1)
    assert found["level_sd"].item() == pytest.approx(SPREAD / np.sqrt(63), rel=1e-6)
    (sentence,) = found.attrs["cautions"]
    assert "level of region True: its pixels are as wide as their priors, whose pull" in sentence
    assert np.isnan(found["level_prior_pull"].item())
    # Without a known prior nothing is said of its pull.
    unknown = maps.copy()
    for key in ("prior_mean", "prior_sd"):
        del unknown["level"].attrs[key]
    found = pb.maps.region_means(unknown, quarters())
    assert np.isnan(found["level_prior_pull"]).all()
    assert not [told for told in found.attrs["cautions"] if told.startswith("level ")]
