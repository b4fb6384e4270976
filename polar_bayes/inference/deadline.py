"""Work that is abandoned at a deadline, because what runs compiled cannot be interrupted."""

import contextvars
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future

import jax

from polar_bayes.inference.tracing import TRACING, AbandonedError
from polar_bayes.progress import Progress


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
            TRACING.refuse(self._thread)

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
