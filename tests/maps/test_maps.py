"""What a map says of every pixel: NumPyro's approximation, honest intervals, clear refusals."""

import dataclasses
import json
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from cases import each
from numpyro import handlers
from numpyro.infer.autoguide import AutoLaplaceApproximation
from plate_images import ASKED, NAMES, backwards, mapped, planned, plate_image, stacked
from scipy import optimize, stats

import polar_bayes as pb
from polar_bayes.inference.batch_modes import find_modes_from, find_starts
from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.inference.program import Program
from polar_bayes.inference.result import PROVENANCE
from polar_bayes.maps.fit_map import MapPlan, blank, fit_pixels
from polar_bayes.methods.corrected_laplace import CorrectedLaplace
from polar_bayes.methods.importance import Importance
from polar_bayes.methods.laplace import Laplace
from polar_bayes.models.per_material import per_material
from polar_bayes.physics.facets import FacetQuadrature

INTERVALS = {"50%": (0.25, 0.75), "80%": (0.1, 0.9), "95%": (0.025, 0.975)}


@pytest.fixture(scope="module")
def image() -> xr.Dataset:
    return plate_image(30, 30, seed=5).assign_coords(x=np.arange(100.0, 130.0))


@pytest.fixture(scope="module")
def plan(image: xr.Dataset) -> MapPlan:
    return planned(image)


@pytest.fixture(scope="module")
def maps(image: xr.Dataset, plan: MapPlan) -> xr.Dataset:
    return mapped(image, plan)


# --- the approximation is NumPyro's ---------------------------------------------------------------


class Twin:
    """The mode of one pixel by SciPy's trust region, with derivatives that run backwards."""

    def __init__(self, program: Program) -> None:
        bend = jax.jit(backwards(program.potential))
        self._around = lambda z, data: [np.asarray(x) for x in bend(jnp.asarray(z), data)]

    def mode(self, start: np.ndarray, data) -> np.ndarray:
        z = optimize.minimize(
            lambda z: tuple(self._around(z, data)[:2]),
            start,
            jac=True,
            hess=lambda z: self._around(z, data)[2],
            method="trust-exact",
        ).x
        _, slope, bend = self._around(z, data)
        return z - np.linalg.solve(bend, slope)

    def covariance(self, z: np.ndarray, data) -> np.ndarray:
        return np.linalg.inv(self._around(z, data)[2])


def _guide_covariance(program: Program, z: jax.Array, data) -> jax.Array:
    """Return the covariance of the guide, in the order of the program's own vector."""
    guide = AutoLaplaceApproximation(program.model)
    with handlers.seed(rng_seed=0):
        guide(data)
    place = guide._unpack_latent(jnp.arange(program.size))
    order = jnp.stack([place[name] for name in program.unravel(z)])
    location = jnp.zeros_like(z).at[order].set(z)
    half = guide.get_transform({"auto_loc": location}).scale_tril
    return (half @ half.T)[jnp.ix_(order, order)]


GOAL = 1e-4
"""Posterior sds within which a search for modes ends."""


def assert_modes_agree(plan, batch, covariance=None):
    """Of all pixels that arrived; how many did."""
    found = find_modes_from(batch, find_starts(batch)[:, 0])
    twin = Twin(plan.engine.program)
    for number in np.flatnonzero(found.converged):
        z, half = found.mode.z[number], found.mode.root[number]
        data = batch.pixels.pixel(number)
        # From a start two posterior widths away the climb back is SciPy's own.
        mode = twin.mode(z + np.full(z.size, 2.0 / z.size**0.5) @ half, data)
        own_covariance = covariance or twin.covariance
        theirs = own_covariance(mode, data)
        sd = np.sqrt(np.diagonal(theirs))
        assert np.abs((z - mode) / sd).max() < GOAL, number
        # The curvature is taken before the last step, which is shorter than the goal.
        before = sum(np.abs(own_covariance(mode + GOAL * step, data) - theirs) for step in half)
        error = np.abs(half.T @ half - theirs)
        assert np.all(error < GOAL * np.outer(sd, sd) + before), number
    return int(found.converged.sum())


@pytest.fixture(scope="module")
def guide(plan: MapPlan) -> Callable:
    covariance = jax.jit(lambda z, data: _guide_covariance(plan.engine.program, z, data))
    return lambda z, data: np.asarray(covariance(z, data))


@pytest.mark.thorough
def test_five_hundred_pixels_have_the_mode_and_the_covariance_of_numpyros_guide(plan, guide):
    rng = np.random.default_rng(1)
    noise = np.exp(rng.uniform(np.log(3e-3), np.log(0.1), (20, 25)))
    assert assert_modes_agree(plan, stacked(plate_image(20, 25, noise=noise), plan), guide) == 500


HARD = {
    "at the horizon": {"views": np.array([80.0, 85.0, 89.0, 89.9, 89.99, 89.999])},
    "from above, where nothing is polarized": {"views": np.zeros(6)},
    "one direction, six times": {"views": np.full(6, 68.0)},
    "two directions that differ by nothing": {"views": np.array([68.0, 68.0 + 1e-9] * 3)},
    "nearly no noise": {"noise": 1e-5},
    "nothing but noise": {"noise": 30.0},
}


@pytest.mark.thorough
@each("hard", HARD)
def test_hard_pixels_have_them_too(plan: MapPlan, guide: Callable, hard: str) -> None:
    image = plate_image(2, 5, **HARD[hard], seed=4)
    assert assert_modes_agree(plan, stacked(image, plan), guide) == 10


@pytest.mark.thorough
def test_on_a_bent_ridge_some_arrive_and_the_others_say_that_they_did_not(plan, guide):
    """One reading a thousand times better than the rest: damped steps creep along its curve."""
    image = plate_image(2, 5, noise=0.1, seed=4)
    image["q_error"][..., 3] = 1e-4
    arrived = assert_modes_agree(plan, stacked(image, plan), guide)
    maps = mapped(image, plan)
    assert 3 <= arrived < 10
    lost = (maps["status"] == Status.NOT_CONVERGED).values
    assert lost.sum() <= 10 - arrived  # starting again may have helped
    assert np.isnan(maps[NAMES[0]].values[lost]).all()


@pytest.mark.thorough
def test_rough_pixels_have_the_mode_and_the_curvature_there() -> None:
    surface = pb.RoughSurface(pb.Beckmann(), pb.PointSource(), FacetQuadrature(along=2, across=2))
    scene = dataclasses.replace(pb.setups.SETUPS["paper"].scene, surface=surface)
    shape = (3, 4)
    rng = np.random.default_rng(2)
    truth = {
        "roughness": rng.uniform(0.08, 0.35, shape),
        "subsurface_fraction": rng.uniform(0.2, 0.7, shape),
        "absorption": rng.uniform(0.1, 0.8, shape),
        "refractive_index": rng.uniform(1.35, 1.6, shape),
    }
    base = pb.simulate(
        "leaf", seed=1, scene=scene, protocol=pb.simulation.Protocol(views=12, wavelengths=())
    )
    angles = ["view_zenith", "view_azimuth", "light_zenith", "light_azimuth"]
    geometry = pb.Geometry.from_degrees(**{name: base[name].to_numpy() for name in angles})
    predict = jax.jit(lambda truth: scene.predict(truth, geometry)["dop"])
    dop = np.asarray(predict({name: jnp.asarray(x) for name, x in truth.items()}))
    dop = np.clip(dop + 0.01 * rng.normal(size=dop.shape), 0.0, 1.0)
    image = base[angles].assign(dop=(("y", "x", "view"), dop))
    model = handlers.condition(per_material, data={"normal_scale": 0.01})
    plan = planned(image, model=model, scene=scene, links=pb.links.NormalLink())
    assert_modes_agree(plan, stacked(image, plan))


@pytest.mark.thorough
def test_a_map_without_weights_is_the_laplace_fit_of_its_pixel() -> None:
    image = plate_image(1, 2, seed=4)
    plan = planned(image, Laplace(draws=4000, chains=1))
    maps = mapped(image, plan).isel(y=0, x=1)
    pixel = image.isel(y=0, x=1, drop=True)
    fit = pb.fit(pixel, method=pb.methods.Laplace(draws=40_000, chains=1), seed=1, **ASKED)
    assert maps["method"] == MethodUsed.LAPLACE
    assert maps["status"] == Status.GOOD
    for name in NAMES:
        draws = fit["posterior"][name].to_numpy().ravel()
        # Four standard errors of 40,000 and of 4,000 draws.
        both = np.sqrt(1.0 / 40_000 + 1.0 / 4_000)
        assert abs(float(maps[name]) - draws.mean()) < 4.0 * draws.std() * both
        # The error of an sd is 1 / sqrt(2 n) of a normal one, and twice that of a skewed one.
        assert float(maps[f"{name}_sd"]) == pytest.approx(draws.std(), rel=4.0 * both)
        for level, value in zip(maps["quantile"].values, maps[f"{name}_quantile"], strict=True):
            below = np.mean(draws < float(value))
            error = np.sqrt(level * (1.0 - level)) * both
            assert abs(below - level) < 4.0 * error, (name, level)


# --- what the intervals are worth -----------------------------------------------------------------


@pytest.mark.thorough
def test_intervals_hold_the_truth_as_often_as_they_say(image: xr.Dataset, maps: xr.Dataset) -> None:
    # 900 plates drawn from the priors, readings from the model's own noise: a true map fails
    # once in 1000 (six comparisons).
    good = maps["status"] == Status.GOOD
    assert float(good.mean()) > 0.99  # a pixel without an answer counts as a miss
    for name in NAMES:
        truth, quantiles = image[f"true_{name}"], maps[f"{name}_quantile"]
        for label, (low, high) in INTERVALS.items():
            inside = (quantiles.sel(quantile=low) <= truth) & (
                truth <= quantiles.sel(quantile=high)
            )
            hits = int((inside & good).sum())
            fewest, most = stats.binom.ppf([0.5e-3 / 6, 1.0 - 0.5e-3 / 6], 900, high - low)
            assert fewest <= hits <= most, (name, label, hits)


@pytest.mark.thorough
def test_single_precision_finds_the_same_maps(image: xr.Dataset) -> None:
    corner = image.isel(y=slice(10), x=slice(10))
    single, double = (
        mapped(corner, planned(corner, CorrectedLaplace(sampler=None), precision=precision))
        for precision in ("single", "double")
    )
    assert (single["method"] == double["method"]).all()
    weighted = double["method"].isin([MethodUsed.IMPORTANCE, MethodUsed.ADAPTED])
    assert weighted.mean() > 0.75  # the others are for the sampler, which is not asked here
    at_once = (double["method"] == MethodUsed.IMPORTANCE).values
    assert at_once.mean() > 0.5  # adapted proposals carry errors further than the bound below
    for name in NAMES:
        sd = double[f"{name}_sd"].values
        # A reading is predicted to some 30 units of the last digit, 4e-6: 2e-4 of its noise. Six
        # of them move the mode, the mean and the sd by at most 6**0.5 times that; the weights
        # carry as much again, and the maps are kept to 1e-7 of values of order 1: together 2e-3.
        # The unit of a quantile is its slope over the normal score, the sd of a normal posterior:
        # where the density is low, the same change of probability moves a quantile farther.
        scores = stats.norm.ppf(double["quantile"].values)
        slope = np.gradient(double[f"{name}_quantile"].values, scores, axis=0)
        for ending, unit in (("", sd), ("_sd", sd), ("_quantile", slope)):
            apart = np.abs(double[f"{name}{ending}"].values - single[f"{name}{ending}"].values)
            assert (apart / unit)[..., at_once].max() < 2e-3, (name, ending)


# --- what a map is and what is refused ------------------------------------------------------------


@pytest.mark.thorough
def test_a_map_says_what_it_holds_and_how_it_was_made(plan: MapPlan, maps: xr.Dataset) -> None:
    for name in NAMES:
        assert maps[name].dims == maps[f"{name}_sd"].dims == ("y", "x")
        assert maps[f"{name}_quantile"].dims == ("quantile", "y", "x")
        assert maps[name].attrs["units"] == "1"
        assert maps[name].dtype == np.float32
        assert (np.diff(maps[f"{name}_quantile"].values, axis=0) >= 0.0).all()
    assert maps["status"].attrs["flag_meanings"].split()[Status.GOOD] == "good"
    assert maps["method"].attrs["flag_meanings"].split()[MethodUsed.NUTS] == "nuts"
    said = json.loads(maps.attrs[PROVENANCE])
    assert said["seed"] == 0
    assert CorrectedLaplace(**{**said["settings"], "sampler": Importance()}) == plan.settings
    assert said["fixed"] == {"stokes_error_factor": 1.0}
    assert (maps["x"].values == np.arange(100.0, 130.0)).all()


def two_colors() -> xr.Dataset:
    """An image whose plates look the same in two colors."""
    colors = xr.DataArray([450.0, 650.0], dims="wavelength", name="wavelength")
    image = plate_image(1, 3)
    image = image.drop_vars([f"true_{name}" for name in NAMES])
    both = {name: xr.concat([image[name]] * 2, colors) for name in ("q", "q_error")}
    order = ("y", "x", "wavelength", "view")
    return image.drop_vars(both).assign({n: values.transpose(*order) for n, values in both.items()})


def test_an_image_in_two_colors_has_an_index_of_each() -> None:
    image = two_colors()
    maps = blank(image, planned(image))
    assert maps["refractive_index"].dims == ("y", "x", "wavelength")
    assert maps["refractive_index_quantile"].dims == ("quantile", "y", "x", "wavelength")
    assert maps["subsurface_fraction"].dims == ("y", "x")


@pytest.mark.thorough
def test_plates_that_look_the_same_in_two_colors_have_the_same_index() -> None:
    maps = fit_pixels(two_colors(), method=CorrectedLaplace(sampler=None, draws=1024), **ASKED)
    apart = maps["refractive_index"].diff("wavelength") / maps["refractive_index_sd"]
    assert (abs(apart) < 0.2).all()


def masked(image: xr.Dataset) -> xr.Dataset:
    valid = np.zeros(image["q"].shape, bool)
    valid[..., 0] = True
    return image.assign(valid=(("y", "x", "view"), valid))


@each(
    ("change", "settings", "says"),
    [
        (lambda c: c.isel(y=0, x=0), {}, r"plates: it has no axis y or x; give an image"),
        (lambda c: c.isel(y=0), {}, r"plates: it has no axis y; give an image"),
        (masked, {}, r"plates: no pixel has 2 valid views; check `valid`"),
        (lambda c: c.assign(q=c["q"] * np.nan), {}, r"plates: no pixel has 2 valid views"),
        (None, {"method": pb.methods.Point()}, r"point gives no draws of many captures"),
        (None, {"method": "hmc"}, r"no such method; give one of laplace, importance"),
        (None, {"precision": "half"}, r"precision is 'half'; give 'double' or 'single'"),
        (None, {"seed": -1}, r"seed is -1; give an integer"),
        (None, {"scene": "moon"}, r"no such scene; give one of"),
    ],
)
def test_what_cannot_be_mapped_is_refused_with_the_mend(change, settings: dict, says: str) -> None:
    image = plate_image(2, 2)
    with pytest.raises(pb.PolarBayesError, match=says) as caught:
        fit_pixels(change(image) if change else image, **{**ASKED, **settings})
    assert "\n" not in str(caught.value)
