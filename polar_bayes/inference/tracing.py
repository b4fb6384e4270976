"""One thread at a time traces a model: NumPyro keeps one stack of handlers for the whole process.

Two threads that trace at once would find each other's handlers on it: a crash at best, another
model's values at worst. Only tracing and lowering hold that lock. What is traced compiles beside
anything else, once, and compiled programs run side by side: a thread whose result nobody waits for
any more keeps no other one from its work.
"""

import os
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax

from polar_bayes.errors import FitError

QUICK = {"xla_backend_optimization_level": 1}
"""Of three levels: fits run as fast as with all, first ones take three quarters of the time."""

CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")

_BESIDE = ThreadPoolExecutor(1, "polar_bayes compiles")


class AbandonedError(Exception):
    """Raised in a thread whose result nobody waits for any more, so that it ends."""


class _Tracing:
    """A lock that one thread may take several times, and abandoned threads no more."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._refused: weakref.WeakSet[threading.Thread] = weakref.WeakSet()

    def __enter__(self) -> None:
        self._lock.acquire()
        if threading.current_thread() in self._refused:
            self._lock.release()
            raise AbandonedError

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def refuse(self, thread: threading.Thread) -> None:
        """Wait until the thread is not tracing, and let it never trace again."""
        with self._lock:
            self._refused.add(thread)


TRACING = _Tracing()
"""Held while a model is traced; nobody compiles, runs or waits for a program while holding it."""


def compiled(function: Callable) -> Any:
    """The function as `jax.jit` has it, compiled with as much effort as running it pays back."""
    return jax.jit(function, compiler_options=QUICK if jax.default_backend() == "cpu" else None)


class TracedOnce:
    """A function that is traced alone in the process, and compiled once, by its first call."""

    def __init__(self, function: Callable) -> None:
        self._function = compiled(function)
        self._begun: _Compilation | None = None
        self._run: Callable | None = None
        self._device: Any = None

    @property
    def is_begun(self) -> bool:
        """Whether it is compiled, or being compiled."""
        return self._begun is not None

    def __call__(self, *arguments: Any) -> Any:
        """Run it; the first time, trace and compile it before."""
        return self.program(*arguments)(*arguments)

    def begin(self, *arguments: Any) -> None:
        """Trace it for arguments of such shapes and types, and compile it beside what follows."""
        if self._begun is None:
            _BESIDE.submit(self._traced(*arguments).result)

    def program(self, *arguments: Any) -> Callable:
        """The compiled program for arguments of these shapes and types."""
        run = self._run
        if run is None or self._device != jax.config.jax_default_device:
            run = self._run = self._traced(*arguments).result()
        return run

    def _traced(self, *arguments: Any) -> "_Compilation":
        with TRACING:
            device = jax.config.jax_default_device  # a compiled program runs where it was made for
            if self._begun is None or self._device != device:
                self._begun, self._run = _Compilation(self._function.lower(*arguments)), None
                self._device = device
            return self._begun


class TracedByShape:
    """The same for a function whose first argument comes in several shapes."""

    def __init__(self, function: Callable) -> None:
        self._function = function
        self._of_shape: dict[tuple[int, ...], TracedOnce] = {}

    def begin(self, first: Any, *others: Any) -> None:
        """Trace it for arguments of such shapes, and compile it beside what follows."""
        self._of(first.shape).begin(first, *others)

    def __call__(self, first: Any, *others: Any) -> Any:
        """Run it; with a first argument of a new shape, trace and compile it before."""
        return self._of(first.shape)(first, *others)

    def _of(self, shape: tuple[int, ...]) -> TracedOnce:
        found = self._of_shape.get(shape)
        return found or self._of_shape.setdefault(shape, TracedOnce(self._function))


class _Compilation:
    """A traced program, compiled once, by whichever thread comes to it first."""

    def __init__(self, lowered: Any) -> None:
        self._lowered = lowered
        self._found: Callable | None = None
        self._lock = threading.Lock()

    def result(self) -> Callable:
        # A thread that waits for the queue of `_BESIDE` would wait for programs of others, too:
        # it compiles what it needs itself, where that has not begun.
        with self._lock:
            if self._found is None:
                self._found = self._lowered.compile()
                self._lowered = None  # only the program is kept
            check_memory(bytes_of(self._found))
            return self._found


def bytes_of(program: Any) -> int:
    """Memory that one run of a compiled program takes; 0 where the backend does not say."""
    analysis = program.memory_analysis()
    if analysis is None:
        return 0
    parts = ("argument", "output", "temp")
    return sum(int(getattr(analysis, f"{part}_size_in_bytes")) for part in parts)


def check_memory(needed: int) -> None:
    """Refuse what cannot be held in memory, before anything is allocated."""
    there = memory_limit()
    if there is not None and needed > there:
        raise FitError(
            f"this fit would need {needed / 1e9:.1f} GB at once, of {there / 1e9:.1f} GB",
            where="memory",
            mend="average neighboring views, or take a sample of them",
        )


def memory_limit() -> int | None:
    """Bytes of the accelerator, or of the machine and its container; None where nobody says."""
    if jax.default_backend() != "cpu":
        return (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")
    found = []
    if hasattr(os, "sysconf"):
        found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for file in map(Path, CONTAINER_LIMITS):
        text = file.read_text().strip() if file.is_file() else ""
        if text.isdigit():
            found.append(int(text))
    return min(found, default=None)
