"""One thread at a time tells a model: NumPyro keeps one stack of handlers for the whole process.

Two threads that trace at once would find each other's handlers on it: a crash at best, another
model's values at worst. What is traced compiles beside anything else, and compiled programs run
side by side.
"""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax

TRACING = threading.RLock()

QUICK = {"xla_backend_optimization_level": 1}
"""Of three levels: fits run as fast as with all, first ones take three quarters of the time."""

_BESIDE = ThreadPoolExecutor(1, "polar_bayes compiles")


def compiled(function: Callable) -> Any:
    """The function as `jax.jit` has it, compiled with as much effort as running it pays back.

    Args:
        function: Not called by another compiled function.

    Returns:
        The compiled function.

    Raises:
        Nothing.
    """
    return jax.jit(function, compiler_options=QUICK if jax.default_backend() == "cpu" else None)


def compile_beside(function: Any, *arguments: Any) -> Future:
    """Begin to compile in another thread; to be called by the one thread that tells models.

    Args:
        function: What `compiled` returns.
        arguments: Arrays, or anything of such shapes and types.

    Returns:
        What gives the program, for arguments of these shapes and types.

    Raises:
        Nothing: an error of the compiler is that of the future.
    """
    return _BESIDE.submit(function.lower(*arguments).compile)


class TracedOnce:
    """A function that is compiled by its first call, which traces it alone in the process.

    Args:
        function: Always called with arrays of the same shapes and types.
    """

    def __init__(self, function: Callable) -> None:
        self._function = compiled(function)
        self._is_traced = False

    def __call__(self, *arguments: Any) -> Any:
        """Run it; the first time, trace and compile it before."""
        if self._is_traced:
            return self._function(*arguments)
        with TRACING:
            found = self._function(*arguments)
            self._is_traced = True
        return found


class TracedByShape:
    """The same for a function whose first argument comes in several shapes.

    Args:
        function: Its other arguments are always of the same shapes.
    """

    def __init__(self, function: Callable) -> None:
        self._function = compiled(function)
        self._traced: dict[tuple[int, ...], Callable] = {}
        self._begun: dict[tuple[int, ...], Future] = {}

    def begin(self, first: Any, *others: Any) -> None:
        """Trace it for arguments of such shapes, and compile it beside what follows."""
        with TRACING:
            if first.shape not in self._traced and first.shape not in self._begun:
                self._begun[first.shape] = compile_beside(self._function, first, *others)

    def __call__(self, first: Any, *others: Any) -> Any:
        """Run it; with a first argument of a new shape, trace and compile it before."""
        shape = first.shape
        if shape in self._traced:
            return self._traced[shape](first, *others)
        with TRACING:
            begun = self._begun.pop(shape, None)
            run = self._function if begun is None else begun.result()
            found = run(first, *others)
            self._traced[shape] = run
        return found
