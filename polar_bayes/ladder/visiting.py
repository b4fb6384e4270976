"""Whether chains have been at every mode: where all began at one, R-hat cannot see the others."""

import numpy as np

from polar_bayes.inference.bench import Bench
from polar_bayes.inference.ground import WholeGround

HEAVY_MODE = 0.01
"""Laplace weight of a mode that chains must have visited."""


def unvisited_weight(z: np.ndarray, bench: Bench) -> float:
    """Weight of the heaviest mode to which some chain never came nearest."""
    ground = bench.ground
    if not isinstance(ground, WholeGround):
        return 0.0
    modes = ground.modes
    heavy = np.flatnonzero(modes.weight >= HEAVY_MODE)
    if heavy.size < 2:
        return 0.0
    halves = np.linalg.cholesky(modes.covariance[heavy])
    apart = z[None] - modes.z[heavy][:, None, None]
    steps = np.einsum("mij,mcdj->mcdi", np.linalg.inv(halves), apart)
    volume = np.log(np.diagonal(halves, axis1=1, axis2=2)).sum(axis=1)
    nearest = np.argmin(0.5 * np.sum(steps**2, axis=-1) + volume[:, None, None], axis=0)
    visited = np.array([(nearest == number).any(axis=1).all() for number in range(heavy.size)])
    return float(np.max(modes.weight[heavy], where=~visited, initial=0.0))
