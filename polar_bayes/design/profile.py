r"""Profile likelihood (Murphy & van der Vaart 2000, On profile likelihood, JASA 95, 449-465).

At every value of the coordinate $z_i$ of a parameter all others are optimized,

$$ \max_{z_{-i}} [\log L(z) + w \log \pi(z)] $$

by numerical continuation: BFGS starts where the value before ended, in one compiled potential for
all grids. $w = 1$ gives the profile of the posterior, $w = 0.001$ that of the likelihood:
a thousandth of the prior keeps coordinates that the data do not determine from diverging. The
priors of the instrument's parameters belong to $L$ in both: a calibration determines them, and
without it they trade for one another.
"""

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.design.setup import (
    DesignProblem,
    make_design_problem,
    posterior_modes,
    provenance_attrs,
)
from polar_bayes.diagnostics.parameters import Coordinate, label_coordinates, label_scalars
from polar_bayes.errors import FitError
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.program import Program
from polar_bayes.inference.request import resolve
from polar_bayes.numerics.compile import JitOnce
from polar_bayes.numerics.optimize import (
    Modes,
    NumpyPotential,
    ValueAndGradient,
    conditional_mode,
    conditional_normal,
    finite_potential,
    ignore_line_search_warnings,
)
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, with_progress

KINDS = {"posterior": 1.0, "likelihood": 1e-3}
"""Weight of the log prior in each kind of profile."""


@with_progress
def profile(
    capture: xr.Dataset,
    parameter: str,
    *,
    points: int = 31,
    values: Sequence[float] | None = None,
    model: str | Callable = "per_material",
    scene: str | Scene | None = None,
    priors: Mapping[str, dist.Distribution] | None = None,
    links: AbstractLink | Mapping[str, AbstractLink] | None = None,
    largest_view_zenith: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> xr.Dataset:
    r"""Compute the profile likelihood and the profile posterior of one parameter.

    $$ \ell_p(\theta) = \max_{\nu} \log L(\theta, \nu) $$

    over all other parameters, those of the noise included, from the mode outwards in both
    directions. The values of $\theta$ at which it has fallen by less than 1.92 are the 95%
    interval of the likelihood ratio. The priors of the instrument's parameters belong to the
    likelihood, except that of the profiled parameter. Of all other log priors the profile of the
    likelihood keeps a thousandth, so that parameters that the data do not determine stay finite;
    the profile of the posterior has all of them (as a density of the unconstrained coordinates).

    Args:
        capture: As for `polar_bayes.fit`; model, scene, priors, links, largest_view_zenith too.
        parameter: One that is sampled, such as "roughness" or "refractive_index[550]".
        points: Values on the grid, at least 5, evenly spaced in the unconstrained coordinate. It
            spans 4 posterior sds to either side, or almost all of the prior where the profile does
            not fall by 1.92 before.
        values: A grid of your own instead, in the parameter's unit.
        model: A name or a callable.
        scene: A name, a `Scene` or None.
        priors: Overrides.
        links: One link, a mapping or None.
        largest_view_zenith: Unit degree, or None for the set-up's own.
        seed: Of the starts.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        By `value` of the parameter and `kind` ("posterior", "likelihood"): `profile` (log, 0 at
        its best value; NaN where no fit converged), `converged`, and `others`, all parameters
        there by `parameter`. By `kind`: `low` and `high`, where the profile has fallen by 1.92,
        and `open_below`, `open_above`, True where it has not when the grid ends, so that `low` or
        `high` is only the end of the grid. `prior_beyond` by `side`: share of the prior that lies
        outside of the grid.

    Raises:
        CaptureError: The capture does not hold what a fit needs.
        FitError: No such parameter, values outside its prior, or no mode was found.

    Source:
        Murphy & van der Vaart (2000), On profile likelihood, JASA 95, 449-465.
    """
    if points < 5:
        raise FitError(f"points is {points}", where="profile", hint="give 5 or more")
    request = resolve(capture, model, scene, priors, links, largest_view_zenith, seed, "double")
    with jax.enable_x64(True):
        problem = make_design_problem(request)
        coordinate = _find_coordinate(problem, parameter)
        index = coordinate.index
        given = None if values is None else _unconstrained(problem, coordinate, values)
        instrument = request.scene.instrument
        known = set() if instrument is None else {*instrument.parameters} - {coordinate.site}
        run = problem.compiled_model.made(_weighted_potential, frozenset(known))
        dtype = problem.prior.dtype
        potentials = [NumpyPotential(run, (w, problem.data), dtype) for w in KINDS.values()]
        modes = posterior_modes(problem, progress, potentials[0])
        on_grid = partial(_trace_profile, index, modes, potentials)

        if given is not None:
            curve = on_grid(np.sort(np.append(given, modes.z[0, index])))
        else:
            curve = _on_default_grid(on_grid, modes, index, problem.prior[:, index], points)
        return _assemble(problem, coordinate, curve)


def _find_coordinate(problem: DesignProblem, parameter: str) -> Coordinate:
    """Return the coordinate of a scalar parameter that is sampled."""
    program, every = problem.program, label_coordinates(problem.program, problem.request.capture)
    known = [each for each in every if each.is_entry and each.site not in program.auxiliary]
    found = [each for each in known if parameter in (each.label, each.site)]
    if len(found) != 1:
        what = f"it has {len(found)} values" if found else "no sampled parameter has that name"
        hint = f"give one of {', '.join(each.label for each in (found or known)[:12])}"
        raise FitError(what, where=f"parameter={parameter!r}", hint=hint)
    return found[0]


def _unconstrained(
    problem: DesignProblem, coordinate: Coordinate, values: Sequence[float]
) -> np.ndarray:
    """Convert values of a parameter to values of its coordinate."""
    program, entry = problem.program, coordinate.entry
    support = program.supports[coordinate.site]
    template = np.asarray(program.constrain(jnp.zeros(program.size))[coordinate.site])
    found = []
    for value in values:
        site = template.copy()
        site.flat[entry] = value
        inside = np.isfinite(value) and bool(np.all(support(jnp.asarray(site))))
        z = float(np.ravel(dist.biject_to(support).inv(jnp.asarray(site)))[entry])
        if not inside or not np.isfinite(z):
            what, where = f"{value:g} is not inside its prior", f"values of {coordinate.label}"
            raise FitError(what, where=f"profile: {where}", hint="leave it out")
        found.append(z)
    if not found:
        raise FitError("there are no values", where="profile: values", hint="give at least one")
    return np.array(found)


def _assemble(problem: DesignProblem, coordinate: Coordinate, curve: "ProfileCurve") -> xr.Dataset:
    program, capture = problem.program, problem.request.capture
    # The grid's own row gives the parameter's values where no fit converged, too.
    grid = np.where(np.arange(program.size) == coordinate.index, curve.grid[:, None], 0.0)
    z = jnp.asarray([*curve.best, grid])
    at = label_scalars(program, capture, program.parameters_of_chains(z, problem.data))
    labels = [scalar.label for scalar in at]
    values = np.stack([scalar.draws for scalar in at], axis=-1)
    others, theta = values[:-1], values[-1, :, labels.index(coordinate.label)]
    highest = np.array([row[np.isfinite(row)].max(initial=-np.inf) for row in curve.value])
    order = np.argsort(theta)
    theta, others = theta[order], others[:, order]
    value = (curve.value - highest[:, None])[:, order]
    low, high, open_below, open_above = zip(
        *(likelihood_interval(theta, row) for row in value), strict=True
    )
    prior = problem.scalars[problem.names.index(coordinate.label)].draws
    beyond = [float(np.mean(prior < theta[0])), float(np.mean(prior > theta[-1]))]
    return xr.Dataset(
        {
            "profile": (("kind", "value"), value),
            "converged": (("kind", "value"), np.isfinite(value)),
            "others": (("kind", "value", "parameter"), others),
            "low": ("kind", list(low)),
            "high": ("kind", list(high)),
            "open_below": ("kind", list(open_below)),
            "open_above": ("kind", list(open_above)),
            "prior_beyond": ("side", beyond),
        },
        coords={
            "kind": list(KINDS),
            "value": theta,
            "parameter": labels,
            "side": ["below", "above"],
        },
        attrs={"parameter": coordinate.label, **provenance_attrs(problem.request)},
    )


# --- The log density in its parts -----------------------------------------------------------------


def log_density_parts(
    program: Program, known: Collection[str], z: Float[Array, " size"], data: Observations
) -> tuple[Array, Array]:
    """Log likelihood, with the log prior of known parameters, and the log prior of all others."""
    terms, _ = program.log_terms(z, data)
    of_likelihood = {*program.observed, *known} & terms.keys()
    likelihood = sum(terms.pop(name) for name in sorted(of_likelihood))
    return jnp.asarray(likelihood), sum(terms.values(), jnp.zeros((), z.dtype))


def _weighted_potential(compiled_model: CompiledModel, known: frozenset[str]) -> JitOnce:
    """Return minus log likelihood and weighted log prior, with gradient, as a function."""

    def potential(z: Array, given: tuple[float | Array, Observations]) -> Array:
        weight, data = given
        likelihood, prior = log_density_parts(compiled_model.program, known, z, data)
        return -(likelihood + weight * prior)

    return JitOnce(jax.value_and_grad(potential))


# --- Numerical continuation of the conditional modes ----------------------------------------------


class ProfileCurve(NamedTuple):
    """Profiles by kind on one grid of the coordinate; NaN where no search converged."""

    grid: np.ndarray
    value: np.ndarray
    best: np.ndarray


def _trace_profile(
    index: int, modes: Modes, potentials: Sequence[ValueAndGradient], grid: np.ndarray
) -> ProfileCurve:
    """Follow both kinds from the first three modes across the grid, and keep the best."""
    slope, factor = conditional_normal(modes.covariance[0], index)
    value = np.full((len(potentials), grid.size), np.nan)
    best = np.full((len(potentials), grid.size, slope.size), np.nan)
    center = modes.z[0, index]
    sides = np.flatnonzero(grid <= center)[::-1], np.flatnonzero(grid > center)
    with ignore_line_search_warnings():
        for start, side in itertools.product(modes.z[:3], sides):
            last = [start] * len(potentials)
            for point in side:
                guesses = [z + slope * (grid[point] - z[index]) for z in last]
                for kind, potential in enumerate(map(finite_potential, potentials)):
                    # The likelihood starts at the posterior's mode where that is better.
                    near = min([guesses[kind], *last[:kind]], key=lambda z: potential(z)[0])
                    z, _ = conditional_mode(potential, near, factor, gtol=1e-5)
                    last[kind] = z
                    height = _log_density_at(potentials[kind], z, factor)
                    if height > np.nan_to_num(value[kind, point], nan=-np.inf):
                        value[kind, point], best[kind, point] = height, z
    return ProfileCurve(grid, value, best)


def _log_density_at(potential: ValueAndGradient, z: np.ndarray, factor: np.ndarray) -> float:
    """Return the log density where an optimization ended; NaN if that is no mode."""
    if not np.isfinite(z).all():
        return np.nan
    loss, gradient = potential(z)
    # The gradient left, per posterior sd: a profile is within half its square of its mode.
    converged = np.linalg.norm(factor.T @ gradient) < 0.03
    return -loss if converged and np.isfinite(loss) else np.nan


# --- Grid and interval ----------------------------------------------------------------------------


def _on_default_grid(
    on_grid: Callable[[np.ndarray], ProfileCurve],
    modes: Modes,
    index: int,
    prior: np.ndarray,
    points: int,
) -> ProfileCurve:
    """Compute profiles over four sds to either side, or most of the prior if still open."""
    center = modes.z[0, index]
    reach = 4.0 * float(np.sqrt(modes.covariance[0][index, index]))
    half = points // 2

    def grid(low: float, high: float) -> np.ndarray:
        below = np.linspace(low, center, half, endpoint=False)
        return np.concatenate([below, np.linspace(center, high, points - half)])

    low, high = center - reach, center + reach
    curve = on_grid(grid(low, high))
    ends = [likelihood_interval(curve.grid, value)[2:] for value in curve.value]
    open_below, open_above = np.any(ends, axis=0)
    lowest, highest = np.quantile(prior, [0.001, 0.999])
    wider = (min(low, lowest) if open_below else low, max(high, highest) if open_above else high)
    return curve if wider == (low, high) else on_grid(grid(*wider))


def likelihood_interval(theta: np.ndarray, value: np.ndarray) -> tuple[float, float, bool, bool]:
    """Return the ends of the likelihood interval (drop below 1.92), and which are open."""
    known = np.flatnonzero(np.isfinite(value))
    if known.size == 0:
        return np.nan, np.nan, True, True
    most = 1.92  # half the 95% quantile of chi squared with one degree of freedom
    drop = np.nanmax(value) - value
    inside = known[drop[known] < most]

    def end(at: int, beyond: np.ndarray) -> tuple[float, bool]:
        """Interpolate the end next to the last point inside; `beyond` are points outside."""
        if beyond.size == 0:
            return float(theta[at]), True
        other = beyond[np.argmin(np.abs(beyond - at))]
        if abs(other - at) > 1:  # points between them did not converge
            return float(theta[other]), False
        share = (most - drop[at]) / (drop[other] - drop[at])
        return float(theta[at] + share * (theta[other] - theta[at])), False

    first, last = int(inside[0]), int(inside[-1])
    low, open_below = end(first, known[known < first])
    high, open_above = end(last, known[known > last])
    return low, high, open_below, open_above


# --- Table and sentences --------------------------------------------------------------------------


def profile_table(found: xr.Dataset) -> pd.DataFrame:
    """Return both log profiles by value of the parameter, relative to their maxima."""
    table = found["profile"].transpose("value", "kind").to_pandas()
    table.index.name, table.columns.name = str(found.attrs["parameter"]), None
    return table


def profile_sentences(found: xr.Dataset) -> list[str]:
    """State what the data exclude, where the profile is flat, and what did not converge."""
    sentences = [_interval_sentence(str(found.attrs["parameter"]), found.sel(kind="likelihood"))]
    failed = int(np.sum(~found["converged"]))
    if failed:
        sentences.append(
            f"At {failed} of {found['converged'].size} points of the two profiles no fit "
            f"converged; they are left out, not interpolated."
        )
    return sentences


def _interval_sentence(name: str, row: xr.Dataset) -> str:
    if not bool(row["converged"].any()):
        return f"{name}: no fit converged anywhere on the grid."
    low, high = float(row["low"]), float(row["high"])
    flat = {"below": low, "above": high}
    flat = {side: end for side, end in flat.items() if bool(row[f"open_{side}"])}
    if not flat:
        return f"{name} is between {low:.4g} and {high:.4g} (95% interval of the likelihood ratio)."
    ends = []
    for side, end in flat.items():
        way = "down" if side == "below" else "up"
        covers_prior = float(row["prior_beyond"].sel(side=side)) <= 0.02
        reach = f", {way} to {end:.4g}" if covers_prior else f" as far as the grid goes ({end:.4g})"
        ends.append(f"nothing {side}{reach}")
    if len(ends) == 2:
        return f"{name} is flat: the data exclude {ends[0]} and {ends[1]}."
    excluded = f"above {high:.4g}" if "below" in flat else f"below {low:.4g}"
    return f"{name} is flat to one side: the data exclude what is {excluded}, but {ends[0]}."
