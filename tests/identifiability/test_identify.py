"""What captures determine: against a linear model in closed form, and in words."""

import numpy as np
import pytest
import xarray as xr
from numpyro import handlers
from plates import LINKS, PLATE, plate_capture
from polar_bayes.models.per_material import per_material
from textbook import plate_q

import polar_bayes as pb

ASKED = {
    "model": handlers.condition(per_material, data={"stokes_error_factor": 1.0}),
    "scene": PLATE,
    "links": LINKS,
}
VIEWS = np.array([30.0, 42.0, 55.0, 68.0, 74.0, 80.0])


@pytest.fixture(scope="module")
def plate() -> xr.Dataset:
    return pb.identify(plate_capture(VIEWS, 0.01, seed=0), **ASKED)


def test_sensitivities_are_those_of_textbook_optics(plate: xr.Dataset) -> None:
    """One parameter, all else held: root of the summed squares of slopes over the noise."""
    at = plate["value"].sel(parameter=["refractive_index", "subsurface_fraction"]).to_numpy()
    for number, name in enumerate(("refractive_index", "subsurface_fraction")):
        step = np.where(np.arange(2) == number, 1e-6, 0.0)
        low, high = (plate_q(*(at + sign * step), np.radians(VIEWS)) for sign in (-1.0, 1.0))
        slope = (high - low) / 2e-6
        row = plate.sel(parameter=name)
        expected = np.linalg.norm(slope / 0.01) * float(row["prior_sd"])
        assert float(row["sensitivity"]) == pytest.approx(expected, rel=1e-4)


def test_expected_sds_are_those_of_a_fit(plate: xr.Dataset) -> None:
    """The readings of this capture are near what they are expected to be."""
    result = pb.fit(plate_capture(VIEWS, 0.01, seed=0), method="laplace", **ASKED)
    sd = result["posterior"].to_dataset().std(("chain", "draw"))
    assert float(plate["expected_sd"].sel(parameter="refractive_index")) == pytest.approx(
        float(sd["refractive_index"]), rel=0.1
    )


def test_what_is_told_has_small_shares_of_the_prior(plate: xr.Dataset) -> None:
    assert (plate["prior_share"] > 0.0).all()
    assert (plate["prior_share"] < 0.05).all()
    assert (np.diff(plate["information"]) >= 0.0).all()
    np.testing.assert_allclose(np.diag(plate["correlation"]), 1.0)
    assert pb.identifiability_sentences(plate) == [
        "Every parameter of the material is determined by the data."
    ]


def test_without_information_the_prior_is_all_there_is() -> None:
    found = pb.identify(plate_capture(VIEWS, 50.0, seed=0), **ASKED)
    assert found["prior_share"].to_numpy() == pytest.approx(1.0, abs=0.01)
    said = pb.identifiability_sentences(found)
    assert any(line.startswith("refractive_index is not determined: ") for line in said)


def test_glass_does_not_tell_its_absorption() -> None:
    """Its body returns hardly any light: what it absorbs is nowhere in the readings."""
    capture = pb.simulate("glass", seed=0, protocol=pb.Protocol(views=20, wavelengths=()))
    said = pb.identifiability_sentences(pb.identify(capture))
    assert any(line.startswith("absorption is not determined: ") for line in said)


def test_something_else_is_refused() -> None:
    with pytest.raises(pb.FitError, match="it says nothing of identifiability"):
        pb.identifiability_table(xr.Dataset())
