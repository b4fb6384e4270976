"""Initialization: the modes of a posterior, and coordinates, starting points and metric from them.

`JointInit` is for captures of one material: all coordinates are optimized together and sampled as
they are. `HierarchicalInit` is for captures of many groups: each group is optimized by itself, and
chains run in the partially non-centered coordinates of `hierarchical_reparam`.

An initializer holds what is compiled for one layout, and serves every capture of it.
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
from polar_bayes.inference.hierarchical_reparam import FittedReparam, HierarchicalReparam
from polar_bayes.inference.optimize import (
    Modes,
    ValueAndGradient,
    find_modes,
    from_prior,
    numpy_potential,
)
from polar_bayes.inference.program import Model, Program
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress

STARTS = 16

LARGEST_DENSE = 60
"""Most coordinates whose covariance a warm-up of some hundred draws can estimate. The posterior of
the common parameters can have any shape with few groups; with many it is close to normal."""

Draws = tuple[np.ndarray, dict[str, np.ndarray]]
"""Unconstrained draws (chain, draw, size), and statistics, each (chain, draw)."""


class AbstractInit(abc.ABC):
    """Where draws start."""

    metadata: dict[str, Any]
    """Number of starts, failures and weights, for the provenance."""

    @property
    def decrement(self) -> float:
        """Newton decrement: distance to the mode in posterior standard deviations."""
        return float(self.metadata["newton_decrement"])

    @abc.abstractmethod
    def target(self, key: Array, chains: int) -> nuts.Target:
        """The density for NUTS, with starting points and metric."""

    @abc.abstractmethod
    def laplace(self, key: Array, settings: laplace.LaplaceSettings) -> Draws:
        """Draws from the normal approximation at the mode of largest weight."""


@dataclasses.dataclass(frozen=True, eq=False)
class JointInit(AbstractInit):
    """One material: all coordinates together, and a dense metric from the Hessian at the mode."""

    initializer: "JointInitializer"
    data: Observations
    potential: ValueAndGradient
    modes: Modes
    metadata: dict[str, Any]

    @override
    def target(self, key: Array, chains: int) -> nuts.Target:
        return nuts.Target(
            samplers=self.initializer.samplers,
            given=self.data,
            potential=self.potential,
            starts=nuts.draw_starts(self.potential, self.modes, key, chains),
            metric=self.modes.covariance[0],
        )

    @override
    def laplace(self, key: Array, settings: laplace.LaplaceSettings) -> Draws:
        program, guide = self.initializer.program, self.initializer.guide
        return laplace.sample(program, guide, self.data, self.potential, self.modes, key, settings)


@dataclasses.dataclass(frozen=True, eq=False)
class HierarchicalInit(AbstractInit):
    """Many groups: coordinates in which the posterior is close to standard normal."""

    samplers: nuts.SamplerCache
    fitted: FittedReparam
    metadata: dict[str, Any]

    @override
    def target(self, key: Array, chains: int) -> nuts.Target:
        size, dtype = self.fitted.reparam.size, self.fitted.given.point.common.dtype
        few = size <= LARGEST_DENSE
        return nuts.Target(
            samplers=self.samplers,
            given=self.fitted.given,
            potential=self.fitted.potential,
            starts=self.fitted.draw_starts(key, chains),
            metric=np.eye(size, dtype=dtype) if few else np.ones(size, dtype),
            transform=self._to_program,
            acceptance=0.98 if few else 0.7,
            warmup=300 if few else 150,
        )

    @override
    def laplace(self, key: Array, settings: laplace.LaplaceSettings) -> Draws:
        shape = (settings.chains, settings.draws, self.fitted.reparam.size)
        noise = np.asarray(jax.random.normal(key, shape))
        return self._to_program(noise), laplace.weigh(self.fitted.potential, noise, noise)

    def _to_program(self, w: np.ndarray) -> np.ndarray:
        return np.asarray(self.fitted.reparam.forward_chains(jnp.asarray(w), self.fitted.given))


class AbstractInitializer(abc.ABC):
    """The search for modes in all captures of one layout."""

    def expect(self, data: Observations, method: nuts.NutsSettings) -> None:
        """Begin to compile the sampler, in parallel with the search, where its shapes are known."""
        del data, method

    @abc.abstractmethod
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        """The modes of one capture; a `FitError` where no start reached one."""


@dataclasses.dataclass(frozen=True, eq=False)
class JointInitializer(AbstractInitializer):
    """For captures whose coordinates are optimized together."""

    program: Program
    samplers: nuts.SamplerCache

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
        )
        nuts.expect(target, method)

    @override
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        potential = CompiledPotential(self.program, data)
        modes = find_modes(potential, from_prior(self.program, key, STARTS, data), progress)
        metadata = {
            "starts": modes.starts,
            "failures": modes.failures,
            "weights": [round(float(weight), 6) for weight in modes.weight[:8]],
            "newton_decrement": float(modes.decrement[0]),
            "gradients": potential.calls,
        }
        return JointInit(self, data, potential, modes, metadata)


@dataclasses.dataclass(frozen=True, eq=False)
class HierarchicalInitializer(AbstractInitializer):
    """For captures whose groups are optimized one by one."""

    group_model: GroupModel
    reparam: HierarchicalReparam
    samplers: nuts.SamplerCache

    @override
    def find(self, data: Observations, key: Array, progress: Progress) -> AbstractInit:
        fitted = hierarchical_reparam.fit_reparam(
            self.group_model, self.reparam, data, key, progress
        )
        modes = fitted.modes
        metadata = {
            "starts": modes.starts * self.reparam.groups.count,
            "failures": modes.failures,
            "patches_with_several": sum(len(each.weight) > 1 for each in modes.of_group),
            "newton_decrement": fitted.decrement,
        }
        return HierarchicalInit(self.samplers, fitted, metadata)


def make_initializer(model: Model, program: Program, data: Observations) -> AbstractInitializer:
    """The initializer that the layout of a capture calls for."""
    groups = find_groups(program, data)
    group_model = None if groups is None else find_group_model(model, groups, data)
    if groups is None or group_model is None:
        return JointInitializer(program, nuts.SamplerCache(program.potential_jit))
    reparam = HierarchicalReparam(program, groups)
    return HierarchicalInitializer(group_model, reparam, nuts.SamplerCache(reparam.potential_jit))


class CompiledPotential:
    """Potential and gradient of a program as functions of NumPy arrays; counts its calls."""

    def __init__(self, program: Program, data: Observations) -> None:
        self._potential = numpy_potential(program.value_and_gradient, data, data.brightness.dtype)
        self.calls = 0

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """At an unconstrained vector."""
        self.calls += 1
        return self._potential(z)
