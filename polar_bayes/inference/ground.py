"""The ground that draws start from: the peaks of a posterior, and the coordinates to sample in.

A capture of one material is climbed as a whole. A capture of many patches is climbed patch by
patch, and sampled in coordinates in which the patches look alike. Both offer the same.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.inference import anchoring, laplace, nuts
from polar_bayes.inference.alone import can_be_alone
from polar_bayes.inference.groups import find_groups
from polar_bayes.inference.modes import Modes, ValueAndGradient
from polar_bayes.inference.program import Model, Program
from polar_bayes.inference.search import Progress, find_modes, from_prior
from polar_bayes.observation.data import Observations

STARTS = 16

LARGEST_DENSE = 60
"""Most coordinates whose covariance a warm-up of some hundred draws can learn. With few patches
what they share may bend as it likes; with many it is known so well that it is close to normal."""

Draws = tuple[np.ndarray, dict[str, np.ndarray]]
"""Unconstrained draws (chain, draw, size), and statistics, each (chain, draw)."""


class AbstractGround(abc.ABC):
    """Where draws start."""

    said: dict[str, Any]
    """What there is to say of the peaks, for the provenance."""

    @property
    def decrement(self) -> float:
        """How far, in posterior standard deviations, the true peak may still be."""
        return float(self.said["newton_decrement"])

    @abc.abstractmethod
    def target(self, key: Array, chains: int) -> nuts.Target:
        """What the sampler needs."""

    @abc.abstractmethod
    def laplace(self, key: Array, settings: laplace.Laplace) -> Draws:
        """Draws from the normal distribution at the heaviest peak."""


@dataclasses.dataclass(frozen=True, eq=False)
class WholeGround(AbstractGround):
    """One material: all coordinates together, a dense metric."""

    program: Program
    data: Observations
    potential: ValueAndGradient
    modes: Modes
    said: dict[str, Any]

    @override
    def target(self, key: Array, chains: int) -> nuts.Target:
        return nuts.Target(
            density=self.program.potential,
            given=self.data,
            potential=self.potential,
            starts=nuts.draw_starts(self.potential, self.modes, key, chains),
            metric=self.modes.covariance[0],
            place=lambda z: z,
        )

    @override
    def laplace(self, key: Array, settings: laplace.Laplace) -> Draws:
        return laplace.sample(self.program, self.data, self.potential, self.modes, key, settings)


@dataclasses.dataclass(frozen=True, eq=False)
class PatchGround(AbstractGround):
    """Many patches: the coordinates of `transport`, in which the metric is about the identity."""

    found: anchoring.Anchoring
    said: dict[str, Any]

    @override
    def target(self, key: Array, chains: int) -> nuts.Target:
        size, dtype = self.found.transport.size, self.found.given.anchors.common.dtype
        few = size <= LARGEST_DENSE
        return nuts.Target(
            density=self.found.transport.potential,
            given=self.found.given,
            potential=self.found.potential,
            starts=self.found.draw_starts(key, chains),
            metric=np.eye(size, dtype=dtype) if few else np.ones(size, dtype),
            place=self._place,
            acceptance=0.98 if few else 0.7,
        )

    @override
    def laplace(self, key: Array, settings: laplace.Laplace) -> Draws:
        shape = (settings.chains, settings.draws, self.found.transport.size)
        noise = np.asarray(jax.random.normal(key, shape))
        lp = -np.array([self.found.potential(draw)[0] for draw in noise.reshape(-1, shape[-1])])
        lp = lp.reshape(shape[:2])
        approximation = -0.5 * np.sum(noise**2, axis=-1)
        return self._place(noise), {"lp": lp, "log_weight": lp - approximation}

    def _place(self, w: np.ndarray) -> np.ndarray:
        return np.asarray(self._to_program(jnp.asarray(w), self.found.given))

    @property
    def _to_program(self) -> Callable[[Array, Any], Array]:
        one = self.found.transport.to_program
        return jax.jit(
            lambda w, given: jax.lax.map(
                lambda chain: jax.lax.map(lambda x: one(x, given)[0], chain), w
            )
        )


def find_ground(
    model: Model, program: Program, data: Observations, key: Array, progress: Progress
) -> AbstractGround:
    """Search for the peaks, in the way that the layout of the capture calls for.

    Args:
        model: The model of the data alone.
        program: The same on these data.
        data: The capture.
        key: Random key.
        progress: Called with the name of a stage and the fraction of it that is done.

    Returns:
        The ground.

    Raises:
        FitError: No start reached a peak.
    """
    groups = find_groups(program, data)
    if groups is None or not can_be_alone(model, groups, data):
        potential = compiled_potential(program, data)
        starts = np.asarray(from_prior(program, key, STARTS, data))
        modes = find_modes(potential, starts, progress)
        return WholeGround(program, data, potential, modes, _describe(modes))
    found = anchoring.anchor(model, program, groups, data, key, progress)
    peaks = found.peaks
    said = {
        "starts": peaks.starts * groups.count,
        "failures": peaks.failures,
        "patches_with_several": sum(len(modes.weight) > 1 for modes in peaks.of_patch),
        "newton_decrement": found.decrement,
    }
    return PatchGround(found, said)


def compiled_potential(program: Program, data: Observations) -> ValueAndGradient:
    """Minus the log density with its gradient, compiled, for searches in NumPy.

    Args:
        program: The model.
        data: The capture.

    Returns:
        A function of an unconstrained vector.

    Raises:
        Nothing.
    """
    compiled = jax.jit(jax.value_and_grad(program.potential))

    def potential(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = compiled(jnp.asarray(z, data.brightness.dtype), data)
        return float(value), np.asarray(gradient, float)

    return potential


def _describe(modes: Modes) -> dict[str, Any]:
    return {
        "starts": modes.starts,
        "failures": modes.failures,
        "weights": [round(float(weight), 6) for weight in modes.weight[:8]],
        "newton_decrement": float(modes.decrement[0]),
    }
