"""One program with many commands.

Exit status: 0 done; 1 the input or the options are wrong, or something broke (one line: where,
what, the hint); 2 the fit ran but its diagnostics fail, with the result still written; 128 + n
stopped by signal n: 130 Ctrl-C, 143 terminated, 141 nobody reads the output.
"""

import os
import sys
import threading
import traceback
from pathlib import Path
from typing import NoReturn

import click

from polar_bayes.cli.captures import COMMANDS as OF_CAPTURES
from polar_bayes.cli.checks import COMMANDS as OF_CHECKS
from polar_bayes.cli.compile_cache import keep_compiled_programs
from polar_bayes.cli.fits import COMMANDS as OF_FITS
from polar_bayes.cli.imports import COMMANDS as OF_IMPORTS
from polar_bayes.cli.process import TRACEBACK, end, quiet_libraries, run_until_signal
from polar_bayes.errors import PolarBayesError, one_line
from polar_bayes.paths import system_error

BROKEN_PIPE = 141
"""Exit status of a program whose output nobody reads: 128 + SIGPIPE."""


def console() -> NoReturn:
    """The program `polar-bayes`: run the words of this process as a command, and end it."""
    end(main())


def main(arguments: list[str] | None = None) -> int:
    """Run one command."""
    if arguments is not None or threading.current_thread() is not threading.main_thread():
        return _run(arguments)
    return run_until_signal(_own_process)


def _own_process() -> int:
    """The command of the process itself; its output is flushed while an error still has a line."""
    quiet_libraries()
    keep_compiled_programs()
    status = _run(None)
    try:
        sys.stdout.flush()
    except OSError as error:
        # What is left in the buffer would be an error again when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE if isinstance(error, BrokenPipeError) else _last_resort(error)
    return status


def _run(arguments: list[str] | None) -> int:
    """Run one command; whatever goes wrong is one line."""
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
        click.echo(str(error), err=True)
        return 1
    except SystemExit as error:  # click, which replaces a stream whose pipe is broken
        if sys.stdout is not output:
            return BROKEN_PIPE
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except Exception as error:
        return _last_resort(error)
    return int(status or 0)


def _last_resort(error: Exception) -> int:
    """One line for an error that no command expects, and the exit status."""
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
    """From polarization captures to calibrated posteriors of layered dielectrics."""


for _command in (*OF_CAPTURES, *OF_IMPORTS, *OF_FITS, *OF_CHECKS):
    commands.add_command(_command)
