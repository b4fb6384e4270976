r"""Model criticism of one fit: priors, bounds, residuals, influence, repeats and alternatives.

The residuals of the readings are compared with residuals of replicated readings. A replicate is
drawn from the posterior predictive distribution, and refitted in the linear-Gaussian approximation:
with C the posterior covariance of the noise-free readings and $\Sigma$ the covariance of the noise,

$$ e = (I - C \Sigma^{-1}) \varepsilon $$

is what remains of noise $\varepsilon$ after a fit. Without the refit the observed residuals, which
the parameters have absorbed in part, would look too small beside those of the replicates.

Source: Gelman, Meng & Stern (1996), Statistica Sinica 6, 733 (posterior predictive assessment);
Evans & Moshonov (2006), Bayesian Analysis 1, 893 (prior-data conflict by tail probability); Moran
(1950), Biometrika 37, 17 (spatial autocorrelation); Saeilynoja et al. (2022), Stat. Comput. 32, 32
(uniformity of leave-one-out PIT values); Kass & Raftery (1995), J. Am. Stat. Assoc. 90, 773 (Bayes
factors of alternative parts); Vovk & Wang (2021), Ann. Statist. 49, 1736 (their mean as a p-value).
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from arviz_stats.base import array_stats
from scipy import stats
from scipy.special import logsumexp

from polar_bayes.diagnostics.alternatives import alternatives
from polar_bayes.diagnostics.parameters import (
    Scalar,
    method_of,
    posterior_scalars,
    scalars,
    with_entries,
)
from polar_bayes.diagnostics.predictive import (
    FlatVariable,
    PredictiveCheck,
    flat_variables,
    predictive_checks,
)
from polar_bayes.errors import FitError
from polar_bayes.inference.result import CENTRAL_95, bounds_of, provenance_of
from polar_bayes.observation.data import ANGLES

CAUTION = 0.02
"""Probability, under a right model, that one check gives a caution or a problem."""
PROBLEM = 0.004
"""Probability, under a right model, that one check gives a problem."""
FAR = 0.01
"""Prior probability beyond the posterior median, on both sides, of one parameter that is told."""
REPLICATES = 1000
MAX_READINGS = 600
"""Readings that the residual checks use; of more, evenly spaced ones."""
MAX_SATURATED = 0.01
"""Share of the replicates at full scale beyond which the residual checks leave a reading out."""
ANGLE_SCALES = (4.0, 15.0)
"""Length scales of structure over directions, unit degree."""
NEAR_BOUND = 0.05
"""Width of the strip at a bound, as a share of the 95% interval."""
MASS_AT_BOUND = 0.03
"""Share of the draws in that strip that counts: a uniform density over the interval has 0.0475."""
LARGE_SHIFT = 1.0
"""Change of a posterior mean without one reading that counts, in posterior sds."""
REFUTED = -math.log(20.0)
"""Log Bayes factor below which the readings speak strongly against an alternative."""
OUTSIDE = 1.96
"""Shift by an alternative, in posterior sds, that leaves the 95% interval."""
NOISE_FACTOR = "stokes_error_factor"
LARGE_FACTOR = 3.0
"""Stated errors that are exceeded by this factor, with probability 97.5%, give a caution."""
MAX_LISTED = 4
GROUPS = ("prior", "observed_data", "constant_data")
"""Groups of a result without which nothing can be checked."""
QUESTIONS = {
    "priors": "are posterior medians in the tails of their priors?",
    "noise": "do the readings scatter more than their stated errors?",
    "bounds": "does a parameter lie against a bound?",
    "angle": "do neighboring directions err alike?",
    "wavelength": "do the wavelengths of one view err alike?",
    "outliers": "is a reading farther out than noise explains?",
    "leave-one-out": "are leave-one-out PIT values uniform?",
    "influence": "does a single reading decide the answer?",
    "repeats": "was a view entered more than once?",
    "alternatives": "would another part do as well, or better?",
}
"""The checks in the order of the table, and what each asks."""
CHECKS = tuple(QUESTIONS)
COLUMNS = ("level", "p_value", "statistic", "sentence")


@dataclasses.dataclass(frozen=True)
class Finding:
    """The outcome of one check: "passed", "caution", "problem" or "not computed"."""

    level: str
    p_value: float = math.nan
    statistic: float = math.nan
    sentence: str = ""


def criticize(
    result: xr.DataTree, checks: Mapping[str, PredictiveCheck] | None = None
) -> pd.DataFrame:
    """What the readings say against the model of a fit.

    A check with a p-value gives a caution below 0.02 and a problem below 0.004, which is the
    probability of either under a right model whose truth is drawn from its priors.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.
        checks: Those of `predictive_checks(result)`, where they are there already.

    Returns:
        A row for each check: "priors", "noise", "bounds", "angle", "wavelength", "outliers",
        "leave-one-out", "influence", "repeats" and "alternatives". Columns: level ("passed",
        "caution", "problem" or "not computed"), p_value and statistic (NaN where a check has none),
        sentence (empty where it passed).

    Raises:
        FitError: The tree holds no posterior, or its parts do not fit together.

    Source:
        Gelman, Meng and Stern (1996), Statistica Sinica 6, 733; Evans and Moshonov (2006), Bayesian
        Analysis 1, 893.
    """
    found = posterior_scalars(result)
    missing = [f"group {name}" for name in GROUPS if name not in result.children]
    if not missing:
        missing = [name for name in ANGLES if name not in result["constant_data"].data_vars]
    if method_of(result) == "point" or missing:
        why = f"The result has no {', '.join(missing)}, so the model was not checked."
        if method_of(result) == "point":
            why = "A point fit has no draws to criticize."
        return _table(dict.fromkeys(CHECKS, Finding("not computed", sentence=why)))
    variables = flat_variables(result)
    residuals = _residuals(result, variables)
    checks = predictive_checks(result) if checks is None else checks
    return _table(
        {
            "priors": _prior_conflict(result, found),
            "noise": _noise(found),
            "bounds": _bounds(result, found),
            **_residual_findings(residuals),
            "leave-one-out": _leave_one_out(checks),
            "influence": _influence(result, variables, found, checks),
            "repeats": _repeats(result),
            "alternatives": _alternatives(result),
        }
    )


def _table(findings: Mapping[str, Finding]) -> pd.DataFrame:
    rows = [dataclasses.astuple(findings[name]) for name in CHECKS]
    return pd.DataFrame(rows, columns=list(COLUMNS), index=pd.Index(CHECKS, name="check"))


def _p_text(p_value: float) -> str:
    return "p < 1e-6" if p_value < 1e-6 else f"p = {p_value:.2g}"


def _level(p_value: float) -> str:
    if not math.isfinite(p_value):
        return "not computed"
    return "problem" if p_value < PROBLEM else "caution" if p_value < CAUTION else "passed"


def listed(items: Iterable[str]) -> str:
    """The first items, and how many more there are: `roughness 1.08, exposure 1.03 and 2 more`."""
    items = list(items)
    more = len(items) - MAX_LISTED
    return ", ".join(items[:MAX_LISTED]) + (f" and {more} more" if more > 0 else "")


# --- Priors, noise and bounds ---------------------------------------------------------------------


def _prior_conflict(result: xr.DataTree, found: Sequence[Scalar]) -> Finding:
    """Posterior medians in the tails of their priors: the farthest, and all of them together."""
    tails = _prior_tails(result, found)
    if not tails:
        return Finding("not computed", sentence="The fit states no prior probabilities.")
    labels, probability = list(tails), np.array(list(tails.values()))
    two_sided = 2.0 * np.minimum(probability, 1.0 - probability)
    score = stats.norm.isf(np.maximum(two_sided, 1e-300) / 2.0)
    farthest = min(1.0, two_sided.min() * len(labels))
    together = float(stats.chi2.sf(np.sum(score**2), len(labels)))
    p_value = min(1.0, 2.0 * min(farthest, together))
    level = "caution" if _level(p_value) == "passed" and two_sided.min() < FAR else _level(p_value)
    worst = np.argsort(-score)
    names = [f"{labels[i]} {score[i]:.1f} sd" for i in worst if score[i] > 1.5]
    sentence = (
        f"Priors and data are in conflict ({_p_text(p_value)}): {listed(names)} from the center of "
        "the prior; a scene without what the readings show forces its parameters there, so try "
        "polar_bayes.compare_scenes, or state priors that hold for this object."
    )
    return Finding(level, p_value, float(score.max()), "" if level == "passed" else sentence)


def _finding(p_value: float, statistic: float, sentence: str) -> Finding:
    level = _level(p_value)
    return Finding(level, p_value, statistic, "" if level == "passed" else sentence)


def _prior_tails(result: xr.DataTree, found: Sequence[Scalar]) -> dict[str, float]:
    """Prior probability below the posterior median of each parameter that has a prior."""
    stated = provenance_of(result).get("prior_probability") or {}
    fixed = provenance_of(result).get("fixed") or {}
    return {
        scalar.label: float(below)
        for scalar, below in with_entries(found, stated)
        if scalar.name not in fixed
    }


def _noise(found: Sequence[Scalar]) -> Finding:
    """Scatter of the readings beyond their stated errors."""
    for scalar in found:
        if scalar.name == NOISE_FACTOR and np.isfinite(scalar.draws).all():
            low, high = np.quantile(scalar.draws, CENTRAL_95)
            sentence = (
                f"The readings scatter {np.median(scalar.draws):.3g} times [{low:.3g}, {high:.3g}] "
                "as much as their stated errors: the errors are too small, or the scene lacks what "
                "the readings show; check the errors, or try polar_bayes.compare_scenes."
            )
            if low > LARGE_FACTOR:
                return Finding("caution", statistic=float(low), sentence=sentence)
    return Finding("passed")


def _bounds(result: xr.DataTree, found: Sequence[Scalar]) -> Finding:
    """Posterior density at a bound of the support that is as high as inside, unlike the prior's."""
    provenance, hits = provenance_of(result), []
    priors = {s.label: s.draws for s in scalars(result["prior"].to_dataset())}
    for scalar in found:
        if scalar.label not in priors or not np.isfinite(scalar.draws).all():
            continue
        for bound in filter(math.isfinite, bounds_of(provenance, scalar.name)):
            share = _share_at(bound, scalar.draws)
            if share >= MASS_AT_BOUND and _share_at(bound, priors[scalar.label]) < MASS_AT_BOUND:
                hits.append((share, f"{scalar.label} at {bound:g} ({share:.0%} of its draws)"))
    if not hits:
        return Finding("passed")
    hits.sort(reverse=True)
    sentence = (
        f"The posterior lies against a bound: {listed([text for _, text in hits])}; what is beyond "
        "is excluded by the prior or by physics, not by the readings, so the interval is too "
        "narrow or the scene is wrong."
    )
    return Finding("caution", statistic=hits[0][0], sentence=sentence)


def _share_at(bound: float, draws: np.ndarray) -> float:
    """Share of draws in a strip at a bound, whose width is a share of that of their interval."""
    strip = NEAR_BOUND * float(np.diff(np.quantile(draws, CENTRAL_95))[0])
    return float(np.mean(np.abs(draws - bound) < strip))


# --- Residuals ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class _Residuals:
    """Standardized residuals of the readings and of replicates, with where each was read."""

    observed: np.ndarray  # (reading,)
    replicated: np.ndarray  # (replicate, reading)
    directions: np.ndarray  # (reading, 4), degree
    wavelength: np.ndarray  # (reading,): index
    group: np.ndarray  # (reading,): index of variable and material
    labels: tuple[str, ...]


def _residuals(result: xr.DataTree, variables: Sequence[FlatVariable]) -> _Residuals | None:
    """Residuals of all variables together, since they share the parameters that absorb them."""
    if not variables or not all(
        np.isfinite(v.predicted).all() and np.isfinite(v.noise_free).all() for v in variables
    ):
        return None
    noise_free = np.concatenate([v.noise_free for v in variables], axis=1)
    noise = np.concatenate([v.predicted for v in variables], axis=1) - noise_free
    observed = np.concatenate([v.observed for v in variables])
    where = [_positions(result, v) for v in variables]
    sd = noise.std(axis=0)
    # Replicates of a reading near full scale are cut off there, and have no residuals of their own.
    cut = np.concatenate([(v.predicted >= v.full_scale).mean(axis=0) for v in variables])
    keep = np.flatnonzero((sd > 0.0) & (cut < MAX_SATURATED))
    keep = keep[:: max(1, -(-keep.size // MAX_READINGS))]
    if keep.size < 4 or len(noise) < 100:
        return None
    noise, noise_free, sd = noise[:, keep] / sd[keep], noise_free[:, keep] / sd[keep], sd[keep]
    random = np.random.default_rng(0)
    pick = random.permutation(len(noise))[:REPLICATES]
    centered = noise_free - noise_free.mean(axis=0)
    absorbed = noise[pick] @ (centered.T @ centered / (len(centered) - 1))
    group = [name for each in where for name in each.group]
    labels = [label for each in where for label in each.labels]
    groups = {name: number for number, name in enumerate(dict.fromkeys(group))}
    return _Residuals(
        observed=observed[keep] / sd - noise_free.mean(axis=0),
        replicated=noise[pick] - absorbed,
        directions=np.concatenate([each.directions for each in where])[keep],
        wavelength=np.concatenate([each.wavelength for each in where])[keep],
        group=np.array([groups[name] for name in group])[keep],
        labels=tuple(str(labels[i]) for i in keep),
    )


class _Positions(NamedTuple):
    """Where each reading of a variable was read."""

    directions: np.ndarray  # (reading, 4), degree
    wavelength: np.ndarray  # (reading,)
    group: list[str]
    labels: list[str]


def _positions(result: xr.DataTree, variable: FlatVariable) -> _Positions:
    """Directions, wavelength, group and label of every reading of a variable."""
    reading = result["observed_data"].to_dataset()[variable.name]
    constants = result["constant_data"].to_dataset()

    def along(values: xr.DataArray) -> np.ndarray:
        return values.variable.set_dims(reading.sizes).to_numpy()[variable.usable]

    angles = [along(constants[name]) for name in ANGLES]
    wavelength = np.zeros(variable.observed.size)
    if "wavelength" in reading.coords and "wavelength" in reading.dims:
        wavelength = along(reading["wavelength"])
    others = [str(dim) for dim in reading.dims if dim not in ("view", "wavelength")]
    index = [along(xr.DataArray(np.arange(reading.sizes[dim]), dims=dim)) for dim in others]
    group = [
        " ".join([variable.name, *(str(each[i]) for each in index)])
        for i in range(variable.observed.size)
    ]
    colored = len(np.unique(wavelength)) > 1
    labels = [
        f"{variable.name} at {zenith:.3g} degrees" + (f", {length:g} nm" if colored else "")
        for zenith, length in zip(angles[0], wavelength, strict=True)
    ]
    return _Positions(np.stack(angles, axis=1), wavelength, group, labels)


def _residual_findings(residuals: _Residuals | None) -> dict[str, Finding]:
    if residuals is None:
        missing = Finding("not computed", sentence="The fit holds no predicted readings.")
        return dict.fromkeys(("angle", "wavelength", "outliers"), missing)
    return {
        "angle": _angle(residuals),
        "wavelength": _wavelength(residuals),
        "outliers": _outliers(residuals),
    }


def _unit_vectors(zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    zenith, azimuth = np.radians(zenith), np.radians(azimuth)
    return np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1
    )


def _angle(residuals: _Residuals) -> Finding:
    """Neighbors with residuals of one sign, where a coordinate and a scale show it most."""
    view_zenith, view_azimuth, light_zenith, light_azimuth = residuals.directions.T
    view = _unit_vectors(view_zenith, view_azimuth)
    light = _unit_vectors(light_zenith, light_azimuth)
    half = (view + light) / np.maximum(np.linalg.norm(view + light, axis=1, keepdims=True), 1e-9)
    # A wrong microfacet distribution errs by the tilt of the half vector, a wrong reflectance by
    # the angle of incidence on the facet, a wrong body or instrument by the view zenith.
    coordinates = (
        np.hstack([view, light]),
        np.arccos(np.clip(half[:, 2:], -1.0, 1.0)),
        np.arccos(np.clip(np.sum(half * light, axis=1, keepdims=True), -1.0, 1.0)),
        np.radians(view_zenith[:, None]),
    )
    same = residuals.group[:, None] == residuals.group[None]
    kernels = []
    for x in coordinates:
        apart = np.sum((x[:, None] - x[None]) ** 2, axis=-1)
        kernels += [
            np.where(same, np.exp(-0.5 * apart / math.radians(scale) ** 2), 0.0)
            for scale in ANGLE_SCALES
        ]
    p_value, statistic = _autocorrelation(residuals, kernels)
    sentence = (
        f"The residuals have structure over the angle ({_p_text(p_value)}): neighboring readings "
        "err in the same direction, which noise does not, so the scene lacks what the readings "
        "show; look at the residuals in the report, and try polar_bayes.compare_scenes."
    )
    return _finding(p_value, statistic, sentence)


def _wavelength(residuals: _Residuals) -> Finding:
    """Readings of one view that err alike, or with opposite signs, in several wavelengths."""
    if len(np.unique(residuals.wavelength)) < 2:
        return Finding("passed")
    view = np.unique(residuals.directions, axis=0, return_inverse=True)[1].ravel()
    same = (view[:, None] == view[None]) & (residuals.group[:, None] == residuals.group[None])
    kernels = [np.where(same, sign, 0.0) for sign in (1.0, -1.0)]
    p_value, statistic = _autocorrelation(residuals, kernels)
    sentence = (
        f"The residuals of one view depend on those at other wavelengths ({_p_text(p_value)}): the "
        "errors of the wavelengths are not independent, so intervals are too narrow; look at the "
        "residuals in the report."
    )
    return _finding(p_value, statistic, sentence)


def _autocorrelation(residuals: _Residuals, kernels: Sequence[np.ndarray]) -> tuple[float, float]:
    """Moran's I for each kernel, standardized by the replicates; the largest and its p-value."""
    scores, null = [], []
    for kernel in kernels:
        kernel = kernel - np.diag(np.diag(kernel))
        if not kernel.any():
            continue
        replicated = _moran(residuals.replicated, kernel)
        center, sd = replicated.mean(), replicated.std()
        scores.append((_moran(residuals.observed[None], kernel)[0] - center) / sd)
        null.append((replicated - center) / sd)
    if not scores:
        return 1.0, math.nan
    observed, replicates = max(scores), np.max(null, axis=0)
    return _p_value(observed, replicates), float(observed)


def _p_value(observed: float, replicates: np.ndarray) -> float:
    """Share of the replicates, the readings among them, whose statistic is as large."""
    return float((1 + np.sum(replicates >= observed)) / (1 + replicates.size))


def _moran(e: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    return np.sum((e @ kernel) * e, axis=1) / np.sum(e**2, axis=1)


def _outliers(residuals: _Residuals) -> Finding:
    """The largest residual in units of their root mean square."""

    def largest(e: np.ndarray) -> np.ndarray:
        return np.abs(e).max(axis=-1) / np.sqrt(np.mean(e**2, axis=-1))

    observed = float(largest(residuals.observed))
    p_value = _p_value(observed, largest(residuals.replicated))
    farthest = residuals.labels[int(np.abs(residuals.observed).argmax())]
    sentence = (
        f"A reading is farther out than the noise explains ({_p_text(p_value)}): {farthest}, "
        f"{observed:.1f} times the rms residual; check it, or mark it valid=False."
    )
    return _finding(p_value, observed, sentence)


# --- Leave-one-out, influence and repeats ---------------------------------------------------------


def _leave_one_out(checks: Mapping[str, PredictiveCheck]) -> Finding:
    """Uniformity of the leave-one-out PIT values of each variable."""
    pits = {name: check.loo.pit for name, check in checks.items() if check.loo is not None}
    if not pits:
        return Finding("not computed", sentence="The fit holds no log likelihoods.")
    p_values = {name: _uniformity(pit) for name, pit in pits.items() if pit.size > 3}
    if not p_values:
        return Finding("passed")
    worst = min(p_values, key=lambda name: p_values[name])
    p_value = min(1.0, p_values[worst] * len(p_values))
    sentence = (
        f"The leave-one-out PIT values of {worst} are not uniform ({_p_text(p_value)}): the "
        "readings do not scatter about their predictions as the link says; try another link, or "
        "polar_bayes.compare_scenes."
    )
    return _finding(p_value, math.nan, sentence)


def _uniformity(pit: np.ndarray) -> float:
    # A PIT value is a share of some hundreds of draws: none is closer to 0 or 1 than they tell.
    pit = np.clip(pit, 5e-4, 1.0 - 5e-4)
    return float(array_stats.uniformity_test(pit, method="pot_c")[0])


def _influence(
    result: xr.DataTree,
    variables: Sequence[FlatVariable],
    found: Sequence[Scalar],
    checks: Mapping[str, PredictiveCheck],
) -> Finding:
    """Readings without which a material parameter's mean would move by more than its sd."""
    material = [s.draws.ravel() for s in found if s.is_material and np.isfinite(s.draws).all()]
    draws = np.stack([d for d in material if np.ptp(d) > 0.0]) if material else np.empty((0, 0))
    named: list[tuple[float, str]] = []
    for variable in variables:
        check = checks.get(variable.name)
        if check is None or check.loo is None or variable.log_likelihood is None or not len(draws):
            continue
        scores = (draws - draws.mean(axis=1, keepdims=True)) / draws.std(axis=1, keepdims=True)
        weights = check.loo.weights
        shift = np.abs(scores @ weights).max(axis=0)  # (reading,)
        large = np.flatnonzero(shift > LARGE_SHIFT)
        labels = _positions(result, variable).labels if large.size else []
        named += [(float(shift[i]), labels[i]) for i in large]
    if not named:
        return Finding("passed")
    named.sort(reverse=True)
    which = "A reading decides" if len(named) == 1 else f"{len(named)} readings decide"
    sentence = (
        f"{which} the answer: without {listed([text for _, text in named])} a "
        f"parameter's mean would move by up to {named[0][0]:.1f} sd; repeat those readings."
    )
    return Finding("caution", statistic=named[0][0], sentence=sentence)


def _repeats(result: xr.DataTree) -> Finding:
    """Views that repeat another in its directions and in every digit of its readings."""
    observed = result["observed_data"].to_dataset()
    constants = result["constant_data"].to_dataset()
    columns = [
        values.transpose("view", ...).to_numpy().reshape(observed.sizes["view"], -1)
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


def _alternatives(result: xr.DataTree) -> Finding:
    """Parts that explain the readings better, or as well with another answer."""
    try:
        table = alternatives(result)
    except FitError as error:
        return Finding("not computed", sentence=f"{error.what[:1].upper()}{error.what[1:]}.")
    if table.empty:
        return Finding("passed")
    factors = table.groupby(["part", "alternative", "path"])["log_bayes_factor"].first()
    part, alternative, path = factors.idxmax()
    highest = float(factors.max())
    # The mean of Bayes factors is above 1/p with probability p at most, where the fitted scene is
    # right and its truth is drawn from its priors.
    p_value = math.exp(min(0.0, math.log(factors.size) - float(logsumexp(factors))))
    if _level(p_value) != "passed":
        sentence = (
            f"Another part explains the readings better: {alternative} in the place of {part} "
            f"({path}), by a Bayes factor of {_factor_text(highest)}; fit the scene that has it."
        )
        return _finding(p_value, highest, sentence)
    undecided = table[
        (table["log_bayes_factor"] > REFUTED)
        & (table["shift"].abs() > OUTSIDE)
        & ~table["redefined"]
    ]
    if undecided.empty:
        return Finding("passed", p_value, highest)
    answers = [
        f"{label} is {row['other']:.3g}, {abs(row['shift']):.1f} sd away, with "
        f"{row['alternative']} in the place of {row['part']}"
        for label, row in undecided.iterrows()
    ]
    sentence = (
        f"The answer rests on a part that the readings do not decide: {listed(answers)}; unless "
        "you know the part, report both answers, as polar_bayes.compare_scenes gives them."
    )
    return Finding("caution", p_value, highest, sentence)


def _factor_text(log_factor: float) -> str:
    large = log_factor > math.log(1e4)
    return f"10^{log_factor / math.log(10.0):.0f}" if large else f"{math.exp(log_factor):.3g}"
