"""Work under a deadline: done in time it is as if called directly; else it is abandoned."""

import threading
import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polar_bayes.numerics.compile import (
    TRACING_LOCK,
    AbandonedError,
    JitOnce,
    OutOfTimeError,
    run_until,
)
from polar_bayes.progress import Progress, no_progress

LONG = 60.0
"""Seconds after which a test has failed for certain."""


class Stuck:
    """Work that goes on, reporting nothing, until it is let go; then it does what it still can."""

    def __init__(self) -> None:
        self.begun, self.release, self.ended = (threading.Event() for _ in range(3))
        self.said: list[str] = []

    def __call__(self, progress: Progress) -> None:
        self.begun.set()
        self.release.wait(LONG)
        for name, attempt in (("report", lambda: progress("late", 1.0)), ("trace", self._trace)):
            try:
                attempt()
            except AbandonedError:
                self.said.append(f"no {name}")
        self.ended.set()

    @staticmethod
    def _trace() -> None:
        JitOnce(lambda x: x + 1.0)(jnp.ones(2))


@pytest.fixture
def stuck() -> Iterator[Stuck]:
    work = Stuck()
    yield work
    work.release.set()
    assert not work.begun.is_set() or work.ended.wait(LONG)


def after(seconds: float) -> float:
    return time.perf_counter() + seconds


def test_work_done_in_time_is_as_if_called_directly() -> None:
    reports: list[tuple[str, float, bool]] = []
    here = threading.current_thread()

    def progress(stage: str, fraction: float) -> None:
        reports.append((stage, fraction, threading.current_thread() is here))

    def work(progress: Progress) -> np.ndarray:
        progress("half", 0.5)
        return np.asarray(jnp.ones(2) / 3.0)

    for double in (True, False):
        with jax.enable_x64(double):
            found = run_until(after(LONG), progress, work)
        assert found.dtype == (np.float64 if double else np.float32)
    assert reports == [("half", 0.5, True)] * 2


@pytest.mark.thorough
def test_without_a_deadline_there_is_no_thread() -> None:
    here = threading.current_thread()
    found = run_until(float("inf"), no_progress, lambda _: threading.current_thread())
    assert found is here
    assert run_until(1e300, no_progress, lambda _: threading.current_thread()) is not here


def test_what_reports_nothing_is_abandoned_at_the_deadline(stuck: Stuck) -> None:
    late: list[str] = []
    with pytest.raises(OutOfTimeError, match="abandoned when the time was up"):
        run_until(after(0.2), lambda stage, _: late.append(stage), stuck)
    assert not stuck.ended.is_set()
    # It ends where it next reports progress, and it traces no model beside whoever goes on.
    stuck.release.set()
    assert stuck.ended.wait(LONG)
    assert stuck.said == ["no report", "no trace"]
    assert late == []


def test_after_the_deadline_nothing_begins(stuck: Stuck) -> None:
    with pytest.raises(OutOfTimeError, match=r"^the time was up"):
        run_until(after(-1.0), no_progress, stuck)
    assert not stuck.begun.is_set()


@pytest.mark.thorough
def test_an_error_of_the_work_is_raised_where_it_is_waited_for() -> None:
    def fail(progress: Progress) -> None:
        raise ZeroDivisionError("of the work")

    with pytest.raises(ZeroDivisionError, match="of the work"):
        run_until(after(LONG), no_progress, fail)


def test_an_interrupt_of_the_caller_abandons_the_work(stuck: Stuck) -> None:
    def interrupted(stage: str, fraction: float) -> None:
        raise KeyboardInterrupt

    def work(progress: Progress) -> None:
        progress("begun", 0.0)
        stuck(progress)

    with pytest.raises(KeyboardInterrupt):
        run_until(after(LONG), interrupted, work)
    stuck.release.set()
    assert stuck.begun.wait(LONG)
    assert stuck.ended.wait(LONG)
    assert stuck.said == ["no report", "no trace"]


@pytest.mark.thorough
def test_a_caller_waits_until_the_abandoned_thread_is_not_tracing() -> None:
    """NumPyro's handlers are those of the process: nobody may trace beside an abandoned trace."""
    tracing, ended = threading.Event(), threading.Event()

    def work(progress: Progress) -> None:
        with TRACING_LOCK:
            tracing.set()
            time.sleep(0.5)
            ended.set()

    with pytest.raises(OutOfTimeError):
        run_until(after(0.2), no_progress, work)
    assert tracing.is_set()
    assert ended.is_set()
