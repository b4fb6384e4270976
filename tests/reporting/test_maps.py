"""Pictures of maps: every panel is there, labeled and whole."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from clipping import clipped

import polar_bayes as pb


def maps(rows: int = 20, columns: int = 30, wavelengths: tuple[float, ...] = ()) -> xr.Dataset:
    rng = np.random.default_rng(0)
    shape, dims = (rows, columns), ("y", "x")
    found: dict = {}
    for name in ("roughness", "subsurface_fraction", "absorption", "refractive_index"):
        own = wavelengths if name in ("absorption", "refractive_index") else ()
        mean = rng.uniform(0.2, 0.4, (*shape, *([len(own)] if own else [])))
        mean[0, 0] = np.nan
        axes = (*dims, "wavelength") if own else dims
        found[name] = (axes, mean)
        ends = np.linspace(-0.1, 0.1, 7).reshape(7, *[1] * mean.ndim)
        found[f"{name}_quantile"] = (("quantile", *axes), mean + ends)
    found["pareto_k"] = (dims, rng.uniform(0.0, 1.0, shape))
    words = {"method": "none laplace importance nuts", "status": "good masked too_few_views"}
    words["status"] += " not_converged not_trusted"
    for name, meanings in words.items():
        flags = rng.integers(0, len(meanings.split()), shape)
        found[name] = (dims, flags, {"flag_meanings": meanings})
    levels = [0.025, 0.1, 0.25, 0.5, 0.75, 0.9, 0.975]
    coords = {"quantile": levels} | ({"wavelength": list(wavelengths)} if wavelengths else {})
    return xr.Dataset(found, coords=coords)


@each("wavelengths", [(), (450.0, 650.0)])
def test_every_parameter_has_its_mean_and_its_width(wavelengths: tuple[float, ...]) -> None:
    figure = pb.plots.plot_maps(maps(wavelengths=wavelengths))
    assert clipped(figure) == []
    titles = [axes.get_title("left") for axes in figure.axes if axes.get_title("left")]
    assert sum(title == "95% width" for title in titles) == 4
    assert titles[-3:] == ["Pareto k", "method", "status"]
    assert ("absorption a, 450 nm" in titles) == bool(wavelengths)


@pytest.mark.thorough
def test_a_pixel_without_numbers_is_not_drawn_as_good() -> None:
    image = maps()
    image["status"][:] = 0
    image["status"][3, 4] = -1
    panel = pb.plots.plot_maps(image).axes
    status = next(axes for axes in panel if axes.get_title("left") == "status")
    drawn = np.asarray(status.images[0].get_array())
    assert set(zip(*np.nonzero(drawn), strict=True)) == {(0, 0), (3, 4)}  # the first has no mean
    assert drawn[0, 0] == drawn[3, 4] == 5


@pytest.mark.thorough
def test_a_large_image_is_drawn_smaller() -> None:
    figure = pb.plots.plot_maps(maps(1700, 10))
    assert max(image.get_array().shape[0] for axes in figure.axes for image in axes.images) <= 800


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(pb.FitError, match="it holds no maps"):
        pb.plots.plot_maps(xr.Dataset())
    with pytest.raises(pb.FitError, match="no wavelength 500 nm; give one of 450, 650"):
        pb.plots.plot_maps(maps(wavelengths=(450.0, 650.0)), wavelength=500.0)
