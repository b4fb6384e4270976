"""Mistakes as a user types them: one line each, that of `mistakes.txt`, and nothing is written."""

import re
import shlex
from pathlib import Path

import pytest
from cases import each
from cli.test_wording import PYTHON, QUOTED

from polar_bayes.cli import main

MISTAKES = [
    tuple(pair.splitlines())
    for pair in Path(__file__).with_name("mistakes.txt").read_text().strip().split("\n\n")
]
"""A command, and what it says."""

PLACE = re.compile(r"^\w+\([^()]*\): ")
"""A part that a message is of, which is named as it is."""


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of every file."""
    found = {str(path): path.stat() for path in folder.rglob("*")}
    return {name: (about.st_size, about.st_mtime_ns) for name, about in found.items()}


@each(("command", "says"), MISTAKES)
def test_a_mistake_is_one_line_and_writes_nothing(
    command: str, says: str, inputs: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(inputs)
    before = state_of(inputs)
    assert main(shlex.split(command)) == 1
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    assert says in told.err
    assert not PYTHON.findall(QUOTED.sub("", PLACE.sub("", told.err)))
    assert not told.out
    assert state_of(inputs) == before
