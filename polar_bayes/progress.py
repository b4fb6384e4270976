"""Progress bars of long runs, shown in terminals and notebooks only.

A function that takes minutes has an argument `progress`. If it is omitted, Rich draws bars in a
notebook and in a terminal, and nothing is written to a file, a pipe or a log. Bars are erased when
the run ends, so that a saved notebook does not contain them.

The command line, whose error stream is often a pipe, calls `write_lines`: a stage that takes long
is then told in a line from time to time.
"""

import functools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, cast, override

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars

from polar_bayes.interrupts import on_interrupt

Progress = Callable[[str, float], None]
"""Function of the name of a stage and the completed fraction of it."""

Counter = Callable[[int, int], None]
"""Function of the number of completed items and the total number."""

REFRESH_SECONDS = 0.2
"""Shortest time between two updates of a notebook."""

LINE_SECONDS, MOST_LINE_SECONDS = 10.0, 80.0
"""Time until the first line of a log, which doubles from line to line, and its upper limit."""

_write_line: list[Callable[[str], object]] = []
"""Function that writes lines of a log, if set."""

_bars_are_shown = threading.Lock()
"""Lock that is held while bars are shown, so that nested runs add none."""


def write_lines(write: Callable[[str], object]) -> None:
    """Report the progress of long runs as lines of a log where bars cannot be shown.

    Args:
        write: Called with each line.
    """
    _write_line[:] = [write]


def notice(text: str) -> None:
    """Print a sentence in a terminal or notebook, or write it to the log."""
    console = Console(stderr=True)
    if _in_notebook() or console.is_terminal:
        console.print(text, markup=False, highlight=False, soft_wrap=True)  # above the bars
    elif _write_line:
        _write_line[0](text)


def no_progress(stage: object, done: object) -> None:
    """Discard progress."""


def with_progress[**P, R](run: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function to show a bar per stage if its argument `progress` is omitted."""
    return _with_default(run, stages)


def with_counter[**P, R](what: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a function to show a counting bar if its argument `progress` is omitted."""
    return lambda run: _with_default(run, lambda: counts(what))


def _with_default[**P, R](
    run: Callable[P, R], bars: Callable[[], AbstractContextManager[object]]
) -> Callable[P, R]:
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
    """Show one bar per stage in a terminal or notebook."""
    with _bars(TaskProgressColumn()) as show:
        yield lambda stage, fraction: show(stage, fraction, 1.0)


@contextmanager
def counts(what: str) -> Iterator[Counter]:
    """Show one bar that counts in a terminal or notebook."""
    with _bars(MofNCompleteColumn(), TaskProgressColumn(show_speed=True)) as show:
        yield lambda done, total: show(what, done, total)


@contextmanager
def _bars(*columns: ProgressColumn) -> Iterator[Callable[[str, float, float], None]]:
    """Yield a function of stage, completed amount and total that updates bars."""
    notebook, console = _in_notebook(), Console(stderr=True)
    watched = notebook or console.is_terminal
    if not (watched or _write_line) or not _bars_are_shown.acquire(blocking=False):
        yield lambda stage, done, total: None
        return
    if not watched:
        with _lines(_write_line[0]) as tell:
            yield tell
        return
    bars = (_NotebookBars if notebook else Bars)(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        *columns,
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )
    tasks: dict[str, TaskID] = {}

    def show(stage: str, done: float, total: float) -> None:
        if stage not in tasks:
            tasks[stage] = bars.add_task(stage, total=total)
        bars.update(tasks[stage], completed=done, total=total, refresh=notebook)

    try:
        with on_interrupt(bars.stop), bars:  # `stop` shows the cursor of the terminal again
            yield show
    finally:
        _bars_are_shown.release()


@contextmanager
def _lines(write: Callable[[str], object]) -> Iterator[Callable[[str, float, float], None]]:
    """Yield the same function, which writes the current stage to the log from time to time."""
    begin, ended, now = time.monotonic(), threading.Event(), ["compiling"]

    def show(stage: str, done: float, total: float) -> None:
        # What comes after the end of a stage is compiled before it begins.
        now[0] = f"{stage}, {done / total:.0%}" if done < total else f"compiling, after {stage}"

    def tell() -> None:
        wait = LINE_SECONDS
        while not ended.wait(wait):
            write(f"{time.monotonic() - begin:.0f} s: {now[0]}")
            wait = min(2.0 * wait, MOST_LINE_SECONDS)

    writer = threading.Thread(target=tell, daemon=True)
    writer.start()
    try:
        yield show
    finally:
        ended.set()
        writer.join()
        _bars_are_shown.release()


def _in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook: it has loaded IPython."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


class _NotebookBars(Bars):
    """Bars in one output cell as HTML without widgets; the cell is emptied at the end."""

    # Rich's own bars in a notebook require ipywidgets and leave a dead widget in the saved file.

    _handle: Any = None
    _next_refresh = 0.0

    @override
    def start(self) -> None:
        """Start without a live display."""

    @override
    def refresh(self) -> None:
        with self._lock:
            if time.monotonic() < self._next_refresh:
                return
            self._next_refresh = time.monotonic() + REFRESH_SECONDS
            bundle = cast(Any, self)._repr_mimebundle_((), ())
            if self._handle is None:
                display = sys.modules["IPython.display"].display
                self._handle = display(bundle, raw=True, display_id=True)
            else:
                self._handle.update(bundle, raw=True)

    @override
    def stop(self) -> None:
        with self._lock:
            if self._handle is not None:
                self._handle.update({"text/html": "", "text/plain": ""}, raw=True)
