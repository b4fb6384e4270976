"""One thread at a time tells a model: NumPyro keeps one stack of handlers for the whole process.

Two threads that trace at once would find each other's handlers on it: a crash at best, another
model's values at worst. Compiled programs run side by side.
"""

import threading
from collections.abc import Callable
from typing import Any

TRACING = threading.RLock()


class TracedOnce:
    """A compiled function whose first call, which traces it, is alone in the process.

    Args:
        function: Compiled by `jax.jit`; always called with arrays of the same shapes and types.
    """

    def __init__(self, function: Callable) -> None:
        self._function = function
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
        function: Compiled by `jax.jit`; its other arguments are always of the same shapes.
    """

    def __init__(self, function: Callable) -> None:
        self._function = function
        self._traced: set[tuple[int, ...]] = set()

    def __call__(self, first: Any, *others: Any) -> Any:
        """Run it; with a first argument of a new shape, trace and compile it before."""
        if first.shape in self._traced:
            return self._function(first, *others)
        with TRACING:
            found = self._function(first, *others)
            self._traced.add(first.shape)
        return found
