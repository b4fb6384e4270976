"""Proposals that learn from their own weighted draws, for pixels the normal one does not fit.

Each round takes mean and covariance of the weighted draws of the last, and draws from a Student t
distribution with both: its tails are longer than those of nearly every posterior, so weights are
bounded where those of a normal distribution are not. A round takes a small part of the time of
short chains.
"""

from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from polar_bayes.pixels.importance import Points, even, mirrored

DEGREES_OF_FREEDOM = 6.0
"""Of the tails: few enough to outlast a posterior's, many enough to waste few draws on them."""

TIMES = 2
"""How many times the draws of the first look a round takes."""

FEWEST_EFFECTIVE = 100
"""Independent draws that the weighted ones of a round must be worth to be the answer."""


class Proposal(NamedTuple):
    """Where the draws of every pixel are taken: `center + points @ half`."""

    center: Float[np.ndarray, "pixel size"]
    half: Float[np.ndarray, "pixel size size"]

    def turned(self, turns: Float[np.ndarray, "pixel size size"]) -> "Proposal":
        """The same distribution, whose points are turned first, in each pixel by another way."""
        return Proposal(self.center, turns @ self.half)

    def places(self, points: Points) -> Float[np.ndarray, "pixel draw size"]:
        """Unconstrained vectors of all draws."""
        return self.center[:, None] + points.places @ self.half


def heavy_points(count: int, size: int, seed: int) -> Points:
    """Evenly spread points of a standard Student t distribution."""
    share = even(-(-count // 2), size + 1, seed)
    chi_squared = 2.0 * scipy.special.gammaincinv(0.5 * DEGREES_OF_FREEDOM, share[:, :1])
    half = scipy.special.ndtri(share[:, 1:]) / np.sqrt(chi_squared / DEGREES_OF_FREEDOM)
    places = mirrored(half)[:count]
    squares = np.sum(places**2, axis=-1) / DEGREES_OF_FREEDOM
    return Points(places, -0.5 * (DEGREES_OF_FREEDOM + size) * np.log1p(squares))


def learn(
    places: Float[np.ndarray, "pixel draw size"], weights: Float[np.ndarray, "pixel draw"]
) -> Proposal:
    """Mean and covariance of weighted draws."""
    # Source: Cappe, Guillin, Marin & Robert (2004), J. Comput. Graph. Stat. 13(4), 907-929:
    # population Monte Carlo.
    center = np.einsum("pd,pds->ps", weights, places)
    apart = places - center[:, None]
    covariance = np.einsum("pd,pds,pdt->pst", weights, apart, apart)
    half = np.full_like(covariance, np.nan)
    for pixel, spread in enumerate(covariance):
        try:
            half[pixel] = np.linalg.cholesky(spread).T
        except np.linalg.LinAlgError:
            continue  # stays NaN, which no weight trusts
    return Proposal(center, half)
