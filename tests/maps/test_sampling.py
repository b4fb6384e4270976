"""Chains in a pixel: the posterior that a grid finds, and draws that follow the pixel's number."""

import jax
import numpy as np
import pytest
from arviz_stats.base import array_stats
from plate_images import NAMES, VIEWS, on_a_grid, planned, plate_image, stacked

from polar_bayes.inference.batch_engine import BatchEngine
from polar_bayes.inference.batch_method import random_keys
from polar_bayes.inference.batch_nuts import PixelNuts, sample_chains
from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.levenberg_marquardt import ModeSearch, NormalApproximation, find_modes

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

CHAINS = PixelNuts(chains=2, warmup=150, draws=1000)
WEAK = plate_image(1, 3, noise=0.15, views=VIEWS[[1, 4]], seed=7)


def _sampled(
    engine: BatchEngine, pixels: ObservationBatch, mode: NormalApproximation, numbers: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    return sample_chains(engine, CHAINS, pixels, mode.z, mode.root, random_keys(0, numbers))


@pytest.fixture(scope="module")
def made(compiled_in_haste: None) -> tuple[BatchEngine, ObservationBatch, ModeSearch]:
    plan = planned(WEAK)
    pixels = stacked(WEAK, plan)
    settled = find_modes(plan.engine, pixels)
    assert settled.converged.all()
    return plan.engine, pixels, settled


@pytest.fixture(scope="module")
def sampled(made) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    engine, pixels, settled = made
    return _sampled(engine, pixels, settled.mode, np.array([40, 50, 60]))


@pytest.mark.thorough
def test_a_skewed_pixel_has_the_posterior_of_a_grid(sampled) -> None:
    draws, r_hat, effective = sampled
    assert (r_hat < 1.02).all()
    assert (effective > 200.0).all()
    skewest = 0.0
    for pixel, q in enumerate(WEAK["q"].values[0]):
        for name, (mean, sd, skewness) in on_a_grid(q, 0.15, WEAK["view_zenith"].values).items():
            chains = draws[name][pixel].reshape(CHAINS.chains, CHAINS.draws)
            # Four Monte Carlo errors: 6e-5 a comparison, 8e-4 over these twelve.
            assert abs(chains.mean() - mean) < 4.0 * array_stats.mcse(chains, method="mean")
            assert abs(chains.std() - sd) < 4.0 * array_stats.mcse(chains, method="sd")
            skewest = max(skewest, abs(skewness))
    assert skewest > 0.5  # or a normal distribution would have done


@pytest.mark.thorough
def test_draws_follow_the_number_of_a_pixel_not_its_place(made, sampled) -> None:
    engine, pixels, settled = made
    order = np.array([2, 0])
    mode = jax.tree.map(lambda x: x[order], settled.mode)
    draws, r_hat, effective = _sampled(engine, pixels.subset(order), mode, np.array([60, 40]))
    for name, all_draws in sampled[0].items():
        assert draws[name].tobytes() == all_draws[order].tobytes(), name
    assert r_hat.tobytes() == sampled[1][order].tobytes()
    assert effective == pytest.approx(sampled[2][order])


def test_keys_differ_by_number_and_by_seed() -> None:
    numbers = np.array([0, 1, 2**31, 10**8])
    one = random_keys(0, numbers)
    assert len({tuple(key) for key in (*one, *random_keys(1, numbers))}) == 8
    assert (random_keys(0, numbers[::-1]) == one[::-1]).all()


@pytest.mark.thorough
def test_the_two_chains_of_a_pixel_are_not_the_same(sampled) -> None:
    chains = sampled[0][NAMES[0]].reshape(3, CHAINS.chains, CHAINS.draws)
    assert (chains[:, 0] != chains[:, 1]).any(axis=-1).all()
