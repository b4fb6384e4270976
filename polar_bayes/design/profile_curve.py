r"""Following the best fit while one coordinate is moved: the curve under a profile.

At every value of the coordinate $z_i$ all others are found anew,

$$ \max_{z_{-i}} [\log L(z) + w \log \pi(z)] $$

from where the value before left them. With $w = 1$ it is the posterior that is followed. With
$w$ = `FAINT` it is the likelihood: a thousandth of the prior keeps those coordinates from running
away of which the data say nothing. What is known of the instrument stays whole in both: its
imperfections are told by a calibration, and with none of it they trade for one another without end.
"""

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro.infer.util import log_density

from polar_bayes.design.setup import Question
from polar_bayes.inference.compile import compiled
from polar_bayes.inference.optimize import Modes
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

FAINT = 1e-3
"""Share of the prior that stays in the likelihood's profile."""

WEIGHTS = (1.0, FAINT)
STEPS = 300
SETTLED = 0.03
"""Largest slope left, per posterior sd: a profile is then within half its square of its peak."""


class Split(NamedTuple):
    """Log likelihood, with what is known beside the readings, and log prior of the rest."""

    likelihood: Float[Array, ""]
    prior: Float[Array, ""]


def split_density(
    program: Program, known: Collection[str], z: Float[Array, " size"], data: Observations
) -> Split:
    """The log posterior density of the coordinates in its two parts."""
    free = program.unravel(z)
    moves = {name: dist.biject_to(program.supports[name]) for name in free}
    latent = {name: move(free[name]) for name, move in moves.items()}
    whole, trace = log_density(program.model, (data,), {}, latent)
    volumes = {n: jnp.sum(moves[n].log_abs_det_jacobian(free[n], latent[n])) for n in free}
    beside = [name for name in free if name in known]
    told = [
        jnp.sum(trace[n]["fn"].log_prob(trace[n]["value"])) for n in (*program.observed, *beside)
    ]
    likelihood = jnp.sum(jnp.stack([*told, *(volumes[n] for n in beside)]))
    return Split(likelihood, whole + jnp.sum(jnp.stack([*volumes.values()])) - likelihood)


class Slice(NamedTuple):
    """How the other coordinates move when one does, by the normal approximation at a mode."""

    held: int
    slope: np.ndarray
    width: np.ndarray


def slice_at(covariance: Float[np.ndarray, "size size"], index: int) -> Slice:
    """The conditional normal distribution of all coordinates but one."""
    size = len(covariance)
    slope = covariance[:, index] / covariance[index, index]
    others = np.delete(np.arange(size), index)
    width = np.zeros((size, max(size - 1, 1)))
    if size > 1:
        left = covariance - np.outer(slope, covariance[index])
        width[others] = np.linalg.cholesky(left[np.ix_(others, others)])
    return Slice(index, slope, width)


Parts = Callable[[Array, Observations], Split]
Follow = Callable[[Array, Array, Array, Array, Observations], Array]


def make_follow(split: Parts, index: int) -> Follow:
    """Compile the way of all tracks along their targets."""
    solver = optx.BFGS(rtol=1e-6, atol=1e-5)

    def plain(y: Array, guess: Array, weight: Array, width: Array, data: Observations) -> Array:
        parts = split(guess + width @ y, data)
        value = -(parts.likelihood + weight * parts.prior)
        return jnp.where(jnp.isfinite(value), value, jnp.inf)

    # The solver linearizes, then turns round. Giving it the gradient at once halves what is to be
    # compiled; it moves along y alone.
    loss = jax.custom_jvp(plain)

    @loss.defjvp
    def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        value, gradient = jax.value_and_grad(plain)(*primals)
        return value, gradient @ tangents[0]

    def follow(
        starts: Array, targets: Array, slope: Array, width: Array, data: Observations
    ) -> Array:
        def height(y: Array, given: tuple[Array, Array]) -> Array:
            return loss(y, *given, width, data)

        nowhere = jnp.zeros(width.shape[1])

        def climb(beside: Array, asked: tuple[Array, Array]) -> tuple[Array, Array]:
            # The likelihood begins at the posterior's peak where that is higher than its own way.
            own, weight = asked
            heights = jax.lax.map(
                lambda at: height(nowhere, (at, weight)), jnp.stack([own, beside])
            )
            guess = jnp.where(heights[0] <= heights[1], own, beside)
            found = optx.minimise(
                height, solver, nowhere, (guess, weight), max_steps=STEPS, throw=False
            )
            # From a peak itself the solver may step nowhere; whoever asks judges by the slope.
            step = jnp.where(jnp.isfinite(found.value).all(), found.value, nowhere)
            there = guess + width @ step
            return there, there

        def step(last: Array, target: Array) -> tuple[Array, Array]:
            guesses = last + slope * (target - last[:, index, None])
            found = jax.lax.scan(climb, guesses[0], (guesses, jnp.asarray(WEIGHTS)))[1]
            return found, found

        def one(track: tuple[Array, Array]) -> Array:
            start, along = track
            return jax.lax.scan(step, jnp.stack([start] * len(WEIGHTS)), along)[1]

        return jax.lax.map(one, (starts, targets))

    return compiled(follow)


# --- Profiles on a grid: whose ends are found here, and where they have fallen too far ------------


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
