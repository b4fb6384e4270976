r"""Uncertainty budget of a fit: the contributions of noise, prior and set-up to each interval.

The rows are in the words of the GUM: each input quantity of the set-up has a standard uncertainty
u, that of its prior, and contributes to a parameter

$$ c = \operatorname{Cov}(\theta, e) / u $$

over the posterior. Of a normal posterior the squares of all contributions add to the variance: each
factor of the density, with precision P, contributes $\Sigma P \Sigma$ to the covariance $\Sigma$.
A smooth error of the model contributes by its weights, each of standard uncertainty 1, together.
What is left is divided between the noise of the readings and the other priors as power scaling
divides it. These are the noise and smoothing errors of an optimal estimate.

Source: JCGM 100:2008 (GUM), 5.1; Rodgers (2000), Inverse Methods for Atmospheric Sounding, 3.2;
Kallioinen et al. (2024), Statistics and Computing 34, 57 (power scaling).
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from polar_bayes.diagnostics.finding import join
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.diagnostics.sensitivity import total_density
from polar_bayes.diagnostics.view import FitView, once, view_of
from polar_bayes.errors import FitError
from polar_bayes.frames import PrintedFrame
from polar_bayes.physics.input_quantities import quantity_of
from polar_bayes.physics.part import notation
from polar_bayes.setups import check_known, check_uncertainty

WEIGHTS, DISCREPANCY = "discrepancy_weights", "model discrepancy"
"""Parameters of a smooth error over angle, and their row in the table."""

HALVED = " halved"
"""End of the names of columns with the sd for half of the standard uncertainty of a quantity."""


def budget(
    result: xr.DataTree | FitView, *, known: Mapping[str, float] | None = None
) -> pd.DataFrame:
    """Compute the uncertainty budget of each material parameter.

    Args:
        result: A fit, fresh or loaded, whose scene has input quantities or other terms of an
            instrument.
        known: Other standard uncertainties, by input quantity, in its unit; above 0. What they
            would do to the posterior is told to first order, without another fit.

    Returns:
        A row for each scalar parameter of the material, in its unit: the posterior's standard
        deviation `sd`; `perfect`, what it would be in a set-up known perfectly; and what
        contributes to `sd`, in squares: the `noise`, the `prior`, the `model discrepancy` where the
        scene has one, and the prior of each input quantity, which has a sign. What readings tell of
        a quantity is in their noise, so that a part is not the gain of knowing it. Columns that
        end in `halved` have what `sd` would be if that quantity alone were known twice as well. The
        attribute `known` has the standard uncertainties of the quantities.

    Raises:
        FitError: The result is no fit, its scene has no input quantity, or none of that name.
    """
    fit = view_of(result)
    if not has_budget(fit):
        what = "it has no input quantities of its set-up"
        hint = "fit with a set-up whose scene has input quantities, such as camera"
        if fit.method == "point":
            what, hint = "a point fit has no intervals", "fit by another method, such as importance"
        raise FitError(what, where="budget: result", hint=hint)
    errors, stated = _errors(fit), _stated(fit)
    asked = _asked(stated, known)
    # Of the readings, and of all priors but those of the input quantities.
    weights = {each.label: each for each in fit.scalars if each.name == WEIGHTS}
    names = {each.name for each in (*errors.values(), *weights.values())}
    likelihood = total_density(fit.result, "log_likelihood")
    densities = [likelihood, total_density(fit.result, "log_prior", names)]
    rows = {}
    for scalar in fit.scalars:
        if scalar.is_material:
            with np.errstate(all="ignore"):  # draws may be infinite: what is not known is NaN
                joint = _covariance(scalar, {**errors, **weights})
                noise = _share_of_noise(scalar, densities)
                rows[scalar.label] = _row(joint, noise, stated, asked)
    smooth = [DISCREPANCY] if weights else []
    halved = [f"{name}{HALVED}" for name in stated.index]
    columns = ["sd", "perfect", "noise", "prior", *smooth, *stated.index, *halved]
    table = PrintedFrame.from_dict(rows, orient="index", columns=columns)
    table.attrs["known"] = asked.to_dict()
    return table


def has_budget(fit: FitView) -> bool:
    """Return whether a fit has intervals and input quantities."""
    return fit.method != "point" and bool(_errors(fit))


def _errors(fit: FitView) -> dict[str, Scalar]:
    """Return the draws of the input quantities, by name."""
    known = fit.provenance.get("known") or {}
    usable = (each for each in fit.scalars if (known.get(each.name) or 0.0) > 0.0)
    return {quantity_of(each.name): each for each in usable}


def _stated(fit: FitView) -> pd.Series:
    """Return the standard uncertainties of the input quantities, by name."""
    return pd.Series({n: fit.provenance["known"][each.name] for n, each in _errors(fit).items()})


def _covariance(scalar: Scalar, errors: Mapping[str, Scalar]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of a parameter, first, and the input quantities."""
    return np.cov(np.stack([each.draws.ravel() for each in (scalar, *errors.values())]))


def _row(
    joint: Float[np.ndarray, "n n"], noise: float, stated: pd.Series, asked: pd.Series
) -> list[float]:
    """Return one parameter's sd, that for a perfect set-up, all contributions, and other sds."""
    count, weights = len(stated), np.ones(len(joint) - 1 - len(stated))  # weights are last
    if not np.isfinite(joint).all():
        return [np.nan] * (4 + bool(weights.size) + 2 * count)
    # In units of the priors. Readings only add to their precision: what the covariance of the draws
    # has beyond 1 is Monte Carlo error, which a wider prior would multiply.
    u, now = (np.array([*each, *weights]) for each in (stated, asked))
    values, vectors = np.linalg.eigh(joint[1:, 1:] / np.outer(u, u))
    posterior = (vectors * np.clip(values, 0.0, 1.0)) @ vectors.T
    slopes = np.linalg.lstsq(joint[1:, 1:], joint[0, 1:])[0] * u

    def known_to(ratio: np.ndarray) -> tuple[float, np.ndarray]:
        change = posterior @ np.diag(ratio**-2.0 - 1.0)
        other = np.linalg.solve(np.eye(u.size) + change, posterior)
        return joint[0, 0] + slopes @ (other - posterior) @ slopes, other @ slopes / ratio

    ratio = np.clip(now / u, 1e-6, 1e6)
    variance, parts = known_to(ratio)
    own = joint[1 : count + 1, 1 : count + 1], joint[0, 1 : count + 1]
    perfect = joint[0, 0] - own[1] @ np.linalg.lstsq(*own)[0]
    rest = variance - np.sum(parts**2)
    variances = [variance, perfect, noise * rest, (1.0 - noise) * rest]
    variances += [np.sum(parts[count:] ** 2)] if weights.size else []
    halved = [known_to(half)[0] for half in ratio * (1.0 - 0.5 * np.eye(count, u.size))]
    return [
        *np.sqrt(np.maximum(variances, 0.0)),
        *parts[:count],
        *np.sqrt(np.maximum(halved, 0.0)),
    ]


def variance_shares(table: pd.DataFrame) -> pd.DataFrame:
    """Convert the contributions of a budget from standard uncertainties to shares of variance."""
    sds = [name for name in table if name in ("sd", "perfect") or name.endswith(HALVED)]
    parts = table.drop(columns=sds) ** 2
    return table[sds].join(parts.div(parts.sum(axis=1), axis=0))


def _asked(stated: pd.Series, known: Mapping[str, float] | None) -> pd.Series:
    """Return standard uncertainties, with the caller's values where given."""
    known = check_known(known)
    for name, value in known.items():
        if name not in stated.index:
            hint = f"give some of {join(list(stated.index))}"
            raise FitError("it is no input quantity of this fit", where=f"known: {name}", hint=hint)
        check_uncertainty(value, f"known: {name}")
    return pd.Series({**stated.to_dict(), **known}, dtype=float)


def _share_of_noise(scalar: Scalar, densities: list[np.ndarray | None]) -> float:
    """Return the share of noise in the variance that no input quantity explains."""
    # Raising a density to a power a divides its part of the precision by a: the variance then
    # changes at the rate -Cov((x - mean)^2, log density), which is that part of a normal variance.
    square = (scalar.draws - scalar.draws.mean()) ** 2
    rates = []
    for density in densities:
        if density is None or not np.isfinite(density).all():
            return np.nan
        rates.append(max(-float(np.cov(square.ravel(), density.ravel())[0, 1]), 0.0))
    return rates[0] / sum(rates) if sum(rates) > 0.0 else np.nan


def better_known(fit: FitView, row: pd.Series) -> tuple[str, float]:
    """What narrows a parameter most if it is known twice as well, in words; its sd by then.

    The row is that of the parameter in the budget.
    """
    stated = _stated(fit)
    halved = row[[f"{name}{HALVED}" for name in stated.index]].set_axis(stated.index)
    name = str(halved.idxmin())
    return known_to_half(_errors(fit)[name].name, stated[name]), float(halved[name])


def known_to_half(parameter: str, u: float) -> str:
    """State that the quantity of a parameter of the instrument is known twice as well."""
    (meaning, known), (_, better) = _sized(parameter, u), _sized(parameter, 0.5 * u)
    return f"{meaning} known to {better} instead of {known}"


def described(fit: FitView, quantity: str, u: float) -> tuple[str, str]:
    """Describe an input quantity, and its standard uncertainty with its unit."""
    return _sized(_errors(fit)[quantity].name, u)


def _sized(parameter: str, u: float) -> tuple[str, str]:
    _, meaning, unit = notation(parameter)
    return meaning, f"{u:.2g}{'' if unit == '1' else f' {unit}'}"


@once
def budget_sentences(fit: FitView) -> tuple[str, ...]:
    """State what the set-up adds to intervals, where notable, and what to know better."""
    if not has_budget(fit):
        return ()
    table = budget(fit)
    ratio = (table["sd"] / table["perfect"]).where(table["perfect"] > 0.0)
    wider = ratio[ratio > LIMITS.of_setup].sort_values(ascending=False)
    if wider.empty:
        return ()
    worst = table.loc[wider.index[0]]
    what, sd = better_known(fit, worst)
    factors = join([f"{label} {factor:.2g} times" for label, factor in wider.items()])
    return (
        "The uncertainty of the set-up makes standard uncertainties larger than those of a perfect "
        f"one: {factors}. That of {worst.name} would be {sd:.2g} instead of {worst['sd']:.2g} with "
        f"the {what}.",
    )
