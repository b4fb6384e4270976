"""The interface of methods: a problem in, posterior draws out."""

import abc
import dataclasses
import difflib
import inspect
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, NoReturn, Self, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes import methods
from polar_bayes.errors import FitError
from polar_bayes.inference.batching import MethodUsed, Status
from polar_bayes.inference.problem import Problem
from polar_bayes.inference.problem_batch import BatchDraws, ProblemBatch
from polar_bayes.inference.program import THREADS, Values
from polar_bayes.inference.request import MIN_VIEWS
from polar_bayes.inference.result import Provenance
from polar_bayes.methods.registry import METHODS, method_names
from polar_bayes.numerics.batches import AnyArray
from polar_bayes.numerics.compile import TRACING_LOCK
from polar_bayes.numerics.mcse import (
    LARGEST_R_HAT,
    SMALLEST_ESS,
    measure,
    standard_errors,
    weighted_standard_errors,
)
from polar_bayes.progress import Progress, no_progress
from polar_bayes.repr_html import HTMLRepr


@dataclasses.dataclass(frozen=True, eq=False)
class PosteriorDraws:
    """Draws from one posterior, with their diagnostics.

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
        pareto_k: Pareto k of the importance weights; NaN where there are none.
        ess: Effective sample size, the smallest of all coordinates.
        gradients: Evaluations of the log density with its gradient.
        densities: Evaluations of the log density alone.
        metadata: Anything that JSON can hold and the result should keep, by name.
    """

    method: str
    z: np.ndarray
    stats: dict[str, np.ndarray]
    problems: list[str] = dataclasses.field(default_factory=list)
    weighted: tuple[np.ndarray, np.ndarray] | None = None
    covariance: np.ndarray | None = None
    r_hat: float = np.nan
    pareto_k: float = np.nan
    ess: float = np.nan
    gradients: float = np.nan
    densities: float = np.nan
    metadata: Provenance = dataclasses.field(default_factory=dict)

    @property
    def doubts(self) -> list[str]:
        """Problems of the draws, and divergences, which statistics of a result show."""
        diverging = self.stats.get("diverging", np.zeros(0))
        count = int(np.sum(diverging))
        return [*self.problems, *([f"{count} of {diverging.size} draws diverged"] if count else [])]

    def standard_errors(
        self, describe: Callable[[np.ndarray], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return Monte Carlo standard errors of means and sds, in posterior sds.

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


_THREADS = ThreadPoolExecutor(THREADS, "polar_bayes fits")
"""Threads that fit captures of all blocks, so that fits do not compete for a core."""

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
"""Names of settings in NumPyro, PyMC and others, and the names here."""


@dataclasses.dataclass(frozen=True)
class AbstractBatchMethod(HTMLRepr, abc.ABC):
    """A way to fit many captures of one layout; a small frozen dataclass of settings."""

    memory_limit: ClassVar[int] = 1024
    """Number of captures whose draws are in memory together."""

    group_size: ClassVar[int] = 64
    """Captures that a thread or worker fits together; a crash loses at most these."""

    def __new__(cls, *_: object, **settings: object) -> Self:
        """Refuse unknown settings, and suggest the setting that is probably meant."""
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
    def run_batch(self, batch: ProblemBatch) -> Iterator[BatchDraws]:
        """Draw from the posteriors of many captures, each of which has enough views.

        Draws come a part at a time, since those of all would fill the memory. A fit that fails is a
        status, not an error, and a capture of which nothing is said has not converged.
        """

    def fit_batch(self, batch: ProblemBatch) -> Iterator[BatchDraws]:
        """Fit a batch; captures with too few views have a status instead of draws."""
        views = batch.pixels.views
        few = views < MIN_VIEWS
        yield BatchDraws(
            batch.at[few], np.where(views == 0, Status.MASKED, Status.TOO_FEW_VIEWS)[few]
        )
        enough = np.flatnonzero(~few)
        for begin in range(0, enough.size, self.memory_limit):
            yield from self.run_batch(batch.subset(enough[begin : begin + self.memory_limit]))

    def for_image(
        self, size: int, sample: Callable[[int], ProblemBatch], *, is_shared: bool
    ) -> tuple[Self, Provenance]:
        """Return settings that suit an image, and entries of its provenance.

        `size` is the number of its pixels, `sample` gives some of them drawn at random, and
        `is_shared` says whether pixels share parameters.
        """
        return self, {}

    def check_least(self, **least: int) -> None:
        """Refuse settings below their least values."""
        for name, lowest in least.items():
            given = getattr(self, name)
            if given is not None and given < lowest:
                self.refuse(f"{name} is {given}", f"give at least {lowest}")

    def refuse(self, what: str, hint: str) -> NoReturn:
        """Raise the error of a setting."""
        raise FitError(what, where=type(self).__name__, hint=hint)


@dataclasses.dataclass(frozen=True)
class AbstractMethod(AbstractBatchMethod):
    """A way to draw from the posterior of one capture; many are fitted one after another."""

    group_size: ClassVar[int] = 4

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
    def num_draws(self) -> int | None:
        """Least number of draws of the method; None if it is not a setting."""
        draws = getattr(self, "draws", None)
        return draws if isinstance(draws, int) else None

    def scale_draws(self, factor: float) -> Self | None:
        """Return the method with a multiple of its draws.

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
        """Begin to compile what `run` needs, during the search for modes.

        Args:
            problem: The capture and its model.
        """
        del problem

    def deadline(self, problem: Problem) -> float:
        """When comparisons are abandoned, on the clock of `time.perf_counter`, unit second."""
        return np.inf

    def for_comparison(
        self, problem: Problem, draws: PosteriorDraws
    ) -> tuple["AbstractMethod", ...]:
        """Return methods for the comparison fits that follow these draws.

        The first that trusts its draws is taken, and else the last.
        """
        return (self,)

    def cross_check(self, problem: Problem, parameters: Values, key: Array) -> Provenance:
        """Return what other draws of the same posterior say about these draws.

        `polar_bayes.fit` asks for it; simulations of many fits do not.

        Args:
            problem: The capture and its model.
            parameters: Draws of this method by name, each (chain, draw, ...).
            key: Random key of the other draws.

        Returns:
            Entries of the provenance, which JSON can hold; none by default.
        """
        return {}

    @override
    def run_batch(self, batch: ProblemBatch) -> Iterator[BatchDraws]:
        """Fit captures one after another; the draws of each are nearly independent."""
        # Chains are thinned to every k-th draw, where k is the number of draws over the smallest
        # bulk effective sample size of all parameters, rounded up. A fit that must not be trusted
        # gives its draws all the same.
        double = batch.engine.precision == "double"
        with jax.enable_x64(double), TRACING_LOCK:  # two threads that begin at once share it
            _ = batch.engine.initializer

        def run(row: int) -> BatchDraws | None:
            with jax.enable_x64(double):  # a thread does not inherit it
                problem, key_draws = problem_of(batch, row)
                try:
                    draws = self.run(problem, key_draws, no_progress)
                except (FitError, np.linalg.LinAlgError):  # no mode, or no width around it
                    return None
                parameters = problem.constrain(draws.z)
            if not finite_draws(parameters).any():
                return None
            status, effective, method = assess_draws(draws, parameters)
            z, thinned = thin_draws(draws.z, parameters, effective)
            count = len(z)
            return BatchDraws(
                batch.at[[row]],
                status,
                {name: x[None] for name, x in thinned.items()},
                np.full((1, count), 1.0 / count),
                effective,
                method,
                draws.pareto_k,
                z=lambda: z[None],
            )

        yield from (found for found in _THREADS.map(run, range(len(batch))) if found is not None)


def problem_of(batch: ProblemBatch, row: int) -> tuple[Problem, Array]:
    """Return one capture of a batch as a problem, with the key of its draws."""
    key = jax.random.wrap_key_data(jnp.asarray(batch.keys[row]))
    key_search, key_draws = jax.random.split(key)
    data = batch.engine.free(batch.pixels.pixel(row))
    return Problem(batch.engine, data, key_search), key_draws


def assess_draws(draws: PosteriorDraws, parameters: Values) -> tuple[Status, float, MethodUsed]:
    """Status, effective sample size and method of one fit."""
    finite = finite_draws(parameters)
    good, effective = not draws.doubts and bool(finite.all()), float(finite.sum())
    method = MethodUsed.__members__.get(draws.method.upper(), MethodUsed.OTHER)
    if "diverging" in draws.stats or method == MethodUsed.OTHER:  # a user's draws may be chains
        bulk, tail, r_hat = measure(flatten(parameters))
        mixed = min(bulk.min(), tail.min()) >= SMALLEST_ESS and r_hat.max() <= LARGEST_R_HAT
        good = good and bool(mixed and draws.metadata.get("goals_reached", True))
        effective = float(np.nan_to_num(bulk.min(), nan=1.0))
    return Status.GOOD if good else Status.NOT_TRUSTED, effective, method


def thin_draws(
    z: AnyArray, parameters: Values, effective: float
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return nearly independent finite draws of all chains, also by name, (draw, ...)."""
    finite = finite_draws(parameters)
    step = int(np.ceil(finite.size / np.clip(effective, 1.0, finite.size)))
    chosen = np.zeros_like(finite)
    chosen[:, ::step] = True
    if not (chosen & finite).any():
        chosen[:] = True
    kept = chosen & finite
    return np.asarray(z)[kept], {name: np.asarray(x)[kept] for name, x in parameters.items()}


def finite_draws(parameters: Values) -> np.ndarray:
    """Return True for draws that are finite in all parameters, (chain, draw)."""
    finite = [np.isfinite(np.asarray(x)) for x in parameters.values()]
    return np.all([x.all(axis=tuple(range(2, x.ndim))) for x in finite], axis=0)


def flatten(parameters: Values) -> np.ndarray:
    """Stack every scalar of parameters (chain, draw, ...) as (scalar, chain, draw)."""
    flat = [np.asarray(x, float).reshape(*np.shape(x)[:2], -1) for x in parameters.values()]
    return np.moveaxis(np.concatenate(flat, axis=-1), -1, 0)


# --- Methods by name ------------------------------------------------------------------------------


def make_method(name: str) -> Any:
    """Return the method of a name, with its default settings."""
    return getattr(methods, METHODS[name].settings)()


def find_method(method: object, where: str, *, one: bool = False, many: bool = False) -> Any:
    """Return the settings of a caller, given by name or as a value.

    Raises:
        FitError: There is no such method, or it cannot do what is asked for.
    """
    names = method_names(one=one, many=many)
    hint = f"give one of {', '.join(names)}, or settings such as Importance(draws=4096)"
    if isinstance(method, AbstractBatchMethod):
        entry = METHODS.get(name_of(method))
        does_many = entry is None or entry.fits_many
        if isinstance(method, AbstractMethod) >= one and does_many >= many:
            return method
        name = name_of(method)
    elif isinstance(method, str) and method in METHODS:
        if method in names:
            return make_method(method)
        name = method
    else:
        raise FitError("no such method", where=f"{where}: method={method!r}", hint=hint)
    what = "fits many captures side by side, not one" if one else "gives no draws of many captures"
    raise FitError(f"{name} {what}", where=f"{where}: method={method!r}", hint=hint)


def name_of(method: object) -> str:
    """Return the name of a method, or of its class if it has none."""
    made = type(method).__name__
    return next((name for name, each in METHODS.items() if each.settings == made), made)
