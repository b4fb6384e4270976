"""One thread at a time traces a model: NumPyro keeps one stack of handlers for the whole process.

Two threads that trace at once would find each other's handlers on it: a crash at best, another
model's values at worst. Only tracing and lowering hold that lock. What is traced compiles beside
anything else, once, and compiled programs run side by side: a thread whose result nobody waits for
any more keeps no other one from its work.
"""

import contextvars
import dataclasses
import os
import queue
import sys
import sysconfig
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
from dask.base import tokenize
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene
from polar_bayes.progress import Progress

COMPILER_OPTIONS = {"xla_backend_optimization_level": 1}
"""Of three levels: fits run as fast as with all, first ones take three quarters of the time."""

CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")

_COMPILER_THREAD = ThreadPoolExecutor(1, "polar_bayes compiles")


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


TRACING_LOCK = _Tracing()
"""Held while a model is traced; nobody compiles, runs or waits for a program while holding it."""


def compiled(function: Callable) -> Any:
    """The function as `jax.jit` has it, compiled with as much effort as running it pays back."""
    return jax.jit(
        function, compiler_options=COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
    )


class JitOnce:
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
            _COMPILER_THREAD.submit(self._traced(*arguments).result)

    def program(self, *arguments: Any) -> Callable:
        """The compiled program for arguments of these shapes and types."""
        run = self._run
        if run is None or self._device != jax.config.jax_default_device:
            run = self._run = self._traced(*arguments).result()
        return run

    def _traced(self, *arguments: Any) -> "_Compilation":
        with TRACING_LOCK:
            device = jax.config.jax_default_device  # a compiled program runs where it was made for
            if self._begun is None or self._device != device:
                self._begun, self._run = _Compilation(self._function.lower(*arguments)), None
                self._device = device
            return self._begun


class JitByShape:
    """The same for a function whose first argument comes in several shapes."""

    def __init__(self, function: Callable) -> None:
        self._function = function
        self._of_shape: dict[tuple[int, ...], JitOnce] = {}

    def begin(self, first: Any, *others: Any) -> None:
        """Trace it for arguments of such shapes, and compile it beside what follows."""
        self._of(first.shape).begin(first, *others)

    def __call__(self, first: Any, *others: Any) -> Any:
        """Run it; with a first argument of a new shape, trace and compile it before."""
        return self._of(first.shape)(first, *others)

    def _of(self, shape: tuple[int, ...]) -> JitOnce:
        found = self._of_shape.get(shape)
        return found or self._of_shape.setdefault(shape, JitOnce(self._function))


class _Compilation:
    """A traced program, compiled once, by whichever thread comes to it first."""

    def __init__(self, lowered: Any) -> None:
        self._lowered = lowered
        self._found: Callable | None = None
        self._lock = threading.Lock()

    def result(self) -> Callable:
        # A thread that waits for the queue of `_COMPILER_THREAD` would wait for programs of others,
        # too: it compiles what it needs itself, where that has not begun.
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
            hint="average neighboring views, or take a sample of them",
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


# --- What was compiled is kept for the next fit that is the same but for its readings -------------


INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib")})


class LRUCache[T]:
    """The last few things that were made, by key; safe to ask from several threads."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._found: dict[Any, T] = {}
        self._lock = threading.RLock()

    def of(self, key: Any, make: Callable[[], T]) -> T:
        """What has that key, made now if it is not kept."""
        with self._lock:
            found = self._found.pop(key) if key in self._found else make()
            self._found[key] = found
            while len(self._found) > self._most:
                del self._found[next(iter(self._found))]
            return found


def cache_key(
    model: Callable,
    scene: Scene,
    priors: Mapping[str, dist.Distribution],
    links: Mapping[str, AbstractLink],
    *further: Any,
) -> str:
    """A text that is the same for stories whose programs are the same."""
    parts = [
        model,
        dataclasses.replace(scene),  # without its ledger
        # Not the priors themselves: distributions keep what they have computed.
        *(
            (name, jax.tree.leaves(prior), str(jax.tree.structure(prior)))
            for name, prior in priors.items()
        ),
        links,
        last_edit(),
        *further,
    ]
    # One by one: a token depends on which objects of what it is made of are the same one.
    return tokenize([tokenize(part) for part in parts])


def layout_of(data: Observations) -> tuple[str, ...]:
    """What programs know of a capture: variables, axes, lengths and types, and no reading."""
    return (str(jax.tree.structure(data)), *(f"{x.dtype}{x.shape}" for x in jax.tree.leaves(data)))


def last_edit() -> int:
    """When a module that is not installed was edited last, in ns."""
    # A model, link or part of the user's own that is edited and loaded again has the name that it
    # had before. What was compiled of the old one must not answer for it.
    edits = [0]
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if file and not file.startswith(INSTALLED):
            try:
                edits.append(Path(file).stat().st_mtime_ns)
            except OSError:  # in an archive, or gone
                continue
    return max(edits)


# --- Work that is abandoned at a deadline, because what runs compiled cannot be interrupted -------


class OutOfTimeError(Exception):
    """The deadline passed before the work was done."""


def run_until[T](deadline: float, progress: Progress, work: Callable[[Progress], T]) -> T:
    """Do work in a thread of its own, and go on without it after the deadline."""
    # Compilation and compiled programs cannot be interrupted from Python. An abandoned thread ends
    # when it next reports progress or wants to trace a model; it traces nothing after this function
    # has returned or raised, so that it never meets the caller in NumPyro's stack of handlers.
    if deadline == float("inf"):
        return work(progress)
    if time.perf_counter() >= deadline:
        raise OutOfTimeError("the time was up")
    task = _Task(work)
    try:
        while True:
            left = max(deadline - time.perf_counter(), 0.0)
            said = task.reports.get(timeout=min(left, threading.TIMEOUT_MAX))
            if said is None:
                return task.outcome.result()
            progress(*said)
    except queue.Empty:
        raise OutOfTimeError("abandoned when the time was up") from None
    finally:
        task.abandon()


class _Task[T]:
    """Work in a thread of its own."""

    def __init__(self, work: Callable[[Progress], T]) -> None:
        self.outcome: Future[T] = Future()
        self.reports: queue.SimpleQueue[tuple[str, float] | None] = queue.SimpleQueue()
        self._work, self._abandoned = work, threading.Event()
        self._in_double = jax.config.jax_enable_x64
        # Not a daemon: an interpreter that shuts down under compiled code crashes.
        self._thread = threading.Thread(
            target=contextvars.copy_context().run, args=(self._run,), name="polar_bayes in time"
        )
        self._thread.start()

    def abandon(self) -> None:
        """Nobody waits any more; nothing happens where it is done."""
        self._abandoned.set()
        if not self.outcome.done():
            TRACING_LOCK.refuse(self._thread)

    def _run(self) -> None:
        try:
            with jax.enable_x64(self._in_double):  # a thread does not inherit it
                self.outcome.set_result(self._work(self._report))
        except BaseException as error:  # raised again where somebody waits
            self.outcome.set_exception(error)
        self.reports.put(None)

    def _report(self, stage: str, fraction: float) -> None:
        if self._abandoned.is_set():
            raise AbandonedError
        self.reports.put((stage, fraction))
