r"""How far two scenes lie apart: their readings, and the posteriors that they give.

Each posterior is taken as a normal distribution, at its peak and as wide as the Fisher information
there says,

$$ \text{shift} = \frac{\hat z' - \hat z}{\sigma}, \qquad \text{sd ratio} = \frac{\sigma'}{\sigma},
   \qquad \sigma^2 = \operatorname{diag} F^{-1}, \quad
   F = -\frac{\partial^2 \log p(z \mid \text{readings})}{\partial z^2} $$

in the unconstrained coordinates z of the fit. F is the observed information of these very readings
under their own links, prior included. Both scenes are used as they are; linear is the slope of the
log density around its peak. So a shift above 1 only says that the effect matters.

Derivatives are differences of the log density. In units of the posterior's own width they keep
enough digits, and no derivative has to be compiled, which takes two to four times as long as the
density itself.
"""

import dataclasses

import numpy as np
from jaxtyping import Array

from polar_bayes.budget.density import Density, Readings
from polar_bayes.inference.modes import Status, ValueAndGradient, climb
from polar_bayes.inference.search import find_modes, from_prior
from polar_bayes.progress import Progress

STARTS = 6
"""Prior draws from which the peak of the full scene is sought."""

FIRST_STEP, STEP = 1e-5, 1e-3
"""Steps of differences: before the width of the posterior is known, and in units of it."""

ROUNDS = 2
"""Climbs to one peak; the second knows the width that the first has found."""

NEW_WIDTH = 0.1
"""A first guess at the width of a parameter that only the simpler scene has."""


@dataclasses.dataclass(frozen=True, eq=False)
class Peak:
    """The normal distribution that stands for a posterior."""

    density: Density
    z: np.ndarray
    covariance: np.ndarray
    found: bool

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each coordinate, (size,)."""
        return np.sqrt(np.diagonal(self.covariance))


@dataclasses.dataclass(frozen=True, eq=False)
class Change:
    """What becomes of readings and posterior when one scene takes another's place."""

    largest_move: float
    rms_move: float
    shift: np.ndarray
    sd_ratio: np.ndarray
    found: bool

    @property
    def size(self) -> np.ndarray:
        """The larger of the shift and the change of the sd, per coordinate."""
        return np.fmax(np.abs(self.shift), np.abs(self.sd_ratio - 1.0))


def find_peak(density: Density, key: Array, progress: Progress) -> Peak:
    """The heaviest peak of a posterior about which nothing is known yet."""
    size = density.program.size
    starts = from_prior(density.program, key, STARTS, density.data)
    plain = _with_gradient(density, np.zeros(size), np.eye(size), FIRST_STEP)
    modes = find_modes(plain, starts, progress)
    return _climb(density, modes.z[0], modes.covariance[0])


def compare(peak: Peak, noise_sd: Readings, other: Density) -> tuple[Change, Peak]:
    """Put another scene in the place of one whose peak is known."""
    here = {label: index for index, label in enumerate(peak.density.labels)}
    theirs = [index for index, label in enumerate(other.labels) if label in here]
    mine = [here[other.labels[index]] for index in theirs]
    start = np.zeros(len(other.labels))
    start[theirs] = peak.z[mine]
    width = np.diag(np.full(start.size, NEW_WIDTH**2))
    width[np.ix_(theirs, theirs)] = peak.covariance[np.ix_(mine, mine)]
    moves = _moves(peak, noise_sd, other, start)
    found = _climb(other, start, width)
    shift, sd_ratio = np.full((2, peak.z.size), np.nan)
    if found.found:
        shift[mine] = (found.z[theirs] - peak.z[mine]) / peak.sd[mine]
        sd_ratio[mine] = found.sd[theirs] / peak.sd[mine]
    largest, rms = float(np.max(np.abs(moves))), float(np.sqrt(np.mean(moves**2)))
    return Change(largest, rms, shift, sd_ratio, found.found), found


def _moves(peak: Peak, noise_sd: Readings, other: Density, start: np.ndarray) -> np.ndarray:
    """Changes of all valid readings' predictions in units of their noise, in one row."""
    # A sensor far beyond its full scale has no noise, and what it records does not move.
    before, after = peak.density.noise_free(peak.z), other.noise_free(start)
    valid = np.asarray(peak.density.data.valid)
    rows = []
    for name, sd in noise_sd.items():
        move = np.where(sd > 0.0, after[name] - before[name], 0.0) / np.where(sd > 0.0, sd, 1.0)
        rows.append(np.broadcast_to(move, valid.shape)[valid])
    return np.concatenate(rows)


def _climb(density: Density, z: np.ndarray, covariance: np.ndarray) -> Peak:
    """Climb in coordinates in which the posterior is round and of width one, as far as known."""
    for _ in range(ROUNDS):
        width = np.linalg.cholesky(covariance)
        potential = _with_gradient(density, z, width, STEP)
        end = climb(potential, np.zeros(z.size))
        if not np.isfinite(end.covariance).all():
            return Peak(density, z, np.full_like(covariance, np.nan), found=False)
        # A climb ends within a hundredth of a width; one more step makes that nothing.
        z = z + width @ (end.z - end.covariance @ potential(end.z)[1])
        covariance = width @ end.covariance @ width.T
    return Peak(density, z, covariance, found=end.status is Status.OK)


def _with_gradient(
    density: Density, origin: np.ndarray, width: np.ndarray, step: float
) -> ValueAndGradient:
    """Potential and gradient in the coordinates y of z = origin + width y."""

    def value_and_gradient(y: np.ndarray) -> tuple[float, np.ndarray]:
        z = origin + width @ y
        slopes = [
            density.potential(z + step * axis) - density.potential(z - step * axis)
            for axis in width.T
        ]
        return density.potential(z), np.asarray(slopes) / (2.0 * step)

    return value_and_gradient
