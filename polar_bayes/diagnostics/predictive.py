"""Would the fitted model produce these readings? PIT, leave-one-out, coverage and residuals.

One observation is one reading: one variable, view and wavelength. Readings that are masked, set
aside or saturated are left out; a saturated one says only "at least full scale", so the others
are compared with those predictions that are below full scale too.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping

import numpy as np
import xarray as xr
from arviz_stats.base import array_stats
from arviz_stats.ecdf_utils import ecdf_pit

from polar_bayes.diagnostics.parameters import (
    APPROXIMATIONS,
    SAMPLE_DIMS,
    method_of,
    posterior_scalars,
    stats_of,
)
from polar_bayes.inference.files import check_fit

PROBABILITIES = (0.5, 0.8, 0.95)
BAND = 0.95
LARGEST_PARETO_K = 0.7
LEAST_DRAWS = 100
BAND_SIMULATIONS = 1000
LARGEST_BAND = 500


@dataclasses.dataclass(frozen=True, eq=False)
class Loo:
    """Leave-one-out cross-validation by smoothed importance sampling."""

    elpd: float
    standard_error: float
    p_loo: float
    pareto_k: np.ndarray
    pit: np.ndarray
    parts: np.ndarray

    @property
    def unreliable(self) -> int:
        """How many readings have a Pareto k above 0.7."""
        return int(np.sum(~(self.pareto_k <= LARGEST_PARETO_K)))


@dataclasses.dataclass(frozen=True, eq=False)
class Check:
    """How one recorded variable compares with its prediction."""

    name: str
    count: int
    residual_rms: float
    pit: np.ndarray
    coverage: Mapping[float, float]
    loo: Loo | None


@dataclasses.dataclass(frozen=True, eq=False)
class Band:
    """Empirical distribution of PIT values minus the uniform, with a simultaneous band."""

    at: np.ndarray
    difference: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def leaves(self) -> bool:
        """True where the curve leaves the band anywhere."""
        outside = (self.difference < self.lower - 1e-9) | (self.difference > self.upper + 1e-9)
        return bool(np.any(outside))


def predictive_checks(result: xr.DataTree) -> dict[str, Check]:
    """Compare every recorded variable with its prediction."""
    check_fit(result)
    efficiency = _relative_efficiency(result)
    correction = _correction(result)
    checks = {}
    for name in result["observed_data"].data_vars if "observed_data" in result.children else ():
        part = _select(result, str(name))
        if part is not None and part.observed.size:
            checks[str(name)] = _check(part, efficiency, correction)
    return checks


def pit_band(pit: np.ndarray) -> Band | None:
    """Where PIT values leave the uniform distribution, judged at all places at once."""
    # Source: Saeilynoja et al. (2022), Statistics and Computing 32, 32.
    pit = pit[np.isfinite(pit)]
    if pit.size < 2:
        return None
    # Beyond a few hundred values a coarser grid draws the same curve at a fraction of the cost.
    pit = pit[:: -(-pit.size // LARGEST_BAND)]
    at, lower, upper = _uniform_band(pit.size)
    ecdf = np.searchsorted(np.sort(pit), at, side="right") / pit.size
    ecdf[[0, -1]] = 0.0, 1.0
    return Band(at=at, difference=ecdf - at, lower=lower - at, upper=upper - at)


@functools.lru_cache(maxsize=64)
def _uniform_band(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places and edges of the band; they depend on the number of values only."""
    any_values = np.linspace(0.0, 1.0, size)
    at, _, lower, upper = ecdf_pit(
        any_values, BAND, BAND_SIMULATIONS, rng=np.random.default_rng(214)
    )
    return at, lower, upper


@dataclasses.dataclass(frozen=True, eq=False)
class _Part:
    """One variable with its readings flattened into one axis."""

    name: str
    observed: np.ndarray  # (reading,)
    predicted: np.ndarray  # (draw, reading)
    center: np.ndarray  # (draw, reading)
    log_likelihood: np.ndarray | None  # (draw, reading)
    full_scale: float


def _select(result: xr.DataTree, name: str) -> _Part | None:
    needed = ("posterior_predictive", "noise_free")
    if any(g not in result.children or name not in result[g].data_vars for g in needed):
        return None
    observed = result["observed_data"].to_dataset()[name]
    keep = usable(result, name)

    def flat(group: str) -> np.ndarray:
        draws = result[group][name].transpose(*SAMPLE_DIMS, *observed.dims).to_numpy()
        return draws.reshape(-1, *observed.shape)[:, keep]

    likelihood = "log_likelihood" in result.children and name in result["log_likelihood"].data_vars
    return _Part(
        name=name,
        observed=observed.to_numpy()[keep],
        predicted=flat("posterior_predictive"),
        center=flat("noise_free"),
        log_likelihood=flat("log_likelihood") if likelihood else None,
        full_scale=float(observed.attrs.get("saturation_level", math.inf)),
    )


def usable(result: xr.DataTree, name: str) -> np.ndarray:
    """Which readings can be compared with a prediction: finite, valid and not saturated."""
    observed = result["observed_data"].to_dataset()[name]
    keep = np.isfinite(observed.to_numpy())
    constants = result["constant_data"].to_dataset() if "constant_data" in result.children else {}
    for flag, wanted in (("valid", True), ("saturated", False)):
        if flag in constants:
            mask = constants[flag].broadcast_like(observed).transpose(*observed.dims).to_numpy()
            keep = keep & (mask.astype(bool) == wanted)
    return keep


def _check(part: _Part, efficiency: float, correction: np.ndarray | None) -> Check:
    with np.errstate(all="ignore"):  # the square of huge numbers overflows
        residual = part.observed - part.center.mean(axis=0)
        rms = float(np.sqrt(np.mean(residual**2)))
    draws = len(part.predicted)
    if draws < LEAST_DRAWS or not np.isfinite(part.predicted).all():
        return Check(part.name, part.observed.size, rms, np.empty(0), {}, None)
    pit = _pit(part, np.full(part.predicted.shape, 1.0 / draws))
    coverage = {p: float(np.mean(np.abs(2.0 * pit - 1.0) <= p)) for p in PROBABILITIES}
    loo = _loo(part, efficiency, correction)
    return Check(part.name, part.observed.size, rms, pit, coverage, loo)


def _pit(part: _Part, weights: np.ndarray) -> np.ndarray:
    """Weighted share of the predicted readings below each reading, ties broken at random."""
    weights = np.where(part.predicted < part.full_scale, weights, 0.0)
    below = np.sum(weights * (part.predicted < part.observed), axis=0)
    tied = np.sum(weights * (part.predicted == part.observed), axis=0)
    total = np.sum(weights, axis=0)
    at = np.random.default_rng(214).uniform(size=part.observed.size)
    return (below + at * tied) / np.where(total > 0.0, total, 1.0)


def _loo(part: _Part, efficiency: float, correction: np.ndarray | None) -> Loo | None:
    log_likelihood = part.log_likelihood
    if log_likelihood is None or not np.isfinite(log_likelihood).all():
        return None
    ratios = (0.0 if correction is None else correction[:, None]) - log_likelihood
    log_weights, pareto_k = np.zeros_like(ratios), np.full(part.observed.size, -np.inf)
    with np.errstate(all="ignore"):  # an extreme tail overflows: what is not known is NaN
        for i in np.flatnonzero(np.ptp(ratios, axis=0) > 1e-12):
            log_weights[:, i], pareto_k[i] = array_stats.psislw(-ratios[:, i], r_eff=efficiency)
        log_weights = log_weights - _log_sum(log_weights)
        elpd = _log_sum(log_weights + log_likelihood)
        base = 0.0 if correction is None else correction[:, None]
        flat = np.zeros_like(log_likelihood) + base
        p_loo = _log_sum(log_likelihood + flat - _log_sum(flat)) - elpd
    return Loo(
        elpd=float(np.sum(elpd)),
        standard_error=_standard_error(elpd),
        p_loo=float(np.sum(p_loo)),
        pareto_k=pareto_k,
        pit=_pit(part, np.exp(log_weights)),
        parts=elpd,
    )


def _standard_error(parts: np.ndarray) -> float:
    """Of a sum, from the spread of its parts."""
    return float(np.sqrt(parts.size * np.var(parts, ddof=1))) if parts.size > 1 else math.nan


def _log_sum(values: np.ndarray) -> np.ndarray:
    largest = np.max(values, axis=0)
    return largest + np.log(np.sum(np.exp(values - largest), axis=0))


def _relative_efficiency(result: xr.DataTree) -> float:
    """Effective over actual draws, averaged over the parameters; 1 for independent draws."""
    if method_of(result) != "nuts":
        return 1.0
    draws = np.stack([s.draws for s in posterior_scalars(result)])
    draws = draws[np.isfinite(draws).all(axis=(1, 2)) & (np.ptp(draws, axis=(1, 2)) > 0.0)]
    if not len(draws) or draws[0].size < LEAST_DRAWS:
        return 1.0
    return float(np.mean(array_stats.ess(draws, method="mean", relative=True)))


def _correction(result: xr.DataTree) -> np.ndarray | None:
    """Log weights that turn draws of an approximation into posterior draws, where stored."""
    stats = stats_of(result)
    if "log_weight" not in stats or method_of(result) not in APPROXIMATIONS:
        return None
    log_weight = stats["log_weight"].to_numpy().astype(float).ravel()
    return log_weight - log_weight.max() if np.isfinite(log_weight).all() else None
