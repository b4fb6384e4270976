"""What commands print: tables and counts."""

from pathlib import Path
from typing import Any

import click

import polar_bayes as pb

NOT_CONVERGED = 2
"""Exit status of a fit whose diagnostics fail."""


def status(result: Any) -> int:
    """Exit status of a fit; its problems and cautions go to the error stream."""
    verdict = pb.verdict(result)
    for problem in verdict.problems:
        click.echo(f"problem: {problem}", err=True)
    for caution in verdict.cautions:
        click.echo(f"caution: {caution}", err=True)
    return 0 if verdict.converged else NOT_CONVERGED


def print_table(result: Any) -> None:
    """A row per parameter."""
    rows = pb.json_summary(result)["parameters"]
    columns = ("mean", "sd", "q2.5", "q97.5", "r_hat", "ess_bulk")
    titles = ("mean", "sd", "2.5%", "97.5%", "R-hat", "ESS")
    width = max(map(len, rows))
    click.echo(" " * width + "".join(f"{title:>10}" for title in titles))
    for name, row in rows.items():
        cells = [row[column] for column in columns]
        texts = ["-" if cell is None else f"{cell:.4g}" for cell in cells[:4]]
        texts += ["-" if cells[4] is None else f"{cells[4]:.3f}"]
        texts += ["-" if cells[5] is None else f"{cells[5]:.0f}"]
        click.echo(f"{name:<{width}}" + "".join(f"{text:>10}" for text in texts))


def print_counts(capture: Any, out: Path) -> None:
    """What a capture holds, in one line."""
    counts = ", ".join(f"{number} {what}" for what, number in pb.count(capture).items())
    click.echo(f"{out}: {counts}")


def print_masked(capture: Any) -> None:
    """Why readings of a picture are masked, in one line; nothing where none is."""
    reasons = {
        str(name).removeprefix("masked_").replace("_", " "): int(number)
        for name, number in capture.attrs.items()
        if str(name).startswith("masked_") and number
    }
    if reasons:
        told = ", ".join(f"{number} {reason}" for reason, number in reasons.items())
        click.echo(f"masked: {told}")
