"""Convergence: a table of every parameter, and the verdict on a fit in sentences.

Source: Vehtari et al. (2021), Bayesian Analysis 16(2) (R-hat, ESS); Vehtari et al. (2024), JMLR
25(72) (Pareto k).
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats

from polar_bayes.diagnostics.approximation import approximation_cautions
from polar_bayes.diagnostics.budget import budget_sentences
from polar_bayes.diagnostics.checked import checks_made
from polar_bayes.diagnostics.criticism import criticize
from polar_bayes.diagnostics.finding import join, listed
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.parameters import (
    APPROXIMATIONS,
    WEIGHTED,
    Scalar,
    with_entries,
)
from polar_bayes.diagnostics.sensitivity import determination_sentences
from polar_bayes.diagnostics.view import FitView, Provenance, once, view_of
from polar_bayes.inference.result import CENTRAL_95, bounds_of
from polar_bayes.numerics.mcse import LARGEST_R_HAT, SMALLEST_ESS, TAILS
from polar_bayes.numerics.psis import FEW_ROUNDS, MAX_PARETO_K
from polar_bayes.priors import RANGES

COLUMNS = ("mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk", "ess_tail", "mcse_mean")


@dataclasses.dataclass(frozen=True)
class Verdict:
    """True if a result may be used, and what follows from it, in sentences.

    Args:
        passed: False where the numbers must not be used.
        problems: Why it did not pass.
        cautions: What a reader should know of a result that passed.
        findings: What the result says.
        converged: False where the method itself failed; where it is True and `passed` is False,
            the draws are of the posterior, but the readings speak against the model.
        checked: What was checked of a fit, in words.
        not_checked: Checks of a fit that could not be computed.
    """

    passed: bool
    problems: tuple[str, ...]
    cautions: tuple[str, ...]
    findings: tuple[str, ...] = ()
    converged: bool = True
    checked: tuple[str, ...] = ()
    not_checked: tuple[str, ...] = ()

    @property
    def sentences(self) -> tuple[str, ...]:
        """Problems, cautions and findings, in this order."""
        return self.problems + self.cautions + self.findings

    @property
    def nothing_against(self) -> str:
        """Checks made of a fit without problems and cautions; empty for any other fit."""
        if not self.passed or self.cautions or not self.checked:
            return ""
        left = f" Not computed: {', '.join(self.not_checked)}." if self.not_checked else ""
        made = join(self.checked)
        return f"Nothing speaks against the intervals in what was checked: {made}.{left}"


@once
def summary(fit: FitView) -> pd.DataFrame:
    """Return one row per scalar parameter of a fit, as `polar_bayes.summary` does."""
    # Source: Vehtari et al. (2021), Bayesian Analysis 16(2): rank-normalized split R-hat and ESS.
    rows = _point_rows(fit) if fit.method == "point" else _draw_rows(fit.scalars)
    return pd.DataFrame(rows, columns=list(COLUMNS), index=pd.Index([s.label for s in fit.scalars]))


@once
def verdict(fit: FitView) -> Verdict:
    """Judge whether the numbers of a fit may be used."""
    method, provenance, criticism = fit.method, fit.provenance, criticize(fit)
    noted = (str(problem).rstrip(".") for problem in provenance.get("problems", ()))
    problems = [f"{text[:1].upper()}{text[1:]}." for text in noted]
    problems += _draw_problems(fit)
    if method not in (*WEIGHTED, *APPROXIMATIONS, "point"):  # chains, those of users included
        problems += _chain_problems(fit)
    problems += _weight_problems(fit)
    against = criticism["sentence"].groupby(criticism["level"], sort=False).agg(list)
    cautions = (
        *approximation_cautions(fit),
        *_modes(provenance, drawn=False),
        *_round_cautions(fit),
        *_tail_cautions(fit),
        *_estimate_cautions(fit),
        *_masked(provenance.get("counts", {})),
        *_edges(provenance.get("counts", {}), many=True),
        *setup_cautions(provenance),
        *provenance.get("capture_cautions", ()),
        *provenance.get("scene_cautions", ()),
        *against.get("caution", []),
        *dict.fromkeys(against.get("not computed", [])),
    )
    faults = tuple(against.get("problem", []))
    notes = (
        *against.get("note", []),
        *_modes(provenance, drawn=True),
        *_chain_notes(fit),
        *_edges(provenance.get("counts", {}), many=False),
        *budget_sentences(fit),
        *(() if problems or faults else determination_sentences(fit)),
    )
    made, missing = checks_made(method, criticism)
    return Verdict(
        passed=not problems and not faults,
        problems=(*problems, *faults),
        cautions=cautions,
        findings=notes,
        converged=not problems,
        checked=() if method == "point" else made,
        not_checked=missing,
    )


def json_summary(result: xr.DataTree | FitView) -> dict[str, Any]:
    """Return table and verdict in the types of JSON; NaN becomes None.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        Keys parameters (label to mean, sd, q2.5, q97.5, r_hat, ess_bulk, ess_tail), converged,
        passed, problems, cautions, notes, checked, not_checked, criticism (check to level and
        p_value), method, model, scene, seed, counts and timings.

    Raises:
        FitError: The tree holds no posterior.
    """
    fit = view_of(result)
    found = verdict(fit)
    shown = [column for column in COLUMNS if column != "mcse_mean"]
    stated = ("model", "scene", "seed", "counts", "timings")
    return {
        "parameters": {
            str(label): {column: _number(row[column]) for column in shown}
            for label, row in summary(fit).iterrows()
        },
        "converged": found.converged,
        "passed": found.passed,
        **{key: list(getattr(found, key)) for key in ("problems", "cautions")},
        "notes": list(found.findings),
        **{key: list(getattr(found, key)) for key in ("checked", "not_checked")},
        "criticism": {
            str(check): {"level": row["level"], "p_value": _number(row["p_value"])}
            for check, row in criticize(fit).iterrows()
        },
        "method": fit.method,
        **{key: fit.provenance.get(key) for key in stated},
    }


def _draw_rows(found: Sequence[Scalar]) -> np.ndarray:
    draws = np.stack([scalar.draws for scalar in found])
    # A draw that is not finite makes its whole row NaN, and no other.
    finite = np.isfinite(draws).all(axis=(1, 2))
    rows = np.full((len(found), len(COLUMNS)), np.nan)
    if draws[0].size == 1:  # one draw is a number without a width
        rows[finite, 0] = draws[finite, 0, 0]
        return rows
    if not finite.any():
        return rows
    draws = draws[finite]
    flat = draws.reshape(len(draws), -1)
    with np.errstate(all="ignore"):  # R-hat of a parameter that never moved is 0/0
        rows[finite] = np.stack(
            [
                flat.mean(axis=1),
                flat.std(axis=1, ddof=1),
                *np.quantile(flat, CENTRAL_95, axis=1),
                array_stats.rhat(draws),
                array_stats.ess(draws, method="bulk"),
                array_stats.ess(draws, method="tail", prob=TAILS),
                array_stats.mcse(draws, method="mean"),
            ],
            axis=1,
        )
    return rows


def _point_rows(fit: FitView) -> np.ndarray:
    stated = dict(with_entries(fit.scalars, fit.provenance.get("standard_errors", {})))
    rows = np.full((len(fit.scalars), len(COLUMNS)), np.nan)
    for row, scalar in zip(rows, fit.scalars, strict=True):
        row[:2] = scalar.draws.mean(), stated.get(scalar)  # None becomes NaN
    return rows


def _draw_problems(fit: FitView) -> Iterator[str]:
    """List draws that are not finite, out of range, or all equal."""
    found, provenance = fit.scalars, fit.provenance
    if infinite := _percentages((s.label, ~np.isfinite(s.draws)) for s in found):
        hint = {
            "laplace": "the posterior is flat or open at its mode, so use method='nuts'",
            "point": "give starting values a chance with narrower priors",
        }.get(fit.method, "check the readings that the fit could not explain, or narrow the priors")
        yield f"Not finite: {infinite}; {hint}."
    declared = provenance.get("declared") or {}  # a user's model may give any name to anything
    known = (s for s in found if s.name not in declared)
    if outside := _percentages(_out_of_range(scalar, provenance) for scalar in known):
        yield (
            f"Outside its range: {outside}; no fit gives such values, so the result was changed or "
            "damaged: fit the capture again."
        )
    free = (s for s in found if s.name not in (provenance.get("fixed") or {}))
    equal = [s.label for s in free if s.draws.min() == s.draws.max()]
    if equal and fit.method != "point":
        yield (
            f"All draws are equal: {listed(equal)}; nothing is known of the width of the "
            "posterior, so fit again with more draws, or hold the parameter fixed."
        )


def _out_of_range(scalar: Scalar, provenance: Provenance) -> tuple[str, np.ndarray]:
    """Return finite draws outside the prior or the physical range of their parameter."""
    least, most = RANGES.get(scalar.name, (-math.inf, math.inf))
    low, high = bounds_of(provenance, scalar.name)
    ends = np.array([max(low, least), min(high, most)])
    low, high = ends + np.array([-LIMITS.rounding, LIMITS.rounding]) * np.maximum(1.0, abs(ends))
    outside = (scalar.draws < low) | (scalar.draws > high)
    label = f"{scalar.label} [{ends[0]:g}, {ends[1]:g}]"
    return label, outside & np.isfinite(scalar.draws)


def _percentages(flags: Iterable[tuple[str, np.ndarray]]) -> str:
    """Format `roughness 3% of its draws` for parameters with flagged draws; else empty."""
    return listed(f"{label} {bad.mean():.0%} of its draws" for label, bad in flags if bad.any())


def _chain_problems(fit: FitView) -> Iterator[str]:
    """List chains that disagree, are too short, or have diverged."""
    table = summary(fit)
    r_hat = table["r_hat"]
    high = r_hat[~(r_hat <= LARGEST_R_HAT)].sort_values(ascending=False)
    if len(high):
        yield (
            f"R-hat above {LARGEST_R_HAT}: {listed(f'{n} {x:.4g}' for n, x in high.items())}; the "
            "chains have not found one distribution, so sample longer, as in Nuts(warmup=1000, "
            "most_draws=20000), and look at the pair plot for several modes."
        )
    for column, part, estimate in (
        ("ess_bulk", "Bulk", "center"),
        ("ess_tail", "Tail", "interval"),
    ):
        low = table[column][~(table[column] >= SMALLEST_ESS)].sort_values()
        if len(low):
            numbers = listed(f"{label} {np.floor(x):.0f}" for label, x in low.items())
            yield (
                f"{part} ESS below {SMALLEST_ESS}: {numbers}; the {estimate} is not known well "
                "enough, so sample longer, as in Nuts(most_draws=20000)."
            )
    diverging = fit.stats.get("diverging")
    if diverging is not None and diverging.any():
        yield (
            f"{int(diverging.sum())} of {diverging.size} draws diverged: the sampler could not "
            "follow a sharp corner of the posterior and may have missed part of it, so raise "
            "target_acceptance, as in Nuts(target_acceptance=0.99), or narrow the priors."
        )


def _weight_problems(fit: FitView) -> Iterator[str]:
    """List weighted draws whose effective sample size is below the limit of chains."""
    effective = fit.provenance.get("ess")
    if fit.method in WEIGHTED and effective is not None and effective < SMALLEST_ESS:
        yield (
            f"The effective sample size of the weighted draws is {effective:.0f} (at least "
            f"{SMALLEST_ESS}): the interval is not known well enough, so draw more, as in "
            "Importance(draws=16384), or use method='nuts'."
        )


def _round_cautions(fit: FitView) -> Iterator[str]:
    """Tell of weighted draws whose proposals were adapted for long."""
    rounds = fit.provenance.get("rounds", 1)
    if fit.method in WEIGHTED and rounds > FEW_ROUNDS:
        yield (
            f"The proposals of the weighted draws were adapted in {rounds} rounds (at most "
            f"{FEW_ROUNDS}): they may miss the end of a long tail, of which Pareto k tells "
            "nothing, so use method='nuts' where the ends of intervals matter."
        )


def _modes(provenance: Provenance, *, drawn: bool) -> Iterator[str]:
    """Another mode, of which the draws are known to have their share, or not."""
    modes = provenance.get("modes") or {}
    weights = modes.get("weights", [])
    method = str(provenance.get("method", "laplace"))
    pareto_k = (provenance if method in WEIGHTED else provenance.get("tails") or {}).get("pareto_k")
    # Of chains that each visited all, R-hat tells whether they agree on the shares.
    visited = modes.get("unvisited") == 0.0
    is_drawn = visited or (pareto_k is not None and pareto_k <= MAX_PARETO_K)
    if len(weights) < 2 or weights[1] <= LIMITS.second_mode or drawn != is_drawn:
        return
    effect = "; "
    if is_drawn:
        effect = ", and the draws are of both; a mean may lie between them; "
    elif method == "nuts":
        effect = ", and chains may not have visited them in proportion; compare chains in the "
        effect += "rank plot, or "
    elif method in APPROXIMATIONS:
        effect = ", and only the heaviest is described here; use method='nuts', or "
    yield (
        f"The posterior has another mode, of weight {weights[1]:.2g}: another explanation of "
        f"the readings exists{effect}add views that tell them apart."
    )


def _tail_cautions(fit: FitView) -> Iterator[str]:
    """List tails of chains that are too light compared with those of weighted draws."""
    tails = fit.provenance.get("tails") or {}
    if not tails or not tails["pareto_k"] <= MAX_PARETO_K:
        return
    nominal, missed = CENTRAL_95[0], []
    variance = nominal * (1.0 - nominal)
    for scalar, shares in with_entries(fit.scalars, tails["shares"]):
        row = summary(fit).loc[scalar.label]
        error = math.sqrt(variance / row["ess_tail"] + variance / tails["ess"])
        for share, side, end in zip(shares, ("below", "above"), ("q2.5", "q97.5"), strict=True):
            if share > max(2.0 * nominal, nominal + LIMITS.tail_errors * error):
                missed.append((share, f"{scalar.label} {side} {row[end]:.3g} ({share:.1%})"))
    if missed:
        names = listed(text for _, text in sorted(missed, reverse=True))
        yield (
            "The chains may have missed an arm of the posterior: where they have 2.5% of their "
            f"draws, weighted draws (Pareto k {tails['pareto_k']:.2f}) have more, {names}; "
            "compare Importance(), or sample longer."
        )


def _chain_notes(fit: FitView) -> Iterator[str]:
    """Note trajectories that reached the depth limit, which costs time but no accuracy."""
    deep = fit.stats.get("reached_max_treedepth")
    if deep is not None and deep.sum() > LIMITS.deep_trees * deep.size:
        yield (
            f"{int(deep.sum())} of {deep.size} draws reached the largest tree depth: "
            "trajectories were cut short, which correlates draws without bias; raise it, as in "
            "Nuts(max_tree_depth=10)."
        )


def _estimate_cautions(fit: FitView) -> Iterator[str]:
    sd = summary(fit)["sd"]
    undetermined = sd.index[sd.isna()]
    if fit.method == "point" and len(undetermined):
        yield (
            f"No standard error: {listed(dict.fromkeys(undetermined))}; least squares does not "
            "determine such values, so do not use them."
        )


def _masked(counts: Provenance) -> Iterator[str]:
    total, masked = counts.get("views") or 0, counts.get("masked") or 0
    if total and masked / total > LIMITS.masked:
        yield (
            f"{masked} of {total} readings are marked valid=False: the rest may not be a fair "
            "sample of the angles."
        )


def _edges(counts: Provenance, *, many: bool) -> Iterator[str]:
    """Readings at the edge of their range, as a mirror has near Brewster's angle: few or many."""
    total = counts.get("views") or 0
    of = "" if many else f" of {total}"
    effect = ": their noise is not what the link describes" if many else ""
    for name, count in (counts.get("at_margin") or {}).items():
        if count and total and many == (count / total > LIMITS.at_margin):
            yield (
                f"{count}{of} readings of {name} lie at the edge of their range and were moved to "
                f"the link's margin{effect}."
            )


def setup_cautions(provenance: Provenance) -> tuple[str, ...]:
    """Caution if no set-up was stated for a capture, however the capture was made."""
    if provenance.get("scene_chosen_by") != "default":
        return ()
    sentence = (
        f"No set-up was stated, so {provenance.get('scene', 'paper')!r} was used, a point "
        "source and an unsigned degree of polarization: state it by setup= at import or "
        "scene=, or let scene='auto' of a fit choose."
    )
    return (sentence,)


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
