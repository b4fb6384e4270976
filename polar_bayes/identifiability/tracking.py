r"""Following the best fit while one coordinate is moved: the curve under a profile.

At every value of the coordinate $z_i$ all others are found anew,

$$ \max_{z_{-i}} [\log L(z) + w \log \pi(z)] $$

from where the value before left them. With $w = 1$ it is the posterior that is followed. With
$w$ = `FAINT` it is the likelihood: a thousandth of the prior keeps those coordinates from running
away of which the data say nothing. What is known of the instrument stays whole in both: its
imperfections are told by a calibration, and with none of it they trade for one another without end.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro.infer.util import log_density

from polar_bayes.inference.program import Program
from polar_bayes.inference.tracing import compiled
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
