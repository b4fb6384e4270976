"""Proposals along profiles: every heavy mode, and an arm that the normal approximation misses."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.initialization import Coordinates
from polar_bayes.methods.profile_mixture import profile_mixture
from polar_bayes.numerics.mixtures import draw_mixture, log_density
from polar_bayes.numerics.optimize import Modes, NumpyPotential
from polar_bayes.numerics.psis import smooth, weighted_ess

DRAWS = 8192
SHARE, NARROW, FAR, WIDE, THICK, BEND = 0.7, 0.2, -2.0, 1.0, 0.2, 0.1


def arm(x: Array, _: None) -> Array:
    """A narrow peak with a wide arm on one side of it, bent along a parabola."""
    peak = jnp.log(SHARE / NARROW) - 0.5 * (x[0] / NARROW) ** 2
    wide = jnp.log((1.0 - SHARE) / WIDE) - 0.5 * ((x[0] - FAR) / WIDE) ** 2
    return 0.5 * ((x[1] - BEND * x[0] ** 2) / THICK) ** 2 - jnp.logaddexp(peak, wide)


def coordinates_at(density, z: np.ndarray, covariance: np.ndarray, axes: np.ndarray) -> Coordinates:
    count = len(z)
    modes = Modes(z, covariance, np.full(count, 1.0 / count), np.zeros(count), 16, 0)
    gradient = jax.jit(jax.value_and_grad(density))
    return Coordinates(
        density=density,
        given=None,
        potential=NumpyPotential(gradient, None, z.dtype),
        log_density_of=lambda x: -np.asarray(jax.jit(jax.vmap(lambda one: density(one, None)))(x)),
        modes=modes,
        axes=axes,
        prior_sd=np.full(z.shape[1], 10.0),
    )


def weighted(peak: Coordinates, *more: list[float]) -> tuple[np.ndarray, np.ndarray, float]:
    """Draws of the mixture and more (draw, 2), their weights, and how many these are worth."""
    mixture = profile_mixture(peak)
    draws = jax.jit(draw_mixture, static_argnums=1)(mixture, DRAWS, jax.random.key(0))
    draws = np.concatenate([draws, np.reshape(more, (-1, 2))])
    proposed, draws = np.asarray(jax.jit(log_density)(mixture, draws)), np.asarray(draws)
    weights, _ = smooth((peak.log_density(draws) - proposed)[None])
    return draws, weights[0], float(weighted_ess(weights)[0])


def test_an_arm_gets_draws_and_its_weight() -> None:
    z, covariance = np.zeros((1, 2)), np.diag([NARROW**2, THICK**2])[None]
    draws, weights, effective = weighted(coordinates_at(arm, z, covariance, np.arange(2)))
    assert effective > 0.5 * DRAWS
    mean = (1.0 - SHARE) * FAR
    variance = SHARE * NARROW**2 + (1.0 - SHARE) * (WIDE**2 + FAR**2) - mean**2
    assert abs(weights @ draws[:, 0] - mean) < 4.0 * np.sqrt(variance / effective)
    # The mode alone leaves most of the arm without draws.
    alone = coordinates_at(arm, z, covariance, np.arange(0))
    draws, weights, effective = weighted(alone)
    assert (draws[:, 0] > FAR).all()
    assert abs(weights @ draws[:, 0] - mean) > 4.0 * np.sqrt(variance / effective)
    # One that fell a sd beyond its center by chance would take the worth of most of them.
    there = FAR - WIDE
    *_, effective = weighted(alone, [there, BEND * there**2])
    assert effective < 0.05 * DRAWS


def test_every_mode_of_weight_gets_draws() -> None:
    log_weight = np.log([0.5, 0.3, 0.2])
    z = 20.0 * np.arange(3.0)[:, None] * np.ones(2)

    def wells(x: Array, _: None) -> Array:
        return -jax.nn.logsumexp(jnp.asarray(log_weight) - 0.5 * jnp.sum((x - z) ** 2, axis=1))

    covariance = np.tile(np.eye(2), (3, 1, 1))
    mixture = profile_mixture(coordinates_at(wells, z, covariance, np.arange(0)))
    at, share = np.asarray(mixture.mean)[:, 0], np.exp(np.asarray(mixture.log_share))
    held = np.array([share[at == number].sum() for number in z[:, 0]])
    expected = np.exp(0.5 * log_weight)
    np.testing.assert_allclose(held, expected / expected.sum(), rtol=1e-9)
    # One program serves any number of components.
    along = profile_mixture(coordinates_at(wells, z[:1], covariance[:1], np.arange(2)))
    assert along.mean.shape == mixture.mean.shape
