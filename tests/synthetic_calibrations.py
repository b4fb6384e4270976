"""Calibrations made by hand: normal posteriors that are right, or wrong in a known way."""

import json

import numpy as np
import xarray as xr
from scipy import stats

from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.numerics.psis import LEVELS

CENTER, PRIOR_SD, NOISE = 0.5, 0.1, 0.05
NAMES = ("roughness", "subsurface_fraction", "refractive_index")


def make_calibration(
    *,
    names=NAMES,
    narrow=None,
    shifted=None,
    wavelengths=(),
    count=400,
    failed=(),
    readings=None,
    seed=0,
    **provenance,
):
    """Truths, readings and their posteriors, all normal.

    `narrow` multiplies the posterior sd of a parameter, `shifted` moves its mean by so many; all
    others are exact. `readings` adds ranks of readings, and says by what the spread of their
    predictions is wrong. Two calibrations of one seed are of the same simulations.
    """
    random = np.random.default_rng(seed)
    level = np.array(LEVELS)
    axes: dict = {"simulation": np.arange(count)}
    axes |= {"wavelength": list(wavelengths)} if wavelengths else {}
    groups: dict = {"prior_sbc": {}, "truth": {}, "marginals": {}}
    for name in names:
        dims = ("simulation", "wavelength") if wavelengths else ("simulation",)
        shape = tuple(len(axes[dim]) for dim in dims)
        truth = CENTER + PRIOR_SD * random.standard_normal(shape)
        reading = truth + NOISE * random.standard_normal(shape)
        weight = PRIOR_SD**2 / (PRIOR_SD**2 + NOISE**2)
        sd = np.full(shape, np.sqrt(weight) * NOISE * (narrow or {}).get(name, 1.0))
        mean = weight * reading + (1.0 - weight) * CENTER + (shifted or {}).get(name, 0.0) * sd
        mean[list(failed)] = sd[list(failed)] = np.nan
        z = (truth - mean) / sd
        score = sd * (z * (2.0 * stats.norm.cdf(z) - 1.0) + 2.0 * stats.norm.pdf(z))
        attributes = {"symbol": "", "units": "1"}
        quantile = mean + sd * stats.norm.ppf(level).reshape(-1, *[1] * mean.ndim)
        groups["prior_sbc"][name] = (dims, stats.norm.cdf(z), attributes)
        groups["truth"][name] = (dims, truth, attributes)
        groups["marginals"] |= {
            name: (dims, mean, attributes),
            f"{name}_sd": (dims, sd, attributes),
            f"{name}_quantile": (("quantile", *dims), quantile, attributes),
            f"{name}_crps": (dims, score - sd / np.sqrt(np.pi), attributes),
        }
    simulation = {"simulation": axes["simulation"]}
    datasets = {
        "prior_sbc": xr.Dataset(groups["prior_sbc"], axes),
        "truth": xr.Dataset(groups["truth"], axes),
        "marginals": xr.Dataset(groups["marginals"], {**axes, "quantile": level}),
        "fits": xr.Dataset(_fits(count, failed), simulation),
    }
    if readings is not None:
        told = _readings(readings, count, failed, random)
        datasets |= {group: xr.Dataset(values, simulation) for group, values in told.items()}
    tree = xr.DataTree.from_dict(datasets)
    about = {"calibration": count, "model": "per_material", "method": "importance"}
    about |= {"scene": "paper", "seed": seed, "capture": "leaf", "truth": {}}
    about |= {"priors": {"roughness": "Beta(2, 3)"}, "links": {"dop": "BetaLink()"}}
    tree.attrs["polar_bayes"] = json.dumps({**about, **provenance})
    return tree


def assert_held_as_stated(table, count):
    """Intervals hold the truth as often as they say, within 3.3 standard errors."""
    for percent in (50, 80, 95):
        share = percent / 100.0
        error = np.sqrt(share * (1.0 - share) / count)
        assert np.abs(table[f"held_{percent}"] - share).max() < 3.3 * error


def _readings(spread, count, failed, random):
    found: dict = {"predictive_pit": {}, "loo_pit": {}, "readings": {}}
    for name in ("dop", "intensity"):
        for group in ("predictive_pit", "loo_pit"):
            pit = stats.norm.cdf(random.standard_normal(count) / spread.get(name, 1.0))
            pit[list(failed)] = np.nan
            found[group][name] = ("simulation", pit)
        k = np.where(np.arange(count) % 10 == 0, 0.9, 0.2)
        found["readings"][f"{name}_pareto_k"] = ("simulation", k)
        found["readings"][f"{name}_view"] = ("simulation", np.arange(count) % 7)
    return found


def _fits(count: int, failed: tuple[int, ...]) -> dict:
    status, method = np.full(count, Status.GOOD), np.full(count, MethodUsed.IMPORTANCE)
    method[::4] = MethodUsed.NUTS
    status[list(failed)], method[list(failed)] = Status.NOT_CONVERGED, MethodUsed.NONE
    k = np.where(np.arange(count) % 10 == 0, 0.9, 0.2)
    draws = np.linspace(100.0, 500.0, count)
    k[list(failed)] = draws[list(failed)] = np.nan
    words = {"status": Status, "method": MethodUsed}
    flags = {name: " ".join(each.name.lower() for each in kinds) for name, kinds in words.items()}
    return {
        "status": ("simulation", status, {"flag_meanings": flags["status"]}),
        "method": ("simulation", method, {"flag_meanings": flags["method"]}),
        "pareto_k": ("simulation", k),
        "ess": ("simulation", draws),
    }
