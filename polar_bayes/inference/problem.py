"""One capture, ready to be fitted: what every method finds on its bench."""

import dataclasses
import functools
import time
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array

from polar_bayes.inference import laplace
from polar_bayes.inference.compile import TRACING_LOCK, JitOnce, LRUCache, cache_key, layout_of
from polar_bayes.inference.initialization import AbstractInit, AbstractInitializer, make_initializer
from polar_bayes.inference.program import Model, Program, compile_program
from polar_bayes.inference.request import Request
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress

# --- A model on captures of one layout, with all that is compiled of it; kept from fit to fit -----


MOST_KEPT = 8


@dataclasses.dataclass(frozen=True, eq=False)
class CompiledModel:
    """What fits of one model to captures of one layout have in common."""

    model: Model
    program: Program
    layout: Observations

    @functools.cached_property
    def initializer(self) -> AbstractInitializer:
        """What searches for peaks."""
        with TRACING_LOCK:
            return make_initializer(self.model, self.program, self.layout)

    @functools.cached_property
    def least_squares(self) -> Callable[[Array, Observations], laplace.Estimate]:
        """The least squares from some starts, compiled."""
        return JitOnce(lambda starts, data: laplace.estimate(self.program, data, starts))


_KEPT: LRUCache[CompiledModel] = LRUCache(MOST_KEPT)


def compile_model(request: Request, scene: Scene, data: Observations) -> CompiledModel:
    """The compiled model of a capture and of every other one of its layout, from the cache."""
    key = cache_key(
        request.model, scene, request.priors, request.links, request.precision, layout_of(data)
    )

    def make() -> CompiledModel:
        model = request.bind(scene)
        return CompiledModel(model, compile_program(model, data), data)

    with TRACING_LOCK:
        return _KEPT.of(key, make)


# --- One capture, ready to be fitted: what every method finds on its bench ------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A capture with the programs that fit it."""

    request: Request
    compiled_model: CompiledModel
    data: Observations
    key: Array
    progress: Progress
    begun: float = dataclasses.field(default_factory=time.perf_counter)

    @property
    def program(self) -> Program:
        """The model as functions of one unconstrained vector."""
        return self.compiled_model.program

    @property
    def key_of_draws(self) -> Array:
        """Random key of what comes after the search for modes."""
        return jax.random.split(self.key)[1]

    @functools.cached_property
    def initialization(self) -> AbstractInit:
        """The peaks of the posterior, searched for once however many methods ask."""
        return self.compiled_model.initializer.find(
            self.data, jax.random.split(self.key)[0], self.progress
        )

    def reporting(self, progress: Progress) -> "Problem":
        """The same with another callback; the peaks go with it where they are found already."""
        other = dataclasses.replace(self, progress=progress)
        if "initialization" in self.__dict__:
            other.__dict__["initialization"] = self.initialization
        return other

    @property
    def dtype(self) -> np.dtype:
        """Floating type of the fit."""
        return np.dtype(self.data.brightness.dtype)
