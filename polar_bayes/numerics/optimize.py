"""Mode finding: BFGS from prior draws, Newton steps, and weights by Laplace's evidence.

These posteriors have several local modes (a large roughness can imitate a low fraction), and one
start finds only one of them. SciPy's BFGS therefore starts from many prior draws; the distinct ends
are weighted by their Laplace evidence (Tierney and Kadane 1986, J. Am. Stat. Assoc. 81, 82-86).

Only the potential (minus the log posterior density) with its gradient is compiled. Hessians are
central differences of the gradient: an exact Hessian of these models takes five times as long to
compile as all searches take to run.
"""

import contextlib
import dataclasses
import enum
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Array, DTypeLike, Float

from polar_bayes.errors import FitError
from polar_bayes.progress import Progress

ValueAndGradient = Callable[[np.ndarray], tuple[float, np.ndarray]]

SAME_MODE = 0.1
"""Largest distance, in posterior sds, between ends of two searches that found the same mode."""

STEP = 1e-3
"""Step of central differences of a potential, in posterior sds: a gradient has a rounding error of
1e-10, and an error of 2e-7 by a third derivative."""

WIDER = (1.0, 100.0, 2000.0)
"""Factors on the steps of a Hessian's differences, up to a quarter of a posterior sd: the next one
where the Hessian is not positive definite. A kink of the density, such as that of readings at their
floor, is a ridge to small steps, and a peak to those across it."""

SETTLED = 1e-2
"""Largest Newton decrement, in posterior sds, of a search that has converged."""


class ModeStatus(enum.IntEnum):
    """Outcome of one search."""

    OK = 0
    NOT_CONVERGED = 1
    NOT_A_MAXIMUM = 2


class Optimum(NamedTuple):
    """The end point of one search."""

    z: np.ndarray
    potential: float
    decrement: float
    covariance: np.ndarray
    status: ModeStatus

    @property
    def log_evidence(self) -> float:
        """Laplace's approximation, up to a constant; NaN without a covariance."""
        return -self.potential + 0.5 * np.linalg.slogdet(self.covariance)[1]

    def distance(self, z: np.ndarray) -> float:
        """Return the Mahalanobis distance of a vector from the mode."""
        return float(np.sqrt((z - self.z) @ np.linalg.solve(self.covariance, z - self.z)))


@dataclasses.dataclass(frozen=True)
class Modes:
    """Distinct modes, the one of largest weight first."""

    z: np.ndarray
    covariance: np.ndarray
    weight: np.ndarray
    decrement: np.ndarray
    starts: int
    failures: int


# --- The potential, its finite values, and its Hessian --------------------------------------------


class NumpyPotential[Given]:
    """A compiled potential of an unconstrained vector as a function of NumPy arrays."""

    def __init__(
        self,
        value_and_gradient: Callable[[np.ndarray, Given], tuple[Array, Array]],
        given: Given,
        dtype: DTypeLike,
    ) -> None:
        self._compiled, self._given, self._dtype = value_and_gradient, given, dtype
        self.calls = 0

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        self.calls += 1
        # A NumPy array: `jnp.asarray` would take as long as a small program.
        value, gradient = self._compiled(np.asarray(z, self._dtype), self._given)
        return float(value), np.asarray(gradient, float)


class DifferencedPotential[Given]:
    """A potential in double precision with gradients by differences: only values are compiled.

    That compiles three times as fast as the gradient, and runs half as fast: for a few searches.
    """

    def __init__(
        self,
        evaluated: Callable[[np.ndarray, Given], tuple[Array, Mapping[str, Array]]],
        given: Given,
        sd: np.ndarray,
    ) -> None:
        self._evaluated, self._given, self._step = evaluated, given, STEP * np.clip(sd, 1e-6, 1.0)

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        value, *shifted = self._evaluate(z)[0]
        above, below = np.split(np.array(shifted), 2)
        return float(value), (above - below) / (2.0 * self._step)

    def parameters(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parameters at a vector."""
        return {name: np.asarray(rows)[0] for name, rows in self._evaluate(z)[1].items()}

    def _evaluate(self, z: np.ndarray) -> tuple[np.ndarray, Mapping[str, Array]]:
        shift = np.diag(self._step)
        rows = np.vstack([z, z + shift, z - shift])
        potentials, parameters = self._evaluated(rows, self._given)
        return np.asarray(potentials, float), parameters


def finite_potential(potential: ValueAndGradient) -> ValueAndGradient:
    """Replace values and gradients of the potential that are not finite by a flat wall."""

    def guarded(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = potential(z)
        finite = np.isfinite(value) and np.isfinite(gradient).all()
        return (value, gradient) if finite else (1e10, np.zeros_like(gradient))

    return guarded


def central_difference_hessian(
    potential: ValueAndGradient,
    z: np.ndarray,
    sd: np.ndarray,
    dtype: DTypeLike,
    rows: Sequence[int] | np.ndarray | None = None,
    *,
    wider: float = 1.0,
) -> np.ndarray:
    """Return rows of the Hessian, all by default, by central differences of the gradient."""
    # With these steps truncation and rounding both stay below 1e-7 of the Hessian (double
    # precision).
    found, steps = [], wider * _steps(sd, dtype)
    for index, step in zip(range(z.size) if rows is None else rows, steps, strict=True):
        shift = np.zeros_like(z)
        shift[index] = step
        found.append((potential(z + shift)[1] - potential(z - shift)[1]) / (2.0 * step))
    return np.stack(found)


def forward_difference_hessian(
    potential: ValueAndGradient, z: np.ndarray, sd: np.ndarray, dtype: DTypeLike
) -> np.ndarray:
    """Return the Hessian by forward differences, to 1e-4: for proposals, not for modes."""
    steps, at_z = _steps(sd, dtype), potential(z)[1]
    return np.stack([(potential(z + s)[1] - at_z) / s.max() for s in np.diag(steps)])


def _steps(sd: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """Return steps: the fourth root of the rounding error, in the posterior's own sds."""
    return np.clip(sd, 1e-6, 1.0) * np.finfo(dtype).eps ** 0.25


def symmetrize(matrix: np.ndarray) -> np.ndarray:
    """Return the symmetric part of a square matrix."""
    return 0.5 * (matrix + matrix.T)


# --- The search from one start, and from many -----------------------------------------------------


def find_mode(
    potential: ValueAndGradient, start: np.ndarray, guess: np.ndarray | None = None
) -> Optimum:
    """Minimize the potential by BFGS, then by at most six Newton steps.

    A guess of the covariance near the mode saves most of the steps; a poor one costs more.
    """
    guarded = finite_potential(potential)
    options = {"gtol": 1e-3, "maxiter": 500, "hess_inv0": guess}
    found = scipy.optimize.minimize(guarded, start, jac=True, method="BFGS", options=options)
    z, sd = found.x, np.sqrt(np.abs(np.diagonal(found.hess_inv)))
    for _ in range(6):
        value, gradient = guarded(z)
        factor = _factor_of_hessian(guarded, z, sd, start.dtype)
        if factor is None:
            unknown = np.full((z.size, z.size), np.nan)
            return Optimum(z, value, np.inf, unknown, ModeStatus.NOT_A_MAXIMUM)
        step = scipy.linalg.cho_solve((factor, True), gradient)
        decrement = float(np.sqrt(max(step @ gradient, 0.0)))
        covariance = scipy.linalg.cho_solve((factor, True), np.eye(z.size))
        sd = np.sqrt(np.diagonal(covariance))
        if decrement < SETTLED or guarded(z - step)[0] >= value:
            break
        z = z - step
    status = ModeStatus.OK if decrement < SETTLED else ModeStatus.NOT_CONVERGED
    return Optimum(z, float(value), decrement, covariance, status)


def _factor_of_hessian(
    potential: ValueAndGradient, z: np.ndarray, sd: np.ndarray, dtype: DTypeLike
) -> np.ndarray | None:
    """Return the Cholesky factor of the Hessian; None where it is not positive definite."""
    for wider in WIDER:
        with contextlib.suppress(np.linalg.LinAlgError):
            hessian = central_difference_hessian(potential, z, sd, dtype, wider=wider)
            return np.linalg.cholesky(symmetrize(hessian))
    return None


def conditional_normal(
    covariance: Float[np.ndarray, "size size"], index: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the regression of all coordinates on one, and a conditional covariance factor."""
    # The factor has a row of zeros for the one, and a column of zeros where there is no other.
    size = len(covariance)
    slope = covariance[:, index] / covariance[index, index]
    others = np.delete(np.arange(size), index)
    factor = np.zeros((size, max(size - 1, 1)))
    if size > 1:
        among = np.linalg.inv(covariance)[np.ix_(others, others)]
        factor[others] = np.linalg.cholesky(np.linalg.inv(among))
    return slope, factor


def conditional_mode(
    potential: ValueAndGradient, start: np.ndarray, factor: np.ndarray, **options: float
) -> tuple[np.ndarray, float]:
    """Minimize a finite potential along a factor's columns by BFGS; return point and value."""

    def along(y: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = potential(start + factor @ y)
        return value, factor.T @ gradient

    origin = np.zeros(factor.shape[1])
    found = scipy.optimize.minimize(along, origin, jac=True, method="BFGS", options=options)
    return start + factor @ found.x, float(found.fun)


def by_likelihood(potential: ValueAndGradient, drawn: np.ndarray) -> np.ndarray:
    """Return the indices of draws, the likeliest first."""
    guarded = finite_potential(potential)
    return np.argsort([guarded(z)[0] for z in drawn], kind="stable")


def likely_starts(potential: ValueAndGradient, drawn: np.ndarray, count: int) -> np.ndarray:
    """Return the likeliest of many draws, half of the starts, and the first of the others."""
    order, half = by_likelihood(potential, drawn), min(count, len(drawn)) // 2
    return drawn[np.concatenate([order[:half], np.sort(order[half:])[: count - half]])]


def distinct_modes(ends: list[Optimum]) -> Modes | None:
    """Return one end per mode, of all ends within one sd of a mode."""
    # The heaviest mode may be one where no search converges: a kink of the density, such as that
    # of readings at their floor, leaves a gradient.
    modes: list[Optimum] = []
    near = (end for end in ends if end.decrement < 1.0)
    for end in sorted(near, key=lambda end: -end.log_evidence):
        apart = (mode.distance(end.z) - mode.decrement - end.decrement for mode in modes)
        if all(distance > SAME_MODE for distance in apart):
            modes.append(end)
    if not modes:
        return None
    weight = np.exp(np.array([mode.log_evidence - modes[0].log_evidence for mode in modes]))
    return Modes(
        z=np.stack([mode.z for mode in modes]),
        covariance=np.stack([mode.covariance for mode in modes]),
        weight=weight / weight.sum(),
        decrement=np.array([mode.decrement for mode in modes]),
        starts=len(ends),
        failures=sum(end.status is not ModeStatus.OK for end in ends),
    )


def find_modes(
    potential: ValueAndGradient,
    starts: np.ndarray,
    progress: Progress,
    guess: np.ndarray | None = None,
) -> Modes:
    """Return distinct modes from searches of all starts, given a guess of the covariance."""
    ends = []
    with ignore_line_search_warnings():
        for number, start in enumerate(starts):
            ends.append(find_mode(potential, start, guess))
            progress("searching for modes", (number + 1) / len(starts))
    modes = distinct_modes(ends)
    if modes is None:
        raise FitError(
            f"none of {len(starts)} starts reached a peak of the posterior",
            where="fit",
            hint="check the capture against the prior predictive, or give narrower priors",
        )
    return modes


class _WarningFilter:
    """A warning filter for all threads: set by the first search and reset by the last."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.searches = 0
        self.filters = contextlib.ExitStack()


_FILTER = _WarningFilter()


@contextlib.contextmanager
def ignore_line_search_warnings() -> Iterator[None]:
    """Ignore SciPy's warning of a poor step: `find_mode` checks where a search ends."""
    # Filters belong to the process, so searches on several threads must share one.
    with _FILTER.lock:
        _FILTER.searches += 1
        if _FILTER.searches == 1:
            _FILTER.filters.enter_context(warnings.catch_warnings())
            warnings.filterwarnings("ignore", "The line search algorithm did not converge")
    try:
        yield
    finally:
        with _FILTER.lock:
            _FILTER.searches -= 1
            if not _FILTER.searches:
                _FILTER.filters.close()


def finite_sd(draws: np.ndarray) -> np.ndarray:
    """Return sds of coordinates, (draw, size), without draws at a bound of a support."""
    return np.std(draws, axis=0, dtype=float, where=np.isfinite(draws))
