"""Profiles on a grid: whose ends are found here, and where they have fallen too far."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.identifiability.peak import Question
from polar_bayes.identifiability.tracking import (
    SETTLED,
    WEIGHTS,
    Follow,
    Parts,
    slice_at,
)
from polar_bayes.inference.modes import Modes
from polar_bayes.inference.tracing import compiled
from polar_bayes.observation.data import Observations

DROP = 1.92
"""Half the 95% quantile of chi squared with one degree of freedom."""

REACH = 4.0
"""How far the first grid goes, in posterior sds of the coordinate."""

PEAKS = 3
"""Modes from which a profile is followed, at most; the best of them counts."""


class Curve(NamedTuple):
    """Profiles on one grid; NaN where no track arrived."""

    z: np.ndarray
    value: np.ndarray
    at: np.ndarray


Density = Callable[[np.ndarray, float], tuple[float, np.ndarray]]


def compile_density(split: Parts, data: Observations) -> Density:
    """Minus log likelihood and weighted log prior, with their gradient, as one program."""

    def loss(z: jax.Array, weight: jax.Array, data: Any) -> jax.Array:
        parts = split(z, data)
        return -(parts.likelihood + weight * parts.prior)

    run = compiled(jax.value_and_grad(loss))

    def density(z: np.ndarray, weight: float) -> tuple[float, np.ndarray]:
        value, gradient = run(jnp.asarray(z), jnp.asarray(weight), data)
        return float(value), np.asarray(gradient, float)

    return density


def draw_curve(
    question: Question,
    held: int,
    modes: Modes,
    density: Density,
    follow: Follow,
    grid: np.ndarray,
) -> Curve:
    """Follow both kinds from every mode to both ends of the grid, and keep the best."""
    center = modes.z[0, held]
    below, above = grid[grid <= center][::-1], grid[grid > center]
    longest = max(len(below), len(above))
    sides = [
        np.append(side, np.full(longest - len(side), (*side, center)[-1]))
        for side in (below, above)
    ]
    cut = slice_at(modes.covariance[0], held)
    tracks = [(start, side) for start in modes.z[:PEAKS] for side in (0, 1)]
    ends = follow(
        jnp.asarray(np.stack([start for start, _ in tracks])),
        jnp.asarray(np.stack([sides[side] for _, side in tracks])),
        jnp.asarray(cut.slope),
        jnp.asarray(cut.width),
        question.data,
    )
    value = np.full((2, grid.size), np.nan)
    at = np.full((2, grid.size, question.program.size), np.nan)
    orders = (np.arange(len(below))[::-1], len(below) + np.arange(len(above)))
    for (_, side), track in zip(tracks, np.asarray(ends), strict=True):
        for point, found in zip(orders[side], track, strict=False):  # the rest only fills up
            for kind, z in enumerate(found):
                height = _height(density, z, WEIGHTS[kind], cut.width)
                if height > np.nan_to_num(value[kind, point], nan=-np.inf):
                    value[kind, point], at[kind, point] = height, z
    return Curve(grid, value, at)


def _height(density: Density, z: np.ndarray, weight: float, width: np.ndarray) -> float:
    """The log density at the end of a climb; NaN where it is no peak."""
    if not np.isfinite(z).all():
        return np.nan
    loss, gradient = density(z, weight)
    settled = np.linalg.norm(width.T @ gradient) < SETTLED
    return -loss if settled and np.isfinite(loss) else np.nan


def widened(
    draw: Callable[[np.ndarray], Curve],
    modes: Modes,
    held: int,
    prior: np.ndarray,
    points: int,
) -> Curve:
    """Profiles four sds to either side, or over almost all of the prior where they stay open."""
    center = modes.z[0, held]
    sd = float(np.sqrt(modes.covariance[0][held, held]))
    low, high = center - REACH * sd, center + REACH * sd
    half = points // 2

    def grid(low: float, high: float) -> np.ndarray:
        return np.concatenate(
            [
                np.linspace(low, center, half, endpoint=False),
                np.linspace(center, high, points - half),
            ]
        )

    curve = draw(grid(low, high))
    flat_below, flat_above = (any(_is_open(value, end) for value in curve.value) for end in (0, -1))
    widest_low, widest_high = np.quantile(prior, [0.001, 0.999])
    wider = (
        min(low, widest_low) if flat_below else low,
        max(high, widest_high) if flat_above else high,
    )
    return curve if wider == (low, high) else draw(grid(*wider))


def _is_open(value: np.ndarray, end: int) -> bool:
    """True where a profile has not fallen by 1.92 at the last point that converged."""
    known = value[np.isfinite(value)]
    return bool(known.size == 0 or known.max() - known[end] < DROP)


def interval(theta: np.ndarray, value: np.ndarray) -> tuple[float, float, bool, bool]:
    """Where a profile has fallen by less than 1.92."""
    known = np.isfinite(value)
    if not known.any():
        return np.nan, np.nan, True, True
    drop = np.nanmax(value) - value
    inside = np.flatnonzero(known & (drop < DROP))

    def end(at: int, way: int) -> tuple[float, bool]:
        beyond = np.flatnonzero(known)
        beyond = beyond[(beyond - at) * way > 0]
        if beyond.size == 0:
            return float(theta[at]), True
        other = beyond[0] if way > 0 else beyond[-1]
        if abs(other - at) > 1:
            return float(theta[other]), False
        share = (DROP - drop[at]) / (drop[other] - drop[at])
        return float(theta[at] + share * (theta[other] - theta[at])), False

    (low, open_below), (high, open_above) = end(inside[0], -1), end(inside[-1], 1)
    return low, high, open_below, open_above
