"""Where the posterior has its peaks, how wide and how heavy each is.

Several local modes exist in these posteriors (a large roughness can imitate a low fraction), and
one start finds only one of them. So every fit first climbs from many prior draws, keeps the
distinct peaks, and weighs each by its Laplace evidence. Chains and approximations start there.

SciPy climbs from outside the compiled program: value and gradient are the only thing that is
compiled, and curvature comes from differences of the gradient. An exact Hessian of these models
takes five times as long to compile as all the climbs take to run.
"""

import contextlib
import dataclasses
import enum
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Array

from polar_bayes.errors import FitError
from polar_bayes.inference.program import Program
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

ValueAndGradient = Callable[[np.ndarray], tuple[float, np.ndarray]]

SAME_PEAK = 0.1
"""Two climbs that end within so many posterior standard deviations found the same peak."""

SETTLED = 1e-2
"""Largest Newton decrement, in posterior standard deviations, of a climb that has arrived."""


class Status(enum.IntEnum):
    """What became of one climb."""

    OK = 0
    NOT_CONVERGED = 1
    NOT_A_MAXIMUM = 2


class Climb(NamedTuple):
    """The end of one climb."""

    z: np.ndarray
    potential: float
    decrement: float
    covariance: np.ndarray
    status: Status

    @property
    def log_evidence(self) -> float:
        """Laplace's approximation, up to a constant of the dimension; NaN without a width."""
        return -self.potential + 0.5 * np.linalg.slogdet(self.covariance)[1]


@dataclasses.dataclass(frozen=True)
class Modes:
    """Distinct peaks, heaviest first."""

    z: np.ndarray
    covariance: np.ndarray
    weight: np.ndarray
    decrement: np.ndarray
    starts: int
    failures: int


class _Quiet:
    """Filters of warnings belong to the process: the first fit sets them, the last one resets."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._fits = 0
        self._filters = contextlib.ExitStack()

    def begin(self) -> None:
        with self._lock:
            self._fits += 1
            if self._fits == 1:
                self._filters.enter_context(warnings.catch_warnings())
                warnings.filterwarnings("ignore", "The line search algorithm did not converge")

    def end(self) -> None:
        with self._lock:
            self._fits -= 1
            if not self._fits:
                self._filters.close()


_QUIET = _Quiet()


@contextlib.contextmanager
def quiet_line_search() -> Iterator[None]:
    """Climbs judge their own ends, so SciPy's warning of a poor step says nothing more."""
    # Fits on several threads may open it side by side.
    _QUIET.begin()
    try:
        yield
    finally:
        _QUIET.end()


def climb(potential: ValueAndGradient, start: np.ndarray) -> Climb:
    """Go downhill in the potential, then settle with Newton steps."""

    def guarded(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = potential(z)
        finite = np.isfinite(value) and np.isfinite(gradient).all()
        return (value, gradient) if finite else (1e10, np.zeros_like(gradient))

    found = scipy.optimize.minimize(
        guarded, start, jac=True, method="BFGS", options={"gtol": 1e-3, "maxiter": 500}
    )
    z, spread = found.x, np.sqrt(np.abs(np.diagonal(found.hess_inv)))
    for _ in range(6):
        value, gradient = guarded(z)
        factor = _cholesky(curvature(guarded, z, spread, start.dtype))
        if factor is None:
            nothing = np.full((z.size, z.size), np.nan)
            return Climb(z, value, np.inf, nothing, Status.NOT_A_MAXIMUM)
        step = scipy.linalg.cho_solve((factor, True), gradient)
        decrement = float(np.sqrt(max(step @ gradient, 0.0)))
        covariance = scipy.linalg.cho_solve((factor, True), np.eye(z.size))
        spread = np.sqrt(np.diagonal(covariance))
        if decrement < SETTLED or guarded(z - step)[0] >= value:
            break
        z = z - step
    arrived = decrement < SETTLED
    status = Status.OK if arrived else Status.NOT_CONVERGED
    return Climb(z, float(value), decrement, covariance, status)


def curvature(
    potential: ValueAndGradient, z: np.ndarray, spread: np.ndarray, precision: np.dtype
) -> np.ndarray:
    """Hessian by central differences of the gradient."""
    # With a step of the fourth root of the rounding error, in units of the posterior's own width,
    # truncation and rounding both stay below 1e-7 of the curvature (double precision).
    steps = np.clip(spread, 1e-6, 1.0) * np.finfo(precision).eps ** 0.25
    rows = []
    for index, step in enumerate(steps):
        shift = np.zeros_like(z)
        shift[index] = step
        rows.append((potential(z + shift)[1] - potential(z - shift)[1]) / (2.0 * step))
    hessian = np.stack(rows)
    return 0.5 * (hessian + hessian.T)


def distinct(climbs: list[Climb]) -> Modes | None:
    """Keep one climb per peak."""
    near = [end for end in climbs if end.decrement < 1.0]
    settled = [end for end in near if end.status is Status.OK]
    arrived = sorted(settled or near, key=lambda end: -end.log_evidence)
    kept: list[Climb] = []
    for end in arrived:
        if all(_distance(end.z - peak.z, peak.covariance) > SAME_PEAK for peak in kept):
            kept.append(end)
    if not kept:
        return None
    weight = np.exp(np.array([end.log_evidence - kept[0].log_evidence for end in kept]))
    return Modes(
        z=np.stack([end.z for end in kept]),
        covariance=np.stack([end.covariance for end in kept]),
        weight=weight / weight.sum(),
        decrement=np.array([end.decrement for end in kept]),
        starts=len(climbs),
        failures=len(climbs) - len(settled),
    )


def _cholesky(hessian: np.ndarray) -> np.ndarray | None:
    try:
        return np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        return None


def _distance(step: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))


# --- The way to the modes that every fit begins with: climbs from many prior draws ----------------


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
            hint="check the capture against the prior predictive, or give narrower priors",
        )
    return modes
