"""Crowds from the prior, and mixtures fitted to them: two modes, a skewed pixel, densities."""

import dataclasses
import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
import scipy.stats
from cases import each
from numpyro import distributions as dist
from plate_images import VIEWS, on_a_grid, planned, plate_image, stacked
from plates import plate_capture

import polar_bayes as pb
from polar_bayes.inference.batch_engine import BatchEngine
from polar_bayes.inference.batch_nuts import PixelNuts
from polar_bayes.inference.batching import MethodUsed, ObservationBatch, Status
from polar_bayes.inference.program import Program, compile_program
from polar_bayes.inference.proposals import (
    DEGREES_OF_FREEDOM,
    Proposed,
    combine_samples,
    draw_mixture,
    fit_mixture,
    log_density,
    moments,
)
from polar_bayes.inference.psis import effective_draws, effective_tails, smooth
from polar_bayes.inference.smc import PixelSMC, _mixture_draws, _particles, temper
from polar_bayes.observation.data import Observations, observe

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

SETTINGS = PixelSMC()
WEAK = plate_image(1, 3, noise=0.15, views=VIEWS[[1, 4]], seed=7)
FAR, WIDTH = 2.0, 0.02


def two_sided(data: Observations) -> None:
    """Readings that know how far x is from 0, and not on which side; y is free."""
    x = numpyro.sample("x", dist.Normal(0.0, 3.0))
    numpyro.sample("y", dist.Normal(0.0, 1.0))
    with numpyro.plate("view", data.shape[-1]):
        numpyro.sample("q", dist.Normal(jnp.abs(x) - FAR, WIDTH), obs=jnp.zeros(data.shape[-1]))


@pytest.fixture(scope="module")
def two_modes() -> tuple[Program, Observations]:
    data = observe(plate_capture(np.array([40.0]), 0.03, seed=0)).in_single_precision()
    return compile_program(two_sided, data), data


@pytest.fixture(scope="module")
def crowd(two_modes: tuple[Program, Observations]) -> tuple[np.ndarray, np.ndarray]:
    """Places and weights."""
    program, data = two_modes
    with jax.enable_x64(False):
        found = jax.jit(lambda data, key: temper(program, SETTINGS, data, key))(
            data, jax.random.key(0)
        )
    assert float(found.temperature) == 1.0
    assert int(found.stages) >= 2
    return np.asarray(found.transform.inverse(found.u)[0]), np.asarray(found.weights)


def test_a_crowd_is_in_both_modes_and_wide_where_nothing_is_known(crowd: tuple) -> None:
    (x, y), weights = crowd[0].T, crowd[1]
    assert weights.sum() == pytest.approx(1.0, abs=1e-5)
    assert 1.0 / np.sum(weights**2) >= 0.5 * SETTINGS.num_particles - 1.0
    # Two in a thousand million of a normal distribution are further out than six widths.
    assert weights @ (np.abs(np.abs(x) - FAR) > 6.0 * WIDTH) < 1e-5
    # 256 walks thinned at each of some stages: the share of a side scatters by about 0.1.
    assert 0.1 < weights @ (x > 0.0) < 0.9
    assert 0.6 < np.sqrt(weights @ y**2 - (weights @ y) ** 2) < 1.4


@pytest.mark.thorough
def test_weighted_draws_of_its_mixture_are_the_posterior(two_modes, crowd: tuple) -> None:
    program, data = two_modes
    count = 4096
    with jax.enable_x64(False):
        mixture = fit_mixture(*(jnp.asarray(x) for x in crowd), 4, jax.random.key(1))
        z = draw_mixture(mixture, count, jax.random.key(2))
        told = log_density(mixture, z)
        values = jax.vmap(lambda z: program.potential(z, data))(z)
    weights, pareto_k = smooth(np.asarray(-values - told)[None])
    assert pareto_k[0] < 0.7
    x, y = np.asarray(z, float).T
    worth = effective_draws(weights)[0]
    assert worth >= SETTINGS.effective_draws
    # Four Monte Carlo errors each: three comparisons fail by chance twice in ten thousand.
    assert abs(weights[0] @ (x > 0.0) - 0.5) < 4.0 * 0.5 / np.sqrt(worth)
    assert abs(weights[0] @ y) < 4.0 / np.sqrt(worth)
    assert abs(weights[0] @ y**2 - 1.0) < 4.0 * np.sqrt(2.0 / worth)


@pytest.mark.thorough
def test_the_density_of_a_mixture_is_that_of_its_parts() -> None:
    random = np.random.default_rng(0)
    z = random.normal(size=(400, 2)) @ np.array([[1.0, 0.4], [0.0, 0.2]]) + np.array([3.0, -5.0])
    mixture = fit_mixture(jnp.asarray(z), jnp.full(400, 1.0 / 400), 3, jax.random.key(0))
    drawn = draw_mixture(mixture, 256, jax.random.key(1))
    center, half = np.asarray(mixture.center), np.asarray(mixture.half)
    expected = np.zeros(256)
    for log_share, mean, scale in zip(*(np.asarray(x) for x in mixture[2:]), strict=True):
        root = half @ scale
        part = scipy.stats.multivariate_t(center + half @ mean, root @ root.T, DEGREES_OF_FREEDOM)
        expected += np.exp(log_share) * part.pdf(np.asarray(drawn))
    difference = np.asarray(log_density(mixture, drawn)) - np.log(expected)
    assert np.exp(np.asarray(mixture.log_share)).sum() == pytest.approx(1.0)
    assert np.ptp(difference) < 1e-9  # up to a constant


def test_spread_is_mean_and_covariance_of_weighted_draws() -> None:
    random = np.random.default_rng(1)
    z, weights = random.normal(size=(50, 3)) * [1.0, 1e-3, 1e3], random.dirichlet(np.ones(50))
    center, half = (np.asarray(x) for x in moments(jnp.asarray(z), jnp.asarray(weights)))
    assert center == pytest.approx(np.average(z, axis=0, weights=weights))
    covariance = np.cov(z.T, aweights=weights, ddof=0)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert np.abs(half @ half.T - covariance).max() < 2e-6 * scale.max()
    assert np.abs((half @ half.T - covariance) / scale).max() < 2e-6  # what the lift adds


Found = dict[int, tuple[dict[str, np.ndarray], np.ndarray]]
"""Of each pixel its draws by name, and their weights."""


def fitted(engine: BatchEngine, settings: PixelSMC | PixelNuts, pixels: ObservationBatch):
    found: Found = {}

    def describe(at: np.ndarray, parameters: dict, weights: np.ndarray) -> None:
        for row, pixel in enumerate(at):
            draws = {name: x[row] for name, x in parameters.items()}
            found[int(pixel)] = draws, weights[row]

    numbers = np.arange(len(pixels))
    return settings.run_batch(engine, pixels, numbers, 0, describe), found


@pytest.mark.thorough
def test_an_engine_goes_when_nobody_holds_it() -> None:
    """Its programs are its own, one for each setting."""
    plan = planned(WEAK)
    engine = BatchEngine(
        plan.engine.program, plan.engine.single_program, plan.engine.layout, "single"
    )
    first = engine.compiled(_particles, SETTINGS)
    assert engine.compiled(_particles, SETTINGS) is first
    assert engine.compiled(_mixture_draws, SETTINGS) is not first
    other = dataclasses.replace(SETTINGS, rounds=SETTINGS.rounds + 1)
    assert engine.compiled(_particles, other) is not first
    gone = weakref.ref(engine)
    del engine, first
    gc.collect()
    assert gone() is None


@pytest.mark.thorough
def test_chains_begin_in_every_mode_and_tempered_draws_stay_where_they_do_not_mix() -> None:
    plan = planned(WEAK)
    pixels = stacked(WEAK, plan).subset(np.zeros(32, int))
    with jax.enable_x64(False):
        layout = pixels.in_precision(np.float32).pixel()
        program = compile_program(two_sided, layout)
    engine = BatchEngine(program, program, layout, "single")
    chains = PixelNuts(start=SETTINGS)
    outcome, found = fitted(engine, chains, pixels)
    sampled = outcome.approach == MethodUsed.NUTS
    assert (outcome.status == np.where(sampled, Status.GOOD, Status.NOT_TRUSTED)).all()
    assert (outcome.approach[~sampled] == MethodUsed.TEMPERED).all()
    # Two chains begin on one side each other time: fewer than 6 or more than 26 do in one of 9000
    # cases, and all that do on the same side in one of 5000.
    assert 6 <= sampled.sum() <= 26
    sides = np.array([np.mean(found[pixel][0]["x"] > 0.0) for pixel in range(32)])
    assert set(sides[sampled]) == {0.0, 1.0}
    assert (np.abs(sides[~sampled] - 0.5) < 0.3).all()


@pytest.mark.thorough
@each("chains", [False, True])
def test_skewed_pixels_have_the_posteriors_of_a_grid(chains: bool) -> None:
    plan = planned(WEAK)
    settings = PixelNuts(draws=1000, start=SETTINGS) if chains else SETTINGS
    # Each pixel eight times, with draws of its own: what one fit hides in its scatter, eight show.
    pixels = stacked(WEAK, plan).subset(np.tile(np.arange(3), 8))
    outcome, found = fitted(plan.engine, settings, pixels)
    assert (outcome.status == Status.GOOD).all()
    assert (outcome.approach == (MethodUsed.NUTS if chains else MethodUsed.TEMPERED)).all()
    if not chains:  # chains promise an R-hat, and are as long as they were asked to be
        assert (outcome.effective_draws >= SETTINGS.effective_draws).all()
    for pixel, q in enumerate(WEAK["q"].values[0]):
        for name, (mean, sd, _) in on_a_grid(q, 0.15, WEAK["view_zenith"].values).items():
            told, error = np.zeros(8), np.zeros(8)
            for fit in range(8):
                draws, weights = found[pixel + 3 * fit]
                told[fit] = weights @ draws[name]
                # Of a ratio of weighted sums, or of as many draws as chains are worth.
                weighted = np.sqrt(np.sum(weights**2 * (draws[name] - told[fit]) ** 2))
                worth = outcome.effective_draws[pixel + 3 * fit]
                error[fit] = sd / np.sqrt(worth) if chains else weighted
            # Four errors of the mean of eight: 8e-4 over these twelve.
            assert abs(told.mean() - mean) < 4.0 * np.sqrt(np.sum(error**2)) / 8
            assert (error < 0.1 * sd).all()


@each(
    ("settings", "said"),
    [
        ({"num_chains": 4}, "num_chains is 4; give 16 or more"),
        ({"rounds": 1}, "rounds is 1; give 2 or more"),
        ({"init_factor": 0}, "init_factor is 0; give 1 or more"),
        ({"target_ess": 0.99}, "target_ess is 0.99; give a number from 0.1 to 0.95"),
        ({"draws": 800}, "draws is 800, of 2048 particles; give at least half of num_chains"),
        ({"effective_draws": 5000.0}, "effective_draws is 5000.0, of 4096 draws"),
    ],
)
def test_mistakes_are_told(settings: dict, said: str) -> None:
    with pytest.raises(pb.FitError, match=said):
        pb.methods.PixelSMC(**settings)


def test_two_mixtures_are_weighed_as_one() -> None:
    """A mixture that sees half of the posterior, and one that sees the other: both together see it.

    The posterior is normal in two coordinates; alone, neither mixture knows its mean.
    """
    count, random = 4096, np.random.default_rng(5)
    parts = []
    for side in (-1.0, 1.0):
        crowd = random.normal([side, 0.0], [0.5, 1.0], (256, 2)).astype(np.float32)
        even = jnp.full(256, np.float32(1.0 / 256))
        with jax.enable_x64(False):
            mixture = fit_mixture(jnp.asarray(crowd), even, 2, jax.random.key(int(side) + 7))
            z = draw_mixture(mixture, count, jax.random.key(int(side) + 11))
        rows = jax.tree.map(lambda x: np.asarray(x)[None], mixture)
        log_posterior = -0.5 * np.sum(np.asarray(z) ** 2, axis=-1)[None]
        parts.append(Proposed(rows, np.asarray(z)[None], {"z": np.asarray(z)[None]}, log_posterior))
    found = combine_samples(*parts)
    worth = found.ess[0]
    assert 1000.0 < worth < 2 * count
    told = found.weights[0] @ found.z[0]
    spread = found.weights[0] @ found.z[0] ** 2
    # Four Monte Carlo errors each: four comparisons fail by chance three times in ten thousand.
    assert np.abs(told).max() < 4.0 / np.sqrt(worth)
    assert np.abs(spread - 1.0).max() < 4.0 * np.sqrt(2.0 / worth)


@pytest.mark.thorough
def test_tails_are_worth_less_where_few_draws_tell_them() -> None:
    random = np.random.default_rng(3)
    z = random.normal(size=(2, 4000, 2))
    even = np.full((2, 4000), 1.0 / 4000)
    # Even weights: as many draws as there are. The quantile is an order statistic: one draw off.
    assert effective_tails(z, even) == pytest.approx(4000.0, rel=0.01)
    heavy = even.copy()
    at = np.argsort(z[0, :, 1])[-200:]  # the upper tail of one coordinate, told by one in ten
    heavy[0, at] = 0.0
    heavy[0, at[::10]] = 10.0 / 4000
    worth = effective_tails(z, heavy)
    assert worth[1] == pytest.approx(4000.0, rel=0.01)
    assert 300.0 < worth[0] < 700.0  # 20 draws for a tail of 5%: 20 / 0.05 = 400


@pytest.mark.thorough
def test_a_tail_that_one_draw_carries_is_worth_as_little_above_as_below() -> None:
    z = np.linspace(-1.0, 1.0, 1000)[None, :, None]
    heavy = np.full((1, 1000), 0.93 / 999)
    heavy[0, -1] = 0.07  # the highest draw alone is more than the tail
    above = effective_tails(z, heavy)
    assert above == pytest.approx(effective_tails(-z, heavy))
    assert 10.0 < above[0] < 20.0  # p (1 - p) / (p^2 (1 - p)^2) = 1 / (.07 * .93) = 15.4
    alone = np.zeros((1, 1000))
    alone[0, 500] = 1.0
    assert effective_tails(z, alone) == pytest.approx(1.0)
