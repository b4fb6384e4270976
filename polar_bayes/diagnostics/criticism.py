r"""Model criticism of a fit: do readings contradict its priors, its instrument or its parts?

Each check has a level. A problem makes the intervals unusable, a caution stands next to them, a
note tells what was found without speaking against anything. Residuals have their own file.

Source: Evans & Moshonov (2006), Bayesian Analysis 1, 893 (prior-data conflict by tail probability);
Saeilynoja et al. (2022), Stat. Comput. 32, 32 (uniformity of leave-one-out PIT values); Dickey
(1971), Ann. Math. Stat. 42, 204 (Bayes factor of a nested model); Kass & Raftery (1995), J. Am.
Stat. Assoc. 90, 773 (Bayes factors of alternative parts); Vovk & Wang (2021), Ann. Statist. 49,
1736 (their mean as a p-value).
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats
from scipy.special import expit, logsumexp

from polar_bayes.capture.plausibility import ASSUMED, IndexByEye, index_sentences
from polar_bayes.diagnostics.alternatives import NOTHING, alternatives
from polar_bayes.diagnostics.approximation import smoothed_weights
from polar_bayes.diagnostics.finding import Finding, join, judged_by, listed, p_text
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.parameters import Scalar, with_entries
from polar_bayes.diagnostics.predictive import PredictiveCheck, predictive_checks
from polar_bayes.diagnostics.residuals import residual_findings, residuals_of
from polar_bayes.diagnostics.view import FitView, Provenance, once, view_of
from polar_bayes.errors import FitError
from polar_bayes.inference.checks import (
    CARRIES,
    MASS_AT_BOUND,
    NOISE_FACTOR,
    excluding_bounds,
    level,
    prior_conflict,
    share_at,
    tail_scores,
)
from polar_bayes.inference.result import CENTRAL_95, bounds_of
from polar_bayes.observation.data import ANGLES
from polar_bayes.observation.links import PERFECT
from polar_bayes.physics.part import absence
from polar_bayes.priors import INDICES

INDEX = "refractive_index"
QUESTIONS = {
    "priors": "are the material and correlated parameters in the tails of their priors?",
    "absent": "is a part of the scene, or a fault of the instrument, not seen at all?",
    "noise": "do the readings scatter more, or less, than was stated?",
    "bounds": "does a parameter lie against a bound?",
    "index": "does Brewster's angle mean an index that the prior excludes?",
    "systematic errors": "does the answer rest on smooth errors that the readings do not show?",
    "angle": "do neighboring directions have correlated errors?",
    "wavelength": "do the wavelengths of one view have correlated errors?",
    "outliers": "is a reading farther out than noise explains?",
    "leave-one-out": "are leave-one-out PIT values uniform?",
    "influence": "does a single reading decide the answer?",
    "repeats": "was a view entered more than once?",
    "alternatives": "would another part do as well, or better?",
}
"""The checks in the order of the table, each with its question."""


@once
def criticize(result: xr.DataTree | FitView) -> pd.DataFrame:
    """Check the model of a fit against its readings.

    A check with a p-value gives a caution below 0.02 and a problem below 0.004, which is the
    probability of either under a right model whose truth is drawn from its priors.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A row for each check of `QUESTIONS`. Columns: level ("passed", "note", "caution", "problem"
        or "not computed"), p_value and statistic (NaN where a check has none), sentence (empty
        where it passed).

    Raises:
        FitError: The tree holds no posterior, or its parts do not fit together.

    Source:
        Gelman, Meng and Stern (1996), Statistica Sinica 6, 733; Evans and Moshonov (2006), Bayesian
        Analysis 1, 893.
    """
    fit = view_of(result)
    needed = ("prior", "observed_data", "constant_data")
    missing = [f"group {name}" for name in needed if name not in fit.result.children]
    if not missing:
        missing = [name for name in ANGLES if name not in fit.result["constant_data"].data_vars]
    if fit.method == "point" or missing:
        why = f"The result has no {', '.join(missing)}, so the model was not checked."
        if fit.method == "point":
            why = "A point fit has no draws to criticize."
        return _table(dict.fromkeys(QUESTIONS, Finding("not computed", sentence=why)))
    absent = [s for s in fit.scalars if _is_absent(s, fit)]
    index = _index(fit)
    # Where the index by eye says so, a wider prior is the remedy, and no other check names one.
    is_beyond = bool(index.sentence)
    return _table(
        {
            "priors": _prior_conflict(fit, is_beyond),
            "absent": _absent(fit.scalars, absent),
            "noise": _noise(fit),
            "bounds": _bounds(fit, is_beyond),
            "index": index,
            "systematic errors": _systematic_errors(fit, absent),
            **residual_findings(residuals_of(fit), smoothed_weights(fit)[1]),
            "leave-one-out": _leave_one_out(predictive_checks(fit)),
            "repeats": _repeats(fit),
            "alternatives": _alternatives(fit, absent),
        }
    )


def _table(findings: Mapping[str, Finding]) -> pd.DataFrame:
    rows = [findings[name] for name in QUESTIONS]
    return pd.DataFrame(rows, index=pd.Index(list(QUESTIONS), name="check"))


# --- Priors, noise and bounds ---------------------------------------------------------------------


def _prior_conflict(fit: FitView, is_beyond: bool) -> Finding:
    """Check posterior medians against the tails of their priors, one by one and jointly."""
    below = _prior_probability(fit, _carriers(fit.scalars))
    if not below:
        return Finding("not computed", sentence="The fit states no prior probabilities.")
    probability = np.array(list(below.values()))
    end = np.array([_absent_end(scalar.name, fit.provenance) for scalar in below])
    p_value = float(prior_conflict(probability, end))
    tails, score = tail_scores(probability, end)
    names = [scalar.label for scalar in below]
    far = [f"{names[i]} {score[i]:.1f} sd" for i in np.argsort(-score) if score[i] > 1.5]
    advice = "state priors that hold for this object"
    if not is_beyond:
        advice = (
            "a scene without what the readings show forces its parameters there, so try "
            f"polar_bayes.compare_scenes, or {advice}"
        )
    sentence = (
        f"Priors and data are in conflict ({p_text(p_value)}): {listed(far)} from the center of "
        f"the prior; {advice}."
    )
    least = "caution" if tails.min() < LIMITS.prior_tail else "passed"
    return judged_by(p_value, float(score.max()), sentence, least=least)


def _carriers(found: Sequence[Scalar]) -> list[Scalar]:
    """Return the material parameters, and scene parameters correlated with one of them."""
    judged = [s for s in found if s.name not in PERFECT and np.isfinite(s.draws).all()]
    material = [s for s in judged if s.is_material]
    if not material:
        return judged
    moving = [s for s in judged if np.ptp(s.draws) > 0.0]
    scaled = [s.draws.ravel() / np.abs(s.draws).max() for s in moving]  # squares do not vanish
    correlation = np.atleast_2d(np.corrcoef(scaled))
    of_material = np.abs(correlation[:, [s.is_material for s in moving]])
    carrying = {
        s.label for s, row in zip(moving, of_material, strict=True) if (row >= CARRIES).any()
    }
    return [s for s in judged if s.is_material or s.label in carrying]


def _absent_end(name: str, provenance: Provenance) -> float:
    """Return -1 or 1 if the low or high end of the support means an absent part, else 0."""
    absent = absence(name)
    if absent is None:
        return 0.0
    low, high = bounds_of(provenance, name)
    return -1.0 if absent.value <= low else 1.0 if absent.value >= high else 0.0


def _prior_probability(fit: FitView, found: Sequence[Scalar]) -> dict[Scalar, float]:
    """Return the prior probability below the posterior median of each parameter."""
    stated = fit.provenance.get("prior_probability") or {}
    fixed = fit.provenance.get("fixed") or {}
    return {
        scalar: float(below)
        for scalar, below in with_entries(found, stated)
        if scalar.name not in fixed
    }


def _absent(found: Sequence[Scalar], absent: Sequence[Scalar]) -> Finding:
    """Note parts and faults that are consistent with absence, and the answer without them."""
    others = [s for s in found if s.is_material and s not in absent and np.isfinite(s.draws).all()]
    others = [s for s in others if s.name == INDEX] or others
    words = list(dict.fromkeys(a.words for s in absent if (a := absence(s.name)) is not None))
    if not words:
        return Finding("passed")
    shown = f"The readings show {join(words)}"
    if not others:
        return Finding("note", sentence=f"{shown}.")
    shifts = {s.label: _without(s, absent) for s in others}
    label = max(shifts, key=lambda name: abs(shifts[name]))
    change = f"{label} is the same without (within {max(abs(shifts[label]), 0.1):.1f} sd)"
    if abs(shifts[label]) > LIMITS.same_mean:
        draws = next(s.draws for s in others if s.label == label)
        value = draws.mean() + shifts[label] * draws.std()
        change = f"without, {label} would be {value:.4g} instead of {draws.mean():.4g}"
    return Finding("note", statistic=shifts[label], sentence=f"{shown}; {change}.")


def _is_absent(scalar: Scalar, fit: FitView) -> bool:
    """Return whether the readings have moved the posterior to the absent end."""
    absent, prior = absence(scalar.name), fit.prior.get(scalar.label)
    if absent is None or prior is None or not np.isfinite(scalar.draws).all():
        return False
    if _absent_end(scalar.name, fit.provenance) == 0.0 or not np.ptp(scalar.draws) > 0.0:
        return False
    distance = np.abs(scalar.draws - absent.value)
    reach = float(np.quantile(distance, CENTRAL_95[1]))
    is_near = float(np.median(distance)) < 2.0 * float(distance.std())
    return is_near and float(np.mean(np.abs(prior.draws - absent.value) <= reach)) < 0.5


def _without(scalar: Scalar, absent: Sequence[Scalar]) -> float:
    """Estimate by regression, in sds, how a mean changes if other parameters are held absent."""
    # Source: conditional mean of a normal posterior.
    values = np.stack([s.draws.ravel() for s in absent])
    ends = np.array([a.value for s in absent if (a := absence(s.name)) is not None])
    score = (scalar.draws.ravel() - scalar.draws.mean()) / scalar.draws.std()
    center, sd = values.mean(axis=1), values.std(axis=1)
    slopes = np.linalg.lstsq(((values - center[:, None]) / sd[:, None]).T, score, rcond=None)[0]
    return float(slopes @ ((ends - center) / sd))


def _noise(fit: FitView) -> Finding:
    """Check the scatter of readings against the noise priors and the errors in the capture."""
    noise = [s for s in fit.scalars if s.name in PERFECT and np.isfinite(s.draws).all()]
    below = _prior_probability(fit, noise)
    worse = {
        s.label: share if math.isinf(PERFECT[s.name]) else 1.0 - share for s, share in below.items()
    }
    if not worse:
        return Finding("passed")
    largest = min(worse, key=lambda label: worse[label])
    p_value = min(1.0, worse[largest] * len(worse))
    sentence = (
        f"The readings scatter more than the prior of their noise allows ({p_text(p_value)} by "
        f"{largest}): the scene lacks what the readings show, or the noise is not as supposed; "
        "look at the residuals in the report, and try polar_bayes.compare_scenes."
    )
    least = "passed"
    is_assumed = (fit.provenance.get("capture") or {}).get("errors") == ASSUMED
    errors = f"the errors that were {ASSUMED}" if is_assumed else "their stated errors"
    # The fit takes the factor for what it is; beyond what its prior allows it is a caution.
    for scalar in (s for s in noise if s.name == NOISE_FACTOR):
        low, high = np.quantile(scalar.draws, CENTRAL_95)
        why = ""
        if low > LIMITS.large_noise_factor:
            why = (
                "these errors are too small, or the scene lacks what the readings show; check the "
                "errors, or try polar_bayes.compare_scenes"
            )
        elif high < LIMITS.small_noise_factor:
            why = "these errors are too large, and the fit takes the readings to be that precise"
        if why:
            least, factor = "note", f"{np.median(scalar.draws):.3g} times [{low:.3g}, {high:.3g}]"
            sentence = f"The readings scatter {factor} {errors}: {why}."
    return judged_by(p_value, math.nan, sentence, least=least)


def _bounds(fit: FitView, is_beyond: bool) -> Finding:
    """Find bounds of the support where the posterior density, unlike the prior's, is high."""
    hits = []
    for scalar in fit.scalars:
        prior = fit.prior.get(scalar.label)
        if prior is None or not np.isfinite(scalar.draws).all():
            continue
        for bound in excluding_bounds(scalar.name, bounds_of(fit.provenance, scalar.name)):
            share = float(share_at(bound, scalar.draws.ravel()))
            if share >= MASS_AT_BOUND > share_at(bound, prior.draws.ravel()):
                hits.append((share, scalar, bound))
    if not hits:
        return Finding("passed")
    hits.sort(key=lambda hit: -hit[0])
    where = [f"{s.label} at {bound:g} ({share:.0%} of its draws)" for share, s, bound in hits]
    (_, scalar, bound), beyond = hits[0], ""
    if scalar.name == INDEX and bound > 1.0 and not is_beyond:
        wider = f"TruncatedNormal({bound:g}, 0.3, low=1)"
        beyond = f" If the index may lie beyond, give priors={{'{INDEX}': {wider}}}."
    sentence = (
        f"The posterior lies against a bound: {listed(where)}; what is beyond is excluded by the "
        "prior or by physics, not by the readings, so the interval is too narrow or the scene is "
        f"wrong.{beyond}"
    )
    return Finding("caution", statistic=hits[0][0], sentence=sentence)


def _index(fit: FitView) -> Finding:
    """Check the index of Brewster's angle by eye against the prior of the fit."""
    provenance = fit.provenance
    stated = provenance.get("indices_by_eye") or {}
    by_eye: dict[str, IndexByEye | None] = {n: IndexByEye(*index) for n, index in stated.items()}
    free = {s.name for s in fit.scalars} & set(provenance.get("bounds") or {})
    free -= set(provenance.get("fixed") or {})
    parameter = next((name for name in INDICES if name in free), "")
    bounds = bounds_of(provenance, parameter)
    sentences = index_sentences(by_eye, bounds, parameter, "the prior")
    if not parameter or not sentences:
        return Finding("passed")
    zeros = [s.draws.std() for s in fit.prior.values() if s.name == "angle_zero"]
    off = 2.0 * float(max(zeros, default=0.0))  # the zero of the angle scale may be off as well
    excluded = any(index and index.is_excluded(bounds, off) for index in by_eye.values())
    is_member = not parameter.endswith("_location")  # a population may have a far member
    return Finding("problem" if excluded and is_member else "caution", sentence=sentences[0])


# --- Systematic errors ----------------------------------------------------------------------------


def _systematic_errors(fit: FitView, absent: Sequence[Scalar]) -> Finding:
    """Find smooth errors that exceed their prior, or that alone move the answer."""
    found, groups = fit.scalars, fit.result.children
    amplitude = [s for s in found if s.name == "discrepancy_amplitude"]
    if not amplitude:
        return Finding("passed")
    if "scenes" in groups:  # those without smooth errors are among the scenes compared
        return Finding("passed")
    if "without_discrepancy" not in groups:
        reason = "The fit without smooth errors was not made."
        return Finding("not computed", sentence=reason)
    sizes = [*amplitude, *(s for s in found if s.name == NOISE_FACTOR)]
    below = _prior_probability(fit, sizes)
    p_value = float(prior_conflict(np.array(list(below.values())), -np.ones(len(below))))
    without = {label: s.draws for label, s in fit.scalars_of("without_discrepancy").items()}
    shifts = {
        s.label: float((without[s.label].mean() - s.draws.mean()) / s.draws.std())
        for s in found
        if s.is_material and s.label in without and np.ptp(s.draws) > 0.0 and s not in absent
    }
    label = max(shifts, key=lambda name: abs(shifts[name]), default="")
    shift = abs(shifts.get(label, 0.0))
    how = f"amplitude {np.median(amplitude[0].draws):.2g}"
    if shift > LIMITS.large_difference and not _is_needed(fit, amplitude[0]):
        sentence = (
            f"The answer rests on smooth errors that the readings do not show for certain ({how}): "
            f"without them {label} would be {without[label].mean():.4g}, {shift:.1f} sd away; "
            "measure again with the errors of the set-up under control, such as the angle's zero, "
            "the gains of both channels, and stray light."
        )
        return Finding("problem", p_value, shift, sentence)
    sentence = (
        f"Smooth errors and noise are larger than a set-up of this kind has ({p_text(p_value)}; "
        f"{how}): the readings hold what the scene does not; look at the residuals in the report, "
        "and try polar_bayes.compare_scenes."
    )
    return judged_by(p_value, shift, sentence)


def _is_needed(fit: FitView, amplitude: Scalar) -> bool:
    """Return whether the readings strongly contradict an amplitude near zero."""
    # The Savage-Dickey ratio of densities at zero, each as the share near it.
    prior = fit.prior.get(amplitude.label)
    if prior is None:
        return True
    near = np.quantile(prior.draws, LIMITS.near_zero)
    return float(np.mean(amplitude.draws < near)) < math.exp(LIMITS.refuted) * LIMITS.near_zero


# --- Leave-one-out and repeats --------------------------------------------------------------------


def _leave_one_out(checks: Mapping[str, PredictiveCheck]) -> Finding:
    """Test the leave-one-out PIT values of each variable for uniformity."""
    pits = {name: check.loo.pit for name, check in checks.items() if check.loo is not None}
    if not pits:
        return Finding("not computed", sentence="The fit holds no log likelihoods.")
    lost = [n for n, x in checks.items() if x.loo is not None and 2 * x.loo.unreliable > x.count]
    if lost:
        why = f"Leave-one-out cannot be approximated for most readings of {listed(lost)}."
        return Finding("not computed", sentence=why)
    p_values = {name: _uniformity(pit) for name, pit in pits.items() if pit.size > 3}
    if not p_values:
        return Finding("passed")
    worst = min(p_values, key=lambda name: p_values[name])
    p_value = min(1.0, p_values[worst] * len(p_values))
    sentence = (
        f"The leave-one-out PIT values of {worst} are not uniform ({p_text(p_value)}): the "
        "readings do not scatter about their predictions as the link says; try another link, or "
        "polar_bayes.compare_scenes."
    )
    return judged_by(p_value, math.nan, sentence)


def _uniformity(pit: np.ndarray) -> float:
    # A PIT value is a share of some hundreds of draws: none is closer to 0 or 1 than they tell.
    pit = np.clip(pit, 5e-4, 1.0 - 5e-4)
    return float(array_stats.uniformity_test(pit, method="pot_c")[0])


def _repeats(fit: FitView) -> Finding:
    """Find views that repeat another one's directions, and every digit of its readings."""
    observed = fit.result["observed_data"].to_dataset()
    constants = fit.result["constant_data"].to_dataset()
    columns = [
        values.transpose("view", ...).to_numpy().reshape(values.sizes["view"], -1)
        for values in (
            *(constants[name] for name in ANGLES),
            *observed.data_vars.values(),
        )
        if "view" in values.dims
    ]
    table = np.concatenate(columns, axis=1)
    table = table[np.isfinite(table).any(axis=1)]
    _, first, counts = np.unique(table, axis=0, return_index=True, return_counts=True)
    repeated = int(np.sum(counts - 1))
    if repeated < 1:
        return Finding("passed")
    zenith = [f"{table[i, 0]:g} degrees" for i in np.sort(first[counts > 1])]
    sentence = (
        f"{repeated} of {len(table)} views repeat another in every digit: those at "
        f"{listed(zenith)}; copies are no new information, and make intervals too narrow, so enter "
        "every reading once."
    )
    return Finding("problem" if repeated > 1 else "caution", statistic=repeated, sentence=sentence)


# --- Alternatives ---------------------------------------------------------------------------------


def _alternatives(fit: FitView, absent: Sequence[Scalar]) -> Finding:
    """Find parts that explain the readings better, or as well with another answer."""
    try:
        table = alternatives(fit)
    except FitError as error:
        return Finding("not computed", sentence=f"{error.what[:1].upper()}{error.what[1:]}.")
    if table.empty:
        return Finding("passed")
    # What is not there has no size to rest on a part.
    own = ~table["redefined"] & ~table.index.isin([s.label for s in absent])
    table = _without_idle(table.assign(moves=own & (table["shift"].abs() > LIMITS.outside)), absent)
    if table.empty:
        return Finding("passed")
    factors = table.groupby(["part", "alternative", "path"])["log_bayes_factor"].first()
    part, alternative, path = factors.idxmax()
    highest = float(factors.max())
    # The mean of Bayes factors is above 1/p with probability p at most, where the fitted scene is
    # right and its truth is drawn from its priors.
    p_value = math.exp(min(0.0, math.log(factors.size) - float(logsumexp(factors))))
    moves = table["moves"][table["alternative"] == alternative]
    if level(p_value) != "passed":
        large = highest > math.log(1e4)
        times = f"10^{highest / math.log(10.0):.0f}" if large else f"{math.exp(highest):.3g}"
        sentence = (
            f"Another scene explains the readings better: {_swap_text(alternative, part)} "
            f"({path}), by a Bayes factor of {times}; fit that scene."
        )
        # What a smooth error has stood in for without harm to the answer only widens it, as does a
        # body that may be absent.
        stands_in = (part == NOTHING and not moves.any()) or alternative == NOTHING
        return judged_by(p_value, highest, sentence, most="caution" if stands_in else "problem")
    layer, factor = table["part"] == NOTHING, table["log_bayes_factor"]
    moving, favored = table["moves"] & (factor > LIMITS.refuted), factor > LIMITS.favored
    undecided, seen = table[moving], table[layer & favored]
    if undecided.empty and seen.empty:
        return Finding("passed", p_value, highest)
    if undecided.empty:  # what explains the readings better, but is no other answer
        best = seen.sort_values("log_bayes_factor").iloc[-1]
        sentence = (
            f"The readings favor {_swap_text(best['alternative'], NOTHING)}, by a Bayes factor of "
            f"{math.exp(best['log_bayes_factor']):.2g}; the answer is the same with it."
        )
        return Finding("note", p_value, highest, sentence)
    # Bodies of any index give the same few under a film, so that the evidence for one never exceeds
    # a few times: it counts by how far it moves the mean over both scenes, at even odds.
    averaged = (expit(factor) * table["shift"]).abs() > LIMITS.outside
    of_layer = layer & table.index.str.startswith(INDEX)
    weighty = moving & favored.mask(of_layer, averaged)
    answers = [
        f"{label} is {row['other']:.3g}, {abs(row['shift']):.1f} sd away, with "
        + _swap_text(row["alternative"], row["part"])
        for label, row in undecided.sort_values("log_bayes_factor", ascending=False).iterrows()
    ]
    sentence = (
        f"The answer rests on a part that the readings do not decide: {listed(answers)}"
        f"{whose_index(list(undecided['alternative']))}; unless "
        "you know the part, report both answers, as polar_bayes.compare_scenes gives them."
    )
    return Finding("caution" if weighty.any() else "note", p_value, highest, sentence)


def whose_index(scenes: Sequence[str]) -> str:
    """State whose index a bare scene finds under the films that scenes name; empty without any."""
    said = {
        "water film": "that of the outermost interface, the film's",
        "thin film": "neither the film's nor the body's",
    }
    there = (film for film in said if any(film in name for name in scenes))
    return "".join(f"; under a {film}, the index of a bare scene is {said[film]}" for film in there)


def _swap_text(alternative: str, part: str) -> str:
    """Format an alternative as `GGX in the place of Beckmann` or `a water film`."""
    return f"a {alternative}" if part == NOTHING else f"{alternative} in the place of {part}"


def _without_idle(table: pd.DataFrame, absent: Sequence[Scalar]) -> pd.DataFrame:
    """Leave out alternatives to a part that sends no light and changes nothing else.

    No reading tells one body that is not there from another: their Bayes factor is that of priors.
    """
    idle = {a.part for s in absent if (a := absence(s.name)) is not None and a.part}
    moved = table.groupby(["path", "alternative"])["moves"].transform("any")
    return table[~table["path"].str.split(".").str[0].isin(idle) | moved]
