"""The program `polar-bayes`: its process, signals, exit status and commands.

Exit status: 0 done; 1 the input or the options are wrong, or something broke (one line: where,
what, the hint); 2 the fit ran but its diagnostics fail, with the result still written; 128 + n
stopped by signal n: 130 Ctrl-C, 143 terminated, 141 the reader of the output ended.

Python runs signal handlers between two bytecodes of the main thread, which may be inside compiled
code for minutes. The command therefore runs in a thread of its own, and the main thread waits for
its end or for a signal. Compiled code cannot be called off, so a signal ends the whole process as
soon as the cleanups of `polar_bayes.interrupts` are done.

A compiled program is native code that the next run loads, so whoever can write it can run it.
"""

import atexit
import contextlib
import contextvars
import ctypes
import functools
import gc
import logging
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import NoReturn

import click

from polar_bayes.cli.captures import COMMANDS as CAPTURE_COMMANDS
from polar_bayes.cli.checks import COMMANDS as CHECK_COMMANDS
from polar_bayes.cli.fits import COMMANDS as FIT_COMMANDS
from polar_bayes.cli.printing import say
from polar_bayes.errors import PolarBayesError, one_line
from polar_bayes.interrupts import clean_up
from polar_bayes.paths import compiled_folder, make_private, system_error
from polar_bayes.progress import write_lines

# --- The process of a command ---------------------------------------------------------------------

TRACEBACK = "POLAR_BAYES_TRACEBACK"
"""Environment variable: if it is set, tracebacks, warnings and logs of libraries are shown."""

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGHUP", "SIGINT", "SIGTERM") if hasattr(signal, name)
)

POLL, CLEAN_UP, LEAVE = 0.1, 3.0, 0.5
"""Seconds between polls for a signal; seconds allowed for all cleanups, and for threads that are
still alive."""

FOLDER = "JAX_COMPILATION_CACHE_DIR"


def run_until_signal(command: Callable[[], int]) -> int:
    """Run a command in its own thread; a signal ends the process."""
    # The first signal runs the cleanups and prints one line; the second ends the process at once.
    # Signals that the process was started to ignore (`nohup`) stay ignored.
    received: list[int] = []

    def receive(number: int, _: object) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)

    outcome: Future[int] = Future()
    before = {number: signal.getsignal(number) for number in SIGNALS}
    handled = [number for number in SIGNALS if before[number] not in (signal.SIG_IGN, None)]
    for number in handled:
        signal.signal(number, receive)
    try:
        _start(contextvars.copy_context(), command, outcome)
        while not wait([outcome], timeout=POLL).done:
            if received:
                _stop(received[0])
    finally:
        for number in handled:
            signal.signal(number, before[number])
    return outcome.result()


def _start(context: contextvars.Context, command: Callable[[], int], outcome: Future[int]) -> None:
    """Run the command in a thread that sets `outcome`."""

    def work() -> None:
        try:
            outcome.set_result(context.run(command))
        except BaseException as error:
            outcome.set_exception(error)

    default_size = threading.stack_size(16 * 2**20)  # by default macOS gives threads 0.5 MiB
    try:
        threading.Thread(target=work, name="polar-bayes command", daemon=True).start()
    finally:
        threading.stack_size(default_size)


def _stop(number: int) -> NoReturn:
    """Clean up and end the process; meanwhile the main thread can receive the next signal."""

    def work() -> None:
        text = ". ".join(["polar-bayes: stopped", *clean_up()])
        with contextlib.suppress(OSError, ValueError):  # the reader of the pipe has ended
            click.echo(text, err=True)
            sys.stdout.flush()

    cleaning = threading.Thread(target=work, daemon=True)
    cleaning.start()
    cleaning.join(CLEAN_UP)
    os._exit(128 + number)


def end(status: int) -> NoReturn:
    """End the process without waiting for threads whose results are no longer needed."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)  # no traceback from here on
    threading.Thread(target=_leave, args=(status,), daemon=True).start()
    sys.exit(status)


def _leave(status: int) -> None:
    """End the process if threads keep it alive: Python joins threads that are not daemons."""
    time.sleep(LEAVE)
    main = threading.main_thread()
    if any(not each.daemon for each in threading.enumerate() if each is not main):
        clean_up()
        os._exit(status)


def quiet_libraries() -> None:
    """Hide logs and warnings of libraries, on which users of the command line cannot act."""
    if os.environ.get(TRACEBACK):
        return
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA: slow compilation, other processors
    logging.getLogger().addHandler(logging.NullHandler())  # else Python writes them to stderr
    damaged: list[str] = []
    start = "Error reading persistent compilation cache entry"

    def show(message: Warning | str, *_: object, **__: object) -> None:
        """Print one line about all damaged entries of the compilation cache, and nothing else."""
        if str(message).startswith(start) and not damaged:
            damaged.append(str(message))
            click.echo(
                f"{os.environ.get(FOLDER, FOLDER)}: compiled programs there are damaged and are "
                "compiled again; delete the folder to have them kept",
                err=True,
            )

    warnings.showwarning = show


# --- The folder of compiled programs, to which no other user may write ----------------------------


def keep_compiled_programs() -> None:
    """Keep compiled programs between runs; a second run of the same fit compiles nothing."""
    # The folder that the user gives by JAX_COMPILATION_CACHE_DIR is used as it is. The own one is
    # not used where other users could write to it; one line on stderr says so.
    if FOLDER not in os.environ:
        folder = compiled_folder()
        if problem := make_private(folder):
            hint = f"change that, or set {FOLDER} to a folder of your own"
            click.echo(f"{folder}: compiled programs are not kept: {problem}; {hint}", err=True)
            return
        os.environ[FOLDER] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


# --- Memory ---------------------------------------------------------------------------------------


def limit_arenas() -> None:
    """Make threads share two malloc arenas, so that the memory of a map does not grow with size."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(-8, 2)  # M_ARENA_MAX of the C library of GNU


# --- Running a command ----------------------------------------------------------------------------


BROKEN_PIPE = 141
"""Exit status of a program whose pipe is broken: 128 + SIGPIPE."""


def console() -> NoReturn:
    """The program `polar-bayes`: run the arguments of this process as a command, and end it."""
    status: list[int] = []

    def leave() -> None:
        if status:  # else Python has an error to print
            os._exit(status[0])

    # What is registered before libraries are imported runs after theirs. Python would go on to free
    # every object, for a second.
    atexit.register(leave)
    status.append(main())
    end(status[0])


def main(arguments: list[str] | None = None) -> int:
    """Run one command."""
    if arguments is not None or threading.current_thread() is not threading.main_thread():
        return _run(arguments)
    return run_until_signal(_own_process)


def _own_process() -> int:
    """Run the command of the process itself, and flush its output before errors are printed."""
    gc.set_threshold(100_000, 50)  # traces are many objects and few cycles: a tenth of a fit
    limit_arenas()
    quiet_libraries()
    keep_compiled_programs()
    write_lines(functools.partial(click.echo, err=True))
    status = _run(None)
    try:
        sys.stdout.flush()
    except OSError as error:
        # What is left in the buffer would be an error again when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE if isinstance(error, BrokenPipeError) else _last_resort(error)
    return status


def _run(arguments: list[str] | None) -> int:
    """Run one command, and print any error on one line."""
    output = sys.stdout
    try:
        status = commands.main(arguments, prog_name="polar-bayes", standalone_mode=False)
    except (click.exceptions.Abort, KeyboardInterrupt):
        click.echo("polar-bayes: stopped", err=True)
        return 130
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "polar-bayes"
        line = " ".join(error.format_message().split())
        click.echo(f"{where}: {line} (see `{where} --help`)", err=True)
        return 1
    except PolarBayesError as error:
        say(error, err=True)
        return 1
    except SystemExit as error:  # click, which replaces a stream whose pipe is broken
        if sys.stdout is not output:
            return BROKEN_PIPE
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except Exception as error:
        return _last_resort(error)
    return int(status or 0)


def _last_resort(error: Exception) -> int:
    """Print an unexpected error on one line, and return the exit status."""
    if os.environ.get(TRACEBACK):
        traceback.print_exception(error)
    said = next(iter(str(error).strip().splitlines()), "")[:200]  # the hint must fit beside it
    kind = type(error).__name__
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in said:
        line = f"out of memory ({kind}: {said}); give it less at a time: readings, pixels or draws"
    elif isinstance(error, OSError) and error.errno is not None:
        line = str(system_error(error, Path(error.filename or "the operating system")))
    else:
        line = (
            f"internal error ({kind}: {said}); this is a defect of polar_bayes: "
            f"set {TRACEBACK}=1 for the traceback and report it"
        )
    click.echo(f"polar-bayes: {one_line(line)}", err=True)
    return 1


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="polar_bayes")
def commands() -> None:
    """Turn polarization captures into calibrated posteriors of layered dielectrics."""


for _command in (*CAPTURE_COMMANDS, *FIT_COMMANDS, *CHECK_COMMANDS):
    commands.add_command(_command)
