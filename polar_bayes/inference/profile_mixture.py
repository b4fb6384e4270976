r"""A mixture of Laplace approximations along the profiles of a posterior.

A posterior with an arm, such as a roughness that no view resolves together with an index that makes
up for it, is not like the normal distribution at its mode, and draws from that never reach the arm.
From each mode every coordinate is moved outwards in growing steps, the others following to their
conditional mode, until the density has fallen by `LARGEST_DROP`. Each point on these profiles gets
a normal distribution with the covariance there.

Source:
    Rue, Martino & Chopin (2009), J. R. Stat. Soc. B 71, 319-392 (exploration along axes from the
    mode); Geweke (1989), Econometrica 57, 1317-1339 (proposals widened along each axis).
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import DTypeLike

from polar_bayes.inference.initialization import Coordinates
from polar_bayes.inference.optimize import (
    ValueAndGradient,
    finite_potential,
    forward_difference_hessian,
    ignore_line_search_warnings,
    symmetrize,
)
from polar_bayes.inference.proposals import Mixture

LEAST_WEIGHT = 1e-3
"""Share of the Laplace evidence; modes of less get no draws."""

LARGEST_DROP = 4.5
"""Of the log density along a profile: that of a normal distribution at three sds."""

FIRST_STEP, GROWTH, MOST_STEPS = 1.5, 1.5, 8
"""Of a profile: the first in posterior sds, each longer than the one before; 74 sds in all."""

WIDEST = 3.0
"""Standard deviations at a point, at most, in units of those at the mode."""

MOST_COORDINATES = 20
"""Posteriors of more coordinates are described by their modes alone."""

COMPONENTS = 64
"""Of the mixture, at least: one program draws from those of most posteriors."""


class _Component(NamedTuple):
    x: np.ndarray
    covariance: np.ndarray
    log_evidence: float


def profile_mixture(coordinates: Coordinates) -> Mixture:
    """Normal components at every heavy mode, and along its profiles."""
    modes = coordinates.modes
    dtype = jnp.asarray(modes.z).dtype  # of the fit: modes are searched in double precision
    components: list[_Component] = []
    with ignore_line_search_warnings():
        for mode in np.flatnonzero(modes.weight >= LEAST_WEIGHT):
            z, covariance = modes.z[mode], modes.covariance[mode]
            evidence = -coordinates.potential(z)[0] + 0.5 * np.linalg.slogdet(covariance)[1]
            components.append(_Component(z, covariance, evidence))
            if z.size <= MOST_COORDINATES:
                components += _along_profiles(coordinates, z, covariance, dtype)
    evidence = np.array([each.log_evidence for each in components])
    # The square root: tails need more draws than they weigh.
    share = np.exp(0.5 * (evidence - evidence.max()))
    which = np.resize(np.arange(share.size), max(COMPONENTS, share.size))
    share = (share / np.bincount(which))[which]
    scale = np.linalg.cholesky(np.stack([components[i].covariance for i in which]))
    size = modes.z.shape[1]
    return Mixture(
        center=jnp.zeros(size, dtype),
        half=jnp.eye(size, dtype=dtype),
        log_share=jnp.asarray(np.log(share / share.sum()), dtype),
        mean=jnp.asarray(np.stack([components[i].x for i in which]), dtype),
        scale=jnp.asarray(scale, dtype),
    )


def _along_profiles(
    coordinates: Coordinates, mode: np.ndarray, covariance: np.ndarray, dtype: DTypeLike
) -> Iterator[_Component]:
    potential = finite_potential(coordinates.potential)
    sd, factor = np.sqrt(np.diagonal(covariance)), np.linalg.cholesky(covariance)
    lowest, precision = potential(mode)[0], np.linalg.inv(covariance)
    for axis in coordinates.axes:
        others = np.setdiff1d(np.arange(mode.size), axis)
        half = np.linalg.cholesky(np.linalg.inv(precision[np.ix_(others, others)]))
        for sign in (-1.0, 1.0):
            x, own, step = mode, covariance, FIRST_STEP * sd[axis]
            for _ in range(MOST_STEPS):
                # The others are first moved to where a normal distribution has their mean.
                x = x + sign * step * own[axis] / own[axis, axis]
                x, value = _conditional_mode(potential, x, others, half)
                if not value - lowest <= LARGEST_DROP:
                    break
                hessian = forward_difference_hessian(potential, x, 0.3 * sd, dtype)
                curvature = factor.T @ symmetrize(hessian) @ factor
                if not np.isfinite(curvature).all():
                    break
                values, vectors = np.linalg.eigh(curvature)
                root = factor @ vectors / np.sqrt(np.maximum(values, WIDEST**-2))
                own = root @ root.T
                yield _Component(x, own, -value + 0.5 * np.linalg.slogdet(own)[1])
                step *= GROWTH


def _conditional_mode(
    potential: ValueAndGradient, start: np.ndarray, others: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, float]:
    """Where the potential is least over the other coordinates, in units of their covariance."""
    if not others.size:
        return start, potential(start)[0]

    def along(y: np.ndarray) -> np.ndarray:
        x = start.copy()
        x[others] += half @ y
        return x

    def objective(y: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = potential(along(y))
        return value, half.T @ gradient[others]

    found = scipy.optimize.minimize(
        objective,
        np.zeros(others.size),
        jac=True,
        method="BFGS",
        options={"gtol": 0.05, "maxiter": 25},
    )
    return along(found.x), float(found.fun)
