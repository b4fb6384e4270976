"""The process of a command: which signals end it, what libraries write to it, and how it ends.

Python runs signal handlers between two bytecodes of the main thread, which may be inside compiled
code for minutes. The command therefore runs in a thread of its own, and the main thread waits for
its end or for a signal. Compiled code cannot be called off, so a signal ends the whole process as
soon as the cleanups of `polar_bayes.interrupts` are done.
"""

import contextlib
import contextvars
import logging
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from typing import Any, NoReturn

import click

from polar_bayes.interrupts import clean_up

TRACEBACK = "POLAR_BAYES_TRACEBACK"
"""Environment variable: if it is set, tracebacks, warnings and logs of libraries are shown."""

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGHUP", "SIGINT", "SIGTERM") if hasattr(signal, name)
)

POLL, CLEAN_UP, LEAVE = 0.1, 3.0, 0.5
"""Seconds: between two looks for a signal; for all cleanups; for threads that are still alive."""

STACK = 16 * 2**20
"""Bytes of the stack of the command's thread: by default macOS gives threads 0.5 MiB."""

DAMAGED = "Error reading persistent compilation cache entry"


def run_until_signal(command: Callable[[], int]) -> int:
    """Run a command in a thread of its own; a signal ends the process."""
    # The first signal runs the cleanups and prints one line; the second ends the process at once.
    # Signals that the process was started to ignore (`nohup`) stay ignored.
    received: list[int] = []

    def receive(number: int, _: object) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)

    outcome: Future[int] = Future()
    with _handled_by(receive):
        _start(contextvars.copy_context(), command, outcome)
        while not wait([outcome], timeout=POLL).done:
            if received:
                _stop(received[0])
    return outcome.result()


@contextlib.contextmanager
def _handled_by(receive: Callable[[int, Any], None]) -> Iterator[None]:
    """Signal handlers while the block runs."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    handled = [number for number in SIGNALS if before[number] not in (signal.SIG_IGN, None)]
    for number in handled:
        signal.signal(number, receive)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, before[number])


def _start(context: contextvars.Context, command: Callable[[], int], outcome: Future[int]) -> None:
    """Start the thread of the command, whose end is that of `outcome`."""

    def work() -> None:
        try:
            outcome.set_result(context.run(command))
        except BaseException as error:
            outcome.set_exception(error)

    others = threading.stack_size(STACK)
    try:
        threading.Thread(target=work, name="polar-bayes command", daemon=True).start()
    finally:
        threading.stack_size(others)


def _stop(number: int) -> NoReturn:
    """Clean up and end the process; the main thread stays free for the next signal."""

    def say() -> None:
        text = ". ".join(["polar-bayes: stopped", *clean_up()])
        with contextlib.suppress(OSError, ValueError):  # nobody reads any more
            click.echo(text, err=True)
            sys.stdout.flush()

    cleaning = threading.Thread(target=say, daemon=True)
    cleaning.start()
    cleaning.join(CLEAN_UP)
    os._exit(128 + number)


def end(status: int) -> NoReturn:
    """End the process, without waiting for threads that compute what nobody needs any more."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)  # no traceback from here on
    threading.Thread(target=_leave, args=(status,), daemon=True).start()
    sys.exit(status)


def _leave(status: int) -> None:
    """End the process if threads keep it from ending: Python joins those that are no daemons."""
    time.sleep(LEAVE)
    main = threading.main_thread()
    if any(not each.daemon for each in threading.enumerate() if each is not main):
        clean_up()
        os._exit(status)


def quiet_libraries() -> None:
    """Keep what libraries log and warn from the user of the command line, who cannot act on it."""
    if os.environ.get(TRACEBACK):
        return
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA: slow compilation, other processors
    logging.getLogger().addHandler(logging.NullHandler())  # else Python writes them to stderr
    warnings.showwarning = _Warnings().show


class _Warnings:
    """One line about all damaged entries of the compilation cache; nothing about the rest."""

    def __init__(self) -> None:
        self._is_said = False

    def show(self, message: Warning | str, *_: Any, **__: Any) -> None:
        """Stands in for `warnings.showwarning`."""
        if str(message).startswith(DAMAGED) and not self._is_said:
            self._is_said = True
            folder = os.environ.get("JAX_COMPILATION_CACHE_DIR", "JAX_COMPILATION_CACHE_DIR")
            click.echo(
                f"{folder}: compiled programs there are damaged and are compiled again; "
                "delete the folder to have them kept",
                err=True,
            )
