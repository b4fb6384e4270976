"""Programs on the disk: what the next process loads, and what it does not trust."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from polar_bayes.numerics.compile import JitOnce, compiled
from polar_bayes.numerics.kept_programs import kept_program
from polar_bayes.paths import compiled_folder

FIT = """
import sys
import jax
import numpy as np
import polar_bayes as pb
from compilations import compilations

few, priors = pb.simulation.Protocol(views=9), {"leakage": pb.priors.HalfNormal(float(sys.argv[1]))}
with compilations() as compiled:  # the simulation's program is kept, too
    capture = pb.simulate("glass", scene="goniometer", protocol=few, seed=2)
    result = pb.fit(capture.isel(wavelength=0), priors=priors, method="laplace", seed=0)
print(len(compiled), repr(float(pb.summary(result).loc["refractive_index", "mean"])))
"""


def run(cache: Path, leakage: float = 0.01, **variables: str) -> subprocess.CompletedProcess[str]:
    """A fit in a new process."""
    return python(FIT, cache, str(leakage), **variables)


def python(
    code: str, cache: Path, *arguments: str, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Code in a new process whose programs are kept in a folder of their own."""
    clean = {name: x for name, x in os.environ.items() if not name.startswith("JAX_")}
    own = {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(Path(__file__).parents[1])}
    words = [sys.executable, "-c", code, *arguments]
    return subprocess.run(
        words, env=clean | own | variables, capture_output=True, text=True, check=True
    )


def fitted(cache: Path, leakage: float = 0.01) -> tuple[int, float]:
    """How many programs a new process compiles for a simulation and a fit, and the answer."""
    count, answer = run(cache, leakage).stdout.split()
    return int(count), float(answer)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def first(cache: Path) -> tuple[int, float]:
    return fitted(cache)


def programs(cache: Path) -> list[Path]:
    return [path for path in cache.rglob("compiled/programs/*/*") if path.is_file()]


def wait_for_programs(cache: Path, count: int) -> list[Path]:
    """Programs on the disk, which another thread writes."""
    for _ in range(100):
        if len(programs(cache)) < count:
            time.sleep(0.05)
    assert len(programs(cache)) == count
    return programs(cache)


@pytest.fixture
def kept_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Programs are kept in this folder, as by a command."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(compiled_folder()))
    yield
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_program_that_another_version_left_in_the_cache_of_jax_is_kept(tmp_path, kept_here):
    """Whether its key comes with its function or later, as of a compiled model."""

    def shifted(x: jax.Array) -> jax.Array:
        return jnp.cos(x) + 0.456

    x = jnp.arange(3.0)
    compiled(shifted)(x)
    first, later = JitOnce(shifted, "first"), JitOnce(shifted)
    later.key = "later"
    for count, program in enumerate((first, later), 1):
        np.testing.assert_allclose(program(x), np.cos(x) + 0.456, rtol=1e-14)
        jax.clear_caches()
        wait_for_programs(tmp_path, count)


FACTORED = """
import jax
import jax.numpy as jnp
from polar_bayes.numerics.compile import JitOnce

def logarithm(x):
    print("traced")
    return jnp.log(jnp.linalg.cholesky(x)).diagonal().sum()

print(float(JitOnce(logarithm, "factored")(4.0 * jnp.eye(3))))
"""


def test_a_process_that_traces_nothing_runs_a_program_that_calls_lapack(
    tmp_path: Path,
) -> None:
    """JAX looks up LAPACK when it traces: the call of a loaded program once ended the process."""
    traced, answer = python(FACTORED, tmp_path).stdout.split()
    assert (traced, float(answer)) == ("traced", pytest.approx(3.0 * np.log(2.0), rel=1e-6))
    assert python(FACTORED, tmp_path).stdout.split() == [answer]


def test_a_program_that_is_gone_is_kept_again(tmp_path: Path, kept_here: None) -> None:
    """Though the cache of JAX has it: what XLA reads from there it cannot write."""
    x = jnp.arange(3.0)
    for _ in range(2):
        JitOnce(lambda x: jnp.tan(x) + 0.789, "gone")(x)
        (kept,) = wait_for_programs(tmp_path, 1)
        kept.unlink()
        jax.clear_caches()


def test_a_program_is_found_by_its_key_and_its_arguments(tmp_path: Path, kept_here: None) -> None:
    x = jnp.arange(3.0)
    kept, other, longer = (
        kept_program(key, (given,)) for key, given in (("a", x), ("b", x), ("a", jnp.ones(4)))
    )
    kept.save(jax.jit(lambda x: jnp.sin(x) + 0.123).lower(x).compile())
    assert len(programs(tmp_path)) == 1
    assert (kept.exists, other.exists, longer.exists) == (True, False, False)
    np.testing.assert_allclose(kept.load()(x), np.sin(x) + 0.123, rtol=1e-14)
    programs(tmp_path)[0].write_bytes(b"half of it")
    with pytest.warns(UserWarning, match="Error reading persistent compilation cache entry"):
        assert kept.load() is None
    assert not kept.exists


@pytest.mark.thorough
def test_the_next_process_traces_no_program_of_the_model_and_finds_the_same(cache, first) -> None:
    kept = programs(cache)
    assert len(kept) >= 4
    count, answer = fitted(cache)
    assert answer == first[1]
    assert count <= first[0] - len(kept)
    assert programs(cache) == kept


@pytest.mark.thorough
def test_another_prior_is_another_program(cache, first) -> None:
    kept = len(programs(cache))
    _, answer = fitted(cache, leakage=0.2)
    assert answer != first[1]
    assert len(programs(cache)) > kept


@pytest.mark.thorough
def test_what_is_damaged_is_compiled_again(cache, first) -> None:
    for path in programs(cache):
        path.write_bytes(path.read_bytes()[:100])
    done = run(cache)
    assert float(done.stdout.split()[1]) == first[1]
    assert "Error reading persistent compilation cache entry" in done.stderr


@pytest.mark.thorough
def test_nothing_is_kept_where_the_user_says_so(tmp_path: Path, first) -> None:
    """Also where a folder is named, as the command line does."""
    folder = str(tmp_path / "polar_bayes" / "compiled")
    asked = {"JAX_ENABLE_COMPILATION_CACHE": "false", "JAX_COMPILATION_CACHE_DIR": folder}
    assert float(run(tmp_path, **asked).stdout.split()[1]) == first[1]
    assert programs(tmp_path) == []
