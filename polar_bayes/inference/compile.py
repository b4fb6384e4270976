"""Ahead-of-time compilation, the cache of compiled programs, and deadlines.

NumPyro has one stack of effect handlers for the whole process, so only one thread may trace a model
at a time. `TRACING_LOCK` is held while a model is traced and lowered; compilation and execution run
in parallel with everything else.
"""

import contextvars
import dataclasses
import gc
import os
import queue
import sys
import threading
import time
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import cachetools
import jax
import numpy as np
from dask.base import tokenize
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress

COMPILER_OPTIONS = {"xla_backend_optimization_level": 1}
"""XLA's optimization level, of 0 to 3: fits run as fast as with 3, and the first one of a layout
takes three quarters of the time."""

CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")

_COMPILER_THREAD = ThreadPoolExecutor(1, "polar_bayes compiler")


class AbandonedError(Exception):
    """Ends a thread that passed its deadline."""


class _TracingLock:
    """A reentrant lock that abandoned threads cannot acquire."""

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
        """Wait until a thread is not tracing, and let it never trace again."""
        with self._lock:
            self._refused.add(thread)


TRACING_LOCK = _TracingLock()
"""Held while a model is traced, and never while a program is compiled or runs."""


def compiled(function: Callable) -> Any:
    """The function under `jax.jit`, with `COMPILER_OPTIONS` on a CPU."""
    return jax.jit(
        function, compiler_options=COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
    )


class JitOnce:
    """A function of arguments of one shape: traced under the lock and compiled once."""

    def __init__(self, function: Callable) -> None:
        self._function = compiled(function)
        self._compilation: _Compilation | None = None
        self._program: Callable | None = None
        self._device: Any = None

    @property
    def is_begun(self) -> bool:
        """Whether the compilation has begun."""
        return self._compilation is not None

    def __call__(self, *arguments: Any) -> Any:
        """Run the program, which the first call compiles."""
        return self.program(*arguments)(*arguments)

    def begin(self, *arguments: Any) -> None:
        """Trace now, and compile on another thread; the arguments may be `ShapeDtypeStruct`."""
        if self._compilation is None:
            _COMPILER_THREAD.submit(self._trace(*arguments).result)

    def program(self, *arguments: Any) -> Callable:
        """The compiled program for arguments of these shapes and types."""
        program = self._program
        if program is None or self._device != jax.config.jax_default_device:
            program = self._program = self._trace(*arguments).result()
        return program

    def _trace(self, *arguments: Any) -> "_Compilation":
        with TRACING_LOCK:
            device = jax.config.jax_default_device  # a compiled program runs on one device
            if self._compilation is None or self._device != device:
                self._compilation = _Compilation(self._function.lower(*arguments))
                self._program, self._device = None, device
            return self._compilation


class JitByShape:
    """A function whose first argument comes in several shapes: one `JitOnce` for each."""

    def __init__(self, function: Callable) -> None:
        self._function = function
        self._programs: dict[tuple[int, ...], JitOnce] = {}

    def begin(self, first: Any, *others: Any) -> None:
        """Trace now, and compile on another thread; the arguments may be `ShapeDtypeStruct`."""
        self._of(first.shape).begin(first, *others)

    def __call__(self, first: Any, *others: Any) -> Any:
        """Run the program of this shape, which its first call compiles."""
        return self._of(first.shape)(first, *others)

    def _of(self, shape: tuple[int, ...]) -> JitOnce:
        found = self._programs.get(shape)
        return found or self._programs.setdefault(shape, JitOnce(self._function))


class _Compilation:
    """A lowered program, compiled once, by the first thread that asks."""

    def __init__(self, lowered: Any) -> None:
        self._lowered = lowered
        self._program: Callable | None = None
        self._lock = threading.Lock()

    def result(self) -> Callable:
        # A thread does not wait for the queue of `_COMPILER_THREAD`, which holds programs of other
        # fits: what is still in the queue is compiled by the thread that needs it.
        with self._lock:
            if self._program is None:
                self._program = self._lowered.compile()
                self._lowered = None  # frees the traced program
            check_memory(bytes_of(self._program))
            return self._program


def bytes_of(program: Any) -> int:
    """Memory that one run of a compiled program takes; 0 where the backend reports nothing."""
    analysis = program.memory_analysis()
    if analysis is None:
        return 0
    parts = ("argument", "output", "temp")
    return sum(int(getattr(analysis, f"{part}_size_in_bytes")) for part in parts)


def check_memory(needed: int) -> None:
    """Refuse a program that does not fit into memory, before anything is allocated."""
    limit = memory_limit()
    if limit is not None and needed > limit:
        raise FitError(
            f"this fit would need {needed / 1e9:.1f} GB at once, of {limit / 1e9:.1f} GB",
            where="memory",
            hint="average neighboring views, or take a sample of them",
        )


def memory_limit() -> int | None:
    """Bytes of the accelerator, or of the machine and its container; None where not known."""
    if jax.default_backend() != "cpu":
        return (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")
    limits = []
    if hasattr(os, "sysconf"):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for file in map(Path, CONTAINER_LIMITS):
        text = file.read_text().strip() if file.is_file() else ""
        if text.isdigit():
            limits.append(int(text))
    return min(limits, default=None)


# --- The cache of compiled programs, which fits of one layout share -------------------------------


class LRUCache[T]:
    """The values used last, by key; several threads may ask at once."""

    def __init__(self, maxsize: int) -> None:
        self._values: cachetools.LRUCache[Hashable, T] = cachetools.LRUCache(maxsize)
        self._lock = threading.RLock()

    def of(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value of a key, made now if it is not in the cache."""
        with self._lock:
            if key not in self._values:
                self._values[key] = make()
            return self._values[key]


def cache_key(
    model: Callable,
    scene: Scene,
    priors: Mapping[str, dist.Distribution],
    links: Mapping[str, AbstractLink],
    *further: Any,
) -> str:
    """A text that is equal for requests whose compiled programs are the same."""
    scene = dataclasses.replace(scene)  # without its ledger
    parts = [
        model,
        scene,
        # Not the priors themselves: distributions store what they have computed.
        *(
            (name, jax.tree.leaves(prior), str(jax.tree.structure(prior)))
            for name, prior in priors.items()
        ),
        links,
        *_code_of(model, scene, links, *map(type, priors.values())),
        *further,
    ]
    # One by one: a token depends on which of the objects inside it are identical.
    return tokenize([tokenize(part) for part in parts])


def layout_of(data: Observations) -> tuple[str, ...]:
    """What programs depend on in a capture: variables, axes, lengths and types, not readings."""
    return (str(jax.tree.structure(data)), *(f"{x.dtype}{x.shape}" for x in jax.tree.leaves(data)))


CONSTANTS = (str, bytes, int, float, complex, np.ndarray, np.generic, jax.Array)


def _code_of(*roots: object) -> Iterator[object]:
    """Byte code of the user's functions that the roots refer to, and the constants they read."""
    # A function or class that is edited and loaded again keeps its name, by which it is pickled.
    # Programs compiled from the old code must not serve the new one.
    seen: dict[int, object] = {}  # holds the objects, so that no other one gets the same id
    pending = list(roots)
    while pending:
        value = pending.pop()
        if isinstance(value, CONSTANTS):
            yield value
        elif id(value) not in seen:
            seen[id(value)] = value
            if isinstance(value, FunctionType) and not _is_installed(value.__module__):
                yield value.__code__
            pending.extend(_references(value))


def _references(value: object) -> Iterable[object]:
    """Objects whose code may run when a value is used."""
    if isinstance(value, ModuleType):
        return ()
    if isinstance(value, FunctionType):
        attached = (value.__closure__, value.__dict__)
        if _is_installed(value.__module__):
            return attached
        return (*attached, value.__defaults__, value.__kwdefaults__, *_globals_of(value))
    if isinstance(value, type):
        return () if _is_installed(value.__module__) else (*vars(value).values(), *value.__bases__)
    if type(value).__module__ in ("builtins", "functools"):  # containers, cells, methods, partials
        return gc.get_referents(value)
    return (type(value), *getattr(value, "__dict__", {}).values())


def _globals_of(function: FunctionType) -> Iterator[object]:
    """Values of the global names in a function, and of attributes of the user's own modules."""
    codes = [function.__code__]
    names: list[str] = []
    for code in codes:
        names.extend(code.co_names)
        codes.extend(constant for constant in code.co_consts if isinstance(constant, CodeType))
    for name in names:
        value = function.__globals__.get(name)
        yield value
        if isinstance(value, ModuleType) and not _is_installed(value.__name__):
            yield from (getattr(value, attribute, None) for attribute in names)


def _is_installed(module: str | None) -> bool:
    """Whether a module is part of Python, of this package or of another installed one."""
    package = (module or "").partition(".")[0]
    if package in sys.stdlib_module_names or package == "polar_bayes":
        return True
    file = getattr(sys.modules.get(module or ""), "__file__", None) or ""
    return not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)


# --- Deadlines: compiled programs cannot be interrupted, but their thread can be abandoned --------


class OutOfTimeError(Exception):
    """The deadline passed before the work was done."""


def run_until[T](deadline: float, progress: Progress, work: Callable[[Progress], T]) -> T:
    """Run work on a thread of its own, and abandon it at the deadline (`time.perf_counter`)."""
    # An abandoned thread ends when it next reports progress or tries to trace a model. It traces
    # nothing after this function has returned or raised, so NumPyro's handlers are not shared.
    if deadline == float("inf"):
        return work(progress)
    if time.perf_counter() >= deadline:
        raise OutOfTimeError("the time was up")
    task = _Task(work)
    try:
        while True:
            remaining = max(deadline - time.perf_counter(), 0.0)
            report = task.reports.get(timeout=min(remaining, threading.TIMEOUT_MAX))
            if report is None:
                return task.outcome.result()
            progress(*report)
    except queue.Empty:
        raise OutOfTimeError("abandoned when the time was up") from None
    finally:
        task.abandon()


class _Task[T]:
    """Work on a thread of its own."""

    def __init__(self, work: Callable[[Progress], T]) -> None:
        self.outcome: Future[T] = Future()
        self.reports: queue.SimpleQueue[tuple[str, float] | None] = queue.SimpleQueue()
        self._work, self._abandoned = work, threading.Event()
        self._enable_x64 = jax.config.jax_enable_x64  # a thread does not inherit it
        # Not a daemon: an interpreter that shuts down while compiled code runs crashes.
        self._thread = threading.Thread(
            target=contextvars.copy_context().run, args=(self._run,), name="polar_bayes in time"
        )
        self._thread.start()

    def abandon(self) -> None:
        """End the thread as soon as possible; no effect after it has finished."""
        self._abandoned.set()
        if not self.outcome.done():
            TRACING_LOCK.refuse(self._thread)

    def _run(self) -> None:
        try:
            with jax.enable_x64(self._enable_x64):
                self.outcome.set_result(self._work(self._report))
        except BaseException as error:  # raised again by `outcome.result()`
            self.outcome.set_exception(error)
        self.reports.put(None)

    def _report(self, stage: str, fraction: float) -> None:
        if self._abandoned.is_set():
            raise AbandonedError
        self.reports.put((stage, fraction))
