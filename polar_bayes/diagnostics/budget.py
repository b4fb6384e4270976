"""The uncertainty budget of a fit: how much of each interval is noise, prior and set-up.

The rows are in the words of the GUM: each input quantity of the set-up has a standard uncertainty,
whose contribution to a parameter is the change of the posterior mean where the quantity is off by
it. Contributions add in squares, to the combined standard uncertainty. The posterior's own variance
is divided between the noise of the readings and the prior as power scaling divides it; of a normal
posterior these are the noise and smoothing errors of an optimal estimate.

Source: JCGM 100:2008 (GUM), 5.1; Rodgers (2000), Inverse Methods for Atmospheric Sounding, 3.2;
Kallioinen et al. (2024), Statistics and Computing 34, 57 (power scaling).
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from polar_bayes.capture.input_quantities import check_uncertainty
from polar_bayes.diagnostics.finding import join
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.diagnostics.sensitivity import total_density
from polar_bayes.diagnostics.view import FitView, once, view_of
from polar_bayes.errors import FitError
from polar_bayes.frames import PrintedFrame
from polar_bayes.inference.input_sensitivity import STATISTICS

INPUT_SHIFTS = "input_shifts"
OWN = ("noise", "prior")
"""Of the posterior's own variance."""


def budget(
    result: xr.DataTree | FitView, *, known: Mapping[str, float] | None = None
) -> pd.DataFrame:
    """How much of the uncertainty of each material parameter comes from what.

    Intervals of a fit take the set-up for perfectly known, but for what its scene estimates. This
    table says what they leave out, to first order, without another fit.

    Args:
        result: A fit, fresh or loaded, of a set-up that states what it is known to (`Setup.known`).
        known: Other standard uncertainties, by input quantity, in its unit; above 0.

    Returns:
        A row for each scalar parameter of the material, in its unit: the posterior's standard
        deviation `sd` with its parts `noise` and `prior` (squares add to that of `sd`), the
        contribution of each input quantity, which has a sign, and the `combined` standard
        uncertainty. The attribute `known` has the standard uncertainties of the quantities, `mcse`
        the Monte Carlo standard errors of their contributions.

    Raises:
        FitError: The result is no fit, its set-up states nothing, or has no such input quantity.
    """
    fit = view_of(result)
    if INPUT_SHIFTS not in fit.result.children or fit.method == "point":
        raise FitError(
            "it does not say what its set-up is known to",
            where="budget: result",
            hint="fit with a set-up whose `known` lists input quantities, such as camera",
        )
    group = _stated(fit)
    stated = group["standard_uncertainty"].to_series()
    asked = _asked(stated, known or {})
    shifts = {each.label: each.draws for each in _shifts(group)}
    rows, errors = {}, {}
    for scalar in fit.scalars:
        if scalar.is_material and scalar.label in shifts:
            parts, error = shifts[scalar.label] * (asked / stated).to_numpy()
            errors[scalar.label] = dict(zip(stated.index, error.tolist(), strict=True))
            sd = float(scalar.draws.std(ddof=1))
            rows[scalar.label] = [sd, *_own_parts(fit, scalar, sd), *parts]
    columns = ["sd", *OWN, *stated.index]
    table = PrintedFrame.from_dict(rows, orient="index", columns=columns)
    table.attrs["known"] = asked.to_dict()
    table.attrs["mcse"] = errors
    table["combined"] = np.sqrt(table["sd"] ** 2 + _squares(table).sum(axis=1))
    return table


def _stated(fit: FitView) -> xr.Dataset:
    """The group of shifts; the schema checks its types, and this its labels and uncertainties."""
    group = fit.result[INPUT_SHIFTS].to_dataset()
    labels = [group[dim].to_numpy().tolist() for dim in ("statistic", "quantity")]
    u = group["standard_uncertainty"].to_numpy().astype(float)
    if (
        labels[0] != list(STATISTICS)
        or len({*labels[1]}) < u.size
        or not (np.isfinite(u) & (u > 0)).all()
    ):
        hint = "fit again: labels and standard uncertainties are not as a fit writes them"
        raise FitError("it states no input quantities", where=INPUT_SHIFTS, hint=hint)
    return group


def _squares(table: pd.DataFrame) -> pd.DataFrame:
    """Squares of what the set-up contributes."""
    # The square of what has an error is too large by that of the error.
    errors = pd.DataFrame.from_dict(table.attrs["mcse"], orient="index")
    return (table[list(errors.columns)] ** 2 - errors**2).clip(lower=0.0)


def variance_shares(table: pd.DataFrame) -> pd.DataFrame:
    """A budget with shares of the combined variance in the place of its parts."""
    parts = pd.concat([table[list(OWN)] ** 2, _squares(table)], axis=1)
    return table[["sd", "combined"]].join(parts.div(table["combined"] ** 2, axis=0))


def _asked(stated: pd.Series, known: Mapping[str, float]) -> pd.Series:
    """Standard uncertainties, those that the caller knows better or worse replaced."""
    for name, value in known.items():
        if name not in stated.index:
            hint = f"give some of {join(list(stated.index))}"
            raise FitError("it is no input quantity of this fit", where=f"known: {name}", hint=hint)
        check_uncertainty(value, f"known: {name}")
    return pd.Series({**stated.to_dict(), **known}, dtype=float)


def _shifts(group: xr.Dataset) -> list[Scalar]:
    """Of every parameter, the shift by each quantity and its Monte Carlo error, (2, quantity)."""
    own = group.drop_vars(["standard_uncertainty", "unit", "meaning"])
    return scalars(own, ("statistic", "quantity"))


def _own_parts(fit: FitView, scalar: Scalar, sd: float) -> tuple[float, float]:
    """The parts of a posterior's sd that come from noise and from the prior."""
    # Raising a density to a power a divides its part of the precision by a: the variance then
    # changes at the rate -Cov((x - mean)^2, log density), which is that part of a normal variance.
    square = (scalar.draws - scalar.draws.mean()) ** 2
    rates = []
    for name in ("log_likelihood", "log_prior"):
        density = total_density(fit.result, name)
        if density is None or not np.isfinite(density).all():
            return np.nan, np.nan
        rates.append(max(-float(np.cov(square.ravel(), density.ravel())[0, 1]), 0.0))
    total = sum(rates)
    noise = rates[0] / total if total > 0.0 else np.nan
    return sd * np.sqrt(noise), sd * np.sqrt(1.0 - noise)


class BetterKnown(NamedTuple):
    """The quantity that contributes most to a parameter, and what knowing it twice as well does."""

    meaning: str
    known: str
    half: str
    combined: float


def better_known(fit: FitView, label: str) -> BetterKnown:
    """What to know better for the sake of a parameter."""
    table, group = budget(fit), fit.result[INPUT_SHIFTS].to_dataset()
    known = table.attrs["known"]
    name = str(table.loc[label, list(known)].abs().idxmax())
    half = 0.5 * known[name]
    unit, meaning = (group[key].sel(quantity=name).item() for key in ("unit", "meaning"))
    of_unit = "" if unit == "1" else f" {unit}"
    combined = float(budget(fit, known={name: half}).loc[label, "combined"])
    return BetterKnown(meaning, f"{known[name]:g}{of_unit}", f"{half:g}{of_unit}", combined)


@once
def wider_by_setup(fit: FitView) -> pd.Series:
    """Factors by which the set-up widens uncertainties, the largest first; those worth a word."""
    if INPUT_SHIFTS not in fit.result.children or fit.method == "point":
        return pd.Series(dtype=float)
    table = budget(fit)
    ratio = (table["combined"] / table["sd"]).where(table["sd"] > 0.0)
    return ratio[ratio > LIMITS.of_setup].sort_values(ascending=False)


@once
def budget_sentences(fit: FitView) -> tuple[str, ...]:
    """What the intervals leave out, where that is material; what to know better first."""
    wider = wider_by_setup(fit)
    if wider.empty:
        return ()
    worst = str(wider.index[0])
    better, now = better_known(fit, worst), budget(fit).loc[worst, "combined"]
    factors = join([f"{label} {factor:.2g} times" for label, factor in wider.items()])
    return (
        "The intervals assume a set-up that is known perfectly. With what it is known to, standard "
        f"uncertainties are larger: {factors}. Most of that of {worst} comes from the "
        f"{better.meaning}, known to {better.known}; known to {better.half}, it would leave "
        f"{better.combined:.2g} instead of {now:.2g}.",
    )
