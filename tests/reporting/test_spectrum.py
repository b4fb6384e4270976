"""Optical constants over wavelength: bands where colors are tied, intervals where they are not."""

import numpy as np
import pytest
import xarray as xr
from cases import each
from clipping import clipped
from synthetic_results import edit_provenance, make_result, replace, with_law

from polar_bayes.diagnostics.view import view_of
from polar_bayes.errors import FitError
from polar_bayes.reporting import plots_curves as module
from polar_bayes.reporting.plots_curves import LEVELS, plot_spectrum, spectra
from polar_bayes.reporting.report import render

pytestmark = pytest.mark.usefixtures("unpainted")

SMALL = {"views": 6, "draws": 60, "variables": ("dop",)}


def test_intervals_where_nothing_ties_the_colors() -> None:
    result = make_result(**SMALL)
    found = spectra(result)
    assert set(found) == {"absorption", "refractive_index"}
    (index,) = found["refractive_index"]
    draws = result["posterior"]["refractive_index"].to_numpy().reshape(-1, 3)
    assert index.levels == pytest.approx(np.quantile(draws, LEVELS, axis=0))
    assert not index.is_band
    true = result["constant_data"]["true_refractive_index"].to_numpy()
    assert index.true == pytest.approx(true)
    figure = plot_spectrum(result, "refractive_index")
    assert clipped(figure) == []


def test_a_law_of_dispersion_has_bands_between_and_beyond_the_colors() -> None:
    result = with_law()
    found = spectra(result)
    (index,) = found["refractive_index"]
    assert index.at.min() == pytest.approx(440.0)
    assert index.at.max() == pytest.approx(660.0)
    at = np.searchsorted(index.at, [450.0, 550.0, 650.0])
    draws = result["posterior"]["refractive_index"].to_numpy().reshape(-1, 3)
    assert index.levels[:, at] == pytest.approx(np.quantile(draws, LEVELS, axis=0))
    assert not found["absorption"][0].is_band
    for name in found:
        assert clipped(plot_spectrum(result, name)) == []


@pytest.mark.thorough
@each("scene", ["Scene(dispersion=<function law at 0x7f>)", "Scene(dispersion=Mine(a=1))"])
def test_a_law_that_cannot_be_read_leaves_intervals(scene: str) -> None:
    assert not spectra(edit_provenance(with_law(), scene_parts=scene))["refractive_index"][
        0
    ].is_band


def test_a_process_is_drawn_from_its_prediction(monkeypatch) -> None:
    """Of many draws and members only some are asked for; what comes back is what is drawn."""
    result = make_result(**{**SMALL, "draws": 600}, materials=tuple("abcdefghijklmn"))
    asked = {}

    def predict(tree, wavelengths):
        asked["draws"] = tree["posterior"].sizes["draw"] * tree["posterior"].sizes["chain"]
        posterior = tree["posterior"]["absorption"]
        return xr.Dataset(
            {
                "absorption": posterior.interp(
                    wavelength=wavelengths, kwargs={"fill_value": "extrapolate"}
                )
            }
        )

    monkeypatch.setattr(module, "predict_spectrum", predict)
    fit = view_of(edit_provenance(result, scene_parts=""))
    found = spectra(fit)
    assert asked["draws"] == 1200
    assert len(found["absorption"]) == module.MAX_MEMBERS
    assert found["absorption"][3].at.size > module.FINE
    assert found["absorption"][3].title == "material d"
    assert not found["refractive_index"][0].is_band
    figure = plot_spectrum(fit, "absorption")
    assert clipped(figure) == []
    assert len(figure.axes) == module.MAX_MEMBERS
    assert figure.get_supxlabel() == "wavelength [nm] (the first 12 of 14)"
    assert len({axes.get_ylim() for axes in figure.axes}) == 1


@pytest.mark.thorough
def test_a_fit_that_cannot_be_predicted_has_intervals(monkeypatch) -> None:
    def predict(tree, wavelengths):
        raise FitError("the fit's kernel has no name", where="x", hint="y")

    monkeypatch.setattr(module, "predict_spectrum", predict)
    assert not spectra(make_result(**SMALL))["absorption"][0].is_band


@pytest.mark.thorough
@each(
    "settings",
    [{"wavelengths": ()}, {"wavelengths": (550.0,)}, {"method": "point"}],
    ids=["no wavelength", "one wavelength", "point fit"],
)
def test_no_spectrum_where_there_is_none(settings) -> None:
    result = make_result(**{**SMALL, **settings})
    assert spectra(result) == {}
    text = render(result)
    assert 'id="spectrum"' not in text
    assert 'href="#spectrum"' not in text
    with pytest.raises(FitError, match="choose one of none"):
        plot_spectrum(result, "absorption")


@pytest.mark.thorough
def test_draws_that_are_not_finite_are_not_drawn() -> None:
    result = make_result(**SMALL)
    draws = result["posterior"]["absorption"].to_numpy().copy()
    draws[0, 0, 1] = np.nan
    assert set(spectra(replace(result, "posterior", "absorption", draws))) == {"refractive_index"}
