"""Alternative parts: Bayes factors and answers in closed form, and worlds with another part."""

import dataclasses
from collections.abc import Iterator

import linear
import numpy as np
import numpyro
import pytest
import toy_models
import xarray as xr
from compilations import compiled_fast
from numpyro import distributions as dist
from scipy import stats

import polar_bayes as pb
from polar_bayes.diagnostics import alternatives, criticize
from polar_bayes.errors import FitError
from polar_bayes.inference.result import capture_of
from polar_bayes.simulation import Protocol

ROUGH = pb.Scene(pb.RoughSurface(pb.Beckmann(), pb.PointSource()))
SLOPE = {pb.Beckmann: 1.0, pb.GGX: 1.3}
DRAWS = 4000


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """The programs of a comparison are many and each runs for a moment."""
    with pytest.MonkeyPatch.context() as patch:
        yield from compiled_fast(patch, starts=8, typical=50, draws=100, block=100)


def _line(data, scene, priors, links):
    """Readings on a line through the origin, whose steepness depends on the distribution."""
    del priors, links
    x = np.linspace(-1.0, 1.0, data.shape[-1])
    tilt = numpyro.sample("normal_tilt_x", dist.Normal(0.0, 1.0))
    with numpyro.plate("view", x.size):
        mean = SLOPE[type(scene.surface.distribution)] * tilt * x
        numpyro.sample("q", dist.Normal(mean, linear.NOISE), obs=data.readings["q"])


def _exact(q: np.ndarray, slope: float) -> tuple[float, float, float]:
    """Log evidence, posterior mean and sd of the tilt."""
    x = slope * np.linspace(-1.0, 1.0, q.size)
    variance = 1.0 / (1.0 + x @ x / linear.NOISE**2)
    covariance = linear.NOISE**2 * np.eye(q.size) + np.outer(x, x)
    evidence = float(stats.multivariate_normal(cov=covariance).logpdf(q))
    return evidence, variance * (x @ q) / linear.NOISE**2, variance**0.5


@pytest.fixture(scope="module")
def fitted_line() -> xr.DataTree:
    asked = {"scene": ROUGH, "links": linear.LINKS, "method": pb.methods.Laplace(draws=DRAWS)}
    return pb.fit(toy_models.capture(), model=_line, **asked)


def test_bayes_factor_and_answer_are_those_in_closed_form(fitted_line) -> None:
    q = fitted_line["observed_data"]["q"].to_numpy()
    (evidence, mean, sd), (other_evidence, other, _) = (_exact(q, s) for s in SLOPE.values())
    table = alternatives(fitted_line)
    row = table.loc["normal_tilt_x"]
    assert (row["part"], row["alternative"]) == ("Beckmann", "GGX")
    assert row["path"] == "surface.distribution"
    # The posterior is normal, so Laplace's approximation is exact but for differences and rounding.
    assert row["log_bayes_factor"] == pytest.approx(other_evidence - evidence, abs=1e-6)
    # The standard error of an sd from independent draws, five times: one run in 2 million.
    error = 5.0 / np.sqrt(2 * DRAWS)
    assert row["shift"] == pytest.approx((other - mean) / sd, rel=error)
    assert row["other"] - row["mean"] == pytest.approx(other - mean, rel=1e-4)


def test_the_same_is_read_back_from_a_file(fitted_line, tmp_path) -> None:
    pb.save(fitted_line, tmp_path / "fit.nc")
    again = alternatives(pb.load(tmp_path / "fit.nc"))
    assert again.equals(alternatives(fitted_line))


def test_a_scene_without_alternatives_has_an_empty_table_and_a_point_fit_none() -> None:
    asked = {"model": toy_models.line, "scene": pb.Scene(pb.SmoothSurface()), "links": linear.LINKS}
    fit = pb.fit(toy_models.capture(), method="laplace", **asked)
    assert alternatives(fit).empty
    assert criticize(fit).loc["alternatives", "level"] == "passed"
    point = pb.fit(toy_models.capture(), method="point", **asked)
    with pytest.raises(FitError, match=r"not compared.*by a method that gives draws"):
        alternatives(point)


FORTY_VIEWS = Protocol(views=40, wavelengths=())


def _fit(
    preset: str,
    setup: str,
    seed=0,
    parameters=None,
    noise=None,
    protocol=FORTY_VIEWS,
    **parts,
) -> xr.DataTree:
    """Fit a set-up to readings simulated with other parts or known parameters."""
    own = pb.setups.SETUPS[setup]
    if "distribution" in parts:
        parts = {"surface": dataclasses.replace(own.scene.surface, **parts)}
    capture = pb.simulate(
        preset,
        scene=dataclasses.replace(own.scene, **parts),
        links=own.links,
        protocol=protocol,
        parameters=parameters,
        noise=noise,
        seed=seed,
    )
    return pb.fit(capture, scene=setup, method="laplace", seed=seed)


@pytest.mark.thorough
def test_a_distribution_that_explains_the_readings_better_is_a_problem() -> None:
    fit = _fit("plastic", "paper", distribution=pb.physics.GGX())
    row = criticize(fit).loc["alternatives"]
    assert row["level"] == "problem"
    assert "GGX in the place of Beckmann (surface.distribution)" in row["sentence"]
    assert any("GGX" in problem for problem in pb.verdict(fit).problems)


@pytest.mark.thorough
def test_a_film_of_water_that_hides_the_index_is_named() -> None:
    """The bare scene misses the index by five sds, and every other check is content."""
    short = {"exposure": 1.5}  # no view saturates, so that the highlight tells both indices
    fit = _fit("plastic", "camera", noise=short, coat=pb.ClearCoat(1.333, 0.0))
    assert not fit["constant_data"]["saturated"].any()
    row = criticize(fit).loc["alternatives"]
    assert row["level"] == "caution"
    assert "with a water film" in row["sentence"]
    assert "is that of the outermost interface, the film's" in row["sentence"]
    assert any("water film" in caution for caution in pb.verdict(fit).cautions)
    water = alternatives(fit).set_index("alternative", append=True).xs("water film", level=1)
    truth = float(fit["constant_data"]["true_refractive_index"])
    n = water.loc["refractive_index"]
    sd = float(fit["posterior"]["refractive_index"].std())  # with a film it is larger
    assert abs(n["mean"] - truth) > 5.0 * sd
    assert abs(n["other"] - truth) < 3.0 * sd


def test_a_plate_in_several_colors_is_compared_with_films_that_have_fringes() -> None:
    """The index of each wavelength starts at draws of its prior, as the thickness does."""
    views = Protocol(views=8, wavelengths=(450.0, 650.0))
    plate = pb.simulate("glass", scene="goniometer", protocol=views, seed=1)
    table = alternatives(pb.fit(plate, scene="goniometer", method="laplace"))
    film = table[table["alternative"].str.contains("film")].loc[["refractive_index[450]"]]
    assert np.isfinite(film[["log_bayes_factor", "shift"]]).all(axis=None)
    assert len(film) == 2


@pytest.fixture(scope="module")
def absorbing_body() -> xr.DataTree:
    return _fit("leaf", "camera", subsurface=pb.physics.Depolarizer())


@pytest.mark.thorough
def test_a_body_that_may_absorb_is_told_with_the_answer_it_gives(absorbing_body) -> None:
    """The readings do not tell it from a white one, whose fraction is tens of sds off."""
    row = criticize(absorbing_body).loc["alternatives"]
    assert row["level"] == "caution"
    assert "Depolarizer in the place of Lambertian" in row["sentence"]
    table = alternatives(absorbing_body)
    told = table[table["alternative"] == "Depolarizer"].loc["subsurface_fraction"]
    own = pb.setups.SETUPS["camera"]
    scene = dataclasses.replace(own.scene, subsurface=pb.physics.Depolarizer())
    other = pb.fit(capture_of(absorbing_body), scene=dataclasses.replace(own, scene=scene))
    answer = pb.summary(other).loc["subsurface_fraction"]
    assert told["other"] == pytest.approx(answer["mean"], abs=answer["sd"])  # mode against mean
    truth = float(absorbing_body["constant_data"]["true_subsurface_fraction"])
    assert answer["q2.5"] < truth < answer["q97.5"]
    assert told["shift"] > 10.0


@pytest.mark.thorough
def test_a_body_that_is_not_there_has_no_alternative() -> None:
    """Another body that sends nothing either is no better explanation, whatever its prior says."""
    fit = _fit("plastic", "camera", seed=14, parameters={"subsurface_fraction": 0.0})
    row = criticize(fit).loc["alternatives"]
    assert row["level"] == "passed"
    assert "Depolarizer" in set(alternatives(fit)["alternative"])  # compared, and no news


@pytest.mark.thorough
def test_a_bare_surface_whose_roughness_a_body_widens_is_named() -> None:
    """Few views do not exclude a body of .003, which leaves room for a wider highlight."""
    bare = {"subsurface_fraction": 0.0, "roughness": 0.11, "refractive_index": 1.5}
    few = Protocol(views=16, largest_view_zenith=80.0, wavelengths=())
    fit = _fit("plastic", "camera", seed=2, parameters=bare, protocol=few)
    row = criticize(fit).loc["alternatives"]
    assert row["level"] == "caution"
    assert "nothing in the place of Lambertian (subsurface)" in row["sentence"]
    told = alternatives(fit).set_index("alternative", append=True).xs("nothing", level=1)
    sd = float(fit["posterior"]["roughness"].std())
    assert told.loc["roughness", "other"] < told.loc["roughness", "mean"] - 1.96 * sd
    setup = pb.setups.SETUPS["camera"]
    scene = dataclasses.replace(setup.scene, subsurface=None, mixing=None)
    own = dataclasses.replace(setup, scene=scene)
    answer = pb.summary(pb.fit(capture_of(fit), scene=own, seed=0)).loc["roughness"]
    assert answer["q2.5"] < bare["roughness"] < answer["q97.5"]


def test_a_body_that_shines_is_not_compared_with_none(absorbing_body) -> None:
    assert "nothing" not in set(alternatives(absorbing_body)["alternative"])


@pytest.mark.thorough
def test_roughness_of_another_distribution_is_not_the_same_quantity(absorbing_body) -> None:
    table = alternatives(absorbing_body)
    slopes = table[table["alternative"] == "GGX"]
    assert slopes.index[slopes["redefined"]].tolist() == ["roughness"]
