"""The picture of the house is a test: every import points up the list, and packages stay home."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# The rows of the design, first to last: a file may import from its own row and rows above it.
LAYERS = (
    (
        "polar_bayes.errors",
        "polar_bayes.interrupts",
        "polar_bayes.paths",
        "polar_bayes.repr_html",
        "polar_bayes.progress",
    ),
    ("polar_bayes.capture",),
    ("polar_bayes.physics",),
    ("polar_bayes.observation",),
    ("polar_bayes.priors", "polar_bayes.setups"),
    ("polar_bayes.models",),
    ("polar_bayes.simulation",),
    ("polar_bayes.inference",),
    ("polar_bayes.pixels",),
    ("polar_bayes.ladder",),
    ("polar_bayes.diagnostics",),
    ("polar_bayes.calibration", "polar_bayes.identifiability"),
    ("polar_bayes.budget",),
    ("polar_bayes.reporting",),
    ("polar_bayes.cli",),
)

# Rows that stand side by side: neither may know the other.
STRANGERS = (
    ("polar_bayes.physics", "polar_bayes.capture"),
    ("polar_bayes.observation", "polar_bayes.capture"),
    ("polar_bayes.inference", "polar_bayes.simulation"),
)

# Packages that only these rows may see; all others may be seen anywhere.
HOMES = {
    "matplotlib": ("polar_bayes.reporting",),
    "arviz_plots": ("polar_bayes.reporting",),
    "jinja2": ("polar_bayes.reporting",),
    "click": ("polar_bayes.cli",),
    "netCDF4": ("polar_bayes.capture",),
    "PIL": ("polar_bayes.importers.detector",),
    "polanalyser": ("polar_bayes.importers.images",),
    "optimistix": ("polar_bayes.inference", "polar_bayes.identifiability"),
    "tinygp": ("polar_bayes.models",),
    "arviz_base": ("polar_bayes.inference", "polar_bayes.diagnostics", "polar_bayes.reporting"),
    "arviz_stats": (
        "polar_bayes.inference",
        "polar_bayes.pixels",
        "polar_bayes.diagnostics",
        "polar_bayes.reporting",
    ),
    "zarr": ("polar_bayes.maps.store", "polar_bayes.maps.lazy"),
    "portalocker": ("polar_bayes.maps.store",),
    "distributed": ("polar_bayes.maps.blocks",),
    "xarray": (
        "polar_bayes.capture",
        "polar_bayes.observation.data",
        "polar_bayes.simulation",
        "polar_bayes.inference",
        "polar_bayes.pixels",
        "polar_bayes.ladder",
        "polar_bayes.diagnostics",
        "polar_bayes.calibration",
        "polar_bayes.identifiability",
        "polar_bayes.budget",
        "polar_bayes.reporting",
    ),
}
NEVER = {"polar_bayes.physics": {"numpyro", "xarray", "arviz"}, "polar_bayes.capture": {"jax"}}


def modules() -> Iterator[tuple[str, Path]]:
    """Every module of the package with its file; `models/` is installed inside it."""
    for folder, prefix in (("polar_bayes", "polar_bayes"), ("models", "polar_bayes.models")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            yield ".".join((prefix, *(part for part in parts if part != "__init__"))), path


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Every module that a file imports, and whether it does so inside a function."""
    tree = ast.parse(path.read_text())
    inside = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
        for node in ast.walk(function)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, id(node) in inside
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or "", id(node) in inside


def belongs(module: str, row: str) -> bool:
    return module == row or module.startswith(f"{row}.")


def row_of(module: str) -> int | None:
    return next((i for i, row in enumerate(LAYERS) if any(belongs(module, r) for r in row)), None)


MODULES = dict(modules())


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_up_the_list(module: str) -> None:
    here = row_of(module)
    if module == "polar_bayes":
        return  # the front door loads names lazily and imports nothing
    assert here is not None, f"{module} is in no row of the design"
    for target, _ in imports(MODULES[module]):
        if belongs(module, "polar_bayes.cli") or not belongs(target, "polar_bayes"):
            continue
        there = row_of(target)
        assert there is not None, f"{module} imports {target}, which is in no row"
        assert there <= here, f"{module} imports {target} from a row below it"


@pytest.mark.parametrize(("row", "stranger"), STRANGERS)
def test_strangers_do_not_know_each_other(row: str, stranger: str) -> None:
    allowed = {"polar_bayes.capture.schema"}
    for module, path in MODULES.items():
        if belongs(module, row):
            for target, _ in imports(path):
                known = belongs(target, stranger) and not (
                    belongs(module, "polar_bayes.inference") and target in allowed
                )
                assert not known, f"{module} imports {target}"


@pytest.mark.parametrize("module", MODULES)
def test_packages_stay_in_their_homes(module: str) -> None:
    for target, _ in imports(MODULES[module]):
        package = target.split(".")[0]
        homes = HOMES.get(package)
        assert homes is None or any(belongs(module, home) for home in homes), (
            f"{module} imports {package}, whose home is {homes}"
        )
        for row, strangers in NEVER.items():
            assert not (belongs(module, row) and package in strangers), f"{module}: {package}"


@pytest.mark.parametrize("module", [m for m in MODULES if not belongs(m, "polar_bayes.cli")])
def test_no_import_hides_inside_a_function(module: str) -> None:
    hidden = [target for target, inside in imports(MODULES[module]) if inside]
    assert not hidden, f"{module} imports {hidden} inside a function"


def test_no_circle() -> None:
    graph = {
        module: {target for target, _ in imports(path) if target in MODULES and target != module}
        for module, path in MODULES.items()
        if module != "polar_bayes"
    }
    settled: set[str] = {"polar_bayes"}
    while pending := {m: targets - settled for m, targets in graph.items() if m not in settled}:
        free = {module for module, targets in pending.items() if not targets}
        assert free, f"these import each other: {sorted(pending)}"
        settled |= free


@pytest.mark.parametrize("module", MODULES)
def test_a_file_can_be_read_in_one_sitting(module: str) -> None:
    lines = MODULES[module].read_text().count("\n")
    assert lines <= 400, f"{module} has {lines} lines"


@pytest.mark.parametrize("module", [m for m in MODULES if not belongs(m, "polar_bayes.cli")])
def test_nothing_prints(module: str) -> None:
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        assert not (isinstance(node, ast.Name) and node.id == "print"), f"{module} prints"


def test_what_is_installed_is_what_is_here() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    packages = {module for module, path in MODULES.items() if path.name == "__init__.py"}
    assert set(listed) == packages
