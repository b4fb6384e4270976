"""One program with many commands.

Exit status: 0 done; 1 the input or the options are wrong (one line: where, what, the mend); 2 the
fit ran but its diagnostics fail, with the result still written.
"""

import os

import click
import platformdirs

import polar_bayes as pb
from polar_bayes.cli.captures import COMMANDS as OF_CAPTURES
from polar_bayes.cli.checks import COMMANDS as OF_CHECKS
from polar_bayes.cli.fits import COMMANDS as OF_FITS
from polar_bayes.cli.imports import COMMANDS as OF_IMPORTS


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Args:
        arguments: Words after the program's name; those of the process by default.

    Returns:
        The exit status.
    """
    _remember_compiled_programs()
    try:
        status = commands.main(arguments, prog_name="polar-bayes", standalone_mode=False)
    except click.exceptions.Abort:
        click.echo("polar-bayes: stopped", err=True)
        return 130
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "polar-bayes"
        line = " ".join(error.format_message().split())
        click.echo(f"{where}: {line} (see `{where} --help`)", err=True)
        return 1
    except pb.PolarBayesError as error:
        click.echo(str(error), err=True)
        return 1
    return int(status or 0)


def _remember_compiled_programs() -> None:
    """Keep compiled programs between runs; a second run of the same fit compiles nothing."""
    cache = platformdirs.user_cache_path("polar_bayes") / "compiled"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="polar_bayes")
def commands() -> None:
    """From polarization captures to calibrated posteriors of layered dielectrics."""


for _command in (*OF_CAPTURES, *OF_IMPORTS, *OF_FITS, *OF_CHECKS):
    commands.add_command(_command)
