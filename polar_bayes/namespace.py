"""Lazy names of a package, as declared in its stub."""

import contextlib
import os
import random
import sys
import time
from collections.abc import Callable, Iterator

import lazy_loader

IMPORTED = time.time()
"""When the package was imported, before any of its modules."""

Attached = tuple[Callable[[str], object], Callable[[], list[str]], list[str]]


def attach(package: str, file: str) -> Attached:
    """Return `__getattr__`, `__dir__` and `__all__` of a package from its stub (PEP 562)."""
    load, listed, names = lazy_loader.attach_stub(package, file)

    def load_guarded(name: str) -> object:
        force_numpyro_import()
        with _callers_random_state(), _quiet_compiler():
            return load(name)

    return load_guarded, listed, names


def force_numpyro_import() -> None:
    """Load NumPyro where an earlier import of ArviZ left a lazy module in its place."""
    # `import numpyro.infer` on a stand-in runs NumPyro twice, and its modules no longer find each
    # other. Reading any attribute of the stand-in loads it once.
    stand_in = sys.modules.get("numpyro")
    if stand_in is not None:
        stand_in.__path__  # noqa: B018


@contextlib.contextmanager
def _quiet_compiler() -> Iterator[None]:
    """Hide logs of XLA, such as alarms of slow compilation, while it is loaded."""
    # It reads the variable when it is loaded, so that others find their environment unchanged.
    log_level = "TF_CPP_MIN_LOG_LEVEL"
    if log_level in os.environ or "jaxlib" in sys.modules:
        yield
        return
    os.environ[log_level] = "3"
    try:
        yield
    finally:
        os.environ.pop(log_level, None)


@contextlib.contextmanager
def _callers_random_state() -> Iterator[None]:
    """Restore global random states, from which JAX and Rich draw when imported."""
    numpy_random = sys.modules.get("numpy.random")  # not there: nobody has seeded it
    state = random.getstate()
    numpy_state = None if numpy_random is None else numpy_random.get_state(legacy=False)
    try:
        yield
    finally:
        random.setstate(state)
        if numpy_random is not None:
            numpy_random.set_state(numpy_state)
