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
from polar_bayes.cli.wording import FUNCTIONS, KEYWORDS, as_commands

ROOT = Path(__file__).parents[2]

SENTENCES = {
    "so sample longer, as in Nuts(warmup=1000, most_draws=20000), and": (
        "so sample longer, as in --warmup 1000 --most-draws 20000, and"
    ),
    "raise it, as in Nuts(max_tree_depth=10).": "raise it, as in --max-tree-depth 10.",
    "give Nuts(chains=8, draws=900).": "give --method 'Nuts(chains=8, draws=900)'.",
    "compare Importance(draws=2048, rounds=6), or": (
        "compare --method 'Importance(draws=2048, rounds=6)', or"
    ),
    "use method='importance' or 'nuts' where that matters": (
        "use --method importance or nuts where that matters"
    ),
    "chains (pb.methods.Nuts()) are": "chains (--method nuts) are",
    "give settings such as polar_bayes.methods.Nuts()": "give settings such as --method nuts",
    "as in --method 'Nuts(most_draws=20000)', or": "as in --method 'Nuts(most_draws=20000)', or",
    "try polar_bayes.compare_scenes.": "try polar-bayes scenes capture.nc.",
    "or compare_scenes and then": "or polar-bayes scenes capture.nc and then",
    "state it by setup= at import or scene=, or let scene='auto' of a fit choose.": (
        "state it by --setup at import or --scene, or let --scene auto of a fit choose."
    ),
    "beyond, give priors={'refractive_index': TruncatedNormal(2, 0.3, low=1)}.": (
        "beyond, give --prior 'refractive_index=TruncatedNormal(2, 0.3, low=1)'."
    ),
    "priors['bend']: it has no prior; give one: priors={'bend': <a NumPyro distribution>}": (
        "--prior bend: it has no prior; give one: --prior 'bend=DISTRIBUTION'"
    ),
    "truncate it, for example TruncatedNormal(..., low=1)": (
        "truncate it, for example --prior 'NAME=TruncatedNormal(..., low=1)'"
    ),
    "links['dop']: no link": "--link dop: no link",
    "give a link such as BetaLink(), or a mapping {'dop': BetaLink()}": (
        "give a link such as BetaLink(), or --link 'dop=BetaLink()'"
    ),
    "Links: q by StokesLink(stated_errors=True); dop by BetaLink().": (
        "Links: --link 'q=StokesLink(stated_errors=True)'; --link 'dop=BetaLink()'."
    ),
    "Links: dop by BetaLink(margin=0.1, schedule=ConcentrationSchedule(minimum=5.0)).": (
        "Links: --link 'dop=BetaLink(margin=0.1, schedule=ConcentrationSchedule(minimum=5.0))'."
    ),
    "Angles set by: hand; the prior of angle_zero is Normal(loc=0, scale=0.75).": (
        "Angles set by: hand; its prior is --prior 'angle_zero=Normal(loc=0, scale=0.75)'."
    ),
    "StokesLink(stated_errors=True): no q_error; add it or use stated_errors=False": (
        "--link 'StokesLink(stated_errors=True)': no q_error; add it or use "
        "--link 'StokesLink(stated_errors=False)'"
    ),
    "check it, or mark it valid=False.": "check it, or mark it 0 in column valid.",
    "8 of 20 readings are marked valid=False": "8 of 20 readings are marked 0 in column valid",
    "correct it or mark it valid=False, as by capture['valid'] = capture['q'].notnull()": (
        "correct it or mark it 0 in column valid"
    ),
    "fit_pixels: shared='roughness': an image cannot share it": (
        "map: --share roughness: an image cannot share it"
    ),
    "let each pixel have its own: shared=(), or": "let each pixel have its own: --share none, or",
    "drop='Fog': the scene has no such effect": "--drop Fog: the scene has no such effect",
    "leave it out of all with drop=['q'], in a command --drop q": (
        "leave it out of all with --drop q"
    ),
    "drop the label with drop_vars('tone')": "drop the label with --drop tone",
    "use table= and name the columns angle=, s= and p=": (
        "use --table and name the columns --angle, --s and --p"
    ),
    "give captures joined by polar_bayes.capture.combine, or use model='per_material'": (
        "give captures joined by polar-bayes combine, or use --model per_material"
    ),
    "give the tree that polar_bayes.fit or load returned": (
        "give the file that polar-bayes fit wrote"
    ),
    "give what polar_bayes.calibrate returns": "give what polar-bayes calibrate wrote",
    "give the file that polar_bayes.save or a command wrote": "give the file that a command wrote",
    "polar-bayes import table a.csv --out a.nc, or pb.from_table('a.csv')": (
        "polar-bayes import table a.csv --out a.nc"
    ),
    "average a region first, for example capture.mean(('y', 'x'))": (
        "average a region first, or fit each pixel with polar-bayes map"
    ),
    "a model of your own goes with pb.fit only": "a model of your own is fitted in Python only",
    "a shape=3, p = 0.02 and refractive_index near 1.5": (
        "a shape=3, p = 0.02 and refractive_index near 1.5"
    ),
}


@pytest.mark.parametrize("python", SENTENCES)
def test_advice_names_options_and_commands(python: str) -> None:
    said = as_commands(python)
    assert said == SENTENCES[python]
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


QUOTED = re.compile(r"--(?:method|prior|link) '[^']*'")
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


def test_a_good_fit_tells_what_was_checked(
    plate: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
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
