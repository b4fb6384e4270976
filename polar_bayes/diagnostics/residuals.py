r"""Residuals of a fit: structure, outliers, and readings that determine the answer.

The residuals of the readings are compared with residuals of replicated readings. A replicate is
drawn from the posterior predictive distribution, and refitted by one linear step: with C the
posterior covariance of the noise-free readings, in units in which each reading has a Fisher
information of 1, and $\psi$ the derivative of the noise's negative log density (its score),

$$ e = \varepsilon - C \psi(\varepsilon) + (I - C) (\mu - \mu_0) $$

is what remains after a fit of noise $\varepsilon$ and of readings $\mu$ that the prior expects at
$\mu_0$. The last term has the covariance $C - C^2$, that of $(I - C)^{1/2} m$ with $m$ a posterior
draw of the noise-free readings less their mean. Normal noise has $\psi(\varepsilon) = \varepsilon$;
noise with long tails pulls the fit less than its size suggests, so that its outliers stay. The
noise of each variable is taken for Student's t, with the degrees of freedom of its draws.

Without the refit the observed residuals, which the parameters have absorbed in part, would look
too small compared with those of the replicates; without the prior, too large where an uncertain
set-up shifts all readings and they tell little of it.
The same approximation tells the fit without reading i: with the leverage $h_i = C_{ii}$ its
residual is $e_i / (1 - h_i)$, and the mean of a parameter moves by its covariance with the
noise-free reading times $\psi(e_i) / (1 - h_i)$.

Source: Gelman, Meng & Stern (1996), Statistica Sinica 6, 733 (posterior predictive assessment);
Moran (1950), Biometrika 37, 17 (spatial autocorrelation); Cook (1977), Technometrics 19, 15
(influence of one reading); Huber (1981), Robust Statistics (influence by the score).
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr
from scipy import optimize, special

from polar_bayes.diagnostics.approximation import smoothed_weights
from polar_bayes.diagnostics.finding import Finding, judged_by, listed, p_text
from polar_bayes.diagnostics.limits import LIMITS
from polar_bayes.diagnostics.predictive import FlatVariable, flat_variables
from polar_bayes.diagnostics.view import FitView, once
from polar_bayes.inference.checks import ANGLE_SCALES
from polar_bayes.numerics.psis import MAX_PARETO_K
from polar_bayes.observation.data import ANGLES
from polar_bayes.physics.geometry import unit_vectors


@dataclasses.dataclass(frozen=True, eq=False)
class Residuals:
    """Standardized residuals of readings and replicates, with their positions."""

    observed: np.ndarray  # (reading,)
    replicated: np.ndarray  # (replicate, reading)
    stated: np.ndarray  # (reading,): stated errors, 0 where there is none
    left_out: np.ndarray  # (reading,): one minus the leverage
    freedom: np.ndarray  # (reading,): degrees of freedom of the noise
    gains: np.ndarray  # (parameter, reading): correlation times sd of the noise-free reading
    parameters: tuple[str, ...]
    directions: np.ndarray  # (reading, 4), degree
    wavelength: np.ndarray  # (reading,): index
    group: np.ndarray  # (reading,): index of variable and material
    labels: tuple[str, ...]

    def pull(self, e: np.ndarray) -> np.ndarray:
        """Return the score of residuals (..., reading), by which they pull the fit."""
        return _score(e, self.freedom)


@once
def residuals_of(fit: FitView) -> Residuals | None:
    """Compute residuals of all variables together, since they share their parameters."""
    result, variables = fit.result, flat_variables(fit)
    constants = result.children.get("constant_data", xr.DataTree()).data_vars
    if not all(name in constants for name in ANGLES):
        return None
    predictions = [np.asarray(x, float) for v in variables for x in (v.predicted, v.noise_free)]
    if not all((np.abs(x) < 1e100).all() for x in predictions) or not variables:  # squares, too
        return None
    noise_free = np.concatenate([v.noise_free for v in variables], axis=1)
    noise = np.concatenate([v.predicted for v in variables], axis=1) - noise_free
    rows, (weights, _) = np.arange(len(noise)), smoothed_weights(fit)
    if weights.size == rows.size:
        # Laplace's draws of a plate are too narrow in its noise and its discrepancy: systematic
        # resampling, which leaves draws of equal weights as they are.
        rows = np.searchsorted(np.cumsum(weights), (rows + 0.5) / rows.size)
        noise, noise_free = noise[rows], noise_free[rows]
    observed = np.concatenate([v.observed for v in variables])
    readings = pd.concat([_readings(result, v) for v in variables], ignore_index=True)
    sd = noise.std(axis=0)
    # Replicates of a reading near zero or full scale are cut off there, so the residual of one that
    # lies there has the sign that its cut allows.
    cut = np.concatenate([_cut_off(v) for v in variables])
    keep = np.flatnonzero((sd > 0.0) & (cut < LIMITS.cut_off))
    keep = keep[:: max(1, -(-keep.size // LIMITS.readings))]
    if keep.size < 4 or len(noise) < 100:
        return None
    noise, noise_free, sd = noise[:, keep] / sd[keep], noise_free[:, keep] / sd[keep], sd[keep]
    variable = np.repeat(np.arange(len(variables)), [v.observed.size for v in variables])[keep]
    tails = {k: _tails(noise[:, variable == k]) for k in np.unique(variable)}
    freedom, unit = np.array([tails[k] for k in variable]).T
    noise, noise_free, sd = noise / unit, noise_free / unit, sd * unit
    random = np.random.default_rng(0)
    pick = random.permutation(len(noise))[: LIMITS.replicates]
    centered = noise_free - noise_free.mean(axis=0)
    share, axes = np.linalg.eigh(centered.T @ centered / (len(centered) - 1))
    share = np.clip(share, 0.0, 1.0)
    absorbed, root = ((axes * scale) @ axes.T for scale in (share, np.sqrt(1.0 - share)))
    replicated = noise[pick] - _score(noise[pick], freedom) @ absorbed + centered[pick] @ root
    material = {s.label: s.draws.ravel()[rows] for s in fit.scalars if s.is_material}
    material = {n: x for n, x in material.items() if np.isfinite(x).all() and x.std() > 0.0}
    scores = np.array([(x - x.mean()) / x.std() for x in material.values()]).reshape(
        len(material), len(centered)
    )
    used = readings.iloc[keep]
    return Residuals(
        observed=observed[keep] / sd - noise_free.mean(axis=0),
        replicated=replicated,
        stated=used["stated"].to_numpy() / sd,
        left_out=np.maximum(1.0 - np.diagonal(absorbed), 1.0 - LIMITS.leverage),
        freedom=freedom,
        gains=scores @ centered / (len(centered) - 1),
        parameters=tuple(material),
        directions=used[[*ANGLES]].to_numpy(float),
        wavelength=used["wavelength"].to_numpy(),
        group=pd.factorize(readings["group"])[0][keep],
        labels=tuple(used["label"]),
    )


def _tails(noise: np.ndarray) -> tuple[float, float]:
    """Return degrees of freedom of noise (draw, reading), and the unit of Fisher information 1.

    They are those of the Student t distribution with the median and the 95% quantile of its size.
    """
    half, most = np.quantile(np.abs(noise), [0.5, 0.95])
    least, largest = LIMITS.freedom
    if not half > 0.0:
        return largest, 1.0

    def ratio(freedom: float) -> float:
        inner, outer = special.stdtrit(freedom, [0.75, 0.975])
        return float(outer / inner)

    observed = np.clip(most / half, ratio(largest), ratio(least))
    freedom = float(optimize.brentq(lambda x: ratio(x) - observed, least, largest))
    scale = half / float(special.stdtrit(freedom, 0.75))
    return freedom, scale * math.sqrt((freedom + 3.0) / (freedom + 1.0))


def _score(e: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Return the score of Student's t at e (..., reading), in units of Fisher information 1."""
    a = (freedom + 3.0) / (freedom + 1.0)
    return (freedom + 1.0) * a * e / (freedom + a * e**2)


def _cut_off(variable: FlatVariable) -> np.ndarray:
    """Share of the replicates of each reading that lie at an end of the range of its variable."""
    least, largest = variable.predicted.min(), variable.predicted.max()
    is_high = variable.predicted >= min(largest, variable.full_scale)
    return (is_high | (variable.predicted == least)).mean(axis=0)


def _readings(result: xr.DataTree, variable: FlatVariable) -> pd.DataFrame:
    """Directions, wavelength, stated error (0 where there is none), group and label of readings."""
    reading = result["observed_data"].to_dataset()[variable.name]
    constants = result["constant_data"].to_dataset()

    def along(values: xr.DataArray) -> np.ndarray:
        return values.variable.set_dims(reading.sizes).to_numpy()[variable.usable]

    found = pd.DataFrame({name: along(constants[name]) for name in ANGLES})
    is_spectral = "wavelength" in reading.coords and "wavelength" in reading.dims
    found["wavelength"] = along(reading["wavelength"]) if is_spectral else 0.0
    error = constants.get(f"{variable.name}_error", xr.DataArray(0.0)).astype(float)
    found["stated"] = np.nan_to_num(along(error))
    found["group"] = variable.name
    for dim in (str(x) for x in reading.dims if x not in ("view", "wavelength")):
        place = along(xr.DataArray(np.arange(reading.sizes[dim]), dims=dim))
        found["group"] += [f" {at}" for at in place]
    colored = found["wavelength"].nunique() > 1
    found["label"] = [
        f"{variable.name} at {zenith:.3g} degrees" + (f", {length:g} nm" if colored else "")
        for zenith, length in zip(found[ANGLES[0]], found["wavelength"], strict=True)
    ]
    return found


def residual_findings(residuals: Residuals | None, pareto_k: float) -> dict[str, Finding]:
    """Run the checks of residuals, and return them by name; pareto_k of weights, or NaN."""
    checks = {
        "angle": _angle,
        "wavelength": _wavelength,
        "outliers": _outliers,
        "influence": _influence,
    }
    is_coarse = pareto_k > MAX_PARETO_K
    if is_coarse or residuals is None:
        sentence = "The fit holds too few predicted readings that lie within their range."
        if is_coarse:
            sentence = (
                "The residuals were not judged, since the draws are too far from the posterior."
            )
        missing = Finding("not computed", sentence=sentence)
        return dict.fromkeys(checks, missing)
    return {name: check(residuals) for name, check in checks.items()}


def _angle(residuals: Residuals) -> Finding:
    """Test for neighboring views with residuals of one sign, on several scales."""
    view, light = (unit_vectors(residuals.directions[:, at]) for at in ([0, 1], [2, 3]))
    half = (view + light) / np.maximum(np.linalg.norm(view + light, axis=1, keepdims=True), 1e-9)
    # A wrong microfacet distribution errs by the tilt of the half vector, a wrong reflectance by
    # the angle of incidence on the facet, a wrong body or instrument by the view zenith.
    coordinates = (
        np.hstack([view, light]),
        np.arccos(np.clip(half[:, 2:], -1.0, 1.0)),
        np.arccos(np.clip(np.sum(half * light, axis=1, keepdims=True), -1.0, 1.0)),
        np.radians(residuals.directions[:, :1]),
    )
    same = residuals.group[:, None] == residuals.group[None]
    kernels = []
    for x in coordinates:
        # Where a coordinate does not vary, as the tilt of mirror views, all would be neighbors.
        if np.ptp(x, axis=0).max() <= 1e-3:
            continue
        apart = np.sum((x[:, None] - x[None]) ** 2, axis=-1)
        kernels += [
            np.where(same, np.exp(-0.5 * apart / math.radians(scale) ** 2), 0.0)
            for scale in ANGLE_SCALES
        ]
    p_value, statistic = _autocorrelation(residuals, kernels)
    sentence = (
        f"The residuals have structure over the angle ({p_text(p_value)}): neighboring readings "
        "err in the same direction, which noise does not, so the scene lacks what the readings "
        "show; look at the residuals in the report, and try polar_bayes.compare_scenes."
    )
    return judged_by(p_value, statistic, sentence)


def _wavelength(residuals: Residuals) -> Finding:
    """Test for readings of one view with correlated residuals in several wavelengths."""
    if len(np.unique(residuals.wavelength)) < 2:
        return Finding("passed")
    view = np.unique(residuals.directions, axis=0, return_inverse=True)[1].ravel()
    same = (view[:, None] == view[None]) & (residuals.group[:, None] == residuals.group[None])
    kernels = [np.where(same, sign, 0.0) for sign in (1.0, -1.0)]
    p_value, statistic = _autocorrelation(residuals, kernels)
    sentence = (
        f"The residuals of one view depend on those at other wavelengths ({p_text(p_value)}): the "
        "errors of the wavelengths are not independent, so intervals are too narrow; look at the "
        "residuals in the report."
    )
    return judged_by(p_value, statistic, sentence)


def _autocorrelation(residuals: Residuals, kernels: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the largest Moran's I, standardized by replicates, and its p-value."""
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
    """Return the share of replicates, and the readings, whose statistic is as large."""
    return float((1 + np.sum(replicates >= observed)) / (1 + replicates.size))


def _moran(e: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    e = e / np.max(np.abs(e), axis=1, keepdims=True)  # squares of residuals of any size
    return np.sum((e @ kernel) * e, axis=1) / np.sum(e**2, axis=1)


def _outliers(residuals: Residuals) -> Finding:
    """Test the largest residual in units of their root mean square."""

    def largest(e: np.ndarray) -> np.ndarray:
        return np.abs(e).max(axis=-1) / np.sqrt(np.mean(e**2, axis=-1))

    # Where all readings scatter less than stated, one that keeps to its statement is no outlier.
    size = np.abs(residuals.observed)
    beyond = np.where(size > LIMITS.stated_errors * residuals.stated, size, 0.0)
    observed = float(beyond.max() / np.sqrt(np.mean(size**2)))
    p_value = _p_value(observed, largest(residuals.replicated))
    farthest = residuals.labels[int(beyond.argmax())]
    sentence = (
        f"A reading is farther out than the noise explains ({p_text(p_value)}): {farthest}, "
        f"{observed:.1f} times the rms residual; check it, or mark it valid=False."
    )
    return judged_by(p_value, observed, sentence)


# --- Readings that decide the answer --------------------------------------------------------------


def _influence(residuals: Residuals) -> Finding:
    """Find readings that move a parameter and that the other readings contradict."""
    if not residuals.parameters:
        return Finding("passed")
    left_out = residuals.left_out
    gain = np.abs(residuals.gains).max(axis=0) / left_out

    def contradiction(e: np.ndarray) -> np.ndarray:
        """Return leave-one-out residuals, in their sd, of readings that move the answer."""
        moves = gain * np.abs(residuals.pull(e)) > LIMITS.large_shift
        moves &= left_out > LIMITS.known_too
        return np.where(moves, np.abs(e) / np.sqrt(left_out), 0.0)

    observed = contradiction(residuals.observed)
    largest = float(observed.max())
    if not largest > 0.0:
        return Finding("passed")
    p_value = _p_value(largest, contradiction(residuals.replicated).max(axis=-1))
    order = np.argsort(-observed)[: int(np.sum(observed >= 0.75 * largest))]
    moved = float((gain * np.abs(residuals.pull(residuals.observed)))[order].max())
    which = "A reading decides" if len(order) == 1 else f"{len(order)} readings decide"
    sentence = (
        f"{which} the answer against the others ({p_text(p_value)}): without "
        f"{listed(residuals.labels[i] for i in order)} the mean of a parameter would move by up to "
        f"{moved:.1f} sd; repeat {'it' if len(order) == 1 else 'them'}."
    )
    return judged_by(p_value, largest, sentence, most="caution")


def readings_alone(residuals: Residuals | None) -> dict[str, tuple[str, float]]:
    """Find, by parameter, the reading without which its sd would at least double."""
    if residuals is None or not residuals.parameters:
        return {}
    widened = np.sqrt(1.0 + residuals.gains**2 / residuals.left_out)
    best = widened.argmax(axis=1)
    return {
        name: (residuals.labels[at], float(factors[at]))
        for name, factors, at in zip(residuals.parameters, widened, best, strict=True)
        if factors[at] > LIMITS.alone
    }
