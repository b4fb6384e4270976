"""The public verb: how far can one parameter move before the data object?"""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from numpyro import distributions as dist

from polar_bayes.design.identify import provenance
from polar_bayes.design.profile_curve import (
    Curve,
    compile_density,
    draw_curve,
    interval,
    make_follow,
    split_density,
    widened,
)
from polar_bayes.design.setup import (
    Question,
    find_peaks,
    flat_parameters,
    label_parameters,
    pose,
    with_labels,
)
from polar_bayes.diagnostics.parameters import Scalar, scalars
from polar_bayes.errors import FitError
from polar_bayes.inference.compile import compiled
from polar_bayes.inference.result import PROVENANCE, posterior_of
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress, with_progress

KINDS = ("posterior", "likelihood")


class Place(NamedTuple):
    """One scalar parameter among the coordinates."""

    label: str
    site: str
    entry: int
    held: int


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
    r"""Profile likelihood and profile posterior of one parameter.

    $$ \ell_p(\theta) = \max_{\nu} \log L(\theta, \nu) $$

    over all other parameters, those of the noise included, from the mode outwards in both
    directions. The values of $\theta$ at which it has fallen by less than 1.92 are the 95%
    interval of the likelihood ratio. What is known of the instrument belongs to the likelihood:
    the priors of its parameters stay whole (but for the one that is followed). Of all others a
    thousandth of the log prior stays, so that what the data do not determine stays where it can be
    found; the profile of the posterior has all of it (as a density of the unconstrained
    coordinates).

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
    with jax.enable_x64(True):
        question = pose(capture, model, scene, priors, links, largest_view_zenith, seed)
        place = _place_of(question, parameter)
        given = None if values is None else _coordinates_of(question, place, values)
        split = partial(split_density, question.program, _known_beside(question, place))
        density = compile_density(split, question.data)
        modes = find_peaks(question, progress, lambda z: density(z, 1.0))
        follow = make_follow(split, place.held)

        def draw(grid: np.ndarray) -> Curve:
            return draw_curve(question, place.held, modes, density, follow, grid)

        if given is not None:
            curve = draw(np.sort(np.append(given, modes.z[0, place.held])))
        else:
            curve = widened(draw, modes, place.held, question.prior[:, place.held], points)
        return _assemble(question, place, curve)


def _place_of(question: Question, parameter: str) -> Place:
    """The coordinate of a parameter that is sampled."""
    program, places = question.program, []
    free = program.unravel(jnp.arange(float(program.size)))
    constrained = program.constrain(jnp.zeros(program.size))
    for name, positions in free.items():
        flat = np.ravel(positions).astype(int)
        shape = (*(program.plates[d] for d in program.dims[name]), *program.events[name])
        if name in program.auxiliary or flat.size != np.size(constrained[name]):
            continue  # a simplex, say, has fewer free coordinates than numbers
        group = posterior_of(program, {name: flat.reshape(1, 1, *shape)})
        for entry, scalar in enumerate(scalars(with_labels(group, question.request.capture))):
            places.append(Place(scalar.label, name, entry, int(scalar.draws[0, 0])))
    found = [place for place in places if parameter in (place.label, place.site)]
    if len(found) != 1:
        said = f"it has {len(found)} values" if found else "no sampled parameter has that name"
        raise FitError(
            said,
            where=f"parameter={parameter!r}",
            hint=f"give one of {', '.join(place.label for place in (found or places)[:12])}",
        )
    return found[0]


def _known_beside(question: Question, place: Place) -> tuple[str, ...]:
    """Parameters of the instrument, but for the one that is followed."""
    instrument = question.request.scene.instrument
    told = () if instrument is None else instrument.parameters
    return tuple(name for name in told if name != place.site)


def _coordinates_of(question: Question, place: Place, values: Sequence[float]) -> np.ndarray:
    """Values of a parameter as values of its coordinate."""
    program = question.program
    support = program.supports[place.site]
    whole = np.asarray(program.constrain(jnp.zeros(program.size))[place.site])
    found = []
    for value in values:
        trial = whole.copy()
        trial.flat[place.entry] = value
        inside = np.isfinite(value) and bool(np.all(support(jnp.asarray(trial))))
        moved = np.ravel(dist.biject_to(support).inv(jnp.asarray(trial)))[place.entry]
        if not inside or not np.isfinite(moved):
            raise FitError(
                f"{value:g} is not inside its prior",
                where=f"profile: values of {place.label}",
                hint="leave it out",
            )
        found.append(float(moved))
    if not found:
        raise FitError("there are no values", where="profile: values", hint="give at least one")
    return np.array(found)


def _assemble(question: Question, place: Place, curve: Curve) -> xr.Dataset:
    program, data = question.program, question.data
    labels = label_parameters(question)
    told = compiled(jax.vmap(lambda z: flat_parameters(program, z, data)))
    others = np.asarray(told(curve.at.reshape(-1, program.size))).reshape(*curve.value.shape, -1)
    others = others[..., labels.rows]
    grid = jnp.asarray(np.where(np.arange(program.size) == place.held, curve.z[:, None], 0.0))
    values = compiled(jax.vmap(lambda z: jnp.ravel(program.constrain(z)[place.site])[place.entry]))
    theta = np.asarray(values(grid))
    best = np.array([np.nanmax(row) if np.isfinite(row).any() else np.nan for row in curve.value])
    order = np.argsort(theta)
    theta, value, others = theta[order], (curve.value - best[:, None])[:, order], others[:, order]
    low, high, open_below, open_above = zip(*(interval(theta, row) for row in value), strict=True)
    prior = _prior_of(labels.scalars, place)
    return xr.Dataset(
        {
            "profile": (("kind", "value"), value),
            "converged": (("kind", "value"), np.isfinite(value)),
            "others": (("kind", "value", "parameter"), others),
            "low": ("kind", list(low)),
            "high": ("kind", list(high)),
            "open_below": ("kind", list(open_below)),
            "open_above": ("kind", list(open_above)),
            "prior_beyond": (
                "side",
                [float(np.mean(prior < theta[0])), float(np.mean(prior > theta[-1]))],
            ),
        },
        coords={
            "kind": list(KINDS),
            "value": theta,
            "parameter": labels.names,
            "side": ["below", "above"],
        },
        attrs={
            "parameter": place.label,
            PROVENANCE: json.dumps(provenance(question.request), sort_keys=True),
        },
    )


def _prior_of(found: list[Scalar], place: Place) -> np.ndarray:
    return next(scalar.draws for scalar in found if scalar.label == place.label)


# --- What a profile says, as a table and in words -------------------------------------------------


ALMOST_ALL = 0.02
"""Share of the prior beyond a grid that may be left out of sight."""


def profile_table(found: xr.Dataset) -> pd.DataFrame:
    """One row for each value of the grid.

    Args:
        found: What `polar_bayes.profile` returns.

    Returns:
        Columns posterior and likelihood: logarithms, 0 at the best value; NaN where no fit
        converged. The index is the parameter's value.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    table = found["profile"].transpose("value", "kind").to_pandas()
    table.index.name, table.columns.name = str(found.attrs["parameter"]), None
    return table


def profile_sentences(found: xr.Dataset) -> list[str]:
    """What the data exclude, where they are flat, and what was not found.

    Args:
        found: What `polar_bayes.profile` returns.

    Returns:
        One sentence on the 95% interval of the likelihood ratio, and one on values at which no
        fit converged, where there are any.

    Raises:
        FitError: It is something else.
    """
    _check(found)
    name = str(found.attrs["parameter"])
    row = found.sel(kind="likelihood")
    failed = int(np.sum(~found["converged"]))
    said = [_interval_in_words(name, row)]
    if failed:
        said.append(
            f"At {failed} of {found['converged'].size} points of the two profiles no fit "
            f"converged; they are left out, not interpolated."
        )
    return said


def _interval_in_words(name: str, row: xr.Dataset) -> str:
    if not bool(row["converged"].any()):
        return f"{name}: no fit converged anywhere on the grid."
    low, high = float(row["low"]), float(row["high"])
    below, above = bool(row["open_below"]), bool(row["open_above"])
    ends = (
        _end_in_words(row, "below", low) if below else "",
        _end_in_words(row, "above", high) if above else "",
    )
    if below and above:
        return f"{name} is flat: the data exclude {ends[0]} and {ends[1]}."
    if below or above:
        side = f"above {high:.4g}" if below else f"below {low:.4g}"
        return f"{name} is flat to one side: the data exclude what is {side}, but {''.join(ends)}."
    return f"{name} is between {low:.4g} and {high:.4g} (95% interval of the likelihood ratio)."


def _end_in_words(row: xr.Dataset, side: str, end: float) -> str:
    beyond = float(row["prior_beyond"].sel(side=side))
    if beyond <= ALMOST_ALL:
        return (
            f"nothing {side}, down to {end:.4g}"
            if side == "below"
            else (f"nothing {side}, up to {end:.4g}")
        )
    return f"nothing {side} as far as the grid goes ({end:.4g})"


def _check(found: xr.Dataset) -> None:
    if not isinstance(found, xr.Dataset) or "prior_beyond" not in found:
        raise FitError(
            "it is no profile", where="profile", hint="give what polar_bayes.profile returns"
        )
