"""What JAX compiles, counted by tests and benchmarks."""

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path

import jax

from polar_bayes.numerics.compile import LRUCache
from polar_bayes.scenes.fit_request import fit_request


def fit_alone(patch) -> None:
    """Let fits do without those of other scenes, which compile programs of their own."""
    alone = functools.partial(fit_request, with_comparisons=False)
    patch.setattr("polar_bayes.scenes.fitting.fit_request", alone)


FAST = {"inference.compiled_model._COMPILED": LRUCache(16), "simulation._RECORDERS": LRUCache(16)}
"""What was compiled fast, by where the package keeps it: models, and records of captures."""


def compile_anew(patch) -> None:
    """Forget what other tests compiled: JAX finds it in memory, however it was optimized."""
    jax.clear_caches()
    for name in FAST:
        patch.setattr(f"polar_bayes.{name}", LRUCache(16))


def drop_programs() -> None:
    """Linux gives a process 65,530 memory maps, and XLA crashes without one for a program."""
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()


@contextlib.contextmanager
def compilations() -> Iterator[list[str]]:
    """Names of the programs that are compiled or read from a cache meanwhile, in any thread."""
    found: list[str] = []

    def listen(event: str, seconds: float, **about: object) -> None:
        del seconds
        if event == "/jax/core/compile/backend_compile_duration":
            found.append(str(about.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)


def compiled_fast(monkeypatch, *, starts, typical, draws, block):
    """Yield the value of a fixture while programs are compiled fast: they run only a few times."""
    numbers = {
        "inference.initialization.STARTS": starts,
        "inference.hierarchical_reparam.MOST_STARTS": 4,
        "inference.hierarchical_reparam.TYPICAL_DRAWS": typical,
        "scenes.fit_request.PRIOR_DRAWS": draws,
        "inference.program.BLOCK": block,
    }
    # Other tests of this process must not meet what was compiled and searched in haste.
    for name, value in {**numbers, **FAST}.items():
        monkeypatch.setattr(f"polar_bayes.{name}", value)
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
