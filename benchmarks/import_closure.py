"""Number of files of the package that a public function needs: the closure of its imports.

    python benchmarks/import_closure.py                 every verb
    python benchmarks/import_closure.py fit --list      the files that `polar_bayes.fit` needs

The imports at the head of a file are followed to files of the package; nothing is executed.
"""

import argparse
import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
VERBS = (
    "load_capture",
    "simulate",
    "fit",
    "fit_pixels",
    "calibrate",
    "identify",
    "choose_effects",
    "accuracy",
    "summary",
    "verdict",
    "report",
)


def modules() -> dict[str, Path]:
    """Every file of the package by the name of its module; `models/` is installed inside it."""
    found = {}
    for folder, prefix in (("polar_bayes", "polar_bayes"), ("models", "polar_bayes.models")):
        for path in (ROOT / folder).rglob("*.py"):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((prefix, *(part for part in parts if part != "__init__")))] = path
    return found


def imports(path: Path, known: dict[str, Path]) -> set[str]:
    """The modules of the package that a file imports, and the packages that hold them."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                parts = name.split(".")
                found |= {".".join(parts[: end + 1]) for end in range(len(parts))}
    return found & set(known)


def closure(module: str) -> list[str]:
    """Return the module, everything that it imports, and so on."""
    known, found, waiting = modules(), set(), [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += imports(known[name], known)
    return sorted(found)


def home(verb: str) -> str:
    """The module that the stub of the package names for a verb."""
    for node in ast.parse((ROOT / "polar_bayes" / "__init__.pyi").read_text()).body:
        if isinstance(node, ast.ImportFrom) and verb in {alias.name for alias in node.names}:
            return f"polar_bayes.{node.module}"
    raise SystemExit(f"{verb}: no such name in polar_bayes/__init__.pyi")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("verbs", nargs="*", default=VERBS)
    parser.add_argument("--list", action="store_true", help="print the files, too")
    asked = parser.parse_args()
    print(f"{'all':<16}{len(modules()):4} files")
    for verb in asked.verbs:
        files = closure(home(verb))
        print(f"{verb:<16}{len(files):4} files")
        if asked.list:
            print(*(f"    {name}" for name in files), sep="\n")
