r"""How the posterior moves with what the set-up is known to, without another fit.

$$ \frac{d\,\mathrm E[\theta]}{d e} =
   \operatorname{Cov}\left(\theta, \frac{\partial}{\partial e} \log p(y \mid z, e)\right) $$

over the posterior given the readings y, exactly to first order in the input quantity e, whatever
the shape of the posterior. The derivative of the density is a difference at each draw. There are
two estimates of the covariance. One is that of the draws. The other takes what is linear in z from
slopes and Cov(z), which by Stein's identity is the inverse of the slope of the gradient of the
potential by z: it has no Monte Carlo error where the posterior is normal, and much where it is a
funnel. The one with the smaller error, by a jackknife over groups of draws, is taken.

Source:
    Gustafson (1996), Annals of Statistics 24, 174-195; Giordano, Broderick and Jordan (2018), JMLR
    19(51), 1-49. Stein (1981), Annals of Statistics 9, 1135-1151.
"""

import dataclasses

import numpy as np
import xarray as xr
from jaxtyping import Float

from polar_bayes.capture.input_quantities import AbstractInputQuantity
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.program import Draw
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import dims_of, shape_of
from polar_bayes.observation.data import Observations, observe

STATISTICS = ("shift", "mcse")
"""What is known of every parameter and quantity: the shift and its Monte Carlo standard error."""


def mean_shifts(
    request: Request,
    problem: Problem,
    z: np.ndarray,
    posterior: Draw,
    *,
    most_draws: int = 1000,
    step: float = 0.1,
) -> xr.Dataset | None:
    """Change of the posterior mean where a quantity is off by its standard uncertainty.

    Args:
        request: What was asked for; its set-up states what it is known to.
        problem: The posterior.
        z: Draws, shape (chain, draw, size).
        posterior: The same draws, described.
        most_draws: At how many of them derivatives are taken.
        step: Of their differences, in standard uncertainties: densities are linear in it, and
            change by far more than rounding.

    Returns:
        Every parameter of the posterior by `statistic` (the shift and its Monte Carlo standard
        error, in the unit of the parameter) and `quantity`; and of each quantity its
        `standard_uncertainty`, `unit` and `meaning`. None where the set-up states no quantity.
    """
    quantities = request.known
    if not quantities:
        return None
    flat = z.reshape(-1, z.shape[-1])
    some = np.unique(np.linspace(0, len(flat) - 1, most_draws).round().astype(int))
    z, log_density = flat[some], np.asarray(posterior.log_density).ravel()[some]
    gradient = problem.program.value_and_gradient
    slopes = np.array([gradient(each, problem.data)[1] for each in z.astype(problem.dtype)], float)
    rates = [
        (problem.log_density(z, _shifted(request, problem, each, step)) - log_density) / step
        for each in quantities
    ]
    program, dims, parameters = problem.program, dims_of(problem.program), posterior.parameters
    columns = [np.asarray(x, float).reshape(len(flat), -1)[some] for x in parameters.values()]
    shifts = _covariances(z, slopes, np.stack(rates, axis=1), np.hstack(columns))
    ends = np.cumsum([each.shape[1] for each in columns])[:-1]
    dims_of_shift = ("statistic", "quantity")
    found = {
        name: ((*dims_of_shift, *dims[name]), x.reshape(*x.shape[:2], *shape_of(program, name)))
        for name, x in zip(parameters, np.split(shifts, ends, axis=-1), strict=True)
    }
    stated = ("standard_uncertainty", "unit", "meaning")
    of_each = {name: ("quantity", [getattr(each, name) for each in quantities]) for name in stated}
    labels = {"statistic": list(STATISTICS), "quantity": [each.name for each in quantities]}
    return xr.Dataset(found | of_each, coords=labels)


def _shifted(
    request: Request, problem: Problem, quantity: AbstractInputQuantity, step: float
) -> Observations:
    """The readings and directions of an instrument that is off by a step; noise and masks stay."""
    data = problem.data
    capture = quantity.shifted(request.capture, step * quantity.standard_uncertainty)
    unit = float(data.intensity_unit)
    moved = observe(capture, intensity_unit=unit, padded=data.views is not None)
    if data.brightness.dtype == np.float32:
        moved = moved.in_single_precision()
    return dataclasses.replace(data, geometry=moved.geometry, readings=moved.readings)


def _covariances(
    z: Float[np.ndarray, "draw size"],
    gradient: Float[np.ndarray, "draw size"],
    rates: Float[np.ndarray, "draw quantity"],
    values: Float[np.ndarray, "draw value"],
    parts: int = 10,
) -> Float[np.ndarray, "2 quantity value"]:
    """Covariances of values with rates over the draws, and their standard errors."""
    known = np.isfinite(rates).any(axis=0)
    rates = np.where(known, rates, 0.0)
    finite = np.isfinite(np.hstack([gradient, rates, values])).all(axis=1)
    draws = tuple(each[finite] for each in (z, gradient, rates, values))
    groups = np.arange(len(draws[0])) * parts // max(len(draws[0]), 1)
    estimates = _estimates(*draws)
    without = np.stack([_estimates(*(x[groups != g] for x in draws)) for g in range(parts)])
    errors = np.sqrt((parts - 1.0) * without.var(axis=0))
    best = np.argmin(errors, axis=0)[None]
    found = np.concatenate([np.take_along_axis(x, best, 0) for x in (estimates, errors)])
    return np.where(known[:, None], found, np.nan)


def _estimates(
    z: np.ndarray, gradient: np.ndarray, rates: np.ndarray, values: np.ndarray
) -> Float[np.ndarray, "2 quantity value"]:
    """The covariance of the draws, and that by Stein's identity."""
    if len(z) < 2:
        return np.full((2, rates.shape[1], values.shape[1]), np.nan)
    rates, values = rates - rates.mean(axis=0), values - values.mean(axis=0)
    x = (z - z.mean(axis=0)) / np.maximum(z.std(axis=0), np.finfo(float).tiny)
    left = gradient * z.std(axis=0), rates, values
    slopes = np.linalg.lstsq(x, np.hstack([left[0] - left[0].mean(axis=0), rates, values]))[0]
    precision, *slopes = np.split(slopes, np.cumsum([x.shape[1], rates.shape[1]]), axis=1)
    of_rates, of_values = slopes
    spread = np.linalg.lstsq(0.5 * (precision + precision.T), of_values)[0]
    rest = (rates - x @ of_rates).T @ (values - x @ of_values) / len(z)
    return np.stack([rates.T @ values / len(z), of_rates.T @ spread + rest])
