"""An exposure is set for the light of its capture: its share of full scale is sampled."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from numpyro import distributions as dist
from numpyro import handlers
from scipy import stats

import polar_bayes as pb
from polar_bayes.models.per_material import per_material
from polar_bayes.physics.geometry import Geometry
from polar_bayes.priors import CONTRAST
from polar_bayes.setups import SETUPS
from polar_bayes.simulation import Protocol

SCENE = SETUPS["paper"].scene
VIEWS = Protocol(views=12, wavelengths=())
FREE = {"exposure": dist.LogNormal(2.0, 1.0)}
HELD = handlers.condition(per_material, data={"exposure": np.float64(3.0)})


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    return pb.simulate("plastic", scene=SCENE, protocol=VIEWS, seed=1)


def prior_of(capture: xr.Dataset) -> dict[str, np.ndarray]:
    """Prior draws of a fit by name, (draw,)."""
    prior = pb.fit(capture, scene="paper", method="laplace")["prior"].to_dataset()
    return {str(name): each.to_numpy().ravel() for name, each in prior.data_vars.items()}


@pytest.fixture(scope="module")
def prior(capture: xr.Dataset) -> dict[str, np.ndarray]:
    return prior_of(capture)


def log_average(prior: dict[str, np.ndarray], angles: dict[str, np.ndarray]) -> np.ndarray:
    """Mean log intensity of views, counted as the prior counts it."""
    geometry = Geometry.from_degrees(**angles)

    @jax.jit
    def intensity(parameters: dict[str, jax.Array]) -> jax.Array:
        return SCENE.predict(parameters, geometry)["intensity"]

    names = SCENE.parameters
    light = jax.vmap(intensity)({n: jnp.asarray(prior[n]) for n in names})
    seen = np.asarray(light, float)
    return np.log(seen + seen.max(axis=-1, keepdims=True) / CONTRAST).mean(axis=-1)


def test_the_log_average_is_recorded_at_the_share(prior: dict[str, np.ndarray]) -> None:
    found = np.log(prior["exposure"]) + log_average(prior, VIEWS.angles())
    # In single precision, of intensities whose logs reach 25.
    np.testing.assert_allclose(found, np.log(prior["exposure_share"]), atol=1e-4)


def test_the_share_is_a_photographers(prior: dict[str, np.ndarray]) -> None:
    expected = stats.norm(np.log(0.18), 2.0)
    # False alarms: 1 in 10,000.
    assert stats.kstest(np.log(prior["exposure_share"]), expected.cdf).pvalue > 1e-4


@pytest.mark.thorough
def test_a_view_that_is_missing_sets_no_exposure(
    capture: xr.Dataset, prior: dict[str, np.ndarray]
) -> None:
    masked = capture.assign(valid=("view", np.arange(12) < 10))
    found = prior_of(masked)
    shown = {name: x[:10] for name, x in VIEWS.angles().items()}
    np.testing.assert_array_equal(found["exposure_share"], prior["exposure_share"])
    ratio = np.log(found["exposure"]) + log_average(found, shown)
    np.testing.assert_allclose(ratio, np.log(found["exposure_share"]), atol=1e-4)


def test_an_exposure_that_is_known_has_a_prior_of_its_own(capture: xr.Dataset) -> None:
    fit = pb.fit(capture, scene="paper", priors=FREE, method="laplace")
    assert "exposure_share" not in fit["posterior"]
    assert np.log(fit["prior"]["exposure"].to_numpy()).mean() == pytest.approx(2.0, abs=0.2)
    held = pb.fit(capture, scene="paper", priors=FREE, method="laplace", model=HELD)
    assert "exposure" not in held["posterior"]


def test_a_condition_that_holds_nothing_is_refused(capture: xr.Dataset) -> None:
    with pytest.raises(pb.FitError, match=r"^model: it has no site exposure; hold one of .*_share"):
        pb.fit(capture, scene="paper", model=HELD)


@pytest.mark.thorough
def test_a_black_scene_has_a_finite_exposure(capture: xr.Dataset) -> None:
    """Views that see neither the highlight nor a body: intensities of zero in both precisions."""
    dark = dataclasses.replace(VIEWS, azimuths=(0.0,), light_zenith=80.0)
    black = pb.simulate(
        "plastic",
        scene=SCENE,
        protocol=dark,
        seed=1,
        parameters={"roughness": 0.005, "subsurface_fraction": 0.0},
        noise={"exposure": 1.0},
    )
    for precision in ("double", "single"):
        fit = pb.fit(black, scene="paper", method="laplace", precision=precision)
        for group in ("prior", "posterior"):
            assert np.isfinite(fit[group]["exposure"].to_numpy()).all()
