r"""A mixture of Laplace approximations along the profiles of a posterior.

A posterior with an arm, such as a roughness that no view resolves together with an index that makes
up for it, is not like the normal distribution at its mode, and draws from that never reach the arm.
From each mode every coordinate is moved outwards in growing steps, the others following to their
conditional mode, until the Laplace approximation to its marginal density has fallen by
`LARGEST_DROP`. Each point on these profiles gets a normal distribution with the covariance there.

Source:
    Rue, Martino & Chopin (2009), J. R. Stat. Soc. B 71, 319-392 (Laplace approximations to marginal
    densities; exploration along axes from the mode); Geweke (1989), Econometrica 57, 1317-1339
    (proposals widened along each axis).
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import DTypeLike, Float, Int

from polar_bayes.inference.initialization import Coordinates
from polar_bayes.numerics.batches import take_rows
from polar_bayes.numerics.mixtures import Mixture
from polar_bayes.numerics.optimize import (
    conditional_mode,
    conditional_normal,
    finite_potential,
    forward_difference_hessian,
    ignore_line_search_warnings,
    symmetrize,
)

LEAST_WEIGHT = 1e-3
"""Smallest share of the Laplace evidence of a mode that gets draws."""

LARGEST_DROP = 4.5
"""Largest drop of a log marginal density along its profile: a normal one's at three sds."""

FIRST_STEP, GROWTH, MOST_STEPS = 1.5, 1.5, 8
"""First step along a profile in posterior sds, ratio of successive steps, and number of steps;
together they reach 74 sds."""

WIDEST = 3.0
"""Largest standard deviations of a component, in those of the prior, or, where the curvature is not
positive definite and so determines none, in those at the mode."""

MOST_COORDINATES = 20
"""Largest number of coordinates along which profiles are computed."""

COMPONENTS = 64
"""Number of components is rounded up to a multiple of this, so that most posteriors share one
compiled program."""


class Components(NamedTuple):
    """Normal components, and the index of the peak that each belongs to."""

    peak: Int[np.ndarray, " component"]
    z: Float[np.ndarray, "component size"]
    covariance: Float[np.ndarray, "component size size"]
    log_evidence: Float[np.ndarray, " component"]

    @classmethod
    def at(
        cls, peak: np.ndarray, z: np.ndarray, value: np.ndarray, covariance: np.ndarray
    ) -> "Components":
        """Those at points where the potential has these values."""
        evidence = -value + 0.5 * np.linalg.slogdet(covariance)[1]
        return cls(peak, z, covariance, evidence)


Conditional = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Conditional modes, (row, size), with their potentials and Hessians."""

ConditionalModes = Callable[[np.ndarray, np.ndarray, np.ndarray], Conditional]
"""Function that finds modes with one coordinate held.

Its arguments are indices of peaks, (row,), start vectors, and indices of the held coordinates.
"""


def profile_components(
    peaks: Components, axes: np.ndarray, prior_sd: np.ndarray, conditional: ConditionalModes
) -> Components:
    """Return normal components at every peak and along its profiles.

    Args:
        peaks: Those at the modes, each a peak of its own.
        axes: The coordinates that are moved.
        prior_sd: Standard deviations of all coordinates before any reading.
        conditional: Finds the modes of the others.
    """
    size, found = peaks.z.shape[1], [peaks]
    sd = np.sqrt(np.diagonal(peaks.covariance, axis1=1, axis2=2))
    marginal = peaks.log_evidence[:, None] - np.log(sd)
    factor = np.linalg.cholesky(peaks.covariance)
    corners = np.meshgrid(peaks.peak, axes if size <= MOST_COORDINATES else [], [-1.0, 1.0])
    peak, axis, sign = (corner.ravel() for corner in corners)
    axis = axis.astype(int)
    z, own, step = peaks.z[peak], peaks.covariance[peak], sign * FIRST_STEP * sd[peak, axis]
    for _ in range(MOST_STEPS):
        if not peak.size:
            break
        # The others are first moved to where a normal distribution has their mean.
        along = np.take_along_axis(own, axis[:, None, None], axis=1)[:, 0]
        slope = along / np.take_along_axis(along, axis[:, None], axis=1)
        z, value, hessian = conditional(peak, z + step[:, None] * slope, axis)
        known = np.isfinite(value) & np.isfinite(hessian).all((1, 2))
        hessian = np.where(known[:, None, None], hessian, np.eye(size))
        curvature = prior_sd[:, None] * hessian * prior_sd
        is_definite = np.linalg.eigvalsh(curvature)[:, 0] > 0.0
        unit = np.where(is_definite[:, None, None], np.diag(prior_sd), factor[peak])
        values, vectors = np.linalg.eigh(np.swapaxes(unit, 1, 2) @ hessian @ unit)
        root = unit @ vectors / np.sqrt(np.maximum(values, WIDEST**-2))[:, None]
        reached = Components.at(peak, z, value, root @ np.swapaxes(root, 1, 2))
        # Of the coordinate that was moved, by a normal distribution of the others.
        variance = reached.covariance[np.arange(axis.size), axis, axis]
        drop = marginal[peak, axis] - (reached.log_evidence - 0.5 * np.log(variance))
        inside = known & (drop <= LARGEST_DROP)
        reached, axis, step = take_rows((reached, axis, step * GROWTH), inside)
        peak, z, own, _ = reached
        found.append(reached)
    return Components(*map(np.concatenate, zip(*found, strict=True)))


def mixture_of(components: Components, dtype: DTypeLike) -> Mixture:
    """Return the mixture of components, weighted by the square root of their evidence."""
    # The square root: tails need more draws than they weigh.
    share = np.exp(0.5 * (components.log_evidence - components.log_evidence.max()))
    which = np.resize(np.arange(share.size), COMPONENTS * -(-share.size // COMPONENTS))
    share = (share / np.bincount(which))[which]
    size = components.z.shape[1]
    parts = (
        np.zeros(size),
        np.eye(size),
        np.log(share / share.sum()),
        components.z[which],
        np.linalg.cholesky(components.covariance)[which],
    )
    return Mixture(*jax.device_put([part.astype(dtype) for part in parts]))


def profile_mixture(coordinates: Coordinates) -> Mixture:
    """Return the mixture at every heavy mode of one capture, and along its profiles."""
    modes = coordinates.modes
    # Of the fit: modes are searched in double precision.
    dtype = jax.dtypes.canonicalize_dtype(modes.z.dtype)
    potential = finite_potential(coordinates.potential)
    heavy = modes.weight >= LEAST_WEIGHT
    z, covariance = modes.z[heavy], modes.covariance[heavy]
    value = np.array([potential(each)[0] for each in z])
    peaks = Components.at(np.arange(len(z)), z, value, covariance)
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))

    @functools.cache
    def given_one(at: int, fixed: int) -> np.ndarray:
        """Return a factor of the covariance of all coordinates but one."""
        return conditional_normal(covariance[at], fixed)[1]

    def conditional(peak: np.ndarray, z: np.ndarray, axis: np.ndarray) -> Conditional:
        found = []
        for at, start, fixed in zip(peak.tolist(), z, axis.tolist(), strict=True):
            factor = given_one(at, fixed)
            x, height = conditional_mode(potential, start, factor, gtol=0.05, maxiter=25)
            hessian = symmetrize(forward_difference_hessian(potential, x, 0.3 * sd[at], dtype))
            found.append((x, height, hessian))
        xs, heights, hessians = map(np.stack, zip(*found, strict=True))
        return xs, heights, hessians

    with ignore_line_search_warnings():
        return mixture_of(
            profile_components(peaks, coordinates.axes, coordinates.prior_sd, conditional), dtype
        )
