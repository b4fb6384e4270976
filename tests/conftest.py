"""Shared by every test: double precision, quick compilation, and where measured data may be.

What a test computes once need not be fast: XLA optimizes nothing, which takes a third of the time.
"""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")  # before JAX is imported

import jax
import mpmath
import pytest
from compilations import drop_programs, fit_alone
from pages import blank_pictures

jax.config.update("jax_enable_x64", True)
gc.set_threshold(100_000, 50)  # traces are many objects and few cycles: a tenth of the time

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Fits of one model and layout compile once in the whole run, whichever worker fits them."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "compiled"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """Let a file of tests start with few programs."""
    yield
    drop_programs()


@pytest.fixture(scope="module")
def compiled_in_haste() -> Iterator[None]:
    """Compile fast in tests whose programs are compiled more often than they run."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="module")
def without_comparisons() -> Iterator[None]:
    """Fits of a file of tests alone."""
    with pytest.MonkeyPatch.context() as patch:
        fit_alone(patch)
        yield


@pytest.fixture
def fifty_digits() -> Iterator[None]:
    """Numbers of mpmath have them."""
    with mpmath.workdps(50):
        yield


@pytest.fixture(scope="session")
def measured() -> Path:
    """Folder of real measurements, which is not part of the project."""
    folder = Path(os.environ.get("POLAR_BAYES_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no measured data: set POLAR_BAYES_DATA to the folder that holds them")
    return folder


@pytest.fixture(scope="module")
def unpainted() -> Iterator[None]:
    """Pages without pictures, which take most of their time; others test what pictures show."""
    with blank_pictures():
        yield
