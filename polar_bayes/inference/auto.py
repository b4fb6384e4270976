"""The cheapest method that is good enough, found by trying: from cheap to exact."""

import dataclasses
import math
import time
from typing import Any, NamedTuple, override

import numpy as np
import xarray as xr

from polar_bayes.errors import FitError
from polar_bayes.inference.compile import OutOfTimeError, run_until
from polar_bayes.inference.files import check_fit
from polar_bayes.inference.initialization import JointInit
from polar_bayes.inference.mcse import count_scalars, draws_needed, expected_error
from polar_bayes.inference.method import AbstractMethod, PosteriorDraws
from polar_bayes.inference.nuts import Nuts
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.psis import MAX_PARETO_K
from polar_bayes.inference.request import Method
from polar_bayes.inference.resampling import max_effective_size
from polar_bayes.inference.result import provenance_of
from polar_bayes.inference.run_method import answer, draws_of, with_answer_draws, with_draws
from polar_bayes.inference.smc import PixelSMC
from polar_bayes.inference.weighted import Importance, Tempered

# --- Whether chains have been at every mode: where all began at one, R-hat cannot see the others


HEAVY_MODE = 0.01
"""Laplace weight of a mode that chains must have visited."""


def missed_mode_weight(z: np.ndarray, problem: Problem) -> float:
    """Weight of the heaviest mode to which some chain never came nearest."""
    initialization = problem.initialization
    if not isinstance(initialization, JointInit):
        return 0.0
    modes = initialization.modes
    heavy = np.flatnonzero(modes.weight >= HEAVY_MODE)
    if heavy.size < 2:
        return 0.0
    halves = np.linalg.cholesky(modes.covariance[heavy])
    apart = z[None] - modes.z[heavy][:, None, None]
    steps = np.einsum("mij,mcdj->mcdi", np.linalg.inv(halves), apart)
    volume = np.log(np.diagonal(halves, axis1=1, axis2=2)).sum(axis=1)
    nearest = np.argmin(0.5 * np.sum(steps**2, axis=-1) + volume[:, None, None], axis=0)
    visited = np.array([(nearest == number).any(axis=1).all() for number in range(heavy.size)])
    return float(np.max(modes.weight[heavy], where=~visited, initial=0.0))


# --- The cheapest method that is good enough, found by trying: from cheap to exact ----------------


LARGEST_R_HAT = 1.01

RESERVE = 8
"""Times as many weighted draws as normal posteriors need: long tails need more."""

MOST_DRAWS = 2**17
"""Weighted draws beyond which chains are the better way."""

MARGIN, MOST_TIMES = 1.5, 16.0
"""Draws of a second try: more than the first error asks for, but not above so many times."""


@dataclasses.dataclass(frozen=True)
class Auto(AbstractMethod):
    """The cheapest method whose own diagnostics say that it is good enough.

    Methods are tried from cheap to exact: importance, tempered draws (of one material in one
    color), NUTS. One is taken when Pareto k-hat is at most 0.7, R-hat at most 1.01, nothing
    diverged, no mode was left out, and the Monte Carlo error of every mean and standard deviation
    is within the tolerance (but in 1% of the fits). Where only that is missing, the same method
    is tried once more with more draws.

    Args:
        tolerance: Largest error of a posterior mean or standard deviation, in posterior standard
            deviations, above 0 and at most 1.
        seconds: Of the whole fit, counted from the call of `fit`, > 0. What is not done by then is
            abandoned, fits beside this one included, which are made by the method that was taken;
            only the first method always ends.

    Raises:
        FitError: A setting is out of range.
    """

    tolerance: float = 0.1
    seconds: float = 60.0

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance <= 1.0:
            raise FitError(
                f"tolerance is {self.tolerance}",
                where="Auto",
                hint="give posterior standard deviations above 0, at most 1, such as 0.1",
            )
        if not self.seconds > 0.0:
            raise FitError(
                f"seconds is {self.seconds}", where="Auto", hint="give a time above 0, such as 60"
            )

    def rungs(self, problem: Problem) -> dict[str, Method]:
        """What is tried for a capture, cheapest first, each with as many draws as it takes.

        Weighted draws are left out where even the best weights could not meet the tolerance.

        Args:
            bench: The capture.

        Returns:
            Settings by name.

        Raises:
            Nothing.
        """
        needed = draws_needed(self.tolerance, count_scalars(problem.program, problem.data))
        chains = Nuts(effective_draws=max(450.0, float(needed)), most_draws=max(4000, 4 * needed))
        if any(name != "view" and length > 1 for name, length in problem.data.dims):
            return {"nuts": chains}
        weighted = min(RESERVE * needed, MOST_DRAWS)
        tempering = with_answer_draws(PixelSMC(), weighted)
        enough = min(needed, 0.5 * tempering.answer_draws)
        tempering = dataclasses.replace(tempering, effective_draws=enough)
        importance = Importance(draws=max(2048, 2 * weighted))
        rungs: dict[str, Method] = {"importance": importance, "tempered": Tempered(tempering)}
        able = {
            name: rung
            for name, rung in rungs.items()
            if max_effective_size(draws_of(rung) or 0) >= needed
        }
        return able | {"nuts": chains}

    @override
    def draw(self, problem: Problem) -> PosteriorDraws:
        deadline = problem.begun + self.seconds
        steps: list[Step] = []
        best: tuple[Step, PosteriorDraws] | None = None
        waiting = list(self.rungs(problem).items())
        again = False
        while waiting:
            name, method = waiting.pop(0)
            # The first one always ends: there is nothing else to return.
            step, found = self._try(name, method, problem, deadline if steps else np.inf)
            steps.append(step)
            # Of two in doubt the dearer one is nearer to exact.
            if found is not None and (best is None or step.error <= best[0].error):
                best = step, dataclasses.replace(found, beside=method, deadline=deadline)
            if step.taken:
                break
            again = not again and np.isfinite(step.error)
            if again:
                times = MARGIN * (step.error / self.tolerance) ** 2
                # Powers of two: of a layout, few numbers of draws are ever compiled.
                more = with_draws(method, min(2.0 ** math.ceil(math.log2(times)), MOST_TIMES))
                waiting[:0] = [] if more is None else [(name, more)]
        if best is None:
            raise FitError(
                "; ".join(f"{step.name}: {step.why}" for step in steps),
                where="method='auto'",
                hint="give more seconds, or check the capture against the prior predictive",
            )
        return self._told(*best, steps)

    def _try(
        self, name: str, method: Method, problem: Problem, deadline: float
    ) -> tuple["Step", PosteriorDraws | None]:
        """One rung, judged by its own diagnostics, or abandoned at the deadline."""
        begin = time.perf_counter()
        try:
            return run_until(
                deadline,
                problem.progress,
                lambda progress: self._judged(name, method, problem.reporting(progress)),
            )
        except (FitError, OutOfTimeError) as failure:
            return Step(name, time.perf_counter() - begin, why=str(failure)), None

    def _judged(self, name: str, method: Method, problem: Problem) -> tuple["Step", PosteriorDraws]:
        """A rung's own diagnostics."""
        begin = time.perf_counter()
        found = answer(method, problem)
        error = expected_error(found, problem.program, problem.data)
        doubts = _doubts(found, problem)
        biased = bool(doubts)
        if not error <= self.tolerance:
            doubts.append(f"its Monte Carlo error may be {error:.2g} posterior sd")
        return Step(
            name,
            time.perf_counter() - begin,
            why="; ".join(doubts),
            error=np.inf if biased else error,  # a doubt weighs more than any noise
            monte_carlo=error,
            taken=not doubts,
            r_hat=found.r_hat,
            k_hat=found.k_hat,
            effective_draws=found.effective_draws,
        ), found

    def _told(self, step: "Step", found: PosteriorDraws, steps: list["Step"]) -> PosteriorDraws:
        """The answer with what was tried, and a problem where none was good enough."""
        problems = list(found.problems)
        if not step.taken:
            problems.append(
                f"no method met the tolerance of {self.tolerance:g} posterior sd within "
                f"{self.seconds:g} s: {step.name} came nearest, and {step.why or 'was not judged'}"
            )
        said = {
            "tolerance": self.tolerance,
            "seconds": self.seconds,
            "chosen": step.name,
            "met": step.taken,
            "expected_error": _plain(step.monte_carlo),
            "steps": [_as_said(each) for each in steps],
        }
        return dataclasses.replace(found, problems=problems, said=found.said | {"auto": said})


class Step(NamedTuple):
    """One method that was tried."""

    name: str
    seconds: float
    why: str = ""
    error: float = np.inf
    monte_carlo: float = np.inf
    taken: bool = False
    r_hat: float = np.nan
    k_hat: float = np.nan
    effective_draws: float = np.nan


def _doubts(found: PosteriorDraws, problem: Problem) -> list[str]:
    """Why an answer may be biased."""
    doubts = list(found.problems)
    if found.k_hat > MAX_PARETO_K and not doubts:
        doubts.append(f"its Pareto k-hat is {found.k_hat:.2f}")
    if found.r_hat > LARGEST_R_HAT:
        doubts.append(f"its R-hat is {found.r_hat:.3f}")
    if found.kind == "nuts" and (share := missed_mode_weight(found.z, problem)) > 0.0:
        doubts.append(f"a mode of weight {share:.2g} was not visited by every chain")
    return doubts


def _as_said(step: Step) -> dict[str, Any]:
    numbers = ("seconds", "monte_carlo", "r_hat", "k_hat", "effective_draws")
    said = {"name": step.name, "taken": step.taken, "why": step.why}
    return said | {name: _plain(getattr(step, name)) for name in numbers}


def _plain(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


# --- What the automatic choice did and why, in sentences ------------------------------------------


def auto_sentences(result: xr.DataTree) -> list[str]:
    """What `method="auto"` tried, what it took, and why.

    Args:
        result: A tree that `polar_bayes.fit` returned, or one read back from a file.

    Returns:
        A sentence for each method that was tried, in order; none for a fit by a method of one's
        own choice.

    Raises:
        FitError: It is no fit, or does not hold together.
    """
    check_fit(result)
    told = provenance_of(result).get("auto")
    if not told:
        return []
    sentences = []
    for step in told["steps"]:
        took = f"{step['name']} ({step['seconds']:.1f} s)"
        if step["taken"]:
            error = step.get("monte_carlo")
            within = "an unknown number of" if error is None else f"{error:.2g}"
            sentences.append(
                f"{took} was taken: its means and standard deviations are expected within "
                f"{within} posterior sd, and {told['tolerance']:g} were asked for."
            )
        else:
            sentences.append(f"{took} was not taken: {step['why']}.")
    if not told["met"]:
        sentences.append(
            f"Nothing was good enough; these are the numbers of {told['chosen']}, which came "
            "nearest. Give more seconds or a larger tolerance, or doubt them."
        )
    return sentences
