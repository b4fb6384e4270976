"""Means, standard deviations and quantiles of a row of pixels: what maps show."""

from collections.abc import Mapping

import numpy as np

from polar_bayes.inference.program import Values
from polar_bayes.pixels.importance import summarize

LEVELS = (0.025, 0.1, 0.25, 0.5, 0.75, 0.9, 0.975)


class Marginals:
    """What a row of pixels has, filled in as answers come: NaN where a pixel has none."""

    def __init__(self, count: int, sizes: Mapping[str, tuple[int, ...]]) -> None:
        self.mean = {name: np.full((count, *own), np.nan) for name, own in sizes.items()}
        self.sd = {name: np.full((count, *own), np.nan) for name, own in sizes.items()}
        self.quantiles = {
            name: np.full((len(LEVELS), count, *own), np.nan) for name, own in sizes.items()
        }

    def describe(self, at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        """Take down some pixels."""
        for name, mean in self.mean.items():
            draws = np.asarray(parameters[name], float)
            for own in np.ndindex(mean.shape[1:]):
                found = summarize(draws[(..., *own)], weights, LEVELS)
                mean[(at, *own)], self.sd[name][(at, *own)] = found[:2]
                self.quantiles[name][(slice(None), at, *own)] = found[2]
