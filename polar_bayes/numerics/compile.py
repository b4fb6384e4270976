"""Ahead-of-time compilation, the cache of compiled programs, and deadlines.

NumPyro has one stack of effect handlers for the whole process, so only one thread may trace a model
at a time. `TRACING_LOCK` is held while a model is traced and lowered; compilation and execution run
in parallel with everything else.
"""

import contextvars
import functools
import os
import queue
import threading
import time
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cachetools
import jax
from jax.experimental.compilation_cache import compilation_cache
from jax.stages import Compiled, Lowered, Wrapped

from polar_bayes.errors import FitError
from polar_bayes.numerics.kept_programs import KeptProgram, kept_program, with_new_name
from polar_bayes.paths import compiled_folder, make_private
from polar_bayes.progress import Progress

COMPILER_OPTIONS = {"xla_backend_optimization_level": 1}
"""XLA's optimization level, of 0 to 3: fits run as fast as with 3, and the first fit of a layout
takes three quarters of the time. What the environment variable XLA_FLAGS says goes before it."""

CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")

_COMPILER_THREAD = ThreadPoolExecutor(1, "polar_bayes compiler")


class AbandonedError(Exception):
    """Ends a thread that passed its deadline."""


_ABANDONED: contextvars.ContextVar[threading.Event | None] = contextvars.ContextVar(
    "polar_bayes_abandoned", default=None
)
"""Event of a thread with a deadline, set when the deadline has passed."""


class _TracingLock:
    """A reentrant lock that abandoned threads cannot acquire."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()
        abandoned = _ABANDONED.get()
        if abandoned is not None and abandoned.is_set():
            self._lock.release()
            raise AbandonedError

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def wait(self) -> None:
        """Wait until no other thread is tracing; abandoned threads may wait, too."""
        with self._lock:
            pass


TRACING_LOCK = _TracingLock()
"""Lock held while a model is traced, but not while a program is compiled or runs."""


@functools.cache
def keep_compiled_programs() -> None:
    """Store compiled programs on disk between sessions, unless JAX is configured otherwise.

    A compiled program is native code that the next session loads, so a folder to which others can
    write is not used.
    """
    config = jax.config
    if config.jax_compilation_cache_dir is not None or not config.jax_enable_compilation_cache:
        return
    folder = compiled_folder()
    if make_private(folder):
        return
    config.update("jax_compilation_cache_dir", str(folder))
    config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    compilation_cache.reset_cache()  # JAX looks for the folder once, when it first compiles


def compiled(function: Callable) -> Wrapped:
    """Wrap a function in `jax.jit`, with `COMPILER_OPTIONS` on a CPU."""
    keep_compiled_programs()
    flags = os.environ.get("XLA_FLAGS", "")
    ours = {name: value for name, value in COMPILER_OPTIONS.items() if name not in flags}
    return jax.jit(function, compiler_options=ours if jax.default_backend() == "cpu" else None)


class JitOnce:
    """A function that is traced under the lock and compiled once per shape and device.

    The shape is that of the first argument; those of others must follow from it. With a key that
    no other function has, in any process, the next process loads the program from the disk.
    """

    def __init__(self, function: Callable, key: str = "") -> None:
        self.key = key
        self._function = function
        keep_compiled_programs()
        self._compilations: dict[Hashable, _Compilation] = {}

    @property
    def is_begun(self) -> bool:
        """True if a compilation has begun."""
        return bool(self._compilations)

    def __call__(self, *arguments: Any) -> Any:
        """Run the program, which the first call compiles."""
        return self.program(*arguments)(*arguments)

    def begin(self, *arguments: object) -> None:
        """Trace now and compile in another thread; arguments may be `ShapeDtypeStruct`."""
        if self._key(arguments) not in self._compilations:
            _COMPILER_THREAD.submit(self._trace(arguments).result)

    def program(self, *arguments: object) -> Callable:
        """Return the compiled program for arguments of these shapes and types."""
        found = self._compilations.get(self._key(arguments))
        return (found or self._trace(arguments)).result()

    def _trace(self, arguments: tuple) -> "_Compilation":
        with TRACING_LOCK:
            key = self._key(arguments)
            if key not in self._compilations:
                kept = kept_program(self.key, arguments)
                function = self._function if kept is None else with_new_name(self._function)
                lower = functools.partial(compiled(function).lower, *arguments)
                if kept is None or not kept.exists:
                    compile_now = lower().compile
                else:
                    double = jax.config.jax_enable_x64
                    compile_now = functools.partial(_trace_and_compile, lower, double)
                self._compilations[key] = _Compilation(compile_now, kept)
            return self._compilations[key]

    @staticmethod
    def _key(arguments: tuple) -> Hashable:
        shape = getattr(arguments[0], "shape", None)
        return shape, jax.config.jax_default_device  # a compiled program runs on one device


def _trace_and_compile(lower: Callable[[], Lowered], double: bool) -> Compiled:
    """Make a program in a thread that finds the kept one damaged."""
    with TRACING_LOCK, jax.enable_x64(double):
        lowered = lower()
    return lowered.compile()


class _Compilation:
    """A program that is kept on the disk or lowered, made once, by the first thread that asks."""

    def __init__(self, compile_now: Callable[[], Compiled], kept: KeptProgram | None) -> None:
        self._compile_now = compile_now
        self._kept = kept
        self._compiled: Compiled | None = None
        self._program: Compiled | None = None
        self._lock = threading.Lock()

    def result(self) -> Compiled:
        # A thread does not wait for the queue of `_COMPILER_THREAD`, which holds programs of other
        # fits: what is still in the queue is compiled by the thread that needs it.
        if self._program is not None:
            return self._program
        with self._lock:
            if self._compiled is None:
                self._compiled = self._make(self._compile_now)
                del self._compile_now  # it may hold readings
            check_memory(bytes_of(self._compiled))
            self._program = self._compiled
        return self._program

    def _make(self, compile_now: Callable[[], Compiled]) -> Compiled:
        if self._kept is not None and (found := self._kept.load()) is not None:
            return found
        found = compile_now()
        if self._kept is not None:
            _COMPILER_THREAD.submit(self._kept.save, found)
        return found


def bytes_of(program: Compiled) -> int:
    """Return the memory that a run of a program takes; 0 if the backend reports nothing."""
    analysis = program.memory_analysis()
    if analysis is None:
        return 0
    parts = ("argument", "output", "temp")
    return sum(int(getattr(analysis, f"{part}_size_in_bytes")) for part in parts)


def check_memory(needed: int) -> None:
    """Refuse a program that does not fit into memory before anything is allocated."""
    limit = memory_limit()
    if limit is not None and needed > limit:
        raise FitError(
            f"this fit would need {needed / 1e9:.1f} GB at once, of {limit / 1e9:.1f} GB",
            where="memory",
            hint="average neighboring views, or take a sample of them",
        )


def memory_limit() -> int | None:
    """Return bytes of the accelerator, or of machine and container; None if unknown."""
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


# --- A cache of compiled programs -----------------------------------------------------------------


class LRUCache[T]:
    """A thread-safe cache of the most recently used values."""

    def __init__(self, maxsize: int) -> None:
        self._values: cachetools.LRUCache[Hashable, T] = cachetools.LRUCache(maxsize)
        self._lock = threading.RLock()

    def get(self, key: Hashable) -> T | None:
        """Return the value of a key; None if it is not in the cache."""
        with self._lock:
            return self._values.get(key)

    def of(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of a key, computed if it is not in the cache."""
        with self._lock:
            if key not in self._values:
                self._values[key] = make()
            return self._values[key]


# --- Deadlines: compiled programs cannot be interrupted, but their thread can be abandoned --------


class OutOfTimeError(Exception):
    """The deadline passed before the work was done."""


def run_until[T](deadline: float, progress: Progress, work: Callable[[Progress], T]) -> T:
    """Run work in another thread, and abandon it at the deadline (`time.perf_counter`)."""
    # An abandoned thread ends when it next reports progress or tries to trace a model. It traces
    # nothing after this function has returned or raised, so NumPyro's handlers are not shared.
    if deadline == float("inf"):
        return work(progress)
    if time.perf_counter() >= deadline:
        raise OutOfTimeError("the time was up")
    reports: _Reports = queue.SimpleQueue()
    abandoned = threading.Event()
    outcome = _start(work, reports, abandoned)
    try:
        while True:
            remaining = max(deadline - time.perf_counter(), 0.0)
            report = reports.get(timeout=min(remaining, threading.TIMEOUT_MAX))
            if report is None:
                return outcome.result()
            progress(*report)
    except queue.Empty:
        raise OutOfTimeError("abandoned when the time was up") from None
    finally:
        abandoned.set()
        if not outcome.done():
            TRACING_LOCK.wait()


_Reports = queue.SimpleQueue[tuple[str, float] | None]
"""Progress reports of a thread; None marks its end."""


def _start[T](
    work: Callable[[Progress], T], reports: _Reports, abandoned: threading.Event
) -> Future[T]:
    """Run work in a new thread until it is abandoned."""
    enable_x64 = jax.config.jax_enable_x64  # a thread does not inherit it

    def report(stage: str, fraction: float) -> None:
        if abandoned.is_set():
            raise AbandonedError
        reports.put((stage, fraction))

    def run() -> T:
        _ABANDONED.set(abandoned)
        try:
            with jax.enable_x64(enable_x64):
                return work(report)
        finally:
            reports.put(None)

    # Not a daemon thread: an interpreter that shuts down while compiled code runs crashes.
    executor = ThreadPoolExecutor(1, "polar_bayes deadline")
    outcome = executor.submit(contextvars.copy_context().run, run)
    executor.shutdown(wait=False)
    return outcome
