"""May these numbers be quoted? A table of every parameter and a verdict in plain sentences."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats

from polar_bayes.diagnostics.parameters import (
    APPROXIMATIONS,
    Scalar,
    method_of,
    posterior_scalars,
    stats_of,
)
from polar_bayes.inference.result import bounds_of, provenance_of
from polar_bayes.priors import RANGES

COLUMNS = ("mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk", "ess_tail", "mcse_mean")
INTERVAL = (0.025, 0.975)
TAILS = (0.05, 0.95)
LARGEST_R_HAT = 1.01
SMALLEST_ESS = 400
LARGEST_K_HAT = 0.7
LARGEST_SECOND_MODE = 0.01
MANY_MASKED = 0.25
MANY_DEEP = 0.01
LONGEST_LIST = 4
ROUNDING = 1e-6
"""How far draws in single precision may lie beyond the end of their prior."""
HEAVIEST = ", and only the heaviest is described here; use method='nuts', or "
OTHER_MODES = {
    "laplace": HEAVIEST,
    "variational": HEAVIEST,
    "importance": ", and the draws are of both; a mean may lie between them; ",
    "nuts": ", and chains may not have visited them in proportion; compare chains in the rank "
    "plot, or ",
}
"""What methods make of a further mode; of one's own nothing is known."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Whether a fit may be used."""

    converged: bool
    problems: tuple[str, ...]
    cautions: tuple[str, ...]


def summary(result: xr.DataTree) -> pd.DataFrame:
    """One row per scalar parameter, numbers unrounded.

    Intervals are equal-tailed. A point fit has no draws: its standard errors stand in `sd` and
    the rest is NaN, as is the standard error of a parameter that the readings do not determine.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        Columns mean, sd, q2.5, q97.5 (unit of the parameter), r_hat, ess_bulk, ess_tail (unit 1)
        and mcse_mean; the index holds labels such as `refractive_index[450]`, the material first.

    Raises:
        FitError: The tree holds no posterior.

    Source:
        Vehtari et al. (2021), Bayesian Analysis 16(2): rank-normalized split R-hat and ESS.
    """
    found = posterior_scalars(result)
    rows = _point_rows(result, found) if method_of(result) == "point" else _draw_rows(found)
    return pd.DataFrame(rows, columns=list(COLUMNS), index=pd.Index([s.label for s in found]))


def verdict(result: xr.DataTree) -> Verdict:
    """Whether the numbers of a fit may be used, and what a reader of them should know.

    Sampling fails on any R-hat above 1.01, any effective sample size below 400 and any divergence;
    every method fails on a draw that is not finite or that its prior or physics rules out, on draws
    of a parameter that are all equal, and on a problem that the fit itself noted.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        The verdict; its sentences name the parameter, the number and the remedy.

    Raises:
        FitError: The tree holds no posterior.
    """
    return judge(result, summary(result))


def judge(result: xr.DataTree, table: pd.DataFrame) -> Verdict:
    """The verdict of `verdict`, from a table that is already there."""
    method, provenance = method_of(result), provenance_of(result)
    problems = [f"{_sentence(problem)}." for problem in provenance.get("problems", ())]
    found = posterior_scalars(result)
    problems += _not_finite(found, method) + _impossible(found, provenance)
    if method != "point":
        problems += _frozen(found, provenance)
    if method == "nuts":
        problems += _chains_disagree(table) + _divergences(result)
    cautions = [
        *_approximation(result, method),
        *_several_modes(provenance),
        *_deep_trees(result),
        *_undetermined_point(table, method),
        *_readings(provenance.get("counts", {})),
    ]
    return Verdict(not problems, tuple(problems), tuple(cautions))


def json_summary(result: xr.DataTree) -> dict[str, Any]:
    """Table and verdict as JSON can hold them; NaN becomes None.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        Keys parameters (label to mean, sd, q2.5, q97.5, r_hat, ess_bulk, ess_tail), converged,
        problems, cautions, method, model, scene, seed, counts and timings.

    Raises:
        FitError: The tree holds no posterior.
    """
    table, provenance = summary(result), provenance_of(result)
    judged = judge(result, table)
    shown = [column for column in COLUMNS if column != "mcse_mean"]
    said = {key: provenance.get(key) for key in ("model", "scene", "seed", "counts", "timings")}
    return {
        "parameters": {
            str(label): {column: _number(row[column]) for column in shown}
            for label, row in table.iterrows()
        },
        "converged": judged.converged,
        "problems": list(judged.problems),
        "cautions": list(judged.cautions),
        "method": method_of(result),
        **said,
    }


def laplace_k_hat(result: xr.DataTree) -> float:
    """Pareto k-hat of the importance weights of Laplace draws or of a variational guide."""
    # $$ w = p(z | data) / q(z) $$
    # Source: Vehtari et al. (2024), JMLR 25(72).
    stats = stats_of(result)
    if "log_weight" not in stats:
        return math.nan
    log_weight = stats["log_weight"].to_numpy().astype(float).ravel()
    if np.any(np.isnan(log_weight) | np.isposinf(log_weight)) or np.all(np.isneginf(log_weight)):
        return math.nan
    lowest = np.min(log_weight[np.isfinite(log_weight)])
    log_weight = np.where(np.isneginf(log_weight), lowest - 700.0, log_weight) - log_weight.max()
    if np.ptp(log_weight) < 1e-12:
        return -math.inf
    with np.errstate(all="ignore"):  # smoothing an extreme tail overflows inside ArviZ
        # psislw expects log likelihoods, which are minus the log ratios: hence the sign.
        return float(array_stats.psislw(-log_weight)[1])


def _draw_rows(found: Sequence[Scalar]) -> np.ndarray:
    draws = np.stack([scalar.draws for scalar in found])
    # A draw that is not finite spoils its whole row, visibly, and no other.
    whole = np.isfinite(draws).all(axis=(1, 2))
    rows = np.full((len(found), len(COLUMNS)), np.nan)
    if draws[0].size == 1:  # one draw is a number without a width
        rows[whole, 0] = draws[whole, 0, 0]
        return rows
    if not whole.any():
        return rows
    kept = draws[whole]
    flat = kept.reshape(len(kept), -1)
    with np.errstate(all="ignore"):  # R-hat of a parameter that never moved is 0/0
        rows[whole] = np.stack(
            [
                flat.mean(axis=1),
                flat.std(axis=1, ddof=1),
                *np.quantile(flat, INTERVAL, axis=1),
                array_stats.rhat(kept),
                array_stats.ess(kept, method="bulk"),
                array_stats.ess(kept, method="tail", prob=TAILS),
                array_stats.mcse(kept, method="mean"),
            ],
            axis=1,
        )
    return rows


def _point_rows(result: xr.DataTree, found: Sequence[Scalar]) -> np.ndarray:
    errors = provenance_of(result).get("standard_errors", {})
    rows = np.full((len(found), len(COLUMNS)), np.nan)
    rows[:, 0] = [scalar.draws.mean() for scalar in found]
    place: dict[str, int] = {}
    for row, scalar in enumerate(found):
        stated, at = errors.get(scalar.name, []), place.get(scalar.name, 0)
        place[scalar.name] = at + 1
        if at < len(stated) and stated[at] is not None:
            rows[row, 1] = stated[at]
    return rows


def _not_finite(found: Iterable[Scalar], method: str) -> list[str]:
    bad = {s.label: float(np.mean(~np.isfinite(s.draws))) for s in found}
    bad = {label: share for label, share in bad.items() if share > 0.0}
    if not bad:
        return []
    remedy = {
        "laplace": "the posterior is flat or open at its mode, so use method='nuts'",
        "point": "give starting values a chance with narrower priors",
    }.get(method, "check the readings that the fit could not explain, or narrow the priors")
    return [f"Not finite: {_list(bad, lambda x: f'{x:.0%} of its draws')}; {remedy}."]


def _impossible(found: Iterable[Scalar], provenance: Mapping[str, Any]) -> list[str]:
    """Draws beyond the ends of their prior, or beyond what the parameter can be at all."""
    bad = {}
    for scalar in found:
        if scalar.name in (provenance.get("declared") or {}):
            continue  # a model of the user's own may give any name to anything
        least, most = RANGES.get(scalar.name, (-math.inf, math.inf))
        low, high = bounds_of(provenance, scalar.name)
        low, high = max(low, least), min(high, most)
        slack = [
            ROUNDING * max(1.0, abs(end)) if math.isfinite(end) else 0.0 for end in (low, high)
        ]
        outside = (scalar.draws < low - slack[0]) | (scalar.draws > high + slack[1])
        if share := float(np.mean(outside & np.isfinite(scalar.draws))):
            bad[f"{scalar.label} [{low:g}, {high:g}]"] = share
    if not bad:
        return []
    return [
        f"Outside its range: {_list(bad, lambda x: f'{x:.0%} of its draws')}; no fit gives such "
        "values, so the result was changed or damaged: fit the capture again."
    ]


def _frozen(found: Iterable[Scalar], provenance: Mapping[str, Any]) -> list[str]:
    """Parameters whose draws say nothing of a width, but for those that were held fixed."""
    free = (s for s in found if s.name not in (provenance.get("fixed") or {}))
    same = {s.label: 0.0 for s in free if s.draws.min() == s.draws.max()}
    if not same:
        return []
    return [
        f"All draws are equal: {_list(same, None)}; nothing is known of the width of the "
        "posterior, so fit again with more draws, or hold the parameter fixed."
    ]


def _chains_disagree(table: pd.DataFrame) -> list[str]:
    problems = []
    r_hat = table["r_hat"]
    unequal = r_hat[~(r_hat <= LARGEST_R_HAT)].sort_values(ascending=False)
    if len(unequal):
        problems.append(
            f"R-hat above {LARGEST_R_HAT}: {_list(unequal, lambda x: f'{x:.4g}')}; the chains "
            "have not found one distribution, so sample longer, as in Nuts(warmup=1000, "
            "most_draws=20000), and look at the pair plot for several modes."
        )
    for column, part, place in (("ess_bulk", "Bulk", "center"), ("ess_tail", "Tail", "interval")):
        few = table[column][~(table[column] >= SMALLEST_ESS)].sort_values()
        if len(few):
            problems.append(
                f"{part} ESS below {SMALLEST_ESS}: {_list(few, lambda x: f'{np.floor(x):.0f}')}; "
                f"the {place} is not known well enough, so sample longer, as in "
                "Nuts(most_draws=20000)."
            )
    return problems


def _divergences(result: xr.DataTree) -> list[str]:
    diverging = stats_of(result).get("diverging")
    count = 0 if diverging is None else int(diverging.sum())
    if diverging is None or not count:
        return []
    return [
        f"{count} of {diverging.size} draws diverged: the sampler could not follow a sharp corner "
        "of the posterior and may have missed part of it, so raise target_acceptance, as in "
        "Nuts(target_acceptance=0.99), or narrow the priors."
    ]


def _approximation(result: xr.DataTree, method: str) -> list[str]:
    if method not in APPROXIMATIONS:
        return []
    stats = stats_of(result)
    k_hat = laplace_k_hat(result)
    if "log_weight" not in stats or k_hat <= LARGEST_K_HAT:
        return []
    whose, what = (
        ("the Laplace draws", "a normal distribution")
        if method == "laplace"
        else ("the guide's draws", "the guide")
    )
    return [
        f"Pareto k-hat of {whose} is {k_hat:.2f} (at most {LARGEST_K_HAT}): the posterior is not "
        f"close to {what}; use method='nuts' for intervals."
    ]


def _several_modes(provenance: Mapping[str, Any]) -> list[str]:
    weights = (provenance.get("modes") or {}).get("weights", [])
    if len(weights) < 2 or not weights[1] > LARGEST_SECOND_MODE:
        return []
    method = str(provenance.get("method", "laplace"))
    return [
        f"The posterior has another mode, of weight {weights[1]:.2g}: another explanation of the "
        f"readings exists{OTHER_MODES.get(method, '; ')}add views that tell them apart."
    ]


def _deep_trees(result: xr.DataTree) -> list[str]:
    stats = stats_of(result)
    if "reached_max_treedepth" not in stats:
        return []
    count, size = int(stats["reached_max_treedepth"].sum()), stats["reached_max_treedepth"].size
    if count <= MANY_DEEP * size:
        return []
    return [
        f"{count} of {size} draws reached the largest tree depth: steps were cut short, which "
        "biases nothing but makes draws alike; raise it, as in Nuts(max_tree_depth=10)."
    ]


def _undetermined_point(table: pd.DataFrame, method: str) -> list[str]:
    open_ = table.index[table["sd"].isna()] if method == "point" else ()
    if not len(open_):
        return []
    return [
        f"No standard error: {_list(dict.fromkeys(open_, 0.0), None)}; least squares does not "
        "determine such values, so they say nothing."
    ]


def _readings(counts: Mapping[str, Any]) -> list[str]:
    cautions = []
    total, masked = counts.get("views") or 0, counts.get("masked") or 0
    if total and masked / total > MANY_MASKED:
        cautions.append(
            f"{masked} of {total} readings are marked valid=False: the rest may not be a fair "
            "sample of the angles."
        )
    for name, count in (counts.get("at_margin") or {}).items():
        if count:
            cautions.append(
                f"{count} readings of {name} lie at the edge of their range and were moved to "
                "the link's margin: their noise is not what the link describes."
            )
    return cautions


def _list(values: Mapping[Any, float] | pd.Series, number: Callable[[float], str] | None) -> str:
    """`roughness 1.08, absorption[450] 1.03 and 2 more`."""
    items = [
        f"{label} {number(value)}" if number else str(label) for label, value in values.items()
    ]
    shown, more = items[:LONGEST_LIST], len(items) - LONGEST_LIST
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def _sentence(text: str) -> str:
    return (text[:1].upper() + text[1:]).rstrip(".")


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
