"""Comparison of several fits of one capture: parameters, prior sensitivity and predictions."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats import compare
from arviz_stats.utils import ELPDDataLOO

from polar_bayes.diagnostics.convergence import Verdict, summary, verdict
from polar_bayes.diagnostics.parameters import SAMPLE_DIMS
from polar_bayes.diagnostics.predictive import Loo, predictive_checks, usable_readings
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.diagnostics.view import FitView, view_of
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.files import check_fit
from polar_bayes.inference.result import CENTRAL_95
from polar_bayes.numerics.psis import MAX_PARETO_K
from polar_bayes.observation.data import ANGLES


@dataclasses.dataclass(frozen=True, eq=False)
class FitComparison:
    """Comparison of several fits of one capture.

    Args:
        parameters: A row for each parameter and fit that has it, in the order of the fits: mean,
            sd, q2.5, q97.5 (unit of the parameter), r_hat, ess_bulk, and of `sensitivity`
            prior_inside, verdict, prior_sensitivity, likelihood_sensitivity, remark.
        loo: A row for each fit that predicts the readings, best first: elpd and se (nat), p,
            elpd_diff and dse (to the best), weight (stacking), unreliable (readings whose Pareto k
            is above 0.7). Empty where they cannot be compared.
        left_out: By fit, or "" for all, why predictions are not compared.
        verdicts: Whether the numbers of each fit may be used.
    """

    parameters: pd.DataFrame
    loo: pd.DataFrame
    left_out: Mapping[str, str]
    verdicts: Mapping[str, Verdict]


def compare_fits(fits: Mapping[str, xr.DataTree]) -> FitComparison:
    """Compare fits of one capture.

    Args:
        fits: Trees that `polar_bayes.fit` returned, or read back from files, by a name for each.

    Returns:
        Their parameters, and how well each predicts a reading from all others.

    Raises:
        FitError: There are fewer than two, one is no fit, or they are of different captures.

    Source:
        Vehtari, Gelman and Gabry (2017), Statistics and Computing 27, 1413 (leave-one-out); Yao et
        al. (2018), Bayesian Analysis 13, 917 (stacking).
    """
    if not isinstance(fits, Mapping) or len(fits) < 2:
        raise FitError(
            "there is nothing to compare",
            where="compare_fits",
            hint="give two or more fits by name, such as {'rough': a, 'smooth': b}",
        )
    named = {one_line(str(name)): fit for name, fit in fits.items()}
    views = {name: view_of(fit, f"compare_fits: {name}") for name, fit in named.items()}
    (first, reference), *others = views.items()
    for name, fit in others:
        _check_same_capture(reference.result, fit.result, first, name)
    loo, left_out = compare_predictions(views)
    return FitComparison(
        parameters=_parameters(views),
        loo=loo,
        left_out=left_out,
        verdicts={name: verdict(fit) for name, fit in views.items()},
    )


def _parameters(fits: Mapping[str, FitView]) -> pd.DataFrame:
    """Return the columns of both tables for each parameter and fit."""
    own = ["mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk"]
    prior = ["prior_inside", "verdict", "prior_sensitivity", "likelihood_sensitivity", "remark"]
    found = {name: summary(fit)[own].join(sensitivity(fit)[prior]) for name, fit in fits.items()}
    labels = dict.fromkeys(label for table in found.values() for label in table.index)
    rows = [(label, name) for label in labels for name in fits if label in found[name].index]
    return pd.concat(found, names=["fit", "parameter"]).swaplevel().loc[rows]


def _check_same_capture(one: xr.DataTree, other: xr.DataTree, first: str, name: str) -> None:
    """Refuse fits of different directions or readings; the fitted readings may differ."""
    for group, names in (("constant_data", ANGLES), ("observed_data", None)):
        values, expected = (
            tree[group].to_dataset() if group in tree.children else xr.Dataset()
            for tree in (other, one)
        )
        for variable in names or [n for n in expected.data_vars if n in values.data_vars]:
            if variable not in expected or not _agree(expected[variable], values.get(variable)):
                raise FitError(
                    f"it is of another capture than {first}: {variable} differs",
                    where=f"compare_fits: {name}",
                    hint="give fits of one capture",
                )


def _agree(one: xr.DataArray, other: xr.DataArray | None) -> bool:
    if other is None or dict(one.sizes) != dict(other.sizes):
        return False
    first, second = one.to_numpy(), other.transpose(*one.dims).to_numpy()
    both = np.isfinite(first) & np.isfinite(second)
    return bool(np.allclose(first[both], second[both], rtol=1e-9, atol=1e-12))


def compare_predictions(fits: Mapping[str, FitView]) -> tuple[pd.DataFrame, dict[str, str]]:
    """Rank fits by leave-one-out log density, and say why some have none."""
    left_out, found, used = {}, {}, {}
    for name, fit in fits.items():
        parts = {n: check.loo for n, check in sorted(predictive_checks(fit).items())}
        if fit.method == "point" or not parts or any(loo is None for loo in parts.values()):
            left_out[name] = "it has no draws that predict the readings"
            continue
        found[name] = [loo for loo in parts.values() if loo is not None]
        used[name] = {n: usable_readings(fit.result, n) for n in parts}
    if len(found) < 2:
        return pd.DataFrame(), {"": "Fewer than two fits have draws that predict the readings."}
    (first, expected), *others = used.items()
    for name, own in others:
        if set(own) != set(expected):
            names = f"{first} describes {' and '.join(expected)}, {name} {' and '.join(own)}"
            return pd.DataFrame(), {"": f"They predict different readings: {names}."}
        if any(not np.array_equal(own[n], expected[n]) for n in own):
            names = f"{first} and {name} have set aside different views"
            return pd.DataFrame(), {"": f"They were fitted to different readings: {names}."}
    # Weights take exponentials of densities; what all fits share cancels, and would overflow.
    stacked = {n: np.concatenate([part.pointwise for part in p]) for n, p in found.items()}
    best = np.max(list(stacked.values()), axis=0)
    combined = {name: _combined(found[name], each, best) for name, each in stacked.items()}
    table = compare(combined, round_to="none")
    unreliable = {name: sum(part.unreliable for part in parts) for name, parts in found.items()}
    columns = ["elpd", "se", "p", "elpd_diff", "dse", "weight"]
    return table[columns].assign(unreliable=pd.Series(unreliable)), left_out


def _combined(parts: list[Loo], each: np.ndarray, best: np.ndarray) -> ELPDDataLOO:
    """Return what ArviZ compares, of the stacked readings of all variables."""
    return ELPDDataLOO(
        elpd=float(each.sum()),
        se=float(np.sqrt(each.size * each.var())),
        p=sum(part.p_loo for part in parts),
        n_data_points=each.size,
        scale="log",
        elpd_i=xr.DataArray(each - best, dims="reading"),
        # The columns of the table that are used do not depend on these.
        n_samples=1,
        warning=False,
        good_k=MAX_PARETO_K,
    )


# --- The fitted readings on a single axis ---------------------------------------------------------


def stack_readings(result: xr.DataTree) -> xr.DataTree:
    """Return the result with one axis for all readings that the fit has used.

    Masked views and views beyond the angle limit stay in a result, so that its axes are those of
    the capture; their log likelihood is zero in every draw. Leave-one-out functions refuse such
    readings, and some take one axis only: give them this.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A new tree. In `observed_data`, `log_likelihood`, `posterior_predictive`, `noise_free` and
        `prior_predictive` each variable `x` has the axes chain, draw and `x_reading`; all
        other groups and attributes are the same.

    Raises:
        FitError: The tree holds no readings, is no fit, or does not hold together.
    """
    if not isinstance(result, xr.DataTree) or "observed_data" not in result.children:
        raise FitError(
            "it holds no readings",
            where="stack_readings",
            hint="give the tree that polar_bayes.fit or load returned",
        )
    check_fit(result)
    observed = result["observed_data"].to_dataset()
    stacked = result.copy()
    predicted = ("log_likelihood", "posterior_predictive", "noise_free", "prior_predictive")
    for group in ("observed_data", *predicted):
        if group in result.children:
            variables = result[group].to_dataset()
            rows = {
                name: _stack(
                    variables[name], reading, usable_readings(result, str(name), {"valid": True})
                )
                for name, reading in observed.items()
                if name in variables
            }
            stacked[group] = xr.DataTree(xr.Dataset(rows))
    return stacked


def _stack(variable: xr.DataArray, reading: xr.DataArray, fitted: np.ndarray) -> xr.DataArray:
    sample_dims = [dim for dim in SAMPLE_DIMS if dim in variable.dims]
    values: np.ndarray = variable.transpose(*sample_dims, *reading.dims).to_numpy()
    dims = (*sample_dims, f"{reading.name}_reading")
    return xr.DataArray(values[..., fitted], dims=dims, attrs=variable.attrs)


# --- Intervals without a part of the instrument ---------------------------------------------------

WITHOUT = {"discrepancy": "the discrepancy term", "instrument": "any instrument term"}
"""Fits for comparison, in groups `without_<key>`, with the terms that each omits."""


def compare_without(result: xr.DataTree | FitView, part: str) -> pd.DataFrame:
    """Compare intervals of the material with and without a part of the instrument."""
    fit = view_of(result)
    without, rows = fit.scalars_of(f"without_{part}"), {}
    for scalar in fit.scalars:
        if scalar.label not in without or not scalar.is_material:
            continue
        both = scalar.draws, without[scalar.label].draws
        if not all(np.isfinite(draws).all() for draws in both):
            continue
        own, its = ([draws.mean(), *np.quantile(draws, CENTRAL_95)] for draws in both)
        width = own[2] - own[1]
        rows[scalar.label] = (*own, *its, (its[2] - its[1]) / width if width > 0.0 else np.nan)
    columns = ["mean", "q2.5", "q97.5"]
    columns += [*(f"{name}_without" for name in columns), "width_ratio"]
    index = pd.Index(list(rows), dtype=str)
    return pd.DataFrame(list(rows.values()), columns=columns, index=index)
