"""Automatic choice of a method: the cheapest that passes its own diagnostics."""

import dataclasses
import math
import time
from collections.abc import Iterator
from typing import ClassVar, NamedTuple, override

import numpy as np
from jaxtyping import Array

from polar_bayes.errors import FitError
from polar_bayes.inference.batching import Status
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.problem_batch import BatchDraws, ProblemBatch
from polar_bayes.inference.result import Provenance
from polar_bayes.methods.importance import Importance, suits_profiles
from polar_bayes.methods.method import (
    AbstractBatchMethod,
    AbstractMethod,
    PosteriorDraws,
    flatten,
    problem_of,
)
from polar_bayes.methods.nuts import Nuts
from polar_bayes.numerics.compile import OutOfTimeError, run_until
from polar_bayes.numerics.mcse import (
    LARGEST_R_HAT,
    SMALLEST_ESS,
    draws_needed,
    largest_error,
)
from polar_bayes.numerics.psis import (
    FEW_ROUNDS,
    FINITE_VARIANCE,
    MAX_PARETO_K,
    max_effective_size,
)
from polar_bayes.progress import Progress

MARGIN, MOST_TIMES = 1.5, 16.0
"""Factor on the draws that the first error calls for in a second try; largest factor in all."""


def expected_error(draws: PosteriorDraws, problem: Problem) -> float:
    """Return the Monte Carlo error of a mean or sd that 1% of fits exceed.

    In posterior standard deviations; the largest of all parameters.
    """
    return largest_error(*draws.standard_errors(lambda z: flatten(problem.constrain(z))))


@dataclasses.dataclass(frozen=True)
class Auto(AbstractMethod):
    """The cheapest method that passes its own diagnostics.

    Methods are tried from cheap to exact: importance (of at most 20 coordinates), NUTS. One is
    taken when R-hat is at most 1.01, nothing diverged, no mode was left out, and there are enough
    draws. Without a tolerance these are 400 effective ones, and weights that replace chains have a
    finite variance (Pareto k at most 0.5) after few rounds. Proposals that must adapt to many draws
    can miss the end of a long tail, of which Pareto k tells nothing: of captures by a camera that
    took five rounds or more, standard deviations were too small by up to a third
    (`benchmarks/weights_and_chains.py`). With a tolerance Pareto k is at most 0.7, and the Monte
    Carlo error of every mean and standard deviation is within the tolerance (but in 1% of the
    fits); where only that is missing, the same method is tried once more with more draws.

    Args:
        tolerance: Largest error of a posterior mean or standard deviation, in posterior standard
            deviations, above 0 and at most 1; None for the number of draws that each method has by
            default.
        seconds: Of the whole fit, counted from the call of `fit`, > 0; None for no limit. What is
            not done by then is abandoned, comparison fits included, which are made by the method
            that was taken; only the first method always ends.
        rounds: Of importance sampling at most where there is no tolerance, at least 1.

    Raises:
        FitError: A setting is out of range.
    """

    tolerance: float | None = None
    seconds: float | None = None
    rounds: int = FEW_ROUNDS

    group_size: ClassVar[int] = AbstractBatchMethod.group_size

    def __post_init__(self) -> None:
        self.check_least(rounds=1)
        if self.tolerance is not None and not 0.0 < self.tolerance <= 1.0:
            hint = "give posterior standard deviations above 0, at most 1, such as 0.1"
            self.refuse(f"tolerance is {self.tolerance}", hint)
        if self.seconds is not None and not self.seconds > 0.0:
            self.refuse(f"seconds is {self.seconds}", "give a time above 0, such as 60")

    @property
    def largest_pareto_k(self) -> float:
        """Of weights that are taken; without a tolerance their variance must be finite."""
        return FINITE_VARIANCE if self.tolerance is None else MAX_PARETO_K

    def candidates(self, problem: Problem) -> dict[str, AbstractMethod]:
        """Return the methods to try for a capture, each with the draws it needs.

        The order is that of their costs once all programs are compiled.

        Weighted draws are left out where even equal weights could not meet the tolerance.

        Args:
            problem: The capture and its model.

        Returns:
            Methods by name.
        """
        weighs = suits_profiles(problem.program)
        if self.tolerance is None:
            first = {"importance": Importance(rounds=self.rounds)} if weighs else {}
            return {**first, "nuts": Nuts()}
        needed = draws_needed(self.tolerance, int(problem.describe()["size"].sum()))
        chains = Nuts(ess=max(450.0, float(needed)), most_draws=max(4000, 4 * needed))
        if not weighs:
            return {"nuts": chains}
        # Long tails need more weighted draws than normal posteriors; beyond so many chains are the
        # better way.
        weighted = Importance(draws=max(Importance.draws, 2 * min(8 * needed, 2**17)), rounds=1)
        if max_effective_size(weighted.draws) < needed:
            return {"nuts": chains}
        return {"importance": weighted, "nuts": chains}

    @override
    def run(self, problem: Problem, key: Array, progress: Progress) -> PosteriorDraws:
        deadline = self.deadline(problem)
        attempts: list[Attempt] = []
        best: tuple[Attempt, PosteriorDraws] | None = None
        waiting = list(self.candidates(problem).items())
        tried: set[str] = set()

        def attempted(
            name: str, method: AbstractMethod, until: float
        ) -> tuple[Attempt, PosteriorDraws | None]:
            """One method, judged by its own diagnostics, or abandoned at the deadline."""
            begin = time.perf_counter()

            def judged(progress: Progress) -> tuple[Attempt, PosteriorDraws]:
                begin = time.perf_counter()
                draws = method.run(problem, key, progress)
                return self._judge(name, draws, problem, begin), draws

            try:
                return run_until(until, progress, judged)
            except (FitError, OutOfTimeError) as failure:
                return Attempt(name, time.perf_counter() - begin, why=str(failure)), None

        while waiting:
            name, method = waiting.pop(0)
            # The first one always ends: there is nothing else to return.
            until = deadline if attempts else np.inf
            attempt, draws = attempted(name, method, until)
            attempts.append(attempt)
            # Of two in doubt the more expensive one is nearer to exact.
            if draws is not None and (best is None or attempt.error <= best[0].error):
                best = attempt, draws
            if attempt.taken:
                break
            if self.tolerance and name not in tried and np.isfinite(attempt.error):
                tried.add(name)
                times = MARGIN * (attempt.error / self.tolerance) ** 2
                # Powers of two: of a layout, few numbers of draws are ever compiled.
                more = method.scale_draws(min(2.0 ** math.ceil(math.log2(times)), MOST_TIMES))
                waiting[:0] = [] if more is None else [(name, more)]
        return self._report(best, attempts)

    @override
    def prepare(self, problem: Problem) -> None:
        next(iter(self.candidates(problem).values())).prepare(problem)

    @override
    def deadline(self, problem: Problem) -> float:
        return problem.start_time + (np.inf if self.seconds is None else self.seconds)

    @override
    def for_comparison(self, problem: Problem, draws: PosteriorDraws) -> tuple[AbstractMethod, ...]:
        methods = self.candidates(problem)
        begin = list(methods).index(draws.metadata["auto"]["chosen"])
        chosen, *others = (
            each.for_comparison(problem, draws) for each in list(methods.values())[begin:]
        )
        return (*chosen, *(each[-1] for each in others))

    @override
    def run_batch(self, batch: ProblemBatch) -> Iterator[BatchDraws]:
        """Fit all captures by the cheapest method, and those that it does not fit by the next."""
        if self.tolerance is not None or self.seconds is not None:  # which differ by capture
            yield from super().run_batch(batch)
            return
        for method in self.candidates(problem_of(batch, 0)[0]).values():
            taken: list[int] = []
            for found in method.run_batch(batch):
                good = np.asarray(found.status) == Status.GOOD
                good &= ~(np.asarray(found.pareto_k) > self.largest_pareto_k)
                good &= np.asarray(found.ess) >= SMALLEST_ESS
                taken.extend(found.at[np.broadcast_to(good, found.at.shape)])
                yield found
            batch = batch.subset(np.flatnonzero(~np.isin(batch.at, taken)))
            if not len(batch):
                return

    def _judge(self, name: str, draws: PosteriorDraws, problem: Problem, begin: float) -> "Attempt":
        error = expected_error(draws, problem)
        doubts = bias_doubts(draws, self.largest_pareto_k)
        biased = bool(doubts)
        if self.tolerance is None:
            if not draws.ess >= SMALLEST_ESS:
                doubts.append(f"its effective sample size is {draws.ess:.0f}")
        elif not error <= self.tolerance:
            doubts.append(f"its Monte Carlo error may be {error:.2g} posterior sd")
        return Attempt(
            name,
            time.perf_counter() - begin,
            why="; ".join(doubts),
            error=np.inf if biased else error,  # bias weighs more than any noise
            monte_carlo=error,
            taken=not doubts,
            r_hat=draws.r_hat,
            pareto_k=draws.pareto_k,
            ess=draws.ess,
        )

    def _report(
        self, best: tuple["Attempt", PosteriorDraws] | None, attempts: list["Attempt"]
    ) -> PosteriorDraws:
        """The draws with what was tried, and a problem where nothing was good enough."""
        if best is None:
            raise FitError(
                "; ".join(f"{attempt.name}: {attempt.why}" for attempt in attempts),
                where="method='auto'",
                hint="give more seconds, or check the capture against the prior predictive",
            )
        attempt, draws = best
        problems = list(draws.problems)
        if not attempt.taken and self.tolerance is not None:
            within = "" if self.seconds is None else f" within {self.seconds:g} s"
            problems.append(
                f"no method met the tolerance of {self.tolerance:g} posterior sd{within}: "
                f"{attempt.name} came nearest, and {attempt.why or 'was not judged'}"
            )
        summary = {
            "tolerance": self.tolerance,
            "seconds": self.seconds,
            "chosen": attempt.name,
            "met": attempt.taken,
            "expected_error": _rounded(attempt.monte_carlo),
            "steps": [each.as_metadata() for each in attempts],
        }
        metadata = draws.metadata | {"auto": summary}
        return dataclasses.replace(draws, problems=problems, metadata=metadata)


class Attempt(NamedTuple):
    """One attempt: a method, its result and its assessment."""

    name: str
    seconds: float
    why: str = ""
    error: float = np.inf
    monte_carlo: float = np.inf
    taken: bool = False
    r_hat: float = np.nan
    pareto_k: float = np.nan
    ess: float = np.nan

    def as_metadata(self) -> Provenance:
        """Return the attempt in types of JSON."""
        numbers = ("seconds", "monte_carlo", "r_hat", "pareto_k", "ess")
        texts = {"name": self.name, "taken": self.taken, "why": self.why}
        return texts | {name: _rounded(getattr(self, name)) for name in numbers}


def bias_doubts(draws: PosteriorDraws, largest_pareto_k: float = MAX_PARETO_K) -> list[str]:
    """Why draws may be biased."""
    doubts = draws.doubts
    if draws.pareto_k > largest_pareto_k and not doubts:
        doubts.append(f"its Pareto k is {draws.pareto_k:.2f}")
    if draws.r_hat > LARGEST_R_HAT:
        doubts.append(f"its R-hat is {draws.r_hat:.3f}")
    # Where all chains began at one mode, R-hat cannot see the others.
    if (weight := draws.metadata.get("modes", {}).get("unvisited", 0.0)) > 0.0:
        doubts.append(f"a mode of weight {weight:.2g} was not visited by every chain")
    return doubts


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
