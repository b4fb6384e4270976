r"""From the prior to the posterior of one capture, in small steps of temperature.

$$ p_t(z) \propto p(z) \, p(y|z)^t, \quad 0 = t_0 < t_1 < ... < 1 $$

A crowd that begins as draws from the prior sees every mode before any of them is narrow, and keeps
what the data leave open. After each step the crowd is thinned to a few by weight, and each of these
walks on; all places along the walks are the next crowd, so that no evaluation of the model is lost.
All walk in normal scores of the prior, where a step can reach a mode in a long tail. After the last
step nothing is thinned: the crowd keeps its weights, and with them its smallest modes and wings.

An unconstrained vector may have a long tail under its prior (the log of a roughness that may be
zero): steps and mixtures that know one width for each coordinate then see either the middle or the
tail. Scores have neither tail nor skew.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float
from scipy.special import ndtr

from polar_bayes.errors import FitError
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.repr_html import HTMLRepr

# --- Coordinates in which each parameter's prior is standard normal: normal scores ----------------


KNOTS = np.arange(-3.0, 3.01, 0.25, dtype=np.float32)
"""Scores at which values are known; between them, and beyond the last, a map is linear."""

FLATTEST = 1e-4
"""Least slope of a map, in units of its mean one: it must have an inverse."""


class NormalScores(NamedTuple):
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


def normal_scores(z: Float[Array, "draw size"]) -> NormalScores:
    """The scores that make draws from a prior standard normal in every coordinate."""
    # Source: van der Waerden (1952), Indag. Math. 14, 453-458: normal scores.
    values = _quantiles(z.T, ndtr(KNOTS.astype(float)))
    steps = jnp.diff(values)
    steps = jnp.maximum(steps, FLATTEST * jnp.mean(steps, axis=-1, keepdims=True))
    return NormalScores(
        jnp.concatenate([values[:, :1], values[:, :1] + jnp.cumsum(steps, 1)], axis=1)
    )


@dataclasses.dataclass(frozen=True, eq=False)
class ScoredProgram:
    """A program whose vectors are normal scores; densities are those of the scores."""

    program: Program
    scores: NormalScores

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


def place(scores: NormalScores, u: Float[np.ndarray, "pixel draw size"]) -> np.ndarray:
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


# --- From the prior to the posterior of one capture, in small steps of temperature ----------------


HALVINGS = 20
"""Of the interval in which the next temperature lies."""

MOST_STAGES = 60
"""Steps of temperature; what has not arrived by then has failed."""

ACCEPTED = 0.25
"""Share of the steps of a walk that should be taken; the length of the next ones follows it."""

SIDE_BY_SIDE = 256
"""First looks at a time: thousands together leave the cache of a core, and take twice as long."""

LIFT = 1e-6
"""Added to the correlation matrix of a crowd, which single precision rounds."""


@dataclasses.dataclass(frozen=True)
class PixelTempering(HTMLRepr):
    """Tempered draws of every pixel, corrected by weights.

    Args:
        walks: How many of the crowd walk on after each step of temperature, >= 16.
        length: Places of each walk, its first included, >= 2; all together are the crowd.
        looks: Draws from the prior for each of the crowd, >= 1: more find a narrow mode more often,
            and the first step of temperature is longer.
        effective_share: Share of the crowd that its weights must be worth after a step of
            temperature, between 0.1 and 0.95.
        draws: Of a mixture in every round, at least half the crowd. An answer has the draws of two
            rounds.
        components: Of the mixtures, >= 1.
        rounds: In which a mixture is fitted to the weighted draws, at most, >= 2.
        crowds: What has not come to an answer in these rounds begins again from a new crowd, until
            there were so many, >= 1.
        effective_draws: Independent draws that the weighted ones must be worth, >= 1; in the middle
            and in both tails.

    Raises:
        FitError: A setting is outside its range.
    """

    walks: int = 256
    length: int = 8
    looks: int = 2
    effective_share: float = 0.5
    draws: int = 1024
    components: int = 4
    rounds: int = 8
    crowds: int = 3
    effective_draws: float = 200.0

    def __post_init__(self) -> None:
        least = {
            "walks": 16,
            "length": 2,
            "looks": 1,
            "components": 1,
            "rounds": 2,
            "crowds": 1,
            "effective_draws": 1,
        }
        for name, lowest in least.items():
            if getattr(self, name) < lowest:
                raise FitError(
                    f"{name} is {getattr(self, name)}",
                    where="PixelTempering",
                    hint=f"give {lowest} or more",
                )
        if not 0.1 <= self.effective_share <= 0.95:
            raise FitError(
                f"effective_share is {self.effective_share}",
                where="PixelTempering",
                hint="give a number from 0.1 to 0.95",
            )
        if 2 * self.draws < self.crowd:
            raise FitError(
                f"draws is {self.draws}, and the crowd {self.crowd}",
                where="PixelTempering",
                hint="give at least half of walks * length",
            )
        if self.effective_draws >= 2 * self.draws:
            raise FitError(
                f"effective_draws is {self.effective_draws}, and there are {2 * self.draws} draws",
                where="PixelTempering",
                hint="give fewer, or more draws",
            )

    @property
    def crowd(self) -> int:
        """Draws that are tempered."""
        return self.walks * self.length

    @property
    def answer_draws(self) -> int:
        """Weighted draws of an answer: those of two rounds."""
        return 2 * self.draws


class Crowd(NamedTuple):
    """Draws on their way."""

    u: Float[Array, "draw size"]
    log_prior: Float[Array, " draw"]
    log_likelihood: Float[Array, " draw"]


class Tempered(NamedTuple):
    """A crowd that has arrived, or not."""

    u: Float[Array | np.ndarray, "draw size"]
    weights: Float[Array | np.ndarray, " draw"]
    scores: NormalScores
    temperature: Float[Array | np.ndarray, ""]
    stages: Array | np.ndarray


def temper(program: Program, settings: PixelTempering, data: Observations, key: Array) -> Tempered:
    """Draws that are spread about as the posterior is."""
    # Source: Dau & Chopin (2022), J. R. Stat. Soc. B 84(1), 114-148: waste-free sequential Monte
    # Carlo; Jasra, Stephens, Doucet & Tsagaris (2011), Scand. J. Stat. 38(1), 1-22: adaptive steps.
    walks, count, size = settings.walks, settings.crowd, program.size
    key_start, key_crowd, key_stages = jax.random.split(key, 3)
    keys = jax.random.split(key_start, settings.looks * count)
    z = jax.lax.map(lambda key: program.from_prior(key, data), keys, batch_size=SIDE_BY_SIDE)
    scores = normal_scores(z)
    scored = ScoredProgram(program, scores)

    def look(u: Array) -> Crowd:
        prior = -scored.prior_potential(u, data)
        likelihood = -scored.potential(u, data) - prior
        return Crowd(u, prior, jnp.where(jnp.isnan(likelihood), -jnp.inf, likelihood))

    def heat(crowd: Crowd, temperature: Array) -> tuple[Array, Array]:
        """The next temperature, and the weights that it gives."""
        rise = _rise(crowd.log_likelihood, 1.0 - temperature, settings.effective_share * count)
        weights = jax.nn.softmax(jnp.where(rise > 0.0, rise * crowd.log_likelihood, 0.0))
        return jnp.minimum(temperature + rise, 1.0), weights

    def goes_on(state: tuple) -> Array:
        temperature, *_, stages = state
        # The first crowd repeats itself, even where its weights arrive at once.
        return ((temperature < 1.0) | (stages < 1)) & (stages < MOST_STAGES)

    def stage(state: tuple) -> tuple:
        temperature, weights, crowd, stride, key, stages = state
        key, key_thin, key_walk = jax.random.split(key, 3)
        half = spread(crowd.u, weights)[1]

        def walk(at: Crowd, key: Array) -> tuple[Crowd, tuple[Crowd, Array]]:
            key_step, key_choice = jax.random.split(key)
            noise = jax.random.normal(key_step, at.u.shape, at.u.dtype)
            tried = jax.vmap(look)(at.u + stride * noise @ half.T)
            gain = tried.log_prior - at.log_prior
            gain += temperature * (tried.log_likelihood - at.log_likelihood)
            taken = jnp.log(jax.random.uniform(key_choice, gain.shape, gain.dtype)) < gain
            moved = jax.tree.map(lambda new, old: _choose(taken, new, old), tried, at)
            return moved, (moved, jnp.mean(taken))

        first = _thin(crowd, weights, walks, key_thin)
        keys = jax.random.split(key_walk, settings.length - 1)
        _, (rest, accepted) = jax.lax.scan(walk, first, keys)
        crowd = jax.tree.map(
            lambda x, y: jnp.concatenate([x[None], y]).reshape(count, *x.shape[1:]), first, rest
        )
        longer = jnp.exp(jnp.clip(2.0 * (jnp.mean(accepted) - ACCEPTED), -1.0, 1.0))
        return *heat(crowd, temperature), crowd, stride * longer, key, stages + 1

    seen, one = jax.lax.map(look, scores.score(z), batch_size=SIDE_BY_SIDE), jnp.ones((), z.dtype)
    temperature, weights = heat(seen, 0.0 * one)
    crowd = _thin(seen, weights, count, key_crowd)
    state = (*heat(crowd, temperature), crowd, 2.38 / size**0.5 * one, key_stages, jnp.int32(0))
    temperature, weights, crowd, *_, stages = jax.lax.while_loop(goes_on, stage, state)
    return Tempered(crowd.u, weights, scores, temperature, stages)


def spread(
    z: Float[Array, "draw size"], weights: Float[Array, " draw"]
) -> tuple[Float[Array, " size"], Float[Array, "size size"]]:
    """Mean of weighted draws, and the lower root of their covariance."""
    center = weights @ z
    apart = z - center
    sd = jnp.sqrt(weights @ apart**2)
    sd = jnp.where(sd > 0.0, sd, 1.0)
    scaled = apart / sd
    correlation = scaled.T @ (scaled * weights[:, None])
    return center, sd[:, None] * jnp.linalg.cholesky(correlation + LIFT * jnp.eye(sd.size))


def _rise(log_likelihood: Array, most: Array, effective: float) -> Array:
    """The largest step of temperature after which weights are still worth so many draws."""

    def is_worth(rise: Array) -> Array:
        log_weights = rise * log_likelihood
        return 2.0 * logsumexp(log_weights) - logsumexp(2.0 * log_weights) >= jnp.log(effective)

    def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        worth = is_worth(middle)
        return jnp.where(worth, middle, low), jnp.where(worth, high, middle)

    low, _ = jax.lax.fori_loop(0, HALVINGS, halve, (jnp.zeros_like(most), most))
    return jnp.where(is_worth(most), most, low)


def _thin(crowd: Crowd, weights: Array, count: int, key: Array) -> Crowd:
    """So many of the crowd, each as often as it weighs, evenly."""
    even = (jnp.arange(count) + jax.random.uniform(key)) / count
    kept = jnp.clip(jnp.searchsorted(jnp.cumsum(weights), even), 0, len(weights) - 1)
    return jax.tree.map(lambda x: x[kept], crowd)


def _choose(taken: Array, new: Array, old: Array) -> Array:
    return jnp.where(taken.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
