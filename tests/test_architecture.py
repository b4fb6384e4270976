"""The layers of the package: every import points up the list, and packages stay in their homes."""

import ast
import functools
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]

# The layers, first to last: a file may import from its own layer and from those before it.
LAYERS = (
    (
        "polar_bayes.namespace",
        "polar_bayes.errors",
        "polar_bayes.expressions",
        "polar_bayes.frames",
        "polar_bayes.interrupts",
        "polar_bayes.paths",
        "polar_bayes.repr_html",
        "polar_bayes.progress",
    ),
    ("polar_bayes.numerics",),
    ("polar_bayes.capture",),
    ("polar_bayes.importers",),
    ("polar_bayes.physics",),
    ("polar_bayes.observation",),
    ("polar_bayes.priors", "polar_bayes.setups"),
    ("polar_bayes.models",),
    ("polar_bayes.simulation",),
    ("polar_bayes.inference",),
    ("polar_bayes.methods",),
    ("polar_bayes.maps",),
    ("polar_bayes.diagnostics",),
    ("polar_bayes.scenes",),
    ("polar_bayes.calibration", "polar_bayes.design"),
    ("polar_bayes.benchmark",),
    ("polar_bayes.results",),
    ("polar_bayes.reporting",),
    ("polar_bayes.cli",),
)

# Layers that do not import each other.
SEPARATE = (
    ("polar_bayes.physics", "polar_bayes.capture"),
    ("polar_bayes.observation", "polar_bayes.capture"),
    ("polar_bayes.inference", "polar_bayes.simulation"),
)

# Packages that only these layers may import; all others may be imported anywhere.
HOMES = {
    "matplotlib": ("polar_bayes.reporting",),
    "arviz_plots": ("polar_bayes.reporting",),
    "jinja2": ("polar_bayes.reporting",),
    "bokeh": ("polar_bayes.reporting",),
    "click": ("polar_bayes.cli",),
    "netCDF4": ("polar_bayes.capture",),
    "PIL": ("polar_bayes.importers",),
    "polanalyser": ("polar_bayes.importers",),
    "optimistix": ("polar_bayes.methods",),
    "tinygp": ("polar_bayes.models",),
    "arviz_base": (
        "polar_bayes.inference",
        "polar_bayes.maps",
        "polar_bayes.diagnostics",
        "polar_bayes.reporting",
    ),
    "arviz_stats": ("polar_bayes.numerics", "polar_bayes.diagnostics", "polar_bayes.reporting"),
    "zarr": ("polar_bayes.maps",),
    "portalocker": ("polar_bayes.maps",),
    "distributed": ("polar_bayes.maps",),
}
NEVER = {
    "polar_bayes.physics": {"numpyro", "xarray", "arviz"},
    "polar_bayes.models": {"xarray"},
    "polar_bayes.capture": {"jax"},
    "polar_bayes.cli": {"xarray"},
}


def modules() -> Iterator[tuple[str, Path]]:
    """Every module of the package with its file; `models/` is installed inside it."""
    for folder, prefix in (("polar_bayes", "polar_bayes"), ("models", "polar_bayes.models")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            yield ".".join((prefix, *(part for part in parts if part != "__init__"))), path


def statements(node: ast.AST, inside: bool = False) -> Iterator[tuple[ast.AST, bool]]:
    """Every node below, and whether it stands in a function."""
    for child in ast.iter_child_nodes(node):
        within = inside or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
        yield child, within
        yield from statements(child, within)


@functools.cache
def imports(path: Path) -> tuple[tuple[str, bool], ...]:
    """Every module that a file imports, and whether it does so inside a function."""
    found = []
    for node, inside in statements(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [(alias.name, inside) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = node.module or ""
            names = [alias.name for alias in node.names] if module == "polar_bayes" else [""]
            found += [(f"{module}.{name}".rstrip("."), inside) for name in names]
    return tuple(found)


def belongs(module: str, layer: str) -> bool:
    return module == layer or module.startswith(f"{layer}.")


def layer_of(module: str) -> int | None:
    return next(
        (i for i, names in enumerate(LAYERS) if any(belongs(module, n) for n in names)), None
    )


MODULES = dict(modules())


def package_imports() -> Iterator[tuple[str, str, bool]]:
    """Every import of every module: importer, imported, and whether it stands in a function."""
    for module, path in MODULES.items():
        yield from ((module, target, inside) for target, inside in imports(path))


def test_imports_point_up_the_layers() -> None:
    wrong = []
    for module, target, _ in package_imports():
        # The front door loads names lazily.
        if module == "polar_bayes" or not belongs(target, "polar_bayes"):
            continue
        here, there = layer_of(module), layer_of(target)
        assert here is not None, f"{module} is in no layer of the design"
        if belongs(module, "polar_bayes.cli") and target == "polar_bayes":
            continue
        if there is None or there > here:
            wrong.append(f"{module} imports {target}")
    assert not wrong


def test_separate_layers_do_not_know_each_other() -> None:
    assert not [
        f"{module} imports {target}"
        for module, target, _ in package_imports()
        for one, other in SEPARATE
        if belongs(module, one) and belongs(target, other)
    ]


def test_packages_stay_in_their_homes() -> None:
    wrong = []
    for module, target, _ in package_imports():
        package = target.split(".")[0]
        homes = HOMES.get(package)
        if homes is not None and not any(belongs(module, home) for home in homes):
            wrong.append(f"{module} imports {package}, whose home is {homes}")
        if any(belongs(module, layer) and package in never for layer, never in NEVER.items()):
            wrong.append(f"{module} imports {package}")
    assert not wrong


def test_no_import_hides_inside_a_function() -> None:
    assert not [
        f"{module} imports {target} inside a function"
        for module, target, inside in package_imports()
        if inside and not belongs(module, "polar_bayes.cli")
    ]


def test_only_whole_packages_are_loaded_lazily() -> None:
    # A lazy submodule is not an attribute of its package, where others look for it: with a lazy
    # `dask.array` the maps of an image in chunks ended in an AttributeError of xarray.
    assert not [
        f"{module} loads {name} lazily"
        for module, path in MODULES.items()
        for name in re.findall(r'lazy_loader\.load\(\s*"([^"]+)"', path.read_text())
        if "." in name
    ]


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


def test_nothing_prints() -> None:
    assert not [
        module
        for module, path in MODULES.items()
        if not belongs(module, "polar_bayes.cli")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Name) and node.id == "print"
    ]


def test_what_is_installed_is_what_is_here() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    packages = {module for module, path in MODULES.items() if path.name == "__init__.py"}
    assert set(listed) == packages
