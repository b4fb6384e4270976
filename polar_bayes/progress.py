"""Who watches a long run: a notebook, a terminal, or nobody.

A function that takes minutes has an argument `progress`. Where it is left out, bars appear in a
notebook and in a terminal, and nothing is written to a file, a pipe or a log. Bars go when the run
ends, so that a saved notebook does not keep them. In a notebook they are plain HTML that is
replaced: they need no widgets, and work wherever a notebook shows a picture.
"""

import functools
import html
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars

from polar_bayes.interrupts import on_interrupt

Progress = Callable[[str, float], None]
"""Called with the name of a stage and the fraction of it that is done."""

Counter = Callable[[int, int], None]
"""Called with how many are done, and how many there are."""

PAUSE = 0.2
"""Between two pictures of a notebook, unit second."""

_shown = threading.Lock()
"""Held while bars are shown: what a run calls itself adds none of its own."""


class _Board(Protocol):
    """Where bars are drawn."""

    def show(self, stage: str, done: float, every: float) -> None:
        """How much of a stage is done."""

    def clear(self) -> None:
        """Nothing is left."""


def no_progress(stage: object, done: object) -> None:
    """No progress to show."""


def with_progress[**P, R](run: Callable[P, R]) -> Callable[P, R]:
    """Give a function's `progress`, where it is left out, bars for its stages."""
    return _shows(run, stages)


def with_counter[**P, R](what: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Give a function's `progress`, where it is left out, a bar that counts."""
    return lambda run: _shows(run, lambda: counts(what))


def _shows[**P, R](run: Callable[P, R], bars: Callable[[], Any]) -> Callable[P, R]:
    @functools.wraps(run)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        if kwargs.get("progress") is not None:
            return run(*args, **kwargs)
        with bars() as progress:
            kwargs["progress"] = progress
            return run(*args, **kwargs)

    return wrapper


@contextmanager
def stages() -> Iterator[Progress]:
    """A bar for each stage, where somebody watches."""
    with _board("") as board:
        yield no_progress if board is None else lambda stage, share: board.show(stage, share, 1.0)


@contextmanager
def counts(what: str) -> Iterator[Counter]:
    """One bar that counts, with the time that is left, where somebody watches."""
    with _board(what) as board:
        yield no_progress if board is None else lambda done, every: board.show(what, done, every)


@contextmanager
def _board(what: str) -> Iterator[_Board | None]:
    """Where bars go; None where nobody watches, or bars are shown already."""
    kernel, console = _in_notebook(), Console(stderr=True)
    if not (kernel or console.is_terminal) or not _shown.acquire(blocking=False):
        yield None
        return
    board: _Board = _Notebook(what) if kernel else _Terminal(console, what)
    try:
        with on_interrupt(board.clear):  # the cursor of a terminal is hidden
            yield board
    finally:
        board.clear()
        _shown.release()


def _in_notebook() -> bool:
    """True in the kernel of a notebook, which has loaded IPython already."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return hasattr(shell, "kernel")


class _Terminal:
    """Bars of a terminal on the error stream."""

    def __init__(self, console: Console, what: str) -> None:
        columns = [
            BarColumn(),
            *([MofNCompleteColumn()] if what else []),
            TaskProgressColumn(show_speed=True) if what else TaskProgressColumn(),
            TimeRemainingColumn(),
        ]
        name = TextColumn("{task.description}", markup=False)
        self._bars = Bars(name, *columns, console=console, transient=True)
        self._tasks: dict[str, TaskID] = {}
        self._bars.start()

    def show(self, stage: str, done: float, every: float) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=every)
        self._bars.update(self._tasks[stage], completed=done, total=every)

    def clear(self) -> None:
        self._bars.stop()


class _Notebook:
    """Bars of a notebook: a piece of HTML that is replaced, and empty in the end."""

    def __init__(self, what: str) -> None:
        self._counts = bool(what)
        self._begin, self._last = time.monotonic(), 0.0
        self._stages: dict[str, tuple[float, float]] = {}
        self._handle: Any = None
        self._lock = threading.Lock()

    def show(self, stage: str, done: float, every: float) -> None:
        with self._lock:
            self._stages[stage] = done, every
            now = time.monotonic()
            if now - self._last >= PAUSE:
                self._last = now
                self._draw(now - self._begin)

    def clear(self) -> None:
        with self._lock:
            if self._handle is not None:
                self._handle.update({"text/html": "", "text/plain": ""}, raw=True)

    def _draw(self, seconds: float) -> None:
        texts = [
            f"{stage}: {f'{done:,} of {every:,}' if self._counts else f'{done:.0%}'}"
            for stage, (done, every) in self._stages.items()
        ]
        bars = "".join(
            f'<div><progress value="{done / max(every, 1e-9):.4f}" max="1" '
            f'style="width:14em;vertical-align:middle"></progress> {html.escape(text)}</div>'
            for text, (done, every) in zip(texts, self._stages.values(), strict=True)
        )
        picture = {
            "text/html": f'<div style="font:13px/1.5 system-ui,sans-serif">{bars}'
            f"<small>{seconds:.0f} s</small></div>",
            "text/plain": "\n".join(texts),
        }
        if self._handle is None:
            display = sys.modules["IPython.display"].display
            self._handle = display(picture, raw=True, display_id=True)
        else:
            self._handle.update(picture, raw=True)
