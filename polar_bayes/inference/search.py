"""The way to the modes that every fit begins with: climbs from many prior draws."""

import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import FitError
from polar_bayes.inference.modes import Modes, ValueAndGradient, climb, distinct, quiet_line_search
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

KEYS = 500
"""Draws from the prior that one call of a compiled program can make."""


def from_prior(program: Program, key: Array, draws: int, data: Observations) -> np.ndarray:
    """Unconstrained vectors drawn from the prior; other numbers of them compile nothing new."""
    # A key depends on its place alone, so a round number of them serves any number of draws.
    keys = np.asarray(jax.random.key_data(jax.random.split(key, KEYS * -(-draws // KEYS))))
    drawn = [
        program.drawn_from_prior(keys[begin : begin + KEYS], min(KEYS, draws - begin), data)
        for begin in range(0, draws, KEYS)
    ]
    return np.concatenate(drawn)[:draws]


def find_modes(potential: ValueAndGradient, starts: np.ndarray, progress: Progress) -> Modes:
    """Climb from every start and keep the distinct peaks."""
    climbs = []
    with quiet_line_search():
        for number, start in enumerate(starts):
            climbs.append(climb(potential, start))
            progress("searching for modes", (number + 1) / len(starts))
    modes = distinct(climbs)
    if modes is None:
        raise FitError(
            f"none of {len(starts)} starts reached a peak of the posterior",
            where="fit",
            mend="check the capture against the prior predictive, or give narrower priors",
        )
    return modes
