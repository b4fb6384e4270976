"""Crowds, then mixtures in rounds: tempered draws of a row, until they are worth enough."""

from collections.abc import Iterator

import numpy as np

from polar_bayes.pixels.engine import Engine
from polar_bayes.pixels.importance import LARGEST_TRUSTED
from polar_bayes.pixels.outcome import Row, Status, Weighted, rows
from polar_bayes.pixels.pooling import pool
from polar_bayes.pixels.scores import place
from polar_bayes.pixels.stack import Stack
from polar_bayes.pixels.tempering import PixelTempering


def tempered_draws(
    engine: Engine,
    settings: PixelTempering,
    pixels: Stack,
    keys: np.ndarray,
    at: np.ndarray,
    row: Row,
) -> Iterator[tuple[np.ndarray, Weighted]]:
    """Weighted draws as answers come; what has none begins again from a new crowd."""
    row.status[at] = Status.NOT_CONVERGED
    for attempt in range(settings.crowds):
        lost = at
        for some, found, is_worth in _rounds(engine, settings, pixels, keys, at, row, attempt):
            row.temper(some, found, is_worth=is_worth)
            lost = np.setdiff1d(lost, some)
            yield some, found
        at = lost
        if not at.size:
            return


def _rounds(
    engine: Engine,
    settings: PixelTempering,
    pixels: Stack,
    keys: np.ndarray,
    at: np.ndarray,
    row: Row,
    attempt: int,
) -> Iterator[tuple[np.ndarray, Weighted, np.ndarray]]:
    """A crowd from the prior of each; mixtures fitted to it until their draws are worth enough."""
    crowd = engine.temper(pixels.subset(at), settings, keys[at], attempt)
    row.outcome.steps[at] += crowd.stages
    left = np.flatnonzero((crowd.temperature >= 1.0) & np.isfinite(crowd.u).all(axis=(1, 2)))
    count = 2 * settings.draws
    again = np.arange(count) % settings.crowd  # the crowd once, or some of it more often
    u = np.asarray(crowd.u)[left][:, again]
    weights = np.asarray(crowd.weights)[left][:, again] / np.bincount(again)[again]
    before = None
    for number in range(settings.rounds):
        if not left.size:
            return
        some, round_key = pixels.subset(at[left]), attempt * settings.rounds + number
        scores = rows(crowd.scores, left)
        drawn = engine.propose(some, settings, scores, u, weights, keys[at[left]], round_key)
        found = pool(drawn if before is None else before, drawn)
        possible = np.isfinite(found.weights).all(axis=-1)
        settled = np.zeros(left.size, bool)
        if before is not None:  # one mixture alone, too narrow, would look well
            settled = found.worth >= settings.effective_draws
            settled &= found.pareto_k <= LARGEST_TRUSTED
        is_last = number == settings.rounds - 1
        answer = np.flatnonzero(settled | (is_last & possible))
        if answer.size:
            told = rows(found, answer)
            told = told._replace(z=place(rows(scores, answer), told.z))
            yield at[left[answer]], told, settled[answer]
        on = ~settled & possible
        left, before = left[on], rows(drawn, on)
        u, weights = found.z[on], found.weights[on]
