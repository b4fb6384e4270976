"""Posterior predictive checks: residuals, PIT, coverage and leave-one-out cross-validation.

One observation is one reading: one variable, view and wavelength. Readings that are masked, set
aside or saturated are left out; a saturated one says only "at least full scale", so the others
are compared with those predictions that are below full scale too.

Source: Vehtari, Gelman & Gabry (2017), Stat. Comput. 27, 1413 (PSIS-LOO); Saeilynoja, Buerkner &
Vehtari (2022), Stat. Comput. 32, 32 (bands of PIT values).
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import xarray as xr
from arviz_stats.base import array_stats
from arviz_stats.ecdf_utils import ecdf_pit
from scipy.special import logsumexp

from polar_bayes.diagnostics.parameters import APPROXIMATIONS, MIN_DRAWS, SAMPLE_DIMS
from polar_bayes.diagnostics.view import FitView, once
from polar_bayes.numerics.psis import MAX_PARETO_K, smooth

PROBABILITIES = (0.5, 0.8, 0.95)


@dataclasses.dataclass(frozen=True, eq=False)
class Loo:
    """Leave-one-out cross-validation by Pareto-smoothed importance sampling."""

    elpd: float
    standard_error: float
    p_loo: float
    pareto_k: np.ndarray
    pit: np.ndarray
    pointwise: np.ndarray

    @property
    def unreliable(self) -> int:
        """Number of readings with a Pareto k above 0.7."""
        return int(np.sum(~(self.pareto_k <= MAX_PARETO_K)))


@dataclasses.dataclass(frozen=True, eq=False)
class PredictiveCheck:
    """Comparison of one recorded variable with its prediction."""

    name: str
    count: int
    residual_rms: float
    pit: np.ndarray
    coverage: Mapping[float, float]
    loo: Loo | None


@once
def predictive_checks(fit: FitView) -> dict[str, PredictiveCheck]:
    """Compare every recorded variable with its prediction."""
    relative_ess, correction = _relative_ess(fit), _correction(fit)
    return {v.name: _check(v, relative_ess, correction) for v in flat_variables(fit)}


def pit_band(pit: np.ndarray, most: int = 500) -> xr.Dataset | None:
    """Empirical distribution of PIT values minus the uniform, with a simultaneous band.

    Returns:
        `difference`, and the band from `lower` to `upper`, over `at`; None for fewer than two.
    """
    pit = pit[np.isfinite(pit)]
    if pit.size < 2:
        return None
    # Beyond a few hundred values a coarser grid draws the same curve at a fraction of the cost.
    pit = pit[:: -(-pit.size // most)]
    at, lower, upper = _uniform_band(pit.size)
    ecdf = np.searchsorted(np.sort(pit), at, side="right") / pit.size
    ecdf[[0, -1]] = 0.0, 1.0
    curves = {"difference": ecdf, "lower": lower, "upper": upper}
    return xr.Dataset({name: ("at", curve - at) for name, curve in curves.items()}, {"at": at})


@functools.lru_cache(maxsize=64)
def _uniform_band(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points and edges of the band, which depend on the number of values only."""
    values, random = np.linspace(0.0, 1.0, size), np.random.default_rng(214)
    at, _, lower, upper = ecdf_pit(values, ci_prob=0.95, n_simulations=1000, rng=random)
    return at, lower, upper


def usable_readings(
    result: xr.DataTree,
    name: str,
    flags: Mapping[str, bool] = MappingProxyType({"valid": True, "saturated": False}),
) -> np.ndarray:
    """Which readings are finite and have these flags: by default, those of a fair comparison."""
    observed = result["observed_data"].to_dataset()[name]
    usable = np.isfinite(observed.to_numpy())
    constants = result["constant_data"].to_dataset() if "constant_data" in result.children else {}
    for flag in flags.keys() & constants.keys():
        mask = constants[flag].variable.set_dims(observed.sizes).to_numpy()
        usable = usable & (mask.astype(bool) == flags[flag])
    return usable


@dataclasses.dataclass(frozen=True, eq=False)
class FlatVariable:
    """One variable, its readings flattened into one axis."""

    name: str
    usable: np.ndarray  # bool, in the shape of the readings
    observed: np.ndarray  # (reading,)
    predicted: np.ndarray  # (draw, reading)
    noise_free: np.ndarray  # (draw, reading)
    log_likelihood: np.ndarray | None  # (draw, reading)
    full_scale: float


def _select(result: xr.DataTree, name: str) -> FlatVariable | None:
    observed = result["observed_data"].to_dataset()[name]
    usable = usable_readings(result, name)

    def flat(group: str) -> np.ndarray | None:
        if group not in result.children or name not in result[group].data_vars:
            return None
        draws = result[group][name].transpose(*SAMPLE_DIMS, *observed.dims).to_numpy()
        return draws.reshape(-1, *observed.shape)[:, usable]

    predicted, noise_free = flat("posterior_predictive"), flat("noise_free")
    if predicted is None or noise_free is None:
        return None
    full_scale = float(observed.attrs.get("saturation_level", math.inf))
    readings, log_likelihood = observed.to_numpy()[usable], flat("log_likelihood")
    return FlatVariable(name, usable, readings, predicted, noise_free, log_likelihood, full_scale)


@once
def flat_variables(fit: FitView) -> list[FlatVariable]:
    """Return the recorded variables that have readings and predictions."""
    result = fit.result
    names = result["observed_data"].data_vars if "observed_data" in result.children else ()
    found = (_select(result, str(name)) for name in names)
    return [variable for variable in found if variable is not None and variable.observed.size]


def _check(
    variable: FlatVariable, relative_ess: float, correction: np.ndarray | None
) -> PredictiveCheck:
    name, observed, predicted = variable.name, variable.observed, variable.predicted
    with np.errstate(all="ignore"):  # predictions may be infinite
        residual = observed - variable.noise_free.mean(axis=0)
        rms = float(np.sqrt(np.mean(residual**2)))
    if len(predicted) < MIN_DRAWS or not np.isfinite(predicted).all():
        return PredictiveCheck(name, observed.size, rms, np.empty(0), {}, None)
    pit = _pit(variable, np.full(predicted.shape, 1.0 / len(predicted)))
    coverage = {p: float(np.mean(np.abs(2.0 * pit - 1.0) <= p)) for p in PROBABILITIES}
    loo = _loo(variable, relative_ess, correction)
    return PredictiveCheck(name, observed.size, rms, pit, coverage, loo)


def _pit(variable: FlatVariable, weights: np.ndarray) -> np.ndarray:
    """Return the weighted share of predictions below each reading, ties broken at random."""
    weights = np.where(variable.predicted < variable.full_scale, weights, 0.0)
    below = np.sum(weights * (variable.predicted < variable.observed), axis=0)
    tied = np.sum(weights * (variable.predicted == variable.observed), axis=0)
    total = np.sum(weights, axis=0)
    uniform = np.random.default_rng(214).uniform(size=variable.observed.size)
    return (below + uniform * tied) / np.where(total > 0.0, total, 1.0)


def _loo(variable: FlatVariable, relative_ess: float, correction: np.ndarray | None) -> Loo | None:
    log_likelihood = variable.log_likelihood
    if log_likelihood is None or not np.isfinite(log_likelihood).all():
        return None
    base = np.zeros((len(log_likelihood), 1)) if correction is None else correction[:, None]
    ratios, count = base - log_likelihood, variable.observed.size
    weights, pareto_k = (x.T for x in smooth(ratios.T, relative_ess))
    # Weights that differ but have a flat tail, k = 0, are those of chains that stand still.
    pareto_k = np.where(pareto_k == 0.0, np.inf, pareto_k)
    pareto_k = np.where(np.ptp(ratios, axis=0) > 1e-12, pareto_k, -np.inf)
    with np.errstate(all="ignore"):  # an extreme tail overflows: what is not known is NaN
        elpd = logsumexp(log_likelihood, b=weights, axis=0)
        p_loo = logsumexp(log_likelihood + base, axis=0) - logsumexp(base) - elpd
    error = np.sqrt(count * np.var(elpd, ddof=1)) if count > 1 else math.nan
    return Loo(
        elpd=float(np.sum(elpd)),
        standard_error=float(error),
        p_loo=float(np.sum(p_loo)),
        pareto_k=pareto_k,
        pit=_pit(variable, weights),
        pointwise=elpd,
    )


def _relative_ess(fit: FitView) -> float:
    """Return effective over actual draws, averaged over parameters; 1 if independent."""
    if fit.method != "nuts":
        return 1.0
    draws = np.stack([s.draws for s in fit.scalars])
    draws = draws[np.isfinite(draws).all(axis=(1, 2))]
    draws = draws[np.ptp(draws, axis=(1, 2)) > 0.0]
    if not len(draws) or draws[0].size < MIN_DRAWS:
        return 1.0
    return float(np.mean(array_stats.ess(draws, method="mean", relative=True)))


def _correction(fit: FitView) -> np.ndarray | None:
    """Return log weights that turn draws of an approximation into posterior draws."""
    if "log_weight" not in fit.stats or fit.method not in APPROXIMATIONS:
        return None
    log_weight = fit.stats["log_weight"].to_numpy().astype(float).ravel()
    return log_weight - log_weight.max() if np.isfinite(log_weight).all() else None
