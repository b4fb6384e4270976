"""Reference posterior of an accuracy study: long chains, their errors, and distances from them."""

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Array, Float

from polar_bayes.benchmark.run import labeled
from polar_bayes.errors import FitError
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.result import CENTRAL_95
from polar_bayes.methods.auto import bias_doubts
from polar_bayes.methods.importance import Importance
from polar_bayes.methods.method import AbstractMethod, PosteriorDraws
from polar_bayes.methods.nuts import Nuts
from polar_bayes.progress import no_progress

# --- Distances from the reference -----------------------------------------------------------------


DISTANCES = ("mean_error", "sd_error", "low_error", "high_error", "wasserstein")


def distances(
    draws: Float[np.ndarray, "parameter draw"], reference: Float[np.ndarray, "parameter many"]
) -> dict[str, Float[np.ndarray, " parameter"]]:
    """`DISTANCES` of every parameter from a reference, in standard deviations of that."""
    found = np.full((len(DISTANCES), len(draws)), np.inf)
    for at in np.flatnonzero(np.isfinite(draws).all(axis=1)):
        ours, theirs = draws[at], reference[at]
        unit = theirs.std()
        low, high = np.quantile(ours, CENTRAL_95) - np.quantile(theirs, CENTRAL_95)
        wasserstein = scipy.stats.wasserstein_distance(ours, theirs)
        mean, sd = ours.mean() - theirs.mean(), ours.std() - unit
        found[:, at] = np.array([mean, sd, low, high, wasserstein]) / unit
    return dict(zip(DISTANCES, found, strict=True))


# --- The reference --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Reference:
    """Settings of the reference run of an accuracy study.

    Args:
        error: Largest Monte Carlo standard error of a mean or standard deviation, in posterior
            standard deviations, above 0.
        longer: How often chains may be made four times as long to get there, >= 0.

    Raises:
        FitError: A setting is out of range.
    """

    error: float = 0.02
    longer: int = 2

    def __post_init__(self) -> None:
        if not self.error > 0.0 or self.longer < 0:
            raise FitError(
                f"error is {self.error} and longer {self.longer}",
                where="Reference",
                hint="give an error above 0, such as 0.02, and longer from 0",
            )

    @property
    def chains(self) -> Nuts:
        """The method that runs first: NUTS chains."""
        goal = 2.0 / self.error**2
        draws = int(np.ceil(goal / 4.0))
        return Nuts(
            warmup=1000,
            draws=draws,
            most_draws=2 * draws,
            ess=goal,
            target_acceptance=0.95,
            max_tree_depth=10,
        )

    @property
    def weighted(self) -> Importance:
        """The method that runs if the chains disagree: weighted draws."""
        # Half of the effective draws is lost where draws are chosen by weight, and of all draws a
        # few tenths are effective.
        return Importance(draws=math.ceil(16.0 / self.error**2))


class ReferenceRun(NamedTuple):
    """A finished reference; `biases` and `noise` list reasons to doubt it.

    `wasserstein` is the distance of one half of its chains from the other, by parameter.
    """

    labels: tuple[str, ...]
    draws: np.ndarray
    method: str
    mean_error: np.ndarray
    sd_error: np.ndarray
    wasserstein: np.ndarray
    posterior: PosteriorDraws
    biases: tuple[str, ...]
    noise: str = ""

    @property
    def doubts(self) -> tuple[str, ...]:
        """All reasons to doubt the reference; empty without any."""
        return (*self.biases, self.noise) if self.noise else self.biases

    @property
    def error(self) -> float:
        """The largest standard error of a mean or a standard deviation."""
        return float(max(self.mean_error.max(), self.sd_error.max()))


def run_reference(settings: Reference, problem: Problem, key: Array) -> ReferenceRun:
    """Run chains and lengthen them until their own error is small enough."""
    # Where they do not agree, or some of them missed a mode, weighted draws are tried, where the
    # capture allows it.
    runs = [_run_until(settings, "NUTS", settings.chains, problem, key)]
    if runs[0].doubts:
        with contextlib.suppress(FitError):  # no joint approximation
            runs.append(_run_until(settings, "weighted draws", settings.weighted, problem, key))
    return best_reference(runs)


def best_reference(runs: Sequence[ReferenceRun]) -> ReferenceRun:
    """Return the run of fewest biases, and among those the one of smallest error."""
    return min(runs, key=lambda run: (len(run.biases), not run.error < np.inf, run.error))


def _run_until(
    settings: Reference, name: str, method: AbstractMethod, problem: Problem, key: Array
) -> ReferenceRun:
    """Run a method, each time with four times the draws, until its error is small enough."""
    run = _run(settings, name, method, problem, key)
    for _ in range(settings.longer):
        longer = method.scale_draws(4.0)
        if run.error <= settings.error or longer is None:
            break
        method = longer
        run = _run(settings, name, method, problem, key)
    return run


def _run(
    settings: Reference, name: str, method: AbstractMethod, problem: Problem, key: Array
) -> ReferenceRun:
    found = method.run(problem, key, no_progress)
    labels, draws = labeled(problem, found.z)
    mean_error, sd_error = found.standard_errors(lambda z: labeled(problem, z)[1])
    first, second = (
        half.reshape(len(draws), -1) for half in np.split(draws, [draws.shape[1] // 2], axis=1)
    )
    biases = bias_doubts(found)
    apart = distances(first, second)["wasserstein"]
    run = ReferenceRun(labels, draws, name, mean_error, sd_error, apart, found, tuple(biases))
    if run.error <= settings.error:
        return run
    return run._replace(noise=f"its own Monte Carlo error is {run.error:.2g} posterior sd")
