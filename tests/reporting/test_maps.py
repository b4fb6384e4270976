"""Pictures of maps: every panel is there, labeled and whole."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from clipping import clipped
from synthetic_maps import make_maps

import polar_bayes as pb
from polar_bayes.inference.batching import MethodUsed, Status

NAMES = ("roughness", "subsurface_fraction", "absorption", "refractive_index")
STATUSES = (Status.GOOD, Status.MASKED, Status.TOO_FEW_VIEWS, Status.NOT_TRUSTED)


def maps(
    rows: int = 20, columns: int = 30, wavelengths: tuple[float, ...] = (), statuses=STATUSES
) -> xr.Dataset:
    """Maps of four parameters, two of them over the wavelength; the first pixel has no mean."""
    rng, shape, means = np.random.default_rng(0), (rows, columns), {}
    for name in NAMES:
        color = wavelengths if name in NAMES[2:] else ()
        means[name] = rng.uniform(0.2, 0.4, (*shape, *([len(color)] if color else [])))
        means[name][0, 0] = np.nan
    status, methods = rng.choice(statuses, shape), rng.choice(MethodUsed, shape)
    return make_maps(means, status=status, methods=methods, wavelengths=wavelengths, width=0.2)


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
    image = maps(statuses=[Status.GOOD])
    image["status"][3, 4] = -1
    panel = pb.plots.plot_maps(image).axes
    status = next(axes for axes in panel if axes.get_title("left") == "status")
    drawn = np.asarray(status.images[0].get_array())
    assert set(zip(*np.nonzero(drawn), strict=True)) == {(0, 0), (3, 4)}  # the first has no mean
    assert drawn[0, 0] == drawn[3, 4] == list(Status).index(Status.NOT_FITTED)


@pytest.mark.thorough
def test_a_large_image_is_drawn_smaller() -> None:
    figure = pb.plots.plot_maps(maps(1700, 10))
    assert max(image.get_array().shape[0] for axes in figure.axes for image in axes.images) <= 800


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(pb.FitError, match="it holds no maps"):
        pb.plots.plot_maps(xr.Dataset())
    with pytest.raises(pb.FitError, match="no wavelength 500 nm; give one of 450, 650"):
        pb.plots.plot_maps(maps(wavelengths=(450.0, 650.0)), wavelength=500.0)
