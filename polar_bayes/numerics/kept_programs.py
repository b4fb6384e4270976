"""Compiled programs on the disk, which the next process finds without tracing them again.

JAX's own cache finds a program by its text. To write that text, a model must be traced and lowered,
which takes longer than to load the program. Here a program is found by what it is made from: a key
that its maker gives, the shapes of its arguments, the sources of this package, the versions of
libraries, what JAX is set to, and the processor. What is not known to that extent has no key.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import platform
import shutil
import uuid
import warnings
from collections.abc import Callable, Iterable
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.stages import Compiled
from jaxtyping import ArrayLike

from polar_bayes.namespace import IMPORTED
from polar_bayes.paths import atomic_write, compiled_folder

LIBRARIES = ("jax", "jaxlib", "numpyro", "equinox", "tinygp", "numpy")

MOST_ENVIRONMENTS = 3
"""Of sources, libraries and settings, whose programs stay on the disk."""


class KeptProgram:
    """The place of one compiled program on the disk.

    Args:
        path: Its file.
        arguments: What it is called with, or `ShapeDtypeStruct` of it.
    """

    def __init__(self, path: Path, arguments: tuple) -> None:
        self._path = path
        self._arguments = jax.tree.structure((arguments, {}))

    @property
    def exists(self) -> bool:
        """Whether there is something to load."""
        return self._path.is_file()

    def load(self) -> Compiled | None:
        """The program; None where it is damaged, or gone by now."""
        _find_lapack()
        try:
            program, result = pickle.loads(self._path.read_bytes())
            return serialize_executable.deserialize_and_load(program, self._arguments, result)
        except FileNotFoundError:
            return None
        except Exception as error:  # whatever is wrong with it, it can be compiled
            # In the words of JAX, which the command line counts as one.
            what = "Error reading persistent compilation cache entry"
            warnings.warn(
                f"{what} {self._path.name}: {type(error).__name__}: {error}", stacklevel=2
            )
            self._path.unlink(missing_ok=True)
            return None

    def save(self, compiled: Compiled) -> None:
        """Keep a program, where it can be: one that holds arrays, or whose result cannot."""
        with contextlib.suppress(Exception):
            program, _, result = serialize_executable.serialize(compiled)
            written = pickle.dumps((program, result))
            if pickle.loads(written)[1] != result:
                return
            _make_room(self._path.parent)
            with atomic_write(self._path, replaces=lambda _: True) as unfinished:
                unfinished.write_bytes(written)


@functools.cache
def _find_lapack() -> None:
    """Have JAX look up LAPACK, as it does when it lowers a function that calls it.

    A loaded program of a process that has lowered none would call an address of zero.
    """
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))


def with_new_name(function: Callable) -> Callable:
    """The function by a name that JAX's own cache does not know.

    A program that XLA has read from that cache could be run, but not written again and so not kept.
    """

    def run(*arguments: Any) -> Any:
        return function(*arguments)

    run.__name__ = f"{getattr(function, '__name__', 'run')}_{uuid.uuid4().hex[:8]}"
    return run


def kept_program(key: str, arguments: tuple) -> KeptProgram | None:
    """The place of a program; None where it has no key, or programs are not kept here."""
    folder, config = compiled_folder(), jax.config
    is_ours = config.jax_compilation_cache_dir == str(folder)
    if not (key and is_ours and config.jax_enable_compilation_cache):
        return None
    if jax.device_count() > 1 or jax.default_backend() != "cpu" or config.jax_default_device:
        return None  # a program runs where it was compiled
    environment = _environment()
    if not environment:
        return None
    leaves, tree = jax.tree.flatten(arguments)
    words = [key, str(tree), *map(_described, leaves), str(config.jax_enable_x64)]
    return KeptProgram(folder / "programs" / environment / _digest(words), arguments)


def _described(leaf: ArrayLike | jax.ShapeDtypeStruct) -> str:
    like = leaf if isinstance(leaf, jax.ShapeDtypeStruct) else jax.typeof(leaf)
    return f"{like.dtype}{like.shape}{like.weak_type}"


def _digest(texts: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:32]


@functools.cache
def _environment() -> str:
    """Digest what all programs of a process depend on; empty where sources have changed."""
    packages = filter(None, map(find_spec, ("polar_bayes", "polar_bayes.models")))
    roots = {
        Path(root) for package in packages for root in package.submodule_search_locations or ()
    }
    files = (path for root in roots for path in root.rglob("*.*"))
    sources = sorted(path for path in files if path.suffix in (".py", ".csv"))
    if any(path.stat().st_ctime > IMPORTED for path in sources):
        return ""  # what was imported is not what is there
    settings = {n: x for n, x in jax.config.values.items() if "cache" not in n and "log" not in n}
    processor = Path("/proc/cpuinfo")
    lines = processor.read_text().splitlines() if processor.is_file() else [platform.processor()]
    return _digest(
        [
            *(hashlib.sha256(path.read_bytes()).hexdigest() for path in sources),
            *(version(library) for library in LIBRARIES),
            *(f"{name}={value}" for name, value in sorted(settings.items())),
            os.environ.get("XLA_FLAGS", ""),
            platform.machine(),
            platform.python_version(),
            *sorted(
                {line for line in lines if line.startswith(("flags", "Features", "model name"))}
            ),
        ]
    )


def _make_room(folder: Path) -> None:
    """Make the folder of an environment, and remove those that were made before the last ones."""
    if folder.is_dir():
        return
    folder.mkdir(parents=True, exist_ok=True)
    others = sorted(folder.parent.iterdir(), key=lambda path: path.stat().st_mtime)
    for old in others[:-MOST_ENVIRONMENTS]:
        shutil.rmtree(old, ignore_errors=True)
