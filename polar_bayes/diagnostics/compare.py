"""Several fits of one capture side by side: predictions, parameters, and what the priors did."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats import compare
from arviz_stats.utils import ELPDDataLOO

from polar_bayes.diagnostics.convergence import Verdict, judge, summary
from polar_bayes.diagnostics.parameters import SAMPLE_DIMS, method_of, posterior_scalars, scalars
from polar_bayes.diagnostics.predictive import LARGEST_PARETO_K, Loo, predictive_checks, usable
from polar_bayes.diagnostics.sensitivity import sensitivity
from polar_bayes.errors import FitError, one_line
from polar_bayes.inference.files import check_fit

GEOMETRY = ("view_zenith", "view_azimuth", "light_zenith", "light_azimuth")
NUMBERS = ("mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk")
OF_PRIOR = ("prior_inside", "verdict", "prior_sensitivity", "likelihood_sensitivity", "remark")


@dataclasses.dataclass(frozen=True, eq=False)
class FitComparison:
    """Fits of one capture, side by side.

    Args:
        parameters: A row for each parameter and fit that has it, in the order of the fits: mean,
            sd, q2.5, q97.5 (unit of the parameter), r_hat, ess_bulk, and of `sensitivity`
            prior_inside, verdict, prior_sensitivity, likelihood_sensitivity, remark.
        loo: A row for each fit that predicts the readings, best first: elpd and se (nat), p,
            elpd_diff and dse (to the best), weight (stacking), unreliable (readings whose Pareto k
            is above 0.7). Empty where they cannot be compared.
        left_out: By fit, or "" for all, why predictions are not compared.
        verdicts: May the numbers of each fit be used?
    """

    parameters: pd.DataFrame
    loo: pd.DataFrame
    left_out: Mapping[str, str]
    verdicts: Mapping[str, Verdict]


def compare_fits(fits: Mapping[str, xr.DataTree]) -> FitComparison:
    """Put fits of one capture side by side.

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
    for name, fit in named.items():
        check_fit(fit, f"compare_fits: {name}")
    tables = {name: summary(fit) for name, fit in named.items()}
    (first, reference), *others = named.items()
    for name, fit in others:
        _check_same_capture(reference, fit, first, name)
    loo, left_out = _loo(named)
    return FitComparison(
        parameters=_parameters(named, tables),
        loo=loo,
        left_out=left_out,
        verdicts={name: judge(fit, tables[name]) for name, fit in named.items()},
    )


def _parameters(
    fits: Mapping[str, xr.DataTree], tables: Mapping[str, pd.DataFrame]
) -> pd.DataFrame:
    priors = {name: sensitivity(fit) for name, fit in fits.items()}
    labels = dict.fromkeys(s.label for fit in fits.values() for s in posterior_scalars(fit))
    rows = {
        (label, name): {
            **table.loc[label, list(NUMBERS)],
            **(priors[name].loc[label, list(OF_PRIOR)] if label in priors[name].index else {}),
        }
        for label in labels
        for name, table in tables.items()
        if label in table.index
    }
    found = pd.DataFrame.from_dict(rows, orient="index").reindex(columns=[*NUMBERS, *OF_PRIOR])
    found.index = pd.MultiIndex.from_tuples(rows, names=["parameter", "fit"])
    return found


def _check_same_capture(one: xr.DataTree, other: xr.DataTree, first: str, name: str) -> None:
    """Directions and readings must be the same; what each fit has set aside may differ."""
    for group, names in (("constant_data", GEOMETRY), ("observed_data", None)):
        here, there = (
            tree[group].to_dataset() if group in tree.children else xr.Dataset()
            for tree in (one, other)
        )
        for variable in names or [n for n in here.data_vars if n in there.data_vars]:
            if variable not in here or not _agree(here[variable], there.get(variable)):
                raise FitError(
                    f"it is of another capture than {first}: {variable} differs",
                    where=f"compare_fits: {name}",
                    hint="give fits of one capture",
                )


def _agree(one: xr.DataArray, other: xr.DataArray | None) -> bool:
    if other is None or dict(one.sizes) != dict(other.sizes):
        return False
    here, there = one.to_numpy(), other.transpose(*one.dims).to_numpy()
    both = np.isfinite(here) & np.isfinite(there)
    return bool(np.allclose(here[both], there[both], rtol=1e-9, atol=1e-12))


def _loo(fits: Mapping[str, xr.DataTree]) -> tuple[pd.DataFrame, dict[str, str]]:
    """Expected log density of each reading given all others, fit beside fit."""
    left_out, found, read = {}, {}, {}
    for name, fit in fits.items():
        parts = {n: check.loo for n, check in sorted(predictive_checks(fit).items())}
        if method_of(fit) == "point" or not parts or any(loo is None for loo in parts.values()):
            left_out[name] = "it has no draws that predict the readings"
            continue
        found[name] = [loo for loo in parts.values() if loo is not None]
        read[name] = {n: usable(fit, n) for n in parts}
    if len(found) < 2:
        return pd.DataFrame(), {"": "Fewer than two fits have draws that predict the readings."}
    (first, expected), *others = read.items()
    for name, own in others:
        if set(own) != set(expected):
            said = f"{first} describes {_list(expected)}, {name} {_list(own)}"
            return pd.DataFrame(), {"": f"They predict different readings: {said}."}
        if any(not np.array_equal(own[n], expected[n]) for n in own):
            said = f"{first} and {name} have set aside different views"
            return pd.DataFrame(), {"": f"They were fitted to different readings: {said}."}
    table = compare({name: _together(parts) for name, parts in found.items()}, round_to="none")
    bad = {name: sum(part.unreliable for part in parts) for name, parts in found.items()}
    columns = ["elpd", "se", "p", "elpd_diff", "dse", "weight"]
    return table[columns].assign(unreliable=pd.Series(bad)), left_out


def _list(names: Mapping[str, object]) -> str:
    return " and ".join(names)


def _together(parts: list[Loo]) -> ELPDDataLOO:
    """The readings of all variables as ArviZ holds them."""
    each = xr.DataArray(np.concatenate([part.parts for part in parts]), dims="reading")
    pareto_k = xr.DataArray(np.concatenate([part.pareto_k for part in parts]), dims="reading")
    return ELPDDataLOO(
        elpd=float(each.sum()),
        se=float(np.sqrt(each.size * each.var())),
        p=sum(part.p_loo for part in parts),
        n_samples=1,  # not used by the comparison
        n_data_points=each.size,
        scale="log",
        warning=bool((pareto_k > LARGEST_PARETO_K).any()),
        good_k=LARGEST_PARETO_K,
        elpd_i=each,
        pareto_k=pareto_k,
    )


# --- Readings in one row, without those that were not fitted, as tools for plain data want them ---


OF_READINGS = (
    "observed_data",
    "log_likelihood",
    "posterior_predictive",
    "noise_free",
    "prior_predictive",
)


def stack_readings(result: xr.DataTree) -> xr.DataTree:
    """The same result with a single axis of readings, those alone that the fit has read.

    Masked views and views beyond the angle limit stay in a result, so that its axes are those of
    the capture; their log likelihood is zero in every draw. Leave-one-out functions refuse such
    readings, and some take one axis only: give them this.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A new tree. In `observed_data`, `log_likelihood`, `posterior_predictive`, `noise_free` and
        `prior_predictive` each variable `x` has one axis `x_reading` beside chain and draw; all
        other groups and attributes are the same.

    Raises:
        FitError: The tree holds no readings, is no fit, or does not hold together.
    """
    if not isinstance(result, xr.DataTree) or "observed_data" not in result.children:
        raise FitError(
            "it holds no readings",
            where="stack_readings",
            hint="give the tree that polar_bayes.fit or load_result returned",
        )
    check_fit(result)
    observed = result["observed_data"].to_dataset()
    kept = {str(name): _kept(result, observed[name]) for name in observed.data_vars}
    stacked = result.copy()
    for group in OF_READINGS:
        if group in result.children:
            own = result[group].to_dataset()
            rows = {n: _row(own[n], observed[n], keep) for n, keep in kept.items() if n in own}
            stacked[group] = xr.DataTree(xr.Dataset(rows))
    return stacked


def _kept(result: xr.DataTree, reading: xr.DataArray) -> np.ndarray:
    """Whether each reading was fitted, in the order of its axes."""
    finite = reading.notnull()
    if "constant_data" in result.children and "valid" in result["constant_data"].data_vars:
        finite = finite & (result["constant_data"].to_dataset()["valid"] == 1)
    return finite.transpose(*reading.dims).to_numpy().ravel()


def _row(variable: xr.DataArray, reading: xr.DataArray, kept: np.ndarray) -> xr.DataArray:
    lead = [dim for dim in SAMPLE_DIMS if dim in variable.dims]
    values: np.ndarray = variable.transpose(*lead, *reading.dims).to_numpy()
    rows = values.reshape(*values.shape[: len(lead)], -1)[..., kept]
    return xr.DataArray(rows, dims=(*lead, f"{reading.name}_reading"), attrs=variable.attrs)


# --- What would the fit claim if it denied that the instrument errs? ------------------------------


COLUMNS = (
    "mean",
    "q2.5",
    "q97.5",
    "mean_without",
    "q2.5_without",
    "q97.5_without",
    "width_ratio",
)
INTERVAL = (0.025, 0.975)

WITHOUT = {"discrepancy": "the discrepancy term", "instrument": "any instrument term"}
"""Fits that may stand beside the main one, in the groups `without_<key>`: what they leave out."""


def compare_without(result: xr.DataTree, part: str) -> pd.DataFrame:
    """The material's intervals with and without a part of the instrument, side by side."""
    found = posterior_scalars(result)
    rows, labels = [], []
    plain = {}
    if f"without_{part}" in result.children:
        plain = {s.label: s.draws for s in scalars(result[f"without_{part}"].to_dataset())}
    for scalar in found:
        other = plain.get(scalar.label)
        if other is None or not scalar.is_material:
            continue
        if not (np.isfinite(scalar.draws).all() and np.isfinite(other).all()):
            continue
        (low, high), (bare_low, bare_high) = (
            np.quantile(draws, INTERVAL) for draws in (scalar.draws, other)
        )
        ratio = (bare_high - bare_low) / (high - low) if high > low else np.nan
        labels.append(scalar.label)
        rows.append([scalar.draws.mean(), low, high, other.mean(), bare_low, bare_high, ratio])
    return pd.DataFrame(rows, columns=list(COLUMNS), index=pd.Index(labels, dtype=str))
