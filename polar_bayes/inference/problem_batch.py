"""Captures of one layout that are fitted together, and the results of methods for them."""

import contextlib
import dataclasses
import os
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from polar_bayes.inference.batching import MethodUsed, ObservationBatch, Status
from polar_bayes.inference.compiled_model import CompiledModel
from polar_bayes.inference.program import Values
from polar_bayes.numerics.batches import AnyArray, batches, map_batches
from polar_bayes.numerics.compile import JitOnce

BATCH = 128
"""Captures that one call of a program takes."""

SMALL_BATCH = 4
"""The same where each has particles of its own."""

_THREADS = ThreadPoolExecutor(os.cpu_count() or 1, "polar_bayes batches")
"""That run batches of all images at once: a core is not shared by two."""


@dataclasses.dataclass(frozen=True, eq=False)
class ProblemBatch:
    """Posteriors of many captures of one layout.

    Args:
        engine: Programs of the model for the layout.
        pixels: The captures.
        keys: Data of the random key of each capture, shape (capture, 2).
        at: Places of these captures among all to which they belong, shape (capture,).
        seed: Of random numbers that all captures share.
    """

    engine: CompiledModel
    pixels: ObservationBatch
    keys: np.ndarray
    at: np.ndarray
    seed: int = 0

    def __len__(self) -> int:
        return len(self.at)

    def subset(self, index: np.ndarray) -> "ProblemBatch":
        """Return a batch of some of the captures, in that order."""
        pixels, keys, at = self.pixels.subset(index), self.keys[index], self.at[index]
        return dataclasses.replace(self, pixels=pixels, keys=keys, at=at)

    def run[S: Hashable](
        self,
        make: Callable[[CompiledModel, S], JitOnce],
        settings: S,
        *states: Any,
        given: tuple = (),
        batch: int = BATCH,
        single: bool = False,
    ) -> Any:
        """Run a program on all captures; `given` arguments are the same for all of them."""
        double = not single and self.engine.dtype == np.float64
        with self._arguments(states, given, batch, single=single) as arguments:
            program, device = self.engine.made(make, settings), jax.config.jax_default_device
            if not program.is_begun:  # a thread that was abandoned must not trace in another one
                program.program(*arguments(next(batches(len(self), batch))))

            def of_batch(index: np.ndarray) -> Any:
                with jax.enable_x64(double), jax.default_device(device):  # no thread inherits them
                    return program(*arguments(index))

            threads = _THREADS.map if len(self) > batch else map
            return map_batches(of_batch, len(self), batch, threads)

    def begin[S: Hashable](
        self,
        make: Callable[[CompiledModel, S], JitOnce],
        settings: S,
        *states: Any,
        given: tuple = (),
        single: bool = False,
    ) -> None:
        """Begin to compile what `run` needs, in parallel with what follows, given one state."""
        program = self.engine.made(make, settings)
        if not program.is_begun:
            with self._arguments(states, given, BATCH, single=single) as arguments:
                program.begin(*arguments(np.zeros(BATCH, int)))

    @contextlib.contextmanager
    def _arguments(
        self, states: tuple, given: tuple, batch: int, *, single: bool
    ) -> Iterator[Callable[[np.ndarray], tuple]]:
        """The arguments of a program for the captures of a batch, in its precision."""
        dtype = np.float32 if single else self.engine.dtype
        with jax.enable_x64(dtype == np.float64):
            pixels = self.pixels.in_precision(dtype)
            static = jax.tree.map(jnp.asarray, pixels.static)

            def arguments(index: np.ndarray) -> tuple:
                wanted = np.int32(min(batch, len(self) - index[0]))
                state = jax.tree.map(lambda x: x[index], states)
                return (*given, wanted, pixels.take(index), static, *state)

            yield arguments


def problem_batch(
    engine: CompiledModel, pixels: ObservationBatch, numbers: np.ndarray, seed: int
) -> ProblemBatch:
    """Make a batch of captures, each with a random key that depends on its number alone."""
    return ProblemBatch(
        engine, pixels, random_keys(seed, numbers), np.arange(len(pixels)), seed=seed
    )


class BatchDraws(NamedTuple):
    """Results of a method for some captures of a batch: one row each, or one value for all.

    `mode` is a mode of each capture and a root of the covariance there; `draws` is empty where
    there is no answer, and `z` computes the unconstrained vectors of the draws, which few callers
    need. What is found later for a capture replaces what was found before.
    """

    at: np.ndarray
    status: np.ndarray | Status
    draws: Values = {}
    weights: np.ndarray = np.empty((0, 0))
    ess: np.ndarray | float = np.nan
    method: np.ndarray | MethodUsed = MethodUsed.NONE
    pareto_k: np.ndarray | float = np.nan
    condition: AnyArray | float = np.nan
    steps: np.ndarray | int = 0
    mode: tuple[AnyArray, AnyArray] | None = None
    z: Callable[[], AnyArray] = lambda: np.empty((0, 0, 0))


class Outcome:
    """Diagnostics of the captures of a batch, entered as they are found: NaN where there are none.

    Those of the search for modes and of the first proposal stay where a later one gives the answer.
    """

    def __init__(self, count: int, status: Status = Status.NOT_CONVERGED) -> None:
        self.pareto_k, self.ess, self.condition = np.full((3, count), np.nan)
        self.steps = np.zeros(count, np.int32)
        self.method = np.full(count, MethodUsed.NONE, np.int8)
        self.status = np.full(count, status, np.int8)

    def put(self, found: BatchDraws) -> None:
        """Enter the results of some captures."""
        at = found.at
        self.ess[at], self.method[at] = found.ess, found.method
        self.status[at] = found.status
        self.steps[at] += found.steps
        for own, new in ((self.pareto_k, found.pareto_k), (self.condition, found.condition)):
            own[at] = np.where(np.isnan(own[at]), new, own[at])


def random_keys(seed: int, numbers: np.ndarray) -> np.ndarray:
    """Return random keys, as arrays, that depend on the number of each capture alone."""
    base = jax.random.key(seed)
    keys = jax.vmap(lambda number: jax.random.fold_in(base, number))(numbers.astype(np.uint32))
    return np.asarray(jax.random.key_data(keys))
