"""The command that compares scenes."""

from pathlib import Path
from typing import Any

import click

import polar_bayes as pb
from polar_bayes.cli.options import (
    FIT_METHOD,
    RESULT_FILE,
    capture_argument,
    command,
    json_option,
    json_rows,
    model_option,
    option,
    out_option,
    print_fit,
    print_frame,
    print_json,
    print_verdict,
    seed_option,
    view_limit_option,
)
from polar_bayes.progress import stages


@command()
@capture_argument
@out_option(RESULT_FILE, "Fit of the scenes that remain, stacked, to write.", required=False)
@model_option
@option("--method", type=FIT_METHOD, default="nuts", help="Of the fit that --out writes.")
@view_limit_option
@seed_option
@json_option
def scenes(
    capture: Path, out: Path | None, method: str, as_json: bool, **settings: Any
) -> int | None:
    """Compare scenes, from simple to complex; with --out, fit those that remain."""
    data = pb.load_capture(capture)
    found: Any
    with stages() as progress:
        if out is None:
            found = pb.compare_scenes(data, progress=progress, **settings)
        else:
            found = pb.fit(data, scene="auto", method=method, progress=progress, **settings)
            pb.save(found, out)
    table, sentences = pb.scenes.scene_table(found), pb.scenes.scene_sentences(found)
    if as_json:
        print_json({"scenes": json_rows(table), "sentences": sentences})
        return None if out is None else print_verdict(found)
    print_frame(table)
    click.echo("\n".join(["", *sentences]))
    if out is None:
        return None
    click.echo()
    return print_fit(found)


COMMANDS = (scenes,)
