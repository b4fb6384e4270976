"""Where the truth stands among the draws of its posterior."""

import numpy as np
from jaxtyping import Float

from polar_bayes.inference.program import Values


class Standing:
    """Probability integral transforms and scores, filled in as fits come: NaN without an answer."""

    # Source: Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788; Gneiting &
    # Raftery (2007), JASA 102, 359-378, eq. 21.

    def __init__(self, truth: Values, numbers: np.ndarray, seed: int) -> None:
        self._truth = {name: np.asarray(truth[name], float) for name in sorted(truth)}
        random = [np.random.default_rng([seed, number]) for number in numbers]
        self._chance = {
            name: np.array([each.random(x.shape[1:]) for each in random])
            for name, x in self._truth.items()
        }
        self.pit = {name: np.full(x.shape, np.nan) for name, x in self._truth.items()}
        self.crps = {name: np.full(x.shape, np.nan) for name, x in self._truth.items()}

    def describe(self, at: np.ndarray, parameters: Values, weights: np.ndarray) -> None:
        """Take down some fits."""
        for name, truth in self._truth.items():
            draws = np.asarray(parameters[name], float)
            for own in np.ndindex(truth.shape[1:]):
                place = (at, *own)
                told = draws[(..., *own)], weights, truth[place]
                self.pit[name][place] = share_below(*told, self._chance[name][place])
                self.crps[name][place] = ranked_score(*told)


def share_below(
    draws: Float[np.ndarray, "fit draw"],
    weights: Float[np.ndarray, "fit draw"],
    truth: Float[np.ndarray, " fit"],
    chance: Float[np.ndarray, " fit"],
) -> Float[np.ndarray, " fit"]:
    """Share of each posterior below the truth, spread evenly over the gap in which it falls."""
    below = np.sum(weights * (draws < truth[:, None]), axis=-1)
    tied = np.sum(weights * (draws == truth[:, None]), axis=-1)
    count = draws.shape[-1]
    return (count * (below + chance * tied) + chance) / (count + 1)


def ranked_score(
    draws: Float[np.ndarray, "fit draw"],
    weights: Float[np.ndarray, "fit draw"],
    truth: Float[np.ndarray, " fit"],
) -> Float[np.ndarray, " fit"]:
    """E|X - truth| - E|X - X'| / 2 of every fit."""
    order = np.argsort(draws, axis=-1)
    ranked = np.take_along_axis(draws, order, axis=-1)
    share = np.take_along_axis(weights, order, axis=-1)
    spread = np.sum(share * ranked * (2.0 * np.cumsum(share, axis=-1) - share - 1.0), axis=-1)
    return np.sum(share * np.abs(ranked - truth[:, None]), axis=-1) - spread
