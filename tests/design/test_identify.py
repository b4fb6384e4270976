"""What captures determine: against a linear model in closed form, and in words."""

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from plates import KNOWN, at_mirror, plate_capture
from scipy.special import polygamma
from textbook import plate_q

import polar_bayes as pb
from polar_bayes.design.fisher import positive_definite

VIEWS = np.array([30.0, 42.0, 55.0, 68.0, 74.0, 80.0])
pytestmark = pytest.mark.usefixtures("without_comparisons")


@pytest.fixture(scope="module")
def plate() -> xr.Dataset:
    return pb.identify(plate_capture(VIEWS, 0.01, seed=0), **KNOWN)


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
    result = pb.fit(plate_capture(VIEWS, 0.01, seed=0), method="laplace", **KNOWN)
    sd = result["posterior"].to_dataset().std(("chain", "draw"))
    assert float(plate["expected_sd"].sel(parameter="refractive_index")) == pytest.approx(
        float(sd["refractive_index"]), rel=0.1
    )


@pytest.mark.thorough
def test_what_is_told_has_small_shares_of_the_prior(plate: xr.Dataset) -> None:
    assert (plate["prior_share"] > 0.0).all()
    assert (plate["prior_share"] < 0.05).all()
    assert (np.diff(plate["information"]) >= 0.0).all()
    np.testing.assert_allclose(np.diag(plate["correlation"]), 1.0)
    assert list(pb.verdict(plate).sentences) == [
        "Every parameter of the material is determined by the data."
    ]


def test_without_information_the_prior_is_all_there_is() -> None:
    found = pb.identify(plate_capture(VIEWS, 50.0, seed=0), **KNOWN)
    assert found["prior_share"].to_numpy() == pytest.approx(1.0, abs=0.01)
    said = pb.verdict(found).sentences
    assert any(line.startswith("refractive_index is not determined: ") for line in said)


POLISHED = pb.Scene(pb.SmoothSurface(), pb.Depolarizer(), pb.DopMixing())
ANGLES = np.linspace(10.0, 80.0, 12)
GLASS = {
    "roughness": 0.03,
    "subsurface_fraction": 0.05,
    "absorption": 0.2,
    "refractive_index": 1.519,
}


def geometry() -> pb.Geometry:
    angles = (ANGLES, np.full(12, 180.0), ANGLES, np.zeros(12))
    return pb.Geometry(*map(jnp.asarray, angles))


@pytest.fixture(scope="module")
def glass() -> xr.Dataset:
    """A polished pane with errors of one percent."""
    told = POLISHED.predict(GLASS, geometry())
    noise = 0.01 * np.random.default_rng(0).normal(size=(2, 12))
    readings = {
        name: np.clip(np.asarray(told[name]) + error, -0.999, 0.999)
        for name, error in zip(("dop", "q"), noise, strict=True)
    }
    return at_mirror(ANGLES, **readings, q_error=np.full(12, 0.01)).assign_attrs(name="glass")


@pytest.fixture(scope="module")
def of_glass(glass: xr.Dataset) -> xr.Dataset:
    return pb.identify(glass, scene=POLISHED, links={"dop": pb.links.BetaLink()})


@pytest.mark.thorough
def test_glass_does_not_tell_its_absorption(glass: xr.Dataset, of_glass: xr.Dataset) -> None:
    said = pb.verdict(of_glass).sentences
    assert any(line.startswith("absorption is not determined: ") for line in said)
    asked = KNOWN | {"scene": POLISHED, "points": 5}
    flat = pb.verdict(pb.profile(glass, "absorption", **asked)).sentences
    assert flat[0].startswith("absorption is flat: the data exclude nothing below, down to 0.0")


@pytest.mark.thorough
def test_the_papers_sum_is_that_of_slopes_and_concentrations(glass, of_glass):
    """By differences, from the schedule as the paper prints it."""
    value = of_glass["value"]
    at = {name: float(value.sel(parameter=name)) for name in POLISHED.parameters}

    def dop(name: str, step: float) -> np.ndarray:
        return np.asarray(POLISHED.predict({**at, name: at[name] + step}, geometry())["dop"])

    scale = float(value.sel(parameter="concentration_scale"))
    concentration = 5.0 + scale * np.cos(np.radians(ANGLES))
    for name in POLISHED.parameters:
        slope = (dop(name, 1e-5) - dop(name, -1e-5)) / 2e-5
        mean = dop(name, 0.0)
        row = of_glass.sel(parameter=name)
        assert float(row["paper_information"]) == pytest.approx(
            np.sum(concentration * slope**2), rel=1e-3
        )
        each = sum(polygamma(1, part * concentration) for part in (mean, 1.0 - mean))
        assert float(row["exact_information"]) == pytest.approx(
            np.sum(concentration**2 * each * slope**2), rel=1e-3
        )
        assert row["exact_information"] >= 4.0 * row["paper_information"]
        assert row["paper_sd"] >= row["expected_sd"] * 0.99


@pytest.mark.thorough
def test_without_beta_noise_the_paper_says_nothing(plate: xr.Dataset) -> None:
    for name in ("paper_information", "exact_information", "paper_sd"):
        assert np.isnan(plate[name]).all()


@pytest.mark.thorough
def test_the_weakest_direction_is_said_where_its_parts_would_be_seen() -> None:
    """Only the difference of two parameters is read: their sum is the weakest direction."""
    weight = np.array([[0.7, 0.7], [0.7, -0.7]])
    found = xr.Dataset(
        {
            "prior_share": ("parameter", [0.5, 0.5]),
            "prior_sd": ("parameter", [0.1, 0.1]),
            "expected_sd": ("parameter", [0.07, 0.07]),
            "correlation": (("parameter", "other"), np.eye(2)),
            "information": ("direction", [1e-4, 900.0]),
            "weight": (("direction", "parameter"), weight),
            "movement": (("direction", "parameter"), 30.0 * np.abs(weight)),
        },
        coords={
            "parameter": ["roughness", "absorption"],
            "name": ("parameter", ["roughness", "absorption"]),
        },
    )
    said = pb.verdict(found).sentences
    assert said[2] == (
        "The weakest direction moves roughness by +0.7, absorption by +0.7 prior sds together: "
        "the readings move by 0.01 sds of their noise, though roughness alone would move them "
        "by 21."
    )
    found["information"][0] = 4.0
    assert not any("weakest" in line for line in pb.verdict(found).sentences)


@pytest.mark.thorough
def test_a_prior_that_bends_the_other_way_stays_a_precision() -> None:
    draws = np.random.default_rng(0).normal(size=(500, 2)) * [1.0, 3.0]
    found = positive_definite(np.diag([1.0, -0.1]), draws)
    np.testing.assert_allclose(np.diag(found), [1.0, 1.0 / 9.0], rtol=0.2)
    few = positive_definite(np.diag([1.0, -0.1]), draws[:5])
    assert (np.linalg.eigvalsh(few) > 0.0).all()
    sound = np.array([[2.0, 1.0], [1.0, 2.0]])
    np.testing.assert_array_equal(positive_definite(sound, draws), sound)
