"""Coordinates in which each parameter's prior is standard normal: normal scores.

An unconstrained vector may have a long tail under its prior (the log of a roughness that may be
zero): steps and mixtures that know one width for each coordinate then see either the middle or the
tail. Scores have neither tail nor skew.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import ndtr

from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations

KNOTS = np.arange(-3.0, 3.01, 0.25, dtype=np.float32)
"""Scores at which values are known; between them, and beyond the last, a map is linear."""

FLATTEST = 1e-4
"""Least slope of a map, in units of its mean one: it must have an inverse."""


class Scores(NamedTuple):
    """A map of each coordinate to its normal score and back."""

    # Any increasing map would do: what is drawn and weighed allows for its slope. This one is the
    # empirical one of draws from the prior, linear between few knots.

    values: Float[Array, "size knot"]

    def score(self, z: Float[Array, "*draw size"]) -> Float[Array, "*draw size"]:
        """Normal scores of unconstrained vectors."""

        def one(z: Array, values: Array) -> Array:
            at, slope = _segment(z, values, values)
            return jnp.asarray(KNOTS, z.dtype)[at] + (z - values[at]) / slope

        return jax.vmap(one, in_axes=(-1, 0), out_axes=-1)(z, self.values)

    def place(
        self, u: Float[Array, "*draw size"]
    ) -> tuple[Float[Array, "*draw size"], Float[Array, "*draw"]]:
        """Unconstrained vectors of normal scores, and the log of the volume of the map there."""

        def one(u: Array, values: Array) -> tuple[Array, Array]:
            knots = jnp.asarray(KNOTS, u.dtype)
            at, slope = _segment(u, knots, values)
            return values[at] + (u - knots[at]) * slope, jnp.log(slope)

        z, log_slope = jax.vmap(one, in_axes=(-1, 0), out_axes=-1)(u, self.values)
        return z, jnp.sum(log_slope, axis=-1)


def normal_scores(z: Float[Array, "draw size"]) -> Scores:
    """The scores that make draws from a prior standard normal in every coordinate."""
    # Source: van der Waerden (1952), Indag. Math. 14, 453-458: normal scores.
    values = _quantiles(z.T, ndtr(KNOTS.astype(float)))
    steps = jnp.diff(values)
    steps = jnp.maximum(steps, FLATTEST * jnp.mean(steps, axis=-1, keepdims=True))
    return Scores(jnp.concatenate([values[:, :1], values[:, :1] + jnp.cumsum(steps, 1)], axis=1))


@dataclasses.dataclass(frozen=True, eq=False)
class ScoredProgram:
    """A program whose vectors are normal scores; densities are those of the scores."""

    program: Program
    scores: Scores

    def potential(self, u: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """Minus the log posterior density of the scores, up to a constant."""
        z, log_volume = self.scores.place(u)
        return self.program.potential(z, data) - log_volume

    def prior_potential(self, u: Float[Array, " size"], data: Observations) -> Float[Array, ""]:
        """The part of the potential in which no reading has a share."""
        z, log_volume = self.scores.place(u)
        return self.program.prior_potential(z, data) - log_volume

    def parameters(self, u: Float[Array, " size"], data: Observations) -> dict[str, Array]:
        """What the model is about."""
        return self.program.parameters(self.scores.place(u)[0], data)


def place(scores: Scores, u: Float[np.ndarray, "pixel draw size"]) -> np.ndarray:
    """Unconstrained vectors of many pixels, each with scores of its own."""
    at = np.clip(np.searchsorted(KNOTS, u) - 1, 0, len(KNOTS) - 2)
    values = np.asarray(scores.values)
    slopes = np.diff(values, axis=-1) / np.diff(KNOTS)

    def of(values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, np.moveaxis(at, 1, 2), axis=-1).swapaxes(1, 2)

    return of(values) + (u - KNOTS[at]) * of(slopes)


def _quantiles(x: Float[Array, "size draw"], shares: np.ndarray) -> Float[Array, "size share"]:
    """As `jnp.quantile`, of numbers that are finite."""
    # Whole numbers in the same order are sorted instead: XLA compares floating-point numbers at six
    # times the cost.
    whole = jnp.int64 if x.dtype == jnp.float64 else jnp.int32

    def turned(bits: Array) -> Array:
        return jnp.where(bits < 0, bits ^ jnp.iinfo(whole).max, bits)

    bits = jnp.sort(turned(jax.lax.bitcast_convert_type(x, whole)), axis=-1)
    ordered = jax.lax.bitcast_convert_type(turned(bits), x.dtype)
    place = shares * (x.shape[-1] - 1)
    below = np.minimum(place.astype(int), x.shape[-1] - 2)
    low, high = ordered[:, below], ordered[:, below + 1]
    return low + jnp.asarray(place - below, x.dtype) * (high - low)


def _segment(x: Array, ends: Array, values: Array) -> tuple[Array, Array]:
    """Number of the segment in which each x lies, and the slope of the map there."""
    at = jnp.clip(jnp.searchsorted(ends, x) - 1, 0, len(KNOTS) - 2)
    return at, (values[at + 1] - values[at]) / (KNOTS[1] - KNOTS[0])
