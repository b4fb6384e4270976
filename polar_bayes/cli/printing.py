"""Output of commands: sentences in their vocabulary, tables, JSON, and the verdict of a fit."""

import json
import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Literal

import click

import polar_bayes as pb
from polar_bayes.cli.wording import as_commands
from polar_bayes.repr_html import Table

if TYPE_CHECKING:  # a command that needs no numbers loads no library of numbers
    from polar_bayes.frames import Frame
    from polar_bayes.results import Fit, Result

NOT_CONVERGED = 2
"""Exit status of a fit whose diagnostics fail."""


def say(sentence: object, *, err: bool = False) -> None:
    """Print a sentence or an error of the package, with functions replaced by commands."""
    click.echo(as_commands(str(sentence)), err=err)


def print_json(value: object) -> None:
    """Print a value as strict JSON; its sentences name commands and options."""
    click.echo(json.dumps(_in_commands(value), indent=2, allow_nan=False))


def _in_commands(value: object) -> object:
    if isinstance(value, dict):
        return {key: _in_commands(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_in_commands(item) for item in value]
    return as_commands(value) if isinstance(value, str) else value


def json_rows(table: "Frame", orient: Literal["index", "records"] = "index") -> object:
    """Return the rows of a data frame by label, or as a list (`"records"`), for JSON."""
    return json.loads(table.to_json(orient=orient))


def print_frame(frame: "Frame", sentences: Iterable[str] = ()) -> None:
    """Print a data frame with four digits and - for missing numbers, and sentences below."""
    click.echo(Table.of_frame(frame, _text).to_text(sys.stdout))
    if sentences:
        say("\n".join(["", *sentences]))


def _text(cell: object) -> str:
    if cell is None or cell != cell:  # NaN
        return "-"
    if not isinstance(cell, float):
        return as_commands(str(cell))
    return f"{cell:.0f}" if 1e4 <= abs(cell) < 1e7 else f"{cell:.4g}"


# --- Fits -----------------------------------------------------------------------------------------


def print_verdict(result: "Result") -> int:
    """Print problems and cautions, or the checks made, on stderr; return the exit status."""
    verdict = pb.verdict(result)
    for problem in verdict.problems:
        say(f"problem: {problem}", err=True)
    print_cautions(verdict.cautions)
    for note in verdict.findings:
        say(f"note: {note}", err=True)
    if verdict.nothing_against:
        say(verdict.nothing_against, err=True)
    return 0 if verdict.passed else NOT_CONVERGED


def print_fit(result: "Fit", *, as_json: bool = False) -> int:
    """Print a row per parameter and the verdict; return the exit status."""
    if as_json:
        print_json(pb.diagnostics.json_summary(result))
    else:
        columns = ["mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk"]
        titles = ["mean", "sd", "2.5%", "97.5%", "R-hat", "ESS"]
        print_frame(pb.summary(result)[columns].set_axis(titles, axis="columns"))
        if words := list(_explanations(result)):
            click.echo("\n".join(["", *words]))
    return print_verdict(result)


def _explanations(result: "Fit") -> Iterator[str]:
    """Explain parameters whose names are not clear alone, with their units."""
    for name, variable in result["posterior"].data_vars.items():
        meaning, unit = (variable.attrs.get(key, "") for key in ("long_name", "units"))
        if meaning and not meaning.startswith(str(name).replace("_", " ")):
            yield f"{name}: {meaning}{'' if unit == '1' else f' [{unit}]'}"


def print_cautions(sentences: Iterable[str]) -> None:
    """Print cautions on the error stream."""
    for sentence in sentences:
        say(f"caution: {sentence}", err=True)
