"""The ground that draws start from: the peaks of a posterior, and the coordinates to sample in.

A capture of one material is climbed as a whole. A capture of many patches is climbed patch by
patch, and sampled in coordinates in which the patches look alike. Both offer the same.

What is compiled belongs to the grounds of a layout, and serves every capture of it.
"""

import abc
import dataclasses
import functools
from typing import Any, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.inference import hierarchical_reparam, laplace, nuts
from polar_bayes.inference.group_model import GroupModel, find_group_model, find_groups
from polar_bayes.inference.hierarchical_reparam import Transport
from polar_bayes.inference.optimize import Modes, ValueAndGradient, find_modes, from_prior
from polar_bayes.inference.program import Model, Program
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

STARTS = 16

LARGEST_DENSE = 60
"""Most coordinates whose covariance a warm-up of some hundred draws can learn. With few patches
what they share may bend as it likes; with many it is known so well that it is close to normal."""

Draws = tuple[np.ndarray, dict[str, np.ndarray]]
"""Unconstrained draws (chain, draw, size), and statistics, each (chain, draw)."""


class AbstractInit(abc.ABC):
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
    def laplace(self, key: Array, settings: laplace.LaplaceSettings) -> Draws:
        """Draws from the normal distribution at the heaviest peak."""


@dataclasses.dataclass(frozen=True, eq=False)
class JointInit(AbstractInit):
    """One material: all coordinates together, a dense metric."""

    initializer: "JointInitializer"
    data: Observations
    potential: ValueAndGradient
    modes: Modes
    said: dict[str, Any]

    @override
    def target(self, key: Array, chains: int) -> nuts.Target:
        return nuts.Target(
            samplers=self.initializer.samplers,
            given=self.data,
            potential=self.potential,
            starts=nuts.draw_starts(self.potential, self.modes, key, chains),
            metric=self.modes.covariance[0],
            place=lambda z: z,
        )

    @override
    def laplace(self, key: Array, settings: laplace.LaplaceSettings) -> Draws:
        program, guide = self.initializer.program, self.initializer.guide
        return laplace.sample(program, guide, self.data, self.potential, self.modes, key, settings)


@dataclasses.dataclass(frozen=True, eq=False)
class HierarchicalInit(AbstractInit):
    """Many patches: the coordinates of `transport`, in which the metric is about the identity."""

    samplers: nuts.Samplers
    found: hierarchical_reparam.Anchoring
    said: dict[str, Any]

    @override
    def target(self, key: Array, chains: int) -> nuts.Target:
        size, dtype = self.found.transport.size, self.found.given.anchors.common.dtype
        few = size <= LARGEST_DENSE
        return nuts.Target(
            samplers=self.samplers,
            given=self.found.given,
            potential=self.found.potential,
            starts=self.found.draw_starts(key, chains),
            metric=np.eye(size, dtype=dtype) if few else np.ones(size, dtype),
            place=self._place,
            acceptance=0.98 if few else 0.7,
            warmup=300 if few else 150,
        )

    @override
    def laplace(self, key: Array, settings: laplace.LaplaceSettings) -> Draws:
        shape = (settings.chains, settings.draws, self.found.transport.size)
        noise = np.asarray(jax.random.normal(key, shape))
        lp = -np.array([self.found.potential(draw)[0] for draw in noise.reshape(-1, shape[-1])])
        lp = lp.reshape(shape[:2])
        approximation = -0.5 * np.sum(noise**2, axis=-1)
        return self._place(noise), {"lp": lp, "log_weight": lp - approximation}

    def _place(self, w: np.ndarray) -> np.ndarray:
        return np.asarray(self.found.transport.chains_there(jnp.asarray(w), self.found.given))


class AbstractInitializer(abc.ABC):
    """The grounds of all captures of one layout."""

    def expect(self, data: Observations, method: nuts.NutsSettings) -> None:
        """Begin to compile the sampler beside the search, where its shapes are known before it.

        Args:
            data: A capture.
            method: Settings.

        Raises:
            Nothing.
        """
        del data, method

    @abc.abstractmethod
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        """Search for the peaks of one capture.

        Args:
            data: The capture.
            key: Random key.
            progress: Called with the name of a stage and the fraction of it that is done.

        Returns:
            The ground.

        Raises:
            FitError: No start reached a peak.
        """


@dataclasses.dataclass(frozen=True, eq=False)
class JointInitializer(AbstractInitializer):
    """Of captures that are climbed as a whole."""

    program: Program
    samplers: nuts.Samplers

    @functools.cached_property
    def guide(self) -> laplace.Guide:
        """The normal approximation."""
        return laplace.compiled_guide(self.program)

    @override
    def expect(self, data: Observations, method: nuts.NutsSettings) -> None:
        size = self.program.size
        target = nuts.Target(
            samplers=self.samplers,
            given=data,
            potential=lambda z: (0.0, z),
            starts=np.zeros((1, size)),
            metric=np.eye(size),
            place=lambda z: z,
        )
        nuts.expect(target, method)

    @override
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        potential = CompiledPotential(self.program, data)
        starts = from_prior(self.program, key, STARTS, data)
        modes = find_modes(potential, starts, progress)
        said = _describe(modes) | {"gradients": potential.calls}
        return JointInit(self, data, potential, modes, said)


@dataclasses.dataclass(frozen=True, eq=False)
class HierarchicalInitializer(AbstractInitializer):
    """Of captures whose patches are climbed one by one."""

    group_model: GroupModel
    transport: Transport
    samplers: nuts.Samplers

    @override
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        found = hierarchical_reparam.anchor(self.group_model, self.transport, data, key, progress)
        peaks = found.peaks
        said = {
            "starts": peaks.starts * self.transport.groups.count,
            "failures": peaks.failures,
            "patches_with_several": sum(len(modes.weight) > 1 for modes in peaks.of_patch),
            "newton_decrement": found.decrement,
        }
        return HierarchicalInit(self.samplers, found, said)


def make_initializer(model: Model, program: Program, data: Observations) -> AbstractInitializer:
    """What searches for peaks, in the way that the layout of the capture calls for."""
    groups = find_groups(program, data)
    group_model = None if groups is None else find_group_model(model, groups, data)
    if groups is None or group_model is None:
        return JointInitializer(program, nuts.Samplers(program.potential_jit))
    transport = Transport(program, groups)
    return HierarchicalInitializer(group_model, transport, nuts.Samplers(transport.potential_jit))


class CompiledPotential:
    """Minus the log density with its gradient, compiled, for NumPy optimizers; counts its calls."""

    def __init__(self, program: Program, data: Observations) -> None:
        self._program, self._data = program, data
        self.calls = 0

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """Of an unconstrained vector."""
        self.calls += 1
        at = jnp.asarray(z, self._data.brightness.dtype)
        value, gradient = self._program.value_and_gradient(at, self._data)
        return float(value), np.asarray(gradient, float)


def _describe(modes: Modes) -> dict[str, Any]:
    return {
        "starts": modes.starts,
        "failures": modes.failures,
        "weights": [round(float(weight), 6) for weight in modes.weight[:8]],
        "newton_decrement": float(modes.decrement[0]),
    }
