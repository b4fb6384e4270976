"""What commands print names options and commands; no sentence keeps its Python form."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from cases import each
from synthetic_results import edit_provenance, make_result, replace

import polar_bayes as pb
from polar_bayes.cli import main
from polar_bayes.cli.entry import commands
from polar_bayes.cli.wording import FUNCTIONS, KEYWORDS, OF_IMPORTS, as_commands

ROOT = Path(__file__).parents[2]

SENTENCES = [
    tuple(pair.splitlines())
    for pair in Path(__file__).with_name("wording.txt").read_text().split("\n\n")
]
"""Each sentence as Python says it, and as commands do."""


@each(("python", "command"), SENTENCES)
def test_advice_names_options_and_commands(python: str, command: str) -> None:
    said = as_commands(python)
    assert said == command
    assert as_commands(said) == said


def test_every_option_and_command_that_is_named_exists() -> None:
    found = {path: command for path, command in _commands(commands, "")}
    assert set(FUNCTIONS.values()) <= set(found)
    options = {flag for command in found.values() for each in command.params for flag in each.opts}
    assert set(KEYWORDS.values()) <= options


def _commands(group: click.Group, path: str) -> Iterator[tuple[str, click.Command]]:
    for name, command in group.commands.items():
        yield f"{path}{name}", command
        if isinstance(command, click.Group):
            yield from _commands(command, f"{path}{name} ")


QUOTED = re.compile(r"--(?:method|prior|link) '[^']*'|--known \S+")
PYTHON = re.compile(r"polar_bayes\.[a-z_]+|\bpb\.|\b[a-z_]+='|\b[a-z_]+=[\d.]")

VALUES = re.compile(
    r"(?:\w+\([^()]*\)(?:, | or |$))+(?:None)?|TruncatedNormal\(X, [X\d.]+, low=1\)"
)
"""Parts of a scene and priors, which a scene file and `--prior` take as they are."""

OUT_OF_REACH = re.compile(
    r"predict_spectrum\(|ClearCoat\(absorbance|polar_bayes\.summary has|read it first: pb\.|"
    r"^Such as '"
)
"""Hints for functions and arguments that no command calls or takes, and the help of options."""


def test_no_sentence_of_the_package_keeps_its_python_form() -> None:
    left = [
        f"{path.name}: {said}"
        for folder in ("polar_bayes", "models")
        for path in (ROOT / folder).rglob("*.py")
        for text in _texts(ast.parse(path.read_text()))
        if PYTHON.search(QUOTED.sub("", said := as_commands(text)))
        if " " in text and not VALUES.fullmatch(text) and not OUT_OF_REACH.search(text)
    ]
    assert not left


def test_no_sentence_of_an_import_keeps_an_argument_of_python() -> None:
    names = [f"{name}(?!=)" for name in OF_IMPORTS if "_" in name]
    argument = re.compile(
        rf"(?<!attribute )\b(?:{'|'.join(names)})\b|\b(?:{'|'.join(OF_IMPORTS)})="
    )
    left = [
        f"{path.name}: {said}"
        for path in (ROOT / "polar_bayes" / "importers").rglob("*.py")
        for text in _texts(ast.parse(path.read_text()))
        if " " in text and re.search(argument, said := as_commands(text))
    ]
    assert not left


def _texts(tree: ast.AST) -> Iterator[str]:
    """Every text of a program but its docstrings, with X for what is filled in."""
    inside = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr | ast.Expr)
        for part in ast.walk(node)
        if part is not node and (isinstance(node, ast.JoinedStr) or part is node.value)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = (each.value if isinstance(each, ast.Constant) else "X" for each in node.values)
            yield "".join(map(str, parts))
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in inside
        ):
            yield node.value


# --- A bad fit, as commands print it --------------------------------------------------------------


@pytest.fixture(scope="module")
def bad_fit():
    """Chains that disagree and diverged, readings that are far out, and a prior in conflict."""
    result = make_result(wavelengths=(), views=20, draws=150, variables=("dop",), noise=4.0)
    draws = result["posterior"].to_dataset()["roughness"].to_numpy().copy()
    draws[0] += 1.0
    result = replace(result, "posterior", "roughness", draws)
    for name, share in (("diverging", 0.1), ("reached_max_treedepth", 0.5)):
        stats = result["sample_stats"].to_dataset()
        flags = np.random.default_rng(0).uniform(size=(4, 150)) < share
        result["sample_stats"] = stats.assign({name: (("chain", "draw"), flags)})
    return edit_provenance(
        result,
        prior_probability={"roughness": [1.0 - 1e-9]},
        modes={"weights": [0.6, 0.4]},
        counts={"views": 20, "masked": 8},
        scene_chosen_by="default",
        links={name: str(link) for name, link in pb.setups.SETUPS["paper"].links.items()},
        priors={"angle_zero": "Normal(loc=0.0, scale=0.75)"},
        capture={"name": "plate", "angle_set_by": "hand"},
        problems=["the mode is not settled: use method='nuts'"],
    )


@each("as_json", [False, True])
def test_a_bad_fit_is_told_in_the_words_of_the_command_line(
    as_json: bool, bad_fit, plate: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.setattr(pb, "fit", lambda *_, **__: bad_fit)
    out = str(tmp_path / "fit.nc")
    words = ["fit", str(plate), *(["--json"] if as_json else []), "--out", out]
    assert main(words) == 2
    told = capsys.readouterr()
    assert not PYTHON.findall(QUOTED.sub("", told.out + told.err))
    for words in (
        "problem: The mode is not settled: use --method nuts.",
        "as in --warmup 1000 --most-draws 20000,",
        "as in --target-acceptance 0.99,",
        "as in --max-tree-depth 10.",
        f"polar-bayes scenes {plate}",
        "state it by --setup at import or --scene, or let --scene auto",
        "caution: 8 of 20 readings are marked 0 in column valid",
    ):
        assert words in told.err
    if as_json:
        told = json.loads(told.out)
        assert "as in --target-acceptance 0.99" in " ".join(told["problems"])
        (note,) = told["notes"]
        assert note.endswith("raise it, as in --max-tree-depth 10.")
        assert "outliers" in told["checked"]


def test_a_good_fit_tells_what_was_checked(plate, tmp_path, capsys, monkeypatch) -> None:
    result = make_result(wavelengths=(), views=20, draws=150, variables=("dop",))
    monkeypatch.setattr(pb, "fit", lambda *_, **__: result)
    assert main(["fit", str(plate), "--json", "--out", str(tmp_path / "fit.nc")]) == 0
    told = capsys.readouterr()
    checked = json.loads(told.out)["checked"]
    assert checked[:2] == ["chains (R-hat, effective sample sizes, divergences)", "priors"]
    assert (
        "Nothing speaks against the intervals in what was checked: "
        f"{', '.join(checked[:-1])} and {checked[-1]}."
    ) in told.err
    assert "caution" not in told.err
