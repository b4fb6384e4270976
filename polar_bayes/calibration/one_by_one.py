"""Simulations fitted by what `polar_bayes.fit` runs: modes first, then chains or the guide there.

Any model that can be fitted can be calibrated so, whatever its axes. Fits come one after another
on each thread, and all of them run the same compiled programs.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.diagnostics.convergence import LARGEST_R_HAT, SMALLEST_ESS
from polar_bayes.errors import FitError
from polar_bayes.inference.draws import parameters_of
from polar_bayes.inference.ground import AbstractGrounds, Drawn
from polar_bayes.inference.laplace import Laplace
from polar_bayes.inference.mixing import measure
from polar_bayes.inference.nuts import Nuts
from polar_bayes.inference.prepared import Prepared
from polar_bayes.inference.program import Program, Values
from polar_bayes.inference.request import Request
from polar_bayes.inference.tracing import TRACING
from polar_bayes.observation.data import READINGS, Observations
from polar_bayes.physics.discrepancy import Discrepancy
from polar_bayes.pixels.importance import smooth
from polar_bayes.pixels.outcome import Approach, Describe, Outcome, Status, no_outcome
from polar_bayes.pixels.stack import Stack
from polar_bayes.progress import silent

OneByOne = Nuts | Laplace
BLOCK = 4
"""Simulations of a block: few, since each may take half a minute."""


def calls_for_chains(request: Request) -> bool:
    """Whether the posteriors of a capture are out of reach of weighted draws."""
    read = [request.capture[name].sizes for name in READINGS if name in request.capture]
    several = any(dim != "view" and length > 1 for sizes in read for dim, length in sizes.items())
    return several or request.scene.has(Discrepancy)


def fit_each(
    prepared: Prepared,
    settings: OneByOne,
    captures: Stack,
    numbers: np.ndarray,
    seed: int,
    describe: Describe,
) -> Outcome:
    """Fit every capture of a row as `polar_bayes.fit` does, one after another."""
    # The draws of chains are correlated, and ranks want independent ones. So each chain is thinned
    # to every k-th draw, k the number of draws over their effective sample size (of the bulk, the
    # least of all parameters), rounded up. The verdict of `polar_bayes.verdict` becomes the status:
    # good, or not trusted where R-hat is above 1.01, an effective sample size below 400, a draw
    # diverged or is no number, the goals were not reached before `most_draws`, or the mode of a
    # normal approximation is not settled. Such fits are ranked all the same.
    found, base = no_outcome(len(captures)), jax.random.fold_in(jax.random.key(seed), 3)
    with jax.enable_x64(True), TRACING:  # two threads that begin at once share what they make
        grounds = prepared.grounds
    for at, number in enumerate(numbers):
        with jax.enable_x64(True):  # a thread does not inherit it
            data, key = captures.pixel(at), jax.random.fold_in(base, int(number))
            told = _fit(grounds, prepared.program, settings, data, key)
        if told is None:
            continue
        drawn, parameters = told
        measured = _measure(settings, drawn, parameters)
        for name, value in measured.items():
            getattr(found, name)[at] = value
        few = _thin(parameters, measured["effective_draws"])
        count = len(next(iter(few.values())))
        weights = np.full((1, count), 1.0 / count)
        describe(np.array([at]), {name: x[None] for name, x in few.items()}, weights)
    return found


def _fit(
    grounds: AbstractGrounds, program: Program, settings: OneByOne, data: Observations, key: Array
) -> tuple[Drawn, Values] | None:
    """Draws of one capture and their parameters; None where there are none."""
    key_starts, key_draws = jax.random.split(key)
    if isinstance(settings, Nuts):
        settings = dataclasses.replace(settings, threads=1)
    try:
        ground = grounds.find(data, key_starts, silent)
        drawn = ground.draw(key_draws, settings, silent)
    except (FitError, np.linalg.LinAlgError):  # no peak, or no width around it
        return None
    parameters = parameters_of(program, drawn.z, data)
    return (drawn, parameters) if _whole(parameters).any() else None


def _measure(settings: OneByOne, drawn: Drawn, parameters: Values) -> dict[str, float]:
    """What a fit is worth, by the names of `Outcome`."""
    fine = _whole(parameters)
    good, worth, pareto_k = not drawn.problems and bool(fine.all()), float(fine.sum()), np.nan
    if isinstance(settings, Nuts):
        bulk, tail, r_hat = measure(_scalars(parameters))
        mixed = min(bulk.min(), tail.min()) >= SMALLEST_ESS and r_hat.max() <= LARGEST_R_HAT
        good = good and bool(mixed and drawn.goals_reached and not drawn.stats["diverging"].any())
        worth = float(np.nan_to_num(bulk.min(), nan=1.0))
    else:
        pareto_k = float(smooth(drawn.stats["log_weight"].reshape(1, -1))[1][0])
    return {
        "effective_draws": worth,
        "pareto_k": pareto_k,
        "approach": Approach.NUTS if isinstance(settings, Nuts) else Approach.LAPLACE,
        "status": Status.GOOD if good else Status.NOT_TRUSTED,
    }


def _thin(parameters: Values, effective: float) -> dict[str, np.ndarray]:
    """Nearly independent draws, those that are numbers, in a row: by name, (draw, ...)."""
    fine = _whole(parameters)
    step = int(np.ceil(fine.size / np.clip(effective, 1.0, fine.size)))
    few = np.zeros_like(fine)
    few[:, ::step] = True
    if not (few & fine).any():
        few[:] = True
    return {name: np.asarray(x)[few & fine] for name, x in parameters.items()}


def _whole(parameters: Values) -> np.ndarray:
    """Which draws are numbers, (chain, draw)."""
    finite = [np.isfinite(np.asarray(x)) for x in parameters.values()]
    return np.all([x.all(axis=tuple(range(2, x.ndim))) for x in finite], axis=0)


def _scalars(parameters: Values) -> np.ndarray:
    """Every number that a fit estimates, (scalar, chain, draw)."""
    flat = [np.asarray(x).reshape(*np.shape(x)[:2], -1) for x in parameters.values()]
    return np.moveaxis(np.concatenate(flat, axis=-1), -1, 0)
