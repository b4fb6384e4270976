"""What is compiled beside something else: the same program, once; its errors are told."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

import polar_bayes as pb
from polar_bayes.inference.kept import Kept
from polar_bayes.inference.tracing import TracedByShape, TracedOnce


@pytest.fixture
def programs() -> Iterator[list[str]]:
    """Names of the programs that are compiled meanwhile, in any thread."""
    with compilations() as found:
        yield found


def test_what_was_begun_is_compiled_once(programs: list[str]) -> None:
    def twice_the_sum(x: jax.Array, y: jax.Array) -> jax.Array:
        return 2.0 * jnp.sum(x) + y

    run, y = TracedByShape(twice_the_sum), jnp.asarray(1.0)
    run.begin(jax.ShapeDtypeStruct((3,), y.dtype), y)
    run.begin(jax.ShapeDtypeStruct((3,), y.dtype), y)
    assert [float(run(np.full(3, value), y)) for value in (1.0, 2.0)] == [7.0, 13.0]
    assert programs.count("jit(twice_the_sum)") == 1
    assert float(run(np.full(4, 1.0), y)) == 9.0
    assert programs.count("jit(twice_the_sum)") == 2


def test_precision_is_that_of_the_caller_not_of_the_thread() -> None:
    with jax.enable_x64(True):
        divide = TracedOnce(lambda x: x / 3.0)
        divide.begin(jnp.ones(2))
        found = divide(jnp.ones(2))
    assert found.dtype == np.float64
    assert found[0] == 1.0 / 3.0


def test_an_error_of_the_compiler_is_told_where_the_program_is_wanted() -> None:
    def strange(x: jax.Array) -> jax.Array:
        return jax.ffi.ffi_call("no_such_target", jax.ShapeDtypeStruct((), x.dtype))(x)

    run = TracedByShape(strange)
    run.begin(jnp.ones(2))
    with pytest.raises(Exception, match="no_such_target"):
        run(jnp.ones(2))


def test_the_sampler_is_compiled_beside_the_search_and_once(
    programs: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program that is begun before any state of a chain is known is the one that runs."""
    monkeypatch.setattr("polar_bayes.inference.prepared._KEPT", Kept(1))
    capture = pb.simulate("plastic", seed=0, protocol=pb.Protocol(views=9, wavelengths=()))
    scene = pb.Scene(pb.SmoothSurface(), pb.Unpolarized(), pb.StokesMixing())
    pb.fit(capture, scene=scene, method=pb.Nuts(draws=50, most_draws=50))
    assert programs.count("jit(_advance)") == 1
    assert programs.count("jit(describe)") == 1
