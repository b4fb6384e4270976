"""What a reader may paste works: Python runs, commands parse, names, links and messages exist.

The first fit is done by the method that compiles fastest (in the thorough tests of its own scene,
else of a plate), and so is every fit that states its own small settings. The others are checked as
far as the trace of their posterior density and give back the latest result: each would compile
programs of its own.
"""

import ast
import contextlib
import importlib
import inspect
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import jax
import numpy as np
import pytest
import xarray as xr
from cases import each
from compilations import compiled_fast, drop_programs, fit_alone
from test_architecture import LAYERS

import polar_bayes as pb
from polar_bayes.capture.schema import CONTRACT
from polar_bayes.cli import commands
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.observation.data import observe
from polar_bayes.scenes.fitting import fit

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [README, ROOT / "CONTRIBUTING.md", *DOCS]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"`([^`\n]+)`")
RUN = ("README.md", "quickstart.md")
TINY = pb.methods.Laplace(chains=2, draws=50)  # the sampler runs where a page states settings
PLATE = pb.Scene(pb.SmoothSurface(), pb.Unpolarized(), pb.StokesMixing())
CHANGED = (
    "jax_enable_x64",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)

of_every_page = each("page", PAGES, ids=lambda page: page.name)


def blocks(page: Path, language: str) -> Iterator[tuple[int, str]]:
    """Blocks of one language, each with the line on which it begins."""
    text = page.read_text()
    for block in BLOCK.finditer(text):
        if block.group(1) == language:
            yield text.count("\n", 0, block.start(2)), block.group(2)


def prose(page: Path) -> str:
    return BLOCK.sub("", page.read_text())


def inline(page: Path) -> list[str]:
    return CODE.findall(prose(page))


# --- Python ---------------------------------------------------------------------------------


class Fits:
    """Stands in for `polar_bayes.fit` on the pages; `instead` replaces what a first fit asks."""

    def __init__(self, **instead: object) -> None:
        self.instead = {"method": TINY, **instead}
        self.latest: dict[object, xr.DataTree] = {}  # by set-up

    def __call__(self, capture: xr.Dataset, **asked: object) -> xr.DataTree:
        setup = capture.attrs.get("setup")
        if "method" in asked and not isinstance(asked["method"], str):
            self.latest[setup] = fit(capture, **asked)
            return self.latest[setup]
        rehearse(capture, asked)
        if setup not in self.latest:
            self.latest[setup] = fit(capture, **asked | self.instead)
        return self.latest[setup]


def rehearse(capture: xr.Dataset, asked: dict[str, object]) -> None:
    """Everything that a fit does before it searches for modes."""
    options = inspect.signature(fit).bind(capture, **asked)
    options.apply_defaults()
    wanted = list(inspect.signature(resolve).parameters)
    request = resolve(**{n: options.arguments[n] for n in wanted if n in options.arguments})
    data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
    program = compile_program(request.bind(), data)
    assert jax.eval_shape(program.potential, np.zeros(program.size), data).shape == ()


quickly = contextlib.contextmanager(compiled_fast)


IN_FULL, OF_A_PLATE = Fits(), Fits(scene=PLATE, links={"dop": pb.links.NormalLink()})


@pytest.fixture
def settings_of_jax() -> Iterator[None]:
    """Take back what a page changes; its programs take thousands of memory maps."""
    saved = {name: getattr(jax.config, name) for name in CHANGED}
    yield
    for name, value in saved.items():
        jax.config.update(name, value)
    drop_programs()


@pytest.mark.usefixtures("settings_of_jax")
@pytest.mark.parametrize(
    ("page", "fits"),
    [
        *(pytest.param(page, OF_A_PLATE, id=page.name) for page in PAGES if page.name in RUN),
        *(
            pytest.param(page, IN_FULL, id=f"{page.name} in full", marks=pytest.mark.thorough)
            for page in PAGES
            if any(blocks(page, "python"))
        ),
    ],
)
def test_the_python_of_a_page_runs(page, fits, tmp_path, monkeypatch):
    if fits is OF_A_PLATE:
        fit_alone(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pb, "fit", fits)
    namespace: dict[str, object] = {"__name__": page.stem}
    with quickly(monkeypatch, starts=4, typical=50, draws=100, block=100):
        for line, code in blocks(page, "python"):
            exec(compile("\n" * line + code, str(page), "exec"), namespace)


# --- commands -------------------------------------------------------------------------------


def typed(page: Path) -> Iterator[list[str]]:
    """Every call of the program in the shell blocks of a page, as words."""
    for _, block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            for command in line.split("&&"):
                words = shlex.split(command)
                if words and Path(words[0]).name == "polar-bayes":
                    yield words


@of_every_page
def test_the_commands_of_a_page_parse(page: Path) -> None:
    for program, *words in typed(page):
        command: click.Command = commands
        while isinstance(command, click.Group):
            assert words, f"{program}: no command"
            assert words[0] in command.commands, f"{program}: no command {words[0]}"
            command, words = command.commands[words[0]], words[1:]
        with contextlib.suppress(click.exceptions.Exit):  # --help ends the parsing
            command.make_context(program, list(words))


def every_option(command: click.Command) -> set[str]:
    options = {option for part in command.params for option in part.opts}
    children = command.commands.values() if isinstance(command, click.Group) else ()
    return options.union(*map(every_option, children))


@of_every_page
def test_the_options_that_a_page_names_exist(page: Path) -> None:
    option = r"--[a-z][a-z-]*"
    runs = re.findall(r"^python \S+\.py.*", page.read_text(), re.MULTILINE)
    for code in [*inline(page), *runs]:
        script = re.match(r"python (\S+\.py)", code)
        own = every_option(commands)
        known = re.findall(option, (ROOT / script[1]).read_text()) if script else own
        missing = set(re.findall(rf"(?<!\S){option}", code)) - {"--help", *known}
        assert not missing, f"{page.name}: {missing}"


def test_two_commands_set_everything_up() -> None:
    lines = [block.strip() for _, block in blocks(README, "sh") if "python3.12" in block]
    assert len(lines) == 2
    demo, tests = lines
    assert "\n" not in demo + tests
    assert demo.endswith("&& .venv/bin/polar-bayes demo")
    assert tests in (ROOT / ".ci" / "run").read_text().splitlines()


# --- names, paths, links --------------------------------------------------------------------


def find(name: str) -> object:
    """The object of a dotted name, whether module, class, function, method or table."""
    parts = name.split(".")
    for depth in range(len(parts), 0, -1):
        with contextlib.suppress(ModuleNotFoundError):
            found: object = importlib.import_module(".".join(parts[:depth]))
            for attribute in parts[depth:]:
                found = getattr(found, attribute)
            return found
    raise AttributeError(name)


@of_every_page
def test_the_names_of_a_page_exist(page: Path) -> None:
    for code in inline(page):
        for name in re.findall(r"\bpolar_bayes(?:\.\w+)+", code):
            find(name)
        for name in re.findall(r"\bpb((?:\.\w+)+)", code):
            find(f"polar_bayes{name}")


@of_every_page
def test_the_paths_of_a_page_exist(page: Path) -> None:
    for code in inline(page):
        if re.fullmatch(r"(polar_bayes|models|tests|docs|benchmarks|\.ci)/[\w./-]*", code):
            assert (ROOT / code).exists(), f"{page.name}: {code}"


def anchors(page: Path) -> set[str]:
    """Return the anchors of headings, as hosts of repositories and MyST make them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\s-]", "", heading.lower()).replace(" ", "-") for heading in headings}


@each("page", [README, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_the_links_of_a_page_lead_somewhere(page: Path) -> None:
    """Those of the site are resolved when it is built (tests/docs)."""
    for target in re.findall(r"\]\(([^)\s]+)\)", CODE.sub("", prose(page))):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(file), f"{page.name}: {target}"


# --- what single pages promise --------------------------------------------------------------


def test_every_formula_and_every_promise_has_a_test() -> None:
    """Each test that a section or a row names stands in a file that the section or row names."""
    _, *sections = (ROOT / "docs" / "equations.md").read_text().split("\n## ")
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    rows = re.findall(r"^\d+\. `tests/.*$", page, re.MULTILINE)
    assert len(rows) == len(re.findall(r"^\| \d+ \|", page, re.MULTILINE)) > 20
    for section in sections + rows:
        files = re.findall(r"`(tests/[\w/]+\.py)`", section)
        there = {
            node.name
            for file in files
            for node in ast.walk(ast.parse((ROOT / file).read_text()))
            if isinstance(node, ast.FunctionDef)
        }
        named = set(re.findall(r"`(test_\w+)`", section))
        assert named <= there, f"{section.splitlines()[0]}: {named - there}"


def test_the_messages_in_troubleshooting_are_those_of_the_code() -> None:
    said = [
        node.value
        for file in (ROOT / "polar_bayes").rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    for message in re.findall(r"^### `(.*)`$", page, re.MULTILINE):
        assert any(message in text for text in said), message


def test_the_picture_shows_the_layers_that_are_tested() -> None:
    _, picture = next(blocks(ROOT / "docs" / "architecture.md", "text"))
    drawn = re.findall(r"^(\w+(?:, \w+)*)(?:  |$)", picture, re.MULTILINE)
    assert drawn == [", ".join(name.removeprefix("polar_bayes.") for name in row) for row in LAYERS]


def test_tables_are_complete() -> None:
    conventions = inline(ROOT / "docs" / "conventions.md")
    assert {row.name for row in CONTRACT} <= set(", ".join(conventions).split(", "))
    assert set(pb.setups.SETUPS) <= set(inline(ROOT / "docs" / "quickstart.md"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = sum(project["optional-dependencies"].values(), project["dependencies"])
    packages = {re.split(r"[>\[]", package)[0] for package in needed}
    assert packages <= set(inline(ROOT / "docs" / "dependencies.md"))


def test_one_version_is_told_everywhere() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"## [{version}]" in (ROOT / "CHANGELOG.md").read_text()
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
