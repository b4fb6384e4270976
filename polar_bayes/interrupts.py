"""Cleanups that run when a signal ends the program, newest first.

A signal reaches the main thread while others are inside compiled code, which cannot be interrupted.
The command line therefore ends the process at once (`polar_bayes.cli.entry`). Code that holds a
resource which must not outlive the process (temporary files, child processes, a hidden cursor)
registers its release here while it holds it.
"""

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

_CLEANUPS: dict[int, Callable[[], str | None]] = {}
_NUMBERS = itertools.count()
_LOCK = threading.Lock()


@contextlib.contextmanager
def on_interrupt(cleanup: Callable[[], str | None]) -> Iterator[None]:
    """Register a cleanup for the duration of a block; it may return a sentence to print."""
    with _LOCK:
        number = next(_NUMBERS)
        _CLEANUPS[number] = cleanup
    try:
        yield
    finally:
        with _LOCK:
            _CLEANUPS.pop(number, None)


def clean_up() -> list[str]:
    """Run every cleanup, newest first, even if others fail; return their sentences."""
    with _LOCK:
        cleanups = [_CLEANUPS[number] for number in sorted(_CLEANUPS, reverse=True)]
        _CLEANUPS.clear()
    sentences = []
    for cleanup in cleanups:
        with contextlib.suppress(Exception):  # the process ends in any case
            sentences.append(cleanup())
    return [sentence for sentence in sentences if sentence]


def resume_hint(path: Path) -> str:
    """Return the cleanup sentence of work that can be resumed."""
    return f"{path}: finished work is saved; repeat the command with --resume to continue"
