"""A model compiled for a layout: programs for one capture, or for many in a batch.

Programs of batches are made by functions `make(compiled_model, settings)` in the file of their
algorithm. A model compiles each once and keeps it, so all captures of a layout share the programs.
"""

import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Hashable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.inference.batching import ObservationBatch
from polar_bayes.inference.cache_key import cache_key, layout_of
from polar_bayes.inference.initialization import AbstractInitializer, make_initializer
from polar_bayes.inference.program import Model, Program, compile_program, from_prior
from polar_bayes.inference.request import Request, bind_model
from polar_bayes.inference.result import dims_of, shape_of
from polar_bayes.numerics.batches import batches, map_batches
from polar_bayes.numerics.compile import TRACING_LOCK, JitOnce, LRUCache
from polar_bayes.observation.data import Observations

BATCH = 128
"""Captures of one call of a program."""

SMALL_BATCH = 4
"""Captures of one call of a program in which each capture has its own particles."""

DRAW_BATCH = 64
"""Draws of one capture that are evaluated together: larger batches are split among cores, which
then wait for each other."""

MAX_LAYOUTS = 16
"""Models, by layout, that the cache holds: all candidates of a comparison of scenes and more."""

MAX_PROGRAMS = 64
"""Programs of one model, by method and settings, that the cache holds."""

_THREADS = ThreadPoolExecutor(os.cpu_count() or 1, "polar_bayes batches")
"""Threads that run the batches of all images, so that batches do not compete for a core."""

MOMENTS = 4000
"""Number of draws that determine the moments of priors."""


@dataclasses.dataclass(frozen=True, eq=False)
class CompiledModel:
    """The programs that fits of one model to captures of one layout share.

    `program` is the model in the precision of the fit; `layout` is a capture of that layout.
    """

    bind: Callable[[], Model]
    model: Model
    program: Program
    layout: Observations
    precision: str
    priors: Mapping[str, dist.Distribution] = dataclasses.field(default_factory=dict)
    _made: LRUCache[Any] = dataclasses.field(default_factory=lambda: LRUCache(MAX_PROGRAMS))

    @functools.cached_property
    def initializer(self) -> AbstractInitializer:
        """The search for posterior modes of one capture."""
        with jax.enable_x64(self.precision == "double"), TRACING_LOCK:  # whoever asks first
            return make_initializer(self.model, self.program, self.layout)

    def free(self, data: Observations) -> Observations:
        """Return a capture with NaN for parameters that may be held; unchanged if it has groups."""
        return data if data.leading else self.program.free(data)

    @functools.cached_property
    def single_program(self) -> Program:
        """Program of the model in single precision."""
        if self.precision == "single":
            return self.program
        with jax.enable_x64(False), TRACING_LOCK:
            return compile_program(self.bind(), self.layout.in_single_precision())

    @property
    def dtype(self) -> type[np.floating]:
        """Floating type of the answer."""
        return np.float64 if self.precision == "double" else np.float32

    def made[S: Hashable, P](self, make: Callable[["CompiledModel", S], P], settings: S) -> P:
        """Return what a method makes of the model, such as a program, from the cache."""
        return self._made.of((make, settings), lambda: make(self, settings))

    def run[S: Hashable](
        self,
        make: Callable[["CompiledModel", S], JitOnce],
        settings: S,
        pixels: ObservationBatch,
        *states: Any,
        given: tuple = (),
        batch: int = BATCH,
        single: bool = False,
    ) -> Any:
        """Run a program on all pixels; `given` arguments are the same for all of them."""
        double = not single and self.dtype == np.float64
        with self._arguments(pixels, states, given, batch, single=single) as arguments:
            program, device = self.made(make, settings), jax.config.jax_default_device
            if not program.is_begun:  # a thread that was abandoned must not trace in another one
                program.program(*arguments(next(batches(len(pixels), batch))))

            def of_batch(index: np.ndarray) -> Any:
                with jax.enable_x64(double), jax.default_device(device):  # no thread inherits them
                    return program(*arguments(index))

            threads = _THREADS.map if len(pixels) > batch else map
            return map_batches(of_batch, len(pixels), batch, threads)

    def begin[S: Hashable](
        self,
        make: Callable[["CompiledModel", S], JitOnce],
        settings: S,
        pixels: ObservationBatch,
        *states: Any,
        given: tuple = (),
        single: bool = False,
    ) -> None:
        """Begin to compile the program of `run` in another thread, for one state."""
        program = self.made(make, settings)
        if not program.is_begun:
            with self._arguments(pixels, states, given, BATCH, single=single) as arguments:
                program.begin(*arguments(np.zeros(BATCH, int)))

    @contextlib.contextmanager
    def _arguments(
        self, pixels: ObservationBatch, states: tuple, given: tuple, batch: int, *, single: bool
    ) -> Iterator[Callable[[np.ndarray], tuple]]:
        """Yield a function that returns a program's arguments for pixels of a batch."""
        dtype = np.float32 if single else self.dtype
        with jax.enable_x64(dtype == np.float64):
            pixels = pixels.in_precision(dtype)
            static, count = jax.tree.map(jnp.asarray, pixels.static), len(pixels)

            def arguments(index: np.ndarray) -> tuple:
                wanted = np.int32(min(batch, count - index[0]))
                state = jax.tree.map(lambda x: x[index], states)
                return (*given, wanted, pixels.take(index), static, *state)

            yield arguments

    @functools.cached_property
    def parameter_axes(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...]]]:
        """Names and lengths of each parameter's axes in one pixel, by parameter."""
        z = np.zeros(self.program.size, self.dtype)
        with jax.enable_x64(self.precision == "double"), TRACING_LOCK:
            names = jax.eval_shape(self.program.parameters, z, self.layout)
        dims = dims_of(self.program)
        return {name: (tuple(dims[name]), shape_of(self.program, name)) for name in names}

    def prior_draws(self, count: int) -> np.ndarray:
        """Return draws from the prior, at which mode searches start, (draw, size)."""
        # Moments need many, and a draw does not depend on how many there are: keys compile once.
        return self.made(_prior_draws, max(count, MOMENTS))[:count]

    @functools.cached_property
    def prior_parameters(self) -> dict[str, np.ndarray]:
        """Parameters of `MOMENTS` draws from the prior, each (draw, ...)."""
        z = self.prior_draws(MOMENTS)
        with jax.enable_x64(self.precision == "double"):
            draws = self.program.parameters_of_chains(jnp.asarray(z[None]), self.free(self.layout))
        sizes = {name: own for name, (_, own) in self.parameter_axes.items()}
        return {n: np.asarray(x[0], float).reshape(-1, *sizes[n]) for n, x in draws.items()}

    @property
    def prior_moments(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Prior mean and sd of every parameter for which they are finite."""
        found = self.prior_parameters.items()
        moments = {name: (x.mean(axis=0), x.std(axis=0)) for name, x in found}
        return {name: two for name, two in moments.items() if np.isfinite(two).all()}


def _prior_draws(compiled_model: CompiledModel, count: int) -> np.ndarray:
    with jax.enable_x64(compiled_model.precision == "double"):
        key = jax.random.key(0)
        data = compiled_model.free(compiled_model.layout)
        return np.asarray(from_prior(compiled_model.program, key, count, data))


def evaluate_draws(
    program: Program, z: Float[Array, "draw size"], data: Observations
) -> tuple[dict[str, Array], Float[Array, " draw"]]:
    """Return parameters and log posterior densities of draws; minus infinity in place of NaN."""
    parameters, values = jax.lax.map(
        lambda z: program.parameters_and_potential(z, data), z, batch_size=DRAW_BATCH
    )
    return parameters, jnp.where(jnp.isnan(values), -jnp.inf, -values)


_COMPILED: LRUCache[CompiledModel] = LRUCache(MAX_LAYOUTS)


def compile_model(request: Request, data: Observations) -> CompiledModel:
    """Return the compiled model of a capture's layout from the cache."""
    parts = request.model, request.scene, request.priors, request.links
    key = cache_key(*parts, request.precision, layout_of(data))
    return compile_layout(key, request, lambda: data)


def compile_layout(
    key: str, request: Request, observe: Callable[[], Observations]
) -> CompiledModel:
    """Return the compiled model of a layout that `key` identifies, from the cache."""
    parts = request.model, request.scene, request.priors, request.links

    def make() -> CompiledModel:
        bind = functools.partial(bind_model, *parts)
        data, is_double = observe(), request.precision == "double"
        data = data if is_double else data.in_single_precision()
        with jax.enable_x64(is_double):
            model = bind()
            program = compile_program(model, data)
        return CompiledModel(bind, model, program, data, request.precision, request.priors)

    with TRACING_LOCK:
        return _COMPILED.of(key, make)


def layout_key(request: Request, *further: object) -> str:
    """Return a text that is equal for requests with the same model and the same layout."""
    layout = [
        (name, v.dims, v.shape, str(v.dtype)) for name, v in request.capture.variables.items()
    ]
    parts = request.model, request.scene, request.priors, request.links
    return cache_key(*parts, request.precision, layout, *further)
