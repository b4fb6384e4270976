"""One capture, ready to be fitted: what every method finds on its bench."""

import dataclasses
import functools
import time

import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.inference.ground import AbstractGround
from polar_bayes.inference.prepared import Prepared
from polar_bayes.inference.program import Program
from polar_bayes.inference.request import Request
from polar_bayes.observation.data import Observations
from polar_bayes.progress import Progress


@dataclasses.dataclass(frozen=True, eq=False)
class Bench:
    """A capture with the programs that fit it."""

    request: Request
    prepared: Prepared
    data: Observations
    key: Array
    progress: Progress
    begun: float = dataclasses.field(default_factory=time.perf_counter)

    @property
    def program(self) -> Program:
        """The model as functions of one unconstrained vector."""
        return self.prepared.program

    @property
    def key_of_draws(self) -> Array:
        """Random key of what comes after the search for modes."""
        return jax.random.split(self.key)[1]

    @functools.cached_property
    def ground(self) -> AbstractGround:
        """The peaks of the posterior, searched for once however many methods ask."""
        return self.prepared.grounds.find(self.data, jax.random.split(self.key)[0], self.progress)

    def reporting(self, progress: Progress) -> "Bench":
        """The same with another callback; the peaks go with it where they are found already."""
        other = dataclasses.replace(self, progress=progress)
        if "ground" in self.__dict__:
            other.__dict__["ground"] = self.ground
        return other

    @property
    def dtype(self) -> np.dtype:
        """Floating type of the fit."""
        return np.dtype(self.data.brightness.dtype)
