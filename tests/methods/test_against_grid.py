"""Samplers against a brute-force posterior, which knows neither modes nor gradients."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from arviz_stats.base import array_stats
from cases import each
from numpyro import distributions as dist
from plates import LINKS, ON_PLATE, PLATE, plate_capture

import polar_bayes as pb
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.observation.data import observe

pytestmark = pytest.mark.usefixtures("without_comparisons")

POINTS = 61
HALF_WIDTH = 7.0
"""The grid spans so many Laplace standard deviations to each side, in unconstrained space."""

NAMES = ("subsurface_fraction", "refractive_index", "stokes_error_factor")

CASES = {
    # Many precise views: the posterior is nearly normal in the physical parameters.
    "near normal": plate_capture(np.linspace(20.0, 80.0, 60), 0.005, seed=11),
    # Three poor views: skewed, bounded by priors, far from normal.
    "far from normal": plate_capture(np.array([40.0, 57.0, 75.0]), 0.08, seed=12),
}


class Grid(NamedTuple):
    """Exact posterior on a fine grid: draws by index and their weights."""

    values: dict[str, np.ndarray]
    weights: np.ndarray

    def mean(self, name: str) -> float:
        return float(self.weights @ self.values[name])

    def sd(self, name: str) -> float:
        return float(np.sqrt(self.weights @ (self.values[name] - self.mean(name)) ** 2))

    def root_sd(self, name: str) -> float:
        """Sd of the square root: draws from a long tail determine their own sd poorly."""
        root = np.sqrt(self.values[name])
        return float(np.sqrt(self.weights @ (root - self.weights @ root) ** 2))

    def probability_below(self, name: str, value: float) -> float:
        return float(self.weights[self.values[name] <= value].sum())


@functools.cache
def fitted(name: str) -> xr.DataTree:
    """Long chains of a case."""
    settings = pb.methods.Nuts(draws=2000, most_draws=4000, ess=2000.0)
    return pb.fit(CASES[name], **ON_PLATE, method=settings, seed=1)


@functools.cache
def grid_posterior(case: str) -> Grid:
    """Evaluate the log density on a grid wide enough to hold all but 1e-8 of the mass."""
    request = resolve(CASES[case], "per_material", PLATE, None, LINKS, None, 0, "double")
    data = observe(request.capture)
    program = compile_program(request.bind(), data)
    posterior = fitted(case)["posterior"].dataset
    # Axes: the unconstrained coordinates in the program's order, around the sampled range,
    # widened by half on each side; the density at the border proves that nothing is cut off.
    axes = []
    for name in sorted(NAMES):
        to_line = dist.biject_to(program.supports[name]).inv
        values = np.asarray(to_line(posterior[name].to_numpy().ravel()))
        middle, reach = np.median(values), np.ptp(values)
        axes.append(np.linspace(middle - reach, middle + reach, POINTS))
    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    density = jax.jit(
        lambda z, d: jax.lax.map(lambda x: -program.potential(x, d), z, batch_size=999)
    )
    log_density = np.asarray(density(jnp.asarray(mesh), data))
    weights = np.exp(log_density - log_density.max())
    weights /= weights.sum()
    border = np.zeros((POINTS,) * len(axes), bool)
    for axis in range(len(axes)):
        border.swapaxes(0, axis)[[0, -1]] = True
    assert weights[border.ravel()].sum() < 1e-4
    constrained = jax.jit(jax.vmap(program.constrain))(jnp.asarray(mesh))
    return Grid({name: np.asarray(constrained[name]) for name in NAMES}, weights)


@each("case", ["far from normal", "near normal"], quick=1)
def test_nuts_agrees_with_the_grid_everywhere(case: str) -> None:
    grid = grid_posterior(case)
    for name in NAMES:
        draws = fitted(case)["posterior"][name].to_numpy()
        # Four Monte Carlo standard errors: 6e-5 a comparison, 2e-3 over the 30 of this file.
        # The grid's own error, a trapezoid rule on a smooth density, is far below.
        error = array_stats.mcse(draws, method="mean")
        assert abs(draws.mean() - grid.mean(name)) < 4.0 * error, name
        root = np.sqrt(draws)
        spread_error = array_stats.mcse(root, method="sd")
        assert abs(root.std() - grid.root_sd(name)) < 4.0 * spread_error, name
        for probability in (0.025, 0.25, 0.75, 0.975):
            quantile = np.quantile(draws, probability)
            effective = array_stats.ess(draws, method="quantile", prob=probability)
            tolerance = 4.0 * np.sqrt(probability * (1.0 - probability) / effective)
            # One grid step of mass: the grid's distribution function has steps.
            step = grid.weights[np.argsort(np.abs(grid.values[name] - quantile))[: POINTS**2]].sum()
            assert abs(grid.probability_below(name, quantile) - probability) < tolerance + step


@pytest.mark.thorough
def test_laplace_agrees_with_the_grid_where_the_posterior_is_near_normal() -> None:
    grid = grid_posterior("near normal")
    result = pb.fit(CASES["near normal"], **ON_PLATE, method="laplace", seed=1)
    for name in ("refractive_index", "subsurface_fraction"):
        draws = result["posterior"][name].to_numpy()
        # Monte Carlo error of 2,000 independent draws is 0.02 sd; the rest is Laplace's own error.
        assert abs(draws.mean() - grid.mean(name)) < 0.2 * grid.sd(name), name
        assert draws.std() == pytest.approx(grid.sd(name), rel=0.15), name
