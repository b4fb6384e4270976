"""The posterior that others are judged by: long chains, and how far they can be trusted."""

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Array, Float

from polar_bayes.benchmark.run import labeled
from polar_bayes.diagnostics.convergence import LARGEST_R_HAT
from polar_bayes.errors import FitError
from polar_bayes.inference.auto import missed_mode_weight
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.mode_methods import Nuts
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.smc import PixelSMC
from polar_bayes.inference.weighted import Tempered
from polar_bayes.progress import no_progress

# --- How far draws are from those of a reference, in its standard deviations ----------------------


INTERVAL = (0.025, 0.975)


class Distances(NamedTuple):
    """Of every parameter, in standard deviations of the reference, each (parameter,)."""

    mean_error: Float[np.ndarray, " parameter"]
    sd_error: Float[np.ndarray, " parameter"]
    low_error: Float[np.ndarray, " parameter"]
    high_error: Float[np.ndarray, " parameter"]
    wasserstein: Float[np.ndarray, " parameter"]


def distances(
    draws: Float[np.ndarray, "parameter draw"], reference: Float[np.ndarray, "parameter many"]
) -> Distances:
    """Compare draws with those of a reference."""
    whole = np.isfinite(draws).all(axis=1)
    found = np.full((len(Distances._fields), len(draws)), np.inf)
    for at in np.flatnonzero(whole):
        ours, theirs = draws[at], reference[at]
        unit = theirs.std()
        low, high = np.quantile(ours, INTERVAL) - np.quantile(theirs, INTERVAL)
        apart = scipy.stats.wasserstein_distance(ours, theirs)
        moved = np.array([ours.mean() - theirs.mean(), ours.std() - unit, low, high, apart])
        found[:, at] = moved / unit
    return Distances(*found)


# --- The posterior that others are judged by: long chains, and how far they can be trusted --------


@dataclasses.dataclass(frozen=True)
class Reference:
    """Settings of the reference.

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
        """The chains with which it begins."""
        goal = 2.0 / self.error**2
        draws = int(np.ceil(goal / 4.0))
        return Nuts(
            warmup=1000,
            draws=draws,
            most_draws=2 * draws,
            effective_draws=goal,
            target_acceptance=0.95,
            max_tree_depth=10,
        )

    @property
    def tempered(self) -> Tempered:
        """What takes over where chains do not find each other's modes."""
        goal = 4.0 / self.error**2  # half of it is lost where draws are chosen by weight
        settings = Tempered(PixelSMC(num_chains=1024, draws=4096)).with_draws(4.0 * goal).settings
        return Tempered(dataclasses.replace(settings, effective_draws=goal))


class Judge(NamedTuple):
    """A reference that was run."""

    labels: tuple[str, ...]
    draws: np.ndarray
    made_by: str
    mean_error: np.ndarray
    sd_error: np.ndarray
    halves: Distances
    answer: PosteriorDraws
    biases: tuple[str, ...]
    noise: str = ""

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why it may be wrong; empty where nothing speaks against it."""
        return (*self.biases, self.noise) if self.noise else self.biases

    @property
    def error(self) -> float:
        """The largest standard error of a mean or a standard deviation."""
        return float(max(self.mean_error.max(), self.sd_error.max()))


def run_reference(settings: Reference, problem: Problem, key: Array) -> Judge:
    """Chains that go on until their own error is small enough."""
    # Where they do not agree, or some of them missed a mode, tempered draws take over, where the
    # capture allows it. Where nothing is good enough, the best of it says so in its doubts.
    tried = [_climb(settings, "NUTS", settings.chains, problem, key)]
    if tried[0].doubts:
        with contextlib.suppress(FitError):  # several patches or colors
            tried.append(_climb(settings, "tempered draws", settings.tempered, problem, key))
    return nearest(tried)


def nearest(tried: Sequence[Judge]) -> Judge:
    """The one that least can be said against: noise is told, and no reason to take a bias."""
    return min(tried, key=lambda judge: (len(judge.biases), not judge.error < np.inf, judge.error))


def _climb(
    settings: Reference, name: str, method: AbstractMethod, problem: Problem, key: Array
) -> Judge:
    judge = _judge(settings, name, method, problem, key)
    for _ in range(settings.longer):
        longer = method.scale_draws(4.0)
        if judge.error <= settings.error or longer is None:
            break
        method = longer
        judge = _judge(settings, name, method, problem, key)
    return judge


def _judge(
    settings: Reference, name: str, method: AbstractMethod, problem: Problem, key: Array
) -> Judge:
    found = method.run(problem, key, no_progress)
    labels, draws = labeled(problem, found.z)
    mean_error, sd_error = found.standard_errors(lambda z: labeled(problem, z)[1])
    half = draws.shape[1] // 2
    one, other = (part.reshape(len(draws), -1) for part in (draws[:, :half], draws[:, half:]))
    biases = found.doubts
    if found.r_hat > LARGEST_R_HAT:
        biases.append(f"its R-hat is {found.r_hat:.3f}")
    if found.method == "nuts" and (weight := missed_mode_weight(found.z, problem)) > 0.0:
        biases.append(f"a mode of weight {weight:.2g} was not visited by every chain")
    judge = Judge(
        labels, draws, name, mean_error, sd_error, distances(one, other), found, tuple(biases)
    )
    if judge.error <= settings.error:
        return judge
    return judge._replace(noise=f"its own Monte Carlo error is {judge.error:.2g} posterior sd")
