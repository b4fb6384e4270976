"""The spectral model: real materials, hard wavelengths, and a twin with another sampler."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from cases import each
from ensembles import assert_same_draws, ensemble_draws
from jax.flatten_util import ravel_pytree
from numpyro import distributions as dist
from plates import LINKS, PLATE
from scipy import special, stats
from spectral_plates import FRACTION, spectral_plate, tabulated
from textbook import mirror_and_body
from tinygp import kernels

import polar_bayes as pb
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.models.gp_spectral import gp_spectral
from polar_bayes.observation.data import observe
from polar_bayes.priors import PRIORS

INDEX_ONLY = pb.models.GpSpectral(coupled=("refractive_index",))
TINY = pb.methods.Laplace(chains=2, draws=100)
MANY_VIEWS = np.linspace(30.0, 78.0, 24)
FEW_VIEWS = np.linspace(40.0, 75.0, 4)

pytestmark = pytest.mark.usefixtures("compile_fast_rather_than_fast_code")


def fit(capture: xr.Dataset, model: Any = INDEX_ONLY, **asked: Any) -> xr.DataTree:
    return pb.fit(capture, model=model, scene=PLATE, links=LINKS, **{"method": TINY} | asked)


def smooth_index(wavelength: np.ndarray) -> np.ndarray:
    return 1.5046 + 4200.0 / np.asarray(wavelength) ** 2


# --- real materials -------------------------------------------------------------------------------


def held_out(material: Mapping[float, float], held: float, seed: int) -> tuple[float, float]:
    """Ends of the 95% band at a color that was not measured."""
    measured = {color: index for color, index in material.items() if color != held}
    capture = spectral_plate(measured, error=0.002, seed=seed, views=MANY_VIEWS)
    result = fit(capture, method=pb.methods.Laplace(chains=2, draws=500), seed=seed)
    draws = pb.inference.predict_spectrum(result, held, seed=seed)["refractive_index"].to_numpy()
    low, high = np.quantile(draws, (0.025, 0.975))
    return float(low), float(high)


@pytest.mark.thorough  # benchmarks/spectrum.py does the same with NUTS
@each("held", [550.0, 633.0])
def test_real_materials_lie_in_the_bands_of_a_color_that_was_not_measured(held: float) -> None:
    """Five materials. If bands were exact, two misses of five have chance .023.

    Laplace draws stand in for NUTS, which gives the same bands in benchmarks/spectrum.py.
    """
    missed = []
    for number, (name, material) in enumerate(tabulated().items()):
        low, high = held_out(material, held, seed=number)
        # A band as wide as the prior of one color (.29) would hold anything.
        assert high - low < 0.04, name
        if not low < material[held] < high:
            missed.append((name, low, material[held], high))
    assert len(missed) <= 1, missed


# --- the twin -------------------------------------------------------------------------------------

TWIN_COLORS = np.array([450.0, 550.0, 650.0])
TWIN_ERROR = 0.01
TWIN_NAMES = (
    "subsurface_fraction",
    "stokes_error_factor",
    "refractive_index_amplitude",
    "refractive_index_length",
)
TWIN_PRIORS = (
    stats.truncnorm(-0.25 / 0.15, 0.55 / 0.15, 1.45, 0.15),
    stats.beta(2.0, 2.0),
    stats.lognorm(0.7, scale=1.5),
    stats.lognorm(0.7, scale=0.02),
    stats.lognorm(0.5, scale=300.0),
)


class Twin:
    """Log posterior in NumPy and SciPy: indices themselves are the coordinates, no weights."""

    def __init__(self, capture: xr.Dataset) -> None:
        self.zenith = np.radians(capture["view_zenith"].to_numpy())
        self.readings = capture["q"].transpose("wavelength", "view").to_numpy()
        square = (TWIN_COLORS[:, None] - TWIN_COLORS) ** 2
        self.square = square
        # Differences of colors: what the process says once the level, their mean, is apart.
        self.contrast = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]])

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Log density at points (point, 7): three indices, log odds, and three logarithms."""
        index = x[:, :3]
        odds, factor, amplitude, length = x[:, 3], *np.exp(np.clip(x[:, 4:].T, -20.0, 20.0))
        fraction = 1.0 / (1.0 + np.exp(-odds))
        with np.errstate(all="ignore"):
            total = self._prior(index, fraction, factor, amplitude, length)
            total += np.log(fraction) + np.log1p(-fraction) + x[:, 4:].sum(axis=1)
            total += self._likelihood(index, fraction, factor)
        return np.where(
            np.isfinite(total) & np.all((index > 1.2) & (index < 2.0), 1), total, -np.inf
        )

    def _prior(self, index, fraction, factor, amplitude, length) -> np.ndarray:
        level = index.mean(axis=1)
        values = (level, fraction, factor, amplitude, length)
        total = sum(prior.logpdf(x) for prior, x in zip(TWIN_PRIORS, values, strict=True))
        # The same trace on the diagonal: far walkers propose lengths without end.
        kernel = np.exp(-0.5 * self.square / length[:, None, None] ** 2) + 1e-10 * np.eye(3)
        spread = self.contrast @ kernel @ self.contrast.T * amplitude[:, None, None] ** 2
        difference = index @ self.contrast.T
        solved = np.linalg.solve(spread, difference[..., None])[..., 0]
        return total - 0.5 * (np.sum(difference * solved, 1) + np.linalg.slogdet(spread)[1])

    def _likelihood(self, index, fraction, factor) -> np.ndarray:
        s, p, body = mirror_and_body(index[:, :, None], self.zenith)
        share = fraction[:, None, None]
        total = 0.5 * (1.0 - share) * (s + p) + share * body
        q = 0.5 * (1.0 - share) * (s - p) / total
        scale = factor * TWIN_ERROR
        missed = ((self.readings - q) ** 2).sum(axis=(1, 2))
        return -0.5 * missed / scale**2 - self.readings.size * np.log(scale)


@pytest.mark.thorough
def test_the_posterior_is_that_of_another_density_and_another_sampler() -> None:
    colors = (TWIN_COLORS, smooth_index(TWIN_COLORS))
    capture = spectral_plate(colors, error=TWIN_ERROR, seed=21, views=np.linspace(35.0, 75.0, 6))
    center = np.array([1.52, 1.51, 1.505, -3.9, 0.0, np.log(0.02), np.log(300.0)])
    width = np.array([0.003] * 3 + [0.05, 0.1, 0.3, 0.3])
    chain, independent = ensemble_draws(Twin(capture), center, width, walkers=48, steps=6000)
    settings = pb.methods.Nuts(draws=1000, most_draws=2000, ess=1000.0)
    prior = {"subsurface_fraction": dist.Beta(2.0, 2.0)}  # that of the twin
    result = fit(capture, method=settings, priors=prior, seed=4)
    assert pb.verdict(result).passed
    posterior = {name: draws.to_numpy() for name, draws in result["posterior"].items()}
    theirs = dict(zip([*TWIN_COLORS, *TWIN_NAMES], np.moveaxis(chain, -1, 0), strict=True))
    theirs["subsurface_fraction"] = special.expit(theirs["subsurface_fraction"])
    ours = dict(zip(TWIN_COLORS, np.moveaxis(posterior["refractive_index"], -1, 0), strict=True))
    ours["subsurface_fraction"] = posterior["subsurface_fraction"]
    # Heavy tails of amplitude and length are compared on the log scale.
    ours |= {name: np.log(posterior[name]) for name in TWIN_NAMES[1:]}
    assert_same_draws(ours, theirs, independent)


# --- hard wavelengths -----------------------------------------------------------------------------

HARD_COLORS = {"two equal": np.array([550.0, 550.0]), "two hundred": np.linspace(400.0, 800.0, 200)}


@pytest.mark.thorough
@each("precision", ["double", "single"])
@each("colors", HARD_COLORS.values(), ids=HARD_COLORS)
def test_density_and_gradient_are_finite(colors: np.ndarray, precision: str) -> None:
    capture = spectral_plate((colors, smooth_index(colors)), error=0.01, seed=5, views=FEW_VIEWS)
    request = resolve(capture, INDEX_ONLY, PLATE, None, LINKS, None, 0, precision)
    with jax.enable_x64(precision == "double"):
        dtype = jnp.result_type(float)
        data = jax.tree.map(
            lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x,
            observe(request.capture),
        )
        program = compile_program(request.bind(), data)
        density = jax.jit(jax.value_and_grad(program.potential))
        for seed in range(3):
            z = np.asarray(program.from_prior(jax.random.key(seed), data))
            for length in (-4.6, 5.7, 11.5):  # 0.01, 300 and 100,000 nm
                sites = program.unravel(jnp.asarray(z, dtype))
                sites["refractive_index_length"] = jnp.asarray(length, dtype)
                point = ravel_pytree(sites)[0]
                value, gradient = density(point, data)
                assert value.dtype == dtype
                assert np.isfinite(value)
                assert np.isfinite(gradient).all()


@pytest.mark.thorough
def test_two_equal_wavelengths_are_fitted_in_single_precision() -> None:
    colors = HARD_COLORS["two equal"]
    capture = spectral_plate((colors, np.array([1.51, 1.51])), error=0.01, seed=6)
    result = fit(capture, precision="single")
    index = result["posterior"]["refractive_index"].to_numpy()
    assert index.dtype == np.float32
    assert np.isfinite(index).all()
    np.testing.assert_allclose(index[..., 0], index[..., 1], atol=1e-6)
    predicted = pb.inference.predict_spectrum(result, [550.0, 700.0])["refractive_index"]
    assert predicted.dtype == np.float32
    apart = predicted.to_numpy()[..., 0] - index[..., 0]
    assert np.abs(apart).max() < 1e-3
    assert predicted.std(("chain", "draw"))[1] > index[..., 0].std()


@pytest.mark.thorough
def test_one_wavelength_has_the_prior_of_one_wavelength() -> None:
    """Without neighbors the model is `per_material`."""
    capture = spectral_plate({550.0: 1.51}, error=0.01, seed=6)
    spectral, plain = fit(capture, seed=2), fit(capture, "per_material", seed=2)
    one, other = (r["posterior"]["refractive_index"].to_numpy().ravel() for r in (spectral, plain))
    # Means and widths of 200 independent draws each: four standard errors.
    assert abs(one.mean() - other.mean()) < 4.0 * np.hypot(one.std(), other.std()) / 200**0.5
    assert one.std() == pytest.approx(other.std(), rel=4.0 / 200**0.5)


# --- kernels, laws, patches -----------------------------------------------------------------------

THREE = spectral_plate({450.0: 1.525, 550.0: 1.5185, 650.0: 1.5145}, error=0.01, seed=7)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kernel", "length"),
    [
        pytest.param("Matern52", True, id="name"),
        pytest.param(
            lambda length: kernels.RationalQuadratic(scale=length, alpha=1.0), True, id="function"
        ),
        pytest.param(kernels.ExpSquared(scale=200.0), False, id="object"),
    ],
)
def test_other_kernels_are_fitted_and_predict(kernel: Any, length: bool) -> None:
    model = pb.models.GpSpectral(("refractive_index",), pb.models.SpectralProcess(kernel))
    result = fit(THREE, model)
    assert ("refractive_index_length" in result["posterior"]) is length
    given = None if isinstance(kernel, str) else model
    band = pb.inference.predict_spectrum(result, [500.0, 600.0], model=given)["refractive_index"]
    assert np.isfinite(band).all()
    if given is not None:
        with pytest.raises(pb.FitError, match=r"kernel has no name.*give the model again"):
            pb.inference.predict_spectrum(result, [500.0])


def patches() -> xr.Dataset:
    parts = [
        spectral_plate((TWIN_COLORS, smooth_index(TWIN_COLORS) + shift), error=0.005, seed=30 + i)
        for i, shift in enumerate((-0.05, 0.1))
    ]
    return xr.concat(parts, "patch", data_vars=["q", "q_error"], coords="minimal", compat="equals")


@pytest.mark.thorough
def test_every_patch_has_its_own_curve_around_a_pooled_level() -> None:
    model = dataclasses.replace(INDEX_ONLY, pooled=("refractive_index",))
    result = fit(patches(), model)
    assert "refractive_index_level_spread" in result["posterior"]
    index = result["posterior"]["refractive_index"]
    assert set(index.dims) == {"chain", "draw", "patch", "wavelength"}
    assert result["posterior"]["refractive_index_amplitude"].dims == ("chain", "draw")
    band = pb.inference.predict_spectrum(result, [450.0, 500.0, 700.0])["refractive_index"]
    assert band.dims == ("chain", "draw", "patch", "wavelength")
    truth = smooth_index(np.array([450.0, 500.0])) + np.array([[-0.05], [0.1]])
    near = band.isel(wavelength=slice(2))
    apart = (near.mean(("chain", "draw")) - truth) / near.std(("chain", "draw"))
    assert np.abs(apart).max() < 4.0  # 6e-5 each


@pytest.mark.thorough
def test_a_law_of_dispersion_takes_the_place_of_a_process() -> None:
    scene = dataclasses.replace(PLATE, dispersion=pb.physics.Cauchy())
    result = pb.fit(THREE, model=gp_spectral, scene=scene, links=LINKS, method=TINY)
    assert "refractive_index_amplitude" not in result["posterior"]
    band = pb.inference.predict_spectrum(result, [450.0, 500.0])["refractive_index"]
    xr.testing.assert_equal(
        band, pb.inference.predict_spectrum(result, [450.0, 500.0], scene=scene).refractive_index
    )
    a, b = (result["posterior"][name].to_numpy() for name in ("cauchy_a", "cauchy_b"))
    np.testing.assert_allclose(band.sel(wavelength=500.0), a + b / 0.5**2, rtol=1e-12)

    told = json.loads(result.attrs["polar_bayes"])
    told["scene_parts"] = told["scene_parts"].replace("Cauchy(", "LawOfMyOwn(")
    result.attrs["polar_bayes"] = json.dumps(told)
    with pytest.raises(pb.FitError, match="not one of this package; give the same scene"):
        pb.inference.predict_spectrum(result, [500.0])


@pytest.mark.thorough
def test_absorption_and_index_are_coupled_at_once() -> None:
    protocol = pb.simulation.Protocol(views=6, wavelengths=(450.0, 500.0, 550.0, 600.0))
    scene = pb.Scene(pb.SmoothSurface(), pb.Depolarizer(), pb.DopMixing())
    capture = pb.simulate("leaf", scene=scene, protocol=protocol, seed=3)
    processes = (pb.models.SpectralProcess("Matern32"), pb.models.SpectralProcess(knots=3))
    model = pb.models.GpSpectral(("absorption", "refractive_index"), processes)
    result = pb.fit(capture, model=model, scene=scene, method=TINY)
    assert result["unconstrained_posterior"]["refractive_index_weights"].shape[-1] == 3
    assert result["unconstrained_posterior"]["absorption_weights"].shape[-1] == 4
    bands = pb.inference.predict_spectrum(result, [450.0, 525.0, 525.0], seed=1)
    assert set(bands) == {"absorption", "refractive_index"}
    assert float(bands["absorption"].min()) > 0.0
    np.testing.assert_array_equal(bands["absorption"][..., 1], bands["absorption"][..., 2])
    again = result["posterior"]["absorption"].sel(wavelength=450.0)
    np.testing.assert_allclose(bands["absorption"].sel(wavelength=450.0), again, rtol=2e-3)
    xr.testing.assert_identical(
        bands, pb.inference.predict_spectrum(result, [450.0, 525.0, 525.0], seed=1)
    )


# --- what is refused ------------------------------------------------------------------------------


@each(
    ("settings", "message"),
    [
        ({"coupled": ()}, r"coupled=\(\) names no spectra.*refractive_index, absorption"),
        ({"coupled": ("roughness",)}, "names no spectra"),
        ({"coupled": "absorption"}, "names no spectra"),
        (
            {"process": (pb.models.SpectralProcess(),)},
            "does not say what refractive_index and absorption",
        ),
        ({"process": "ExpSquared"}, "does not say what.*one SpectralProcess"),
        ({"pooled": ("n",)}, "'n' is no parameter of a material"),
    ],
)
def test_what_is_no_spectral_model_is_refused(settings: dict, message: str) -> None:
    with pytest.raises(pb.FitError, match=message):
        pb.models.GpSpectral(**settings)


def test_a_capture_without_colors_and_a_scene_without_the_spectrum_are_refused() -> None:
    with pytest.raises(pb.FitError, match="no axis wavelength to couple; fit it with model='per_m"):
        fit(THREE.isel(wavelength=0, drop=True))
    with pytest.raises(pb.FitError, match="reads no absorption; couple one of refractive_index"):
        fit(THREE, pb.models.GpSpectral(coupled=("absorption",)))


@each("wavelengths", [[], [-500.0], [np.nan], [[500.0]], ["green"], None])
def test_what_is_no_wavelength_is_refused(wavelengths: Any) -> None:
    with pytest.raises(pb.FitError, match=r"is no list of wavelengths.*above zero in nm"):
        pb.inference.predict_spectrum(xr.DataTree(), wavelengths)


@pytest.mark.thorough
def test_a_result_without_ties_between_colors_is_refused() -> None:
    result = fit(THREE, "per_material")
    with pytest.raises(pb.FitError, match="'per_material': the fit ties no color to another"):
        pb.inference.predict_spectrum(result, 500.0)


def test_the_truth_of_these_captures_is_inside_the_priors() -> None:
    """Of the tabulated materials: amplitude and level are nowhere in the tails of the priors."""
    for row in tabulated().values():
        drop = row[450.0] - row[650.0]
        assert 0.005 < drop < 0.05
        assert PRIORS["refractive_index_level"].low < row[550.0] < 2.0
    assert 0.0 < FRACTION < 0.1
