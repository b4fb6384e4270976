"""Errors of the set-up in maps: first-order responses, variances that add up, regions."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpyro import distributions as dist

import polar_bayes as pb
from polar_bayes.cli import main
from polar_bayes.inference.result import provenance_of
from polar_bayes.models.per_material import per_material
from polar_bayes.setups import SETUPS

CAMERA = SETUPS["camera"]
PERFECT = dataclasses.replace(CAMERA, known=())
MATERIAL = ("roughness", "subsurface_fraction", "refractive_index")
ONLY_LAMP = dataclasses.replace(
    CAMERA, known=tuple(each for each in CAMERA.known if each.name == "light_zenith")
)
LAPLACE = pb.methods.CorrectedLaplace(sampler=None, starts=1)


@pytest.fixture(scope="module")
def image() -> xr.Dataset:
    """Rough plastics before a camera."""
    rng = np.random.default_rng(1)
    truth = {
        "roughness": rng.uniform(0.15, 0.3, (2, 2)),
        "subsurface_fraction": rng.uniform(0.3, 0.6, (2, 2)),
        "refractive_index": rng.uniform(1.4, 1.6, (2, 2)),
    }
    protocol = pb.simulation.Protocol(views=12, wavelengths=(), largest_view_zenith=75.0)
    return pb.simulate("plastic", scene="camera", protocol=protocol, parameters=truth, seed=1)


@pytest.fixture(scope="module")
def usual(image: xr.Dataset) -> xr.Dataset:
    return pb.fit_pixels(image, scene=ONLY_LAMP, method=LAPLACE)


def test_a_slope_is_what_another_direction_of_the_lamp_does(
    image: xr.Dataset, usual: xr.Dataset
) -> None:
    """A lamp stated a tenth of a degree too low is one whose error is as much."""
    step = 0.1
    low, high = (
        pb.fit_pixels(
            image.assign(light_zenith=image["light_zenith"] + move), scene=PERFECT, method=LAPLACE
        )
        for move in (-step, step)
    )
    for name in MATERIAL:
        moved = (high[name] - low[name]) / (2.0 * step)
        slope = usual[f"{name}_slope"].sel(shared="light_zenith_offset")
        # The mean responds like the mode up to the skewness of a pixel and the error of its draws.
        np.testing.assert_allclose(slope, moved, atol=0.1 * float(usual[f"{name}_sd"].mean()))


def test_variances_add_up_and_follow_what_the_set_up_is_known_to(
    image: xr.Dataset, usual: xr.Dataset
) -> None:
    perfect = pb.fit_pixels(image, scene=PERFECT, method=LAPLACE)
    better = pb.fit_pixels(image, scene=ONLY_LAMP, method=LAPLACE, known={"light_zenith": 0.5})
    assert "perfect" not in perfect.attrs["polar_bayes"]
    assert not pb.maps.setup_sentences(perfect)
    for name in MATERIAL:
        whole, half = (
            m[f"{name}_slope"].sel(shared="light_zenith_offset") for m in (usual, better)
        )
        # To first order: draws move in unconstrained coordinates, which are curved.
        np.testing.assert_allclose(half / whole, 0.5, rtol=0.05)
        added = usual[f"{name}_sd"] ** 2 - perfect[f"{name}_sd"] ** 2
        np.testing.assert_allclose(
            added, whole**2, atol=0.1 * float(usual[f"{name}_sd"].max()) ** 2
        )
    assert "uncertainty of light_zenith (0.5)" in better.attrs["polar_bayes"]


def test_the_set_up_does_not_average_out_over_a_region(usual: xr.Dataset) -> None:
    whole = np.ones((2, 2), bool)
    found = pb.maps.region_means(usual, whole)
    for name in MATERIAL:
        slope = float(usual[f"{name}_slope"].mean())
        own = usual[f"{name}_sd"] ** 2 - usual[f"{name}_slope"].isel(shared=0) ** 2
        expected = np.sqrt(slope**2 + float(own.sum()) / 16.0)
        np.testing.assert_allclose(found[f"{name}_sd"], expected, rtol=1e-5)


def test_means_that_are_no_better_than_the_set_up_are_cautioned(usual: xr.Dataset) -> None:
    """A hundred times as many pixels, alike: noise averages out, the lamp's direction does not."""
    many = xr.concat([usual] * 100, "y")
    found = pb.maps.region_means(many.assign_attrs(usual.attrs), np.ones((200, 2), bool))
    (caution,) = (text for text in found.attrs["cautions"] if "of the set-up" in text)
    assert "most by light_zenith_offset" in caution
    assert "shared=('light_zenith_offset',)" in caution
    few = pb.maps.region_means(usual, np.eye(2, dtype=bool))
    assert not [text for text in few.attrs["cautions"] if "of the set-up" in text]
    # So small an image shares no gain of its polarizer, either.
    (caution,) = (text for text in few.attrs["cautions"] if text.startswith("Each pixel has its"))
    assert "its own dolp_gain, where one value should serve" in caution


def test_maps_tell_what_the_set_up_contributes(usual: xr.Dataset) -> None:
    shares = pb.maps.setup_shares(usual)
    assert list(shares.columns) == ["light_zenith_offset"]
    for name in MATERIAL:
        slope, sd = (usual[f"{name}{ending}"] for ending in ("_slope", "_sd"))
        np.testing.assert_allclose(shares.loc[name], (slope**2).sum() / (sd**2).sum(), rtol=1e-6)
    (sentence,) = pb.maps.setup_sentences(usual)
    assert "of roughness (most by light_zenith)" in sentence


def test_a_method_that_tells_no_mode_has_one_searched(image: xr.Dataset) -> None:
    """Its response is that of the others."""
    pixel = image.isel(y=slice(1), x=slice(1))
    nuts = pb.methods.Nuts(draws=200, warmup=200, chains=2)
    found = pb.fit_pixels(pixel, scene=ONLY_LAMP, method=nuts)
    other = pb.fit_pixels(pixel, scene=ONLY_LAMP, method=LAPLACE)
    for name in MATERIAL:
        slope, expected = (float(m[f"{name}_slope"].squeeze()) for m in (found, other))
        # Of few draws: the slope of a mean has an error of sd / sqrt(draws).
        assert abs(slope - expected) < 0.2 * float(other[f"{name}_sd"].squeeze())


def test_priors_of_the_caller_are_carried(image: xr.Dataset) -> None:
    asked = {"scene": ONLY_LAMP, "method": LAPLACE}
    stated = pb.fit_pixels(image, **asked, known={"light_zenith": 0.5})
    given = pb.fit_pixels(image, **asked, priors={"light_zenith_offset": dist.Normal(0.0, 0.5)})
    for name in MATERIAL:
        np.testing.assert_array_equal(stated[f"{name}_slope"], given[f"{name}_slope"])
    with pytest.raises(pb.FitError, match="light_zenith_offset: a map needs its mean and"):
        pb.fit_pixels(image, **asked, priors={"light_zenith_offset": dist.Cauchy(0.0, 0.5)})


def test_a_model_that_knows_no_set_up_carries_nothing(image: xr.Dataset) -> None:
    """Of a model of one's own, as in a fit."""

    def own(data, *, scene, priors, links) -> None:
        per_material(data, scene=CAMERA.scene, priors=priors, links=links)

    found = pb.fit_pixels(image, scene=ONLY_LAMP, model=own, method=LAPLACE)
    assert "shared" not in found.dims
    assert pb.maps.setup_shares(found).empty


def test_spectra_are_carried() -> None:
    """The weights of a spectrum are auxiliary: no draw of a parameter tells them."""
    colors = (450.0, 550.0, 650.0)
    protocol = pb.simulation.Protocol(views=8, wavelengths=colors, largest_view_zenith=75.0)
    pixel = pb.simulate("plastic", scene="camera", protocol=protocol, seed=1)
    image = pixel.expand_dims(y=1, x=2).transpose("y", "x", ...)
    found = pb.fit_pixels(image, scene=ONLY_LAMP, model="gp_spectral", method=LAPLACE)
    slope, sd = (found[f"refractive_index{ending}"] for ending in ("_slope", "_sd"))
    assert slope.dims == ("shared", "y", "x", "wavelength")
    assert (np.abs(slope) < sd).all()
    assert (slope != 0.0).all()


def test_the_command_takes_standard_uncertainties(
    image: xr.Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image.to_netcdf(tmp_path / "image.nc")
    asked = ["map", str(tmp_path / "image.nc"), "--out", str(tmp_path / "map.zarr")]
    assert main([*asked, "--method", "laplace", "--known", "light_zenith=0.2"]) == 0
    assert "Intervals include errors of the set-up" in capsys.readouterr().out
    maps = pb.maps.open_map(tmp_path / "map.zarr")
    assert provenance_of(maps)["carried"]["light_zenith_offset"] == 0.2
    assert main([*asked, "--method", "laplace", "--resume"]) != 0
    assert "begun with another capture or other settings" in capsys.readouterr().err
