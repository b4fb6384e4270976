"""The contract of methods: a problem in, posterior draws out."""

import abc
import dataclasses
import difflib
import inspect
import math
from collections.abc import Callable
from typing import Any, Self, override

import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.errors import FitError
from polar_bayes.inference.batching import (
    Describe,
    MethodUsed,
    ObservationBatch,
    Outcome,
    Status,
    empty_outcome,
)
from polar_bayes.inference.compile import TRACING_LOCK
from polar_bayes.inference.mcse import (
    LARGEST_R_HAT,
    SMALLEST_ESS,
    measure,
    standard_errors,
    weighted_standard_errors,
)
from polar_bayes.inference.problem import CompiledModel, Problem
from polar_bayes.inference.program import Values
from polar_bayes.progress import Progress, no_progress
from polar_bayes.repr_html import HTMLRepr


@dataclasses.dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """Draws from one posterior, and how far they can be trusted.

    Args:
        method: Name of the method that made them.
        z: Draws of the unconstrained vector, shape (chain, draw, size).
        stats: Sample statistics by name, each of shape (chain, draw).
        problems: Why the draws must not be used; sentences without an end mark.
        weighted: Weighted draws from which `z` was resampled: vectors of shape (draw, size), and
            weights of shape (draw,) that add up to 1.
        covariance: Of a point estimate, whose one draw is the estimate: covariance of `z`, shape
            (size, size), infinite where the readings do not determine it.
        r_hat: Largest R-hat of all coordinates; NaN where there are no chains.
        k_hat: Pareto k-hat of the importance weights; NaN where there are none.
        effective_draws: Effective sample size, the smallest of all coordinates.
        gradients: Evaluations of the log density with its gradient.
        densities: Evaluations of the log density alone.
        metadata: Anything that JSON can hold and the result should keep, by name.
        comparison_method: The method that fits comparisons, where it is another one.
        deadline: When comparisons are abandoned, on the clock of `time.perf_counter`, unit second.
    """

    method: str
    z: np.ndarray
    stats: dict[str, np.ndarray]
    problems: list[str] = dataclasses.field(default_factory=list)
    weighted: tuple[np.ndarray, np.ndarray] | None = None
    covariance: np.ndarray | None = None
    r_hat: float = np.nan
    k_hat: float = np.nan
    effective_draws: float = np.nan
    gradients: float = np.nan
    densities: float = np.nan
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)
    comparison_method: "AbstractMethod | None" = None
    deadline: float = np.inf

    @property
    def doubts(self) -> list[str]:
        """The problems, and divergences, which the statistics of a result show by themselves."""
        diverging = self.stats.get("diverging", np.zeros(0))
        count = int(np.sum(diverging))
        return [*self.problems, *([f"{count} of {diverging.size} draws diverged"] if count else [])]

    def standard_errors(
        self, describe: Callable[[np.ndarray], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Monte Carlo standard errors of means and standard deviations, in standard deviations.

        Args:
            describe: From draws of shape (chain, draw, size) to scalars of shape
                (scalar, chain, draw).

        Returns:
            Both for every scalar, unit 1.
        """
        mean, sd = standard_errors(describe(self.z))
        if self.weighted is None:
            return mean, sd
        z, weights = self.weighted
        weighted = weighted_standard_errors(describe(z[None])[:, 0], weights)
        # Resampling loses at most what as many independent draws would lose.
        return np.hypot(weighted[0], mean), np.hypot(weighted[1], sd)


SYNONYMS = {
    "num_chains": "chains",
    "num_draws": "draws",
    "num_samples": "draws",
    "num_warmup": "warmup",
    "n_draws": "draws",
    "samples": "draws",
    "target_accept": "target_acceptance",
    "target_accept_prob": "target_acceptance",
    "tune": "warmup",
}
"""What NumPyro, PyMC and others call settings."""


class AbstractBatchMethod[Engine](HTMLRepr, abc.ABC):
    """A way to fit many captures of one layout together.

    `Engine` is what is compiled for the layout: `BatchEngine` where the captures run side by side
    in one program, `CompiledModel` where they are fitted one after another.
    """

    def __new__(cls, *_: object, **settings: object) -> Self:
        """Refuse a setting that it does not have, naming the one that is meant."""
        found = [*inspect.signature(cls.__init__).parameters.values()][1:]
        if any(each.kind is each.VAR_KEYWORD for each in found):
            return super().__new__(cls)
        names = [each.name for each in found]
        for name in settings:
            if name not in names:
                near = [SYNONYMS.get(name, ""), *difflib.get_close_matches(name, names, n=1)]
                meant = next((f"did you mean {each}? " for each in near if each in names), "")
                raise FitError(
                    f"there is no setting {name}",
                    where=cls.__name__,
                    hint=f"{meant}there are {', '.join(names)}",
                )
        return super().__new__(cls)

    @abc.abstractmethod
    def run_batch(
        self,
        engine: Engine,
        observations: ObservationBatch,
        numbers: np.ndarray,
        seed: int,
        describe: Describe,
    ) -> Outcome:
        """Fit every capture.

        Args:
            engine: Compiled programs of the model.
            observations: The captures.
            numbers: An integer for each capture, shape (capture,). What is drawn for a capture
                depends on this number and the seed only.
            seed: Of everything that is drawn.
            describe: Called with the indices of captures that have an answer, their parameters by
                name, each (capture, draw, ...), and the weights of these draws (capture, draw); a
                later call for the same capture replaces an earlier one.

        Returns:
            Status, method, Pareto k-hat, effective sample size and steps of every capture, each of
            shape (capture,); NaN where there is nothing to say. A fit that fails is a status, not
            an error.
        """

    def thinning(self, count: int) -> int:
        """Every how many of the draws that it describes are nearly independent.

        Args:
            count: Draws that are wanted, about.

        Returns:
            1 where all are, as resampled draws and those that `run_batch` thins itself.
        """
        del count
        return 1


@dataclasses.dataclass(frozen=True)
class AbstractMethod(AbstractBatchMethod[CompiledModel]):
    """A way to draw from the posterior of one capture; a small frozen dataclass of settings."""

    @abc.abstractmethod
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        """Draw from the posterior of one capture.

        Args:
            problem: The capture and its model, ready to be fitted.
            key: Random key of the draws.
            progress: Called with the name of a stage and the fraction of it that is done.

        Returns:
            The draws, and how far they can be trusted.

        Raises:
            FitError: The method does not suit the capture, or found nothing to draw from.
        """

    @property
    def name(self) -> str:
        """Name of the method, as results state it."""
        return type(self).__name__.lower()

    @property
    def num_draws(self) -> int | None:
        """Draws that the method makes, at least; None where their number is not a setting."""
        draws = getattr(self, "draws", None)
        return draws if isinstance(draws, int) else None

    def scale_draws(self, factor: float) -> Self | None:
        """The same method with a multiple of its draws.

        Args:
            factor: Above 0.

        Returns:
            Other settings; None where the number of draws is not a setting.

        Raises:
            FitError: The method does not allow so few.
        """
        if self.num_draws is None:
            return None
        changed: dict[str, Any] = {"draws": math.ceil(factor * self.num_draws)}
        return dataclasses.replace(self, **changed)

    def prepare(self, problem: Problem) -> None:
        """Begin to compile what `run` needs, in parallel with the search for modes.

        Args:
            problem: The capture and its model.
        """
        del problem

    def cross_check(self, problem: Problem, parameters: Values, key: Array) -> dict[str, Any]:
        """What other draws of the same posterior say of those of this method.

        `polar_bayes.fit` asks for it; simulations of many fits do not.

        Args:
            problem: The capture and its model.
            parameters: Draws of this method by name, each (chain, draw, ...).
            key: Random key of the other draws.

        Returns:
            Entries of the provenance, which JSON can hold; none by default.
        """
        del problem, parameters, key
        return {}

    @override
    def run_batch(
        self,
        engine: CompiledModel,
        observations: ObservationBatch,
        numbers: np.ndarray,
        seed: int,
        describe: Describe,
    ) -> Outcome:
        """Fit one capture after another, and describe nearly independent draws of each."""
        # Chains are thinned to every k-th draw, where k is the number of draws over the smallest
        # bulk effective sample size of all parameters, rounded up. A fit that must not be trusted
        # is described all the same.
        outcome, base = (
            empty_outcome(len(observations)),
            jax.random.fold_in(jax.random.key(seed), 3),
        )
        double = engine.precision == "double"
        with jax.enable_x64(double), TRACING_LOCK:  # two threads that begin at once share it
            _ = engine.initializer
        for at, number in enumerate(numbers):
            with jax.enable_x64(double):  # a thread does not inherit it
                key_search, key_draws = jax.random.split(jax.random.fold_in(base, int(number)))
                problem = Problem(engine, observations.pixel(at), key_search)
                try:
                    draws = self.run(problem, key_draws, no_progress)
                except (FitError, np.linalg.LinAlgError):  # no mode, or no width around it
                    continue
                parameters = problem.constrain(draws.z)
            if not finite_draws(parameters).any():
                continue
            for name, value in assess_draws(draws, parameters).items():
                getattr(outcome, name)[at] = value
            thinned = thin_draws(parameters, outcome.effective_draws[at])
            count = len(next(iter(thinned.values())))
            weights = np.full((1, count), 1.0 / count)
            describe(np.array([at]), {name: x[None] for name, x in thinned.items()}, weights)
        return outcome


def assess_draws(draws: PosteriorDraws, parameters: Values) -> dict[str, float]:
    """Status and effective sample size of one fit, by the names of `Outcome`."""
    finite = finite_draws(parameters)
    good, effective = not draws.doubts and bool(finite.all()), float(finite.sum())
    approach = MethodUsed.__members__.get(draws.method.upper(), MethodUsed.OTHER)
    if "diverging" in draws.stats or approach == MethodUsed.OTHER:  # a user's draws may be chains
        bulk, tail, r_hat = measure(flatten(parameters))
        mixed = min(bulk.min(), tail.min()) >= SMALLEST_ESS and r_hat.max() <= LARGEST_R_HAT
        good = good and bool(mixed and draws.metadata.get("goals_reached", True))
        effective = float(np.nan_to_num(bulk.min(), nan=1.0))
    return {
        "effective_draws": effective,
        "pareto_k": draws.k_hat,
        "approach": approach,
        "status": Status.GOOD if good else Status.NOT_TRUSTED,
    }


def thin_draws(parameters: Values, effective: float) -> dict[str, np.ndarray]:
    """Nearly independent finite draws of all chains: by name, (draw, ...)."""
    finite = finite_draws(parameters)
    step = int(np.ceil(finite.size / np.clip(effective, 1.0, finite.size)))
    chosen = np.zeros_like(finite)
    chosen[:, ::step] = True
    if not (chosen & finite).any():
        chosen[:] = True
    return {name: np.asarray(x)[chosen & finite] for name, x in parameters.items()}


def finite_draws(parameters: Values) -> np.ndarray:
    """Which draws are finite in all parameters, (chain, draw)."""
    finite = [np.isfinite(np.asarray(x)) for x in parameters.values()]
    return np.all([x.all(axis=tuple(range(2, x.ndim))) for x in finite], axis=0)


def flatten(parameters: Values) -> np.ndarray:
    """Every scalar of parameters of shape (chain, draw, ...): (scalar, chain, draw)."""
    flat = [np.asarray(x, float).reshape(*np.shape(x)[:2], -1) for x in parameters.values()]
    return np.moveaxis(np.concatenate(flat, axis=-1), -1, 0)
