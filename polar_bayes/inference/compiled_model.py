"""A model compiled for a layout: programs for one capture, or for many in a batch.

Programs of batches are made by functions `make(compiled_model, settings)` in the file of their
algorithm. A model compiles each once and keeps it, so all captures of a layout share the programs.
"""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro import distributions as dist

from polar_bayes.inference.initialization import AbstractInitializer, make_initializer
from polar_bayes.inference.model_parts import ModelParts, layout_of
from polar_bayes.inference.program import Model, Program, compile_program, from_prior
from polar_bayes.inference.request import Request
from polar_bayes.inference.result import dims_of, shape_of
from polar_bayes.numerics.compile import TRACING_LOCK, JitOnce, LRUCache
from polar_bayes.numerics.fingerprint import fingerprint, uses_own_code
from polar_bayes.observation.data import Observations

MOMENTS = 4000
"""Number of draws that determine the moments of priors."""


@dataclasses.dataclass(frozen=True, eq=False)
class CompiledModel:
    """The programs that fits of one model to captures of one layout share.

    `program` is the model in the precision of the fit; `layout` is a capture of that layout.
    """

    bind: Callable[[], Model]
    program: Program
    layout: Observations
    precision: str
    priors: Mapping[str, dist.Distribution] = dataclasses.field(default_factory=dict)
    _made: LRUCache[Any] = dataclasses.field(default_factory=lambda: LRUCache(64))
    """Programs that methods have made of the model, by settings."""

    @functools.cached_property
    def initializer(self) -> AbstractInitializer:
        """The search for posterior modes of one capture."""
        with jax.enable_x64(self.precision == "double"), TRACING_LOCK:  # whoever asks first
            return make_initializer(self.program, self.layout)

    def free(self, data: Observations) -> Observations:
        """Return a capture with NaN for parameters that may be held; unchanged if it has groups."""
        return data if data.leading else self.program.free(data)

    @functools.cached_property
    def single_program(self) -> Program:
        """Program of the model in single precision."""
        if self.precision == "single":
            return self.program
        with jax.enable_x64(False), TRACING_LOCK:
            single = compile_program(self.bind(), self.layout.in_single_precision())
        return dataclasses.replace(single, key=self.program.key)

    @property
    def dtype(self) -> type[np.floating]:
        """Floating type of the answer."""
        return np.float64 if self.precision == "double" else np.float32

    def made[S: Hashable, P](self, make: Callable[["CompiledModel", S], P], settings: S) -> P:
        """What a method makes of the model for its settings, a program say, at its first use."""

        def made() -> P:
            found = make(self, settings)
            is_own = uses_own_code(make, settings)
            if isinstance(found, JitOnce) and self.program.key and not is_own:
                found.key = f"{self.program.key} {fingerprint(make, settings, code=())}"
            return found

        return self._made.of((make, settings), made)

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


_COMPILED: LRUCache[CompiledModel] = LRUCache(16)
"""Models by layout: all candidates of a comparison of scenes, and some more."""


def compile_model(request: Request, data: Observations) -> CompiledModel:
    """The compiled model of a capture and of every other one of its layout, from the cache."""
    key = request.key(request.precision, layout_of(data))
    return compile_layout(key, request, lambda: data)


def compile_layout(
    key: str, request: Request, observe: Callable[[], Observations]
) -> CompiledModel:
    """The same where a text is known that tells layouts apart without a capture."""
    # Without the capture, which would stay in memory.
    parts = ModelParts(request.model, request.scene, request.priors, request.links)

    def make() -> CompiledModel:
        data, is_double = observe(), request.precision == "double"
        data = data if is_double else data.in_single_precision()
        with jax.enable_x64(is_double):
            program = compile_program(parts.bind(), data)
        program = dataclasses.replace(program, key="" if parts.has_own_code else key)
        return CompiledModel(parts.bind, program, data, request.precision, parts.priors)

    with TRACING_LOCK:
        return _COMPILED.of(key, make)


def layout_key(request: Request, *further: object) -> str:
    """Return a text that is equal for requests with the same model and the same layout."""
    layout = [
        (name, v.dims, v.shape, str(v.dtype)) for name, v in request.capture.variables.items()
    ]
    return request.key(request.precision, layout, *further)
