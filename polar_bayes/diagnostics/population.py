"""Populations of a hierarchical fit: summaries, and shrinkage of each member.

A parameter is pooled where the posterior also holds `<parameter>_location` and
`<parameter>_spread`. The population is normal on the parameter's own scale: log for positive
parameters, log odds for shares, plain (truncated at its bounds) for an index.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy.special
import scipy.stats
import xarray as xr

from polar_bayes.diagnostics.parameters import Scalar
from polar_bayes.diagnostics.view import FitView, Provenance, once
from polar_bayes.inference.result import CENTRAL_95, bounds_of
from polar_bayes.priors import natural_scale

SUMMARY_COLUMNS = (
    "members",
    *(f"{part}{end}" for part in ("location", "spread") for end in ("", "_sd", "_q2.5", "_q97.5")),
    *("new_q2.5", "new_q97.5", "between", "between_q2.5", "between_q97.5", "meaning", "pooling"),
)
MEMBER_COLUMNS = (
    *("mean", "q2.5", "q97.5", "unpooled", "unpooled_q2.5", "unpooled_q97.5", "shrinkage"),
)


@dataclasses.dataclass(frozen=True, eq=False)
class Population:
    """The population of one parameter, at one wavelength where it has several."""

    label: str
    location: Scalar
    spread: Scalar
    members: tuple[Scalar, ...]
    low: float
    high: float

    @property
    def name(self) -> str:
        """Name of the pooled parameter."""
        return self.members[0].name

    @property
    def scale(self) -> str:
        """Scale on which the population is normal: "log", "log odds" or "plain"."""
        return natural_scale(self.name)

    def to_scale(self, value: np.ndarray) -> np.ndarray:
        """From the unit of the parameter to the scale on which the population is normal."""
        scales = {"log": np.log, "log odds": scipy.special.logit, "plain": np.asarray}
        with np.errstate(divide="ignore", invalid="ignore"):
            return scales[self.scale](np.asarray(value, float))

    def from_scale(self, value: np.ndarray) -> np.ndarray:
        """Back to the unit of the parameter."""
        scales = {"log": np.exp, "log odds": scipy.special.expit, "plain": np.asarray}
        with np.errstate(over="ignore"):
            return scales[self.scale](value)

    def differences(self) -> np.ndarray:
        """Return draws of the spread in the parameter's unit; a factor on the log scale."""
        location, spread = self.location.draws.ravel(), self.spread.draws.ravel()
        if self.scale == "log":
            return self.from_scale(spread)
        # Near the location a unit of log odds is worth location (1 - location).
        return location * (1.0 - location) * spread if self.scale == "log odds" else spread

    def new_members(self, count: int = 20_000, seed: int = 0) -> np.ndarray:
        """Draw the parameter of members that were not measured, (count,)."""
        location, spread = self.location.draws.ravel(), self.spread.draws.ravel()
        # Evenly through the draws; as many ranks of the population as there are draws of it.
        at = np.linspace(0, location.size - 1, count).round().astype(int)
        rank = (np.arange(count) + 0.5) / count
        rank = np.random.default_rng(seed).permutation(rank)
        center, width = self.to_scale(location[at]), np.maximum(spread[at], 1e-12)
        if self.scale == "plain":
            # The population is truncated at the bounds.
            low, high = (self.low - center) / width, (self.high - center) / width
            return center + width * scipy.stats.truncnorm.ppf(rank, low, high)
        return self.from_scale(center + width * scipy.special.ndtri(rank))


@once
def populations(fit: FitView) -> list[Population]:
    """List every pooled parameter of a fit, by wavelength; empty for a point fit."""
    found: dict[str, list[Scalar]] = {}
    for scalar in [] if fit.method == "point" else fit.scalars:
        found.setdefault(scalar.name, []).append(scalar)
    return [
        each
        for name in found
        if {f"{name}_location", f"{name}_spread"} <= set(found)
        for each in _of_parameter(name, found, fit.provenance)
    ]


@once
def population_summary(result: xr.DataTree | FitView) -> pd.DataFrame:
    r"""Summarize how much members of each population differ, and predict a new member.

    The location is the population's median in the unit of the parameter, the spread the standard
    deviation between members on the scale on which the population is normal. `between` is what it
    means in the unit of the parameter (median and 95%): a factor exp(spread) where the scale is
    log, location (1 - location) spread where it is log odds, the spread itself where it is plain;
    `meaning` says it in words. The range of a new member has both uncertainties in it;
    an index is drawn from the normal distribution cut at the bounds of its prior. The pooling
    factor compares the members' estimated departures $\epsilon_m$ with all of their variance:

    $$ \lambda = 1 - \frac{Var_m(E[\epsilon_m])}{E[Var_m(\epsilon_m)]} $$

    It is 0 where each member is estimated alone and 1 where all share one value; above 0.5 the
    population says more than the readings of a member.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A row for each pooled parameter and wavelength with members (a count), location,
        location_sd, location_q2.5 and location_q97.5, the same of the spread, new_q2.5 and
        new_q97.5 (the 95% range of a new member), between, between_q2.5 and between_q97.5, meaning
        (text) and pooling (unit 1, at most 1).
        Empty where nothing is pooled and for a point fit; NaN where draws are not finite.

    Raises:
        FitError: The tree holds no posterior.

    Source:
        Gelman & Pardoe (2006), Technometrics 48(2), 241-251: the pooling factor.
    """
    found = populations(result)
    labels = pd.Index([each.label for each in found], dtype=object)
    rows = [_summary_row(each) for each in found]
    return pd.DataFrame(rows, columns=list(SUMMARY_COLUMNS), index=labels)


def _of_parameter(
    name: str, found: Mapping[str, list[Scalar]], provenance: Provenance
) -> Iterator[Population]:
    for location in found[f"{name}_location"]:
        index = location.index.items()
        members = tuple(s for s in found[name] if index <= s.index.items())
        # A spread over wavelength is allowed, although the models of this package have one.
        spread = next((s for s in found[f"{name}_spread"] if s.index.items() <= index), None)
        if spread is not None and len(members) > 1:
            label = location.label.replace(f"{name}_location", name, 1)
            low, high = bounds_of(provenance, f"{name}_location")
            yield Population(label, location, spread, members, low, high)


def _is_finite(population: Population) -> bool:
    """Return whether every draw is finite, also on the population's scale."""
    on_scale = (population.to_scale(s.draws) for s in (population.location, *population.members))
    return all(bool(np.isfinite(draws).all()) for draws in (population.spread.draws, *on_scale))


def _summary_row(population: Population) -> list[Any]:
    row: list[Any] = [len(population.members)]
    for draws in (population.location.draws, population.spread.draws):
        described = draws.mean(), draws.std(ddof=1), *np.quantile(draws, CENTRAL_95)
        row += described if np.isfinite(draws).all() else [math.nan] * 4
    if not _is_finite(population):
        return [*row, *[math.nan] * 5, "", math.nan]
    differences = population.differences()
    median = float(np.median(differences))
    by = f"a factor of about {median:.3g}" if population.scale == "log" else f"about {median:.2g}"
    return [
        *row,
        *np.quantile(population.new_members(), CENTRAL_95),
        *(median, *np.quantile(differences, CENTRAL_95)),
        f"members differ by {by}",
        _pooling_factor(population),
    ]


def _pooling_factor(population: Population) -> float:
    members = np.stack([scalar.draws.ravel() for scalar in population.members])
    location = population.to_scale(population.location.draws.ravel())
    departures = population.to_scale(members) - location
    estimated = np.var(departures.mean(axis=1), ddof=1)
    return float(1.0 - estimated / np.var(departures, axis=0, ddof=1).mean())


# --- Shrinkage: each member with and without its population ---------------------------------------


@once
def shrinkage(fit: FitView) -> pd.DataFrame:
    """Return each member's pooled and unpooled estimate, and its shrinkage."""
    # The unpooled estimate is not a further fit: the population is divided out of the draws. If the
    # likelihood of a member is that of $x_m \sim Normal(a, 1/p)$ on the population's scale, its
    # posterior given the population is
    # $$ x_m | \mu, s \sim Normal\Big(\frac{p a + \mu / s^2}{p + 1 / s^2}, \frac{1}{p + 1 /
    # s^2}\Big) $$
    # and $a$ and $p$ maximize the likelihood of the draws, so that the uncertainty of location and
    # spread is accounted for. This holds where the member's likelihood is about normal on that
    # scale, and the bounds of an index are far; elsewhere it is an approximation. The other
    # parameters of the member keep their priors.
    rows = {}
    for population in populations(fit):
        location = population.to_scale(population.location.draws.ravel())
        spread, is_finite = population.spread.draws.ravel(), _is_finite(population)
        for scalar in population.members:
            draws = scalar.draws.ravel()
            row = [math.nan] * len(MEMBER_COLUMNS)
            if is_finite:
                unpooled = unpooled_estimate(population.to_scale(draws), location, spread)
                ends = unpooled.mean + np.array([0.0, -1.96, 1.96]) * unpooled.sd
                row = [draws.mean(), *np.quantile(draws, CENTRAL_95)]
                row += [*population.from_scale(ends), unpooled.shrinkage]
            rows[scalar.label] = row
    index = pd.Index(list(rows), dtype=object)
    return pd.DataFrame(list(rows.values()), index, list(MEMBER_COLUMNS), dtype=float)


class UnpooledEstimate(NamedTuple):
    """Estimate of one member without its population, on the population's normal scale.

    The shrinkage is the weight of the population in the member's posterior mean.
    """

    mean: float
    sd: float
    shrinkage: float


def unpooled_estimate(
    value: np.ndarray, location: np.ndarray, spread: np.ndarray
) -> UnpooledEstimate:
    """Divide a normal population out of the posterior draws of one of its members."""
    # Under a likelihood $\exp(b x - p x^2 / 2)$ of the member, its draws given location $\mu$ and
    # spread $s$ of the same draw are
    # $$ x | \mu, s \sim Normal(m, v), \qquad v = \frac{1}{p + s^{-2}}, \qquad m = v (b + \mu
    # s^{-2}) $$
    # The log density of all draws is concave in (b, p): Newton's method finds its maximum. So the
    # estimate is exact, up to Monte Carlo error, for any posterior of location and spread.
    center, unit = float(value.mean()), float(value.std())
    if not unit > 0.0:
        return UnpooledEstimate(math.nan, math.nan, math.nan)
    x, mu = (value - center) / unit, (location - center) / unit
    precision = np.maximum(spread / unit, 1e-6) ** -2.0
    b, p = 0.0, max(1.0 - 1.0 / float(np.mean(1.0 / precision)), 0.1)
    lowest = -0.99 * float(precision.min())
    for _ in range(100):
        gradient, curvature = _derivatives(x, mu, precision, b, p)
        step = np.linalg.solve(curvature, gradient)
        # Halved until every variance is positive and the density does not fall.
        before = _log_density(x, mu, precision, b, p)
        while p + step[1] <= lowest or (
            _log_density(x, mu, precision, b + step[0], p + step[1]) < before - 1e-9 * abs(before)
        ):
            step = step / 2.0
        b, p = b + step[0], p + step[1]
        if gradient @ step < 1e-10 * x.size:
            break
    error = math.sqrt(np.linalg.inv(_derivatives(x, mu, precision, b, p)[1])[1, 1])
    weight = float(np.mean(precision / (precision + max(p, 0.0))))
    if not p > 2.0 * error:
        return UnpooledEstimate(math.nan, math.nan, weight)
    return UnpooledEstimate(center + unit * b / p, unit / math.sqrt(p), weight)


def _log_density(x: np.ndarray, mu: np.ndarray, precision: np.ndarray, b: float, p: float) -> float:
    """Return the log density of all draws, up to a constant."""
    variance = 1.0 / (p + precision)
    mean = variance * (b + mu * precision)
    return float(np.sum(-0.5 * (x - mean) ** 2 / variance - 0.5 * np.log(variance)))


def _derivatives(
    x: np.ndarray, mu: np.ndarray, precision: np.ndarray, b: float, p: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient of the log density in (b, p), and minus its Hessian."""
    variance = 1.0 / (p + precision)
    mean = variance * (b + mu * precision)
    gradient = np.array([np.sum(x - mean), 0.5 * np.sum(mean**2 + variance - x**2)])
    cross = -np.sum(mean * variance)
    square = np.sum(mean**2 * variance + 0.5 * variance**2)
    return gradient, np.array([[np.sum(variance), cross], [cross, square]])
