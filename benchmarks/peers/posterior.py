"""The posterior that every peer samples, and the interface of a peer."""

import abc
import dataclasses
import functools
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from polar_bayes.inference.program import Program, compile_program, from_prior
from polar_bayes.inference.request import Request, resolve
from polar_bayes.observation.data import Observations, observe
from polar_bayes.physics.scene import Scene

CHAINS = 4


@dataclasses.dataclass(frozen=True, eq=False)
class Posterior:
    """One capture and the per-material model of it.

    Args:
        capture: The readings.
        scene: What was seen; None for the scene that the capture names.
    """

    capture: xr.Dataset
    scene: Scene | None

    @functools.cached_property
    def request(self) -> Request:
        return resolve(self.capture, "per_material", self.scene, None, None, None, 0, "double")

    @functools.cached_property
    def data(self) -> Observations:
        return observe(self.request.capture, largest_view_zenith=self.request.largest_view_zenith)

    @functools.cached_property
    def model(self) -> Callable[[Observations], None]:
        """The NumPyro model."""
        return self.request.bind()

    @functools.cached_property
    def program(self) -> Program:
        return compile_program(self.model, self.data)

    @property
    def size(self) -> int:
        return self.program.size

    def log_density(self, z: Array) -> Array:
        """Log posterior density of an unconstrained vector, (size,), up to a constant; for JAX."""
        return -self.program.potential(z, self.data)

    def from_prior(self, seed: int, count: int) -> np.ndarray:
        """Unconstrained draws from the prior, (count, size)."""
        return from_prior(self.program, jax.random.key(seed), count, self.data)

    def parameters(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """The parameters, by name, of unconstrained draws (chain, draw, size)."""
        found = jax.vmap(jax.vmap(self.program.constrain))(jnp.asarray(z))
        return {name: np.asarray(value) for name, value in found.items()}


class Round(NamedTuple):
    """State of a peer after one more round.

    Args:
        parameters: All draws that it keeps so far, by name, each (chain, draw).
        evaluations: Of the density or of its gradient so far, warm-up included; None where the
            peer does not count them.
        weights: Of the draws, (chain, draw), where they are not all the same.
        worth: What the draws are worth, where it is not for chains to tell: they are independent.
    """

    parameters: dict[str, np.ndarray]
    evaluations: int | None = None
    weights: np.ndarray | None = None
    worth: float | None = None


class AbstractPeer(abc.ABC):
    """A way to sample the posterior, as its own documentation recommends.

    What a second run can use again belongs to the peer: it is made in the first.

    Args:
        posterior: What is sampled.
    """

    packages: tuple[str, ...]

    def __init__(self, posterior: Posterior) -> None:
        self.posterior = posterior

    @property
    def versions(self) -> str:
        return ", ".join(f"{name} {version(name)}" for name in self.packages)

    @abc.abstractmethod
    def rounds(self, seed: int) -> Iterator[Round]:
        """Sample in rounds; the caller stops when it has enough."""
