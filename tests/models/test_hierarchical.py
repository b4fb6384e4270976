"""Pooling: the populations are those of the paper, and the posterior is that of a twin."""

import jax
import numpy as np
import pytest
import xarray as xr
from cases import each
from ensembles import assert_same_draws, ensemble_draws
from numpyro import distributions as dist
from numpyro import handlers
from plates import LINKS, PLATE, plates
from scipy import special, stats
from textbook import plate_q

import polar_bayes as pb
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.inference.result import provenance_of
from polar_bayes.observation.data import observe

ALL = ("roughness", "subsurface_fraction", "absorption", "refractive_index")

pytestmark = pytest.mark.usefixtures("compile_fast_rather_than_fast_code")


def fit(capture: xr.Dataset, **asked) -> xr.DataTree:
    return pb.fit(capture, **{"model": "hierarchical", "scene": PLATE, "links": LINKS} | asked)


# --- the population -------------------------------------------------------------------------------

EXPECTED = {
    "roughness": lambda m, s: stats.lognorm(s, scale=m),
    "absorption": lambda m, s: stats.lognorm(s, scale=m),
    "refractive_index": lambda m, s: stats.truncnorm((1.2 - m) / s, (2.0 - m) / s, m, s),
    "subsurface_fraction": lambda m, s: LogitNormal(m, s),
}


class LogitNormal:
    def __init__(self, median: float, spread: float) -> None:
        self.center, self.spread = np.log(median / (1.0 - median)), spread

    def cdf(self, x: np.ndarray) -> np.ndarray:
        return stats.norm(self.center, self.spread).cdf(np.log(x / (1.0 - x)))


def test_members_are_drawn_from_the_population() -> None:
    # Members are drawn before readings.
    capture = plates(np.full(400, 1.45), 0.1, np.array([40.0, 60.0]))
    populations = dict.fromkeys(ALL, (0.3, 0.6)) | {"refractive_index": (1.3, 0.2)}
    known = {
        f"{name}_{what}": np.float64(value)
        for name, pair in populations.items()
        for what, value in zip(("location", "spread"), pair, strict=True)
    }
    model = pb.models.Hierarchical(pooled=ALL)
    request = resolve(capture, model, "paper", None, LINKS, None, 0, "double")
    data = observe(request.capture)
    told = handlers.substitute(request.bind(), data=known)
    program = compile_program(told, data)
    assert program.auxiliary == tuple(f"{name}_base" for name in ALL)

    @jax.jit
    def draw(key: jax.Array) -> dict[str, jax.Array]:
        sites = handlers.trace(handlers.seed(told, key)).get_trace(data)
        return {name: sites[name]["value"] for name in ALL}

    draws = [draw(key) for key in jax.random.split(jax.random.key(3), 5)]
    for name, population in populations.items():
        members = np.concatenate([np.ravel(one[name]) for one in draws])
        # 2000 draws: a true population fails once in 1000 (four of them: once in 250).
        assert stats.kstest(members, EXPECTED[name](*population).cdf).pvalue > 1e-3, name


# --- the twin -------------------------------------------------------------------------------------

TWIN_ERROR = 0.02
TWIN_VIEWS = np.linspace(35.0, 75.0, 5)


def normal(x: np.ndarray, center: np.ndarray | float, spread: np.ndarray | float) -> np.ndarray:
    """Log density up to a constant."""
    return -0.5 * ((x - center) / spread) ** 2 - np.log(spread)


class Twin:
    """The posterior in NumPy and SciPy, in the constrained parameters."""

    def __init__(self, capture: xr.Dataset) -> None:
        self.q = capture["q"].to_numpy()
        self.zenith = np.radians(capture["view_zenith"].to_numpy())

    def __call__(self, x: np.ndarray) -> np.ndarray:
        index, fraction = x[:, :3], x[:, 3:6]
        location, spread, factor = x[:, 6], np.exp(x[:, 7]), np.exp(x[:, 8])
        inside = ((index > 1.2) & (index < 2.0) & (fraction > 0.0) & (fraction < 1.0)).all(axis=1)
        inside &= (location > 1.2) & (location < 2.0) & (spread < 5.0)
        out = np.full(len(x), -np.inf)
        x, index, fraction = x[inside], index[inside], fraction[inside]
        location, spread, factor = location[inside], spread[inside], factor[inside]
        ends = [(bound - location) / spread for bound in (1.2, 2.0)]
        kept = special.ndtr(ends[1]) - special.ndtr(ends[0])
        log = normal(index, location[:, None], spread[:, None]).sum(1) - 3 * np.log(kept)
        log += normal(location, 1.45, 0.2) + normal(spread, 0.0, 0.1)  # half of it
        log += np.log(spread) + np.log(fraction * (1.0 - fraction)).sum(1)  # Beta(2, 2)
        log += normal(np.log(factor), np.log(1.5), 0.7)
        q = plate_q(index[..., None], fraction[..., None], self.zenith)
        scale = TWIN_ERROR * factor[:, None, None]
        out[inside] = log + normal(self.q, q, scale).sum((1, 2))
        return out


@pytest.mark.thorough
def test_the_posterior_is_that_of_another_density_and_another_sampler() -> None:
    capture = plates([1.46, 1.5, 1.53], TWIN_ERROR, TWIN_VIEWS, seed=2)
    center = np.array([1.5, 1.5, 1.5, 0.02, 0.02, 0.02, 1.5, -3.5, 0.0])
    width = np.array([0.02] * 3 + [0.003] * 3 + [0.02, 0.3, 0.1])
    chain, independent = ensemble_draws(Twin(capture), center, width, walkers=60, steps=16000)
    settings = pb.methods.Nuts(draws=1000, most_draws=3000, ess=1500.0)
    prior = {"subsurface_fraction": dist.Beta(2.0, 2.0)}  # that of the twin
    result = fit(capture, method=settings, priors=prior)
    assert pb.verdict(result).converged
    posterior = {name: draws.to_numpy() for name, draws in result["posterior"].items()}
    coordinates = [
        *np.moveaxis(posterior["refractive_index"], -1, 0),
        *np.moveaxis(posterior["subsurface_fraction"], -1, 0),
        posterior["refractive_index_location"],
        np.log(posterior["refractive_index_spread"]),
        np.log(posterior["stokes_error_factor"]),
    ]
    theirs = dict(enumerate(np.moveaxis(chain, -1, 0)))
    assert_same_draws(dict(enumerate(coordinates)), theirs, independent)


# --- from complete pooling to none ----------------------------------------------------------------

CASES = {
    "all alike": (np.full(8, 1.5), 0.01),
    "all known, far apart": (np.linspace(1.35, 1.65, 8), 0.002),
    "hardly known": (np.linspace(1.45, 1.55, 8), 0.1),
    "two members": (np.array([1.45, 1.55]), 0.01),
}


@pytest.mark.thorough
@each("case", CASES)
def test_every_degree_of_pooling_samples_without_divergences(case: str) -> None:
    index, error = CASES[case]
    result = fit(plates(index, error, seed=5), seed=1)
    judged = pb.verdict(result)
    assert judged.converged, judged.problems  # plates have no body: the prior of beta says so
    assert int(result["sample_stats"]["diverging"].sum()) == 0
    n = result["posterior"]["refractive_index"]
    assert float(n.min()) >= 1.2
    assert float(n.max()) <= 2.0


@pytest.mark.thorough
def test_many_members_keep_a_fixed_metric_and_converge() -> None:
    index = np.random.default_rng(0).normal(1.5, 0.03, 40)
    result = fit(plates(index, 0.03, seed=6), seed=1)
    assert pb.verdict(result).converged
    assert result["posterior"].sizes["patch"] == 40
    spread = result["posterior"]["refractive_index_spread"].quantile([0.0005, 0.9995])
    assert spread[0] < 0.03 < spread[1]  # fails once in 1000 true captures


@pytest.mark.thorough
def test_coordinates_of_members_stand_apart_and_the_choice_is_recorded() -> None:
    model = pb.models.Hierarchical(pooled=("refractive_index", "subsurface_fraction"))
    capture = plates(np.linspace(1.45, 1.55, 12), 0.01, seed=7)
    result = fit(capture, model=model, method="laplace", seed=1)
    assert set(result["unconstrained_posterior"].data_vars) == {f"{n}_base" for n in model.pooled}
    assert {f"{n}_location" for n in model.pooled} <= set(result["posterior"].data_vars)
    assert np.isfinite(result["posterior"]["refractive_index"]).all()
    said = provenance_of(result)
    assert said["model_settings"] == {"pooled": ["refractive_index", "subsurface_fraction"]}


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_draws() -> None:
    capture = plates([1.45, 1.5, 1.55], 0.02)
    short = pb.methods.Nuts(chains=2, warmup=50, draws=50, most_draws=50, block=50)
    one, two = (fit(capture, method=short, seed=3)["posterior"].to_dataset() for _ in range(2))
    xr.testing.assert_equal(one, two)


@pytest.mark.thorough
def test_single_precision_finds_the_same_population() -> None:
    capture = plates(np.linspace(1.45, 1.55, 6), 0.02, seed=3)
    double, single = (fit(capture, precision=p, seed=1) for p in ("double", "single"))
    assert single["posterior"]["refractive_index"].dtype == np.float32
    for name in ("refractive_index_location", "refractive_index_spread"):
        one, two = (tree["posterior"][name].to_numpy() for tree in (double, single))
        assert abs(one.mean() - two.mean()) < 4.0 * np.sqrt(2.0 / 450.0) * one.std()


# --- what is refused ------------------------------------------------------------------------------


def test_wrong_choices_are_refused_with_a_mend() -> None:
    capture = plates([1.45, 1.55], 0.02)
    for pooled, said in (
        ("refractive_index", "is no tuple of names"),
        (("index",), "is no parameter of a material"),
        ((), "nothing is pooled"),
    ):
        with pytest.raises(pb.FitError, match=said):
            pb.models.Hierarchical(pooled=pooled)
    with pytest.raises(pb.FitError, match="the scene does not read roughness"):
        fit(capture, model=pb.models.Hierarchical(pooled=("roughness",)))
    with pytest.raises(pb.FitError, match="no axis patch or material"):
        fit(capture.isel(patch=0))
