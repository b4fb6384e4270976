"""What is compiled beside something else: the same program, once; its errors are told."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import each
from compilations import compilations
from plates import plate_capture
from toy_models import line

import polar_bayes as pb
from polar_bayes.numerics import compile
from polar_bayes.numerics.compile import JitOnce, bytes_of
from polar_bayes.scenes import fit_request as fitting


@pytest.fixture
def programs() -> Iterator[list[str]]:
    """Names of the programs that are compiled meanwhile, in any thread."""
    with compilations() as found:
        yield found


@pytest.mark.thorough
def test_what_was_begun_is_compiled_once(programs: list[str]) -> None:
    def twice_the_sum(x: jax.Array, y: jax.Array) -> jax.Array:
        return 2.0 * jnp.sum(x) + y

    run, y = JitOnce(twice_the_sum), jnp.asarray(1.0)
    run.begin(jax.ShapeDtypeStruct((3,), y.dtype), y)
    run.begin(jax.ShapeDtypeStruct((3,), y.dtype), y)
    assert [float(run(np.full(3, value), y)) for value in (1.0, 2.0)] == [7.0, 13.0]
    assert programs.count("jit(twice_the_sum)") == 1
    assert float(run(np.full(4, 1.0), y)) == 9.0
    assert programs.count("jit(twice_the_sum)") == 2


def test_precision_is_that_of_the_caller_not_of_the_thread() -> None:
    with jax.enable_x64(True):
        divide = JitOnce(lambda x: x / 3.0)
        divide.begin(jnp.ones(2))
        found = divide(jnp.ones(2))
    assert found.dtype == np.float64
    assert found[0] == 1.0 / 3.0


def test_an_error_of_the_compiler_is_told_where_the_program_is_wanted() -> None:
    def strange(x: jax.Array) -> jax.Array:
        return jax.ffi.ffi_call("no_such_target", jax.ShapeDtypeStruct((), x.dtype))(x)

    run = JitOnce(strange)
    run.begin(jnp.ones(2))
    with pytest.raises(Exception, match="no_such_target"):
        run(jnp.ones(2))


@pytest.mark.thorough
def test_the_sampler_is_compiled_beside_the_search_and_once(programs: list[str]) -> None:
    """The program that is begun before any state of a chain is known is the one that runs."""
    protocol = pb.simulation.Protocol(views=11, wavelengths=())  # no other test has this layout
    plastic = pb.simulate("plastic", seed=0, protocol=protocol)
    scene = pb.Scene(pb.SmoothSurface(), pb.Unpolarized(), pb.StokesMixing())
    pb.fit(plastic, scene=scene, method=pb.methods.Nuts(draws=50, most_draws=50))
    assert programs.count("jit(_advance)") == 1
    assert programs.count("jit(describe)") == 1


class Gate:
    """A barrier at which a thread waits, and another one sees that it does."""

    def __init__(self) -> None:
        self.reached, self.open = threading.Event(), threading.Event()

    def wait(self) -> None:
        self.reached.set()
        assert self.open.wait(60.0)


@pytest.fixture
def gate() -> Iterator[Gate]:
    gate = Gate()
    yield gate
    gate.open.set()


def slow(x: jax.Array) -> jax.Array:
    """A program whose compilation waits at the gate, where `slow_to_compile` is asked for."""
    return 2.0 * x


@pytest.fixture
def slow_to_compile(gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    at_once = jax.stages.Lowered.compile

    def compile_slowly(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
        if "slow" in lowered.as_text()[:200]:
            gate.wait()
        return at_once(lowered)

    monkeypatch.setattr(jax.stages.Lowered, "compile", compile_slowly)


def keeps_nobody_from_tracing(gate: Gate, *waiting: Future, begun: bool = False) -> None:
    """Another program is compiled and run while these wait at the gate."""
    assert gate.reached.wait(60.0)
    needed = JitOnce(lambda x: x + 1.0)
    if begun:
        needed.begin(np.ones(3))
    with ThreadPoolExecutor(1) as pool:
        try:
            assert np.array_equal(pool.submit(needed, np.ones(3)).result(60.0), np.full(3, 2.0))
            assert not any(each.done() for each in waiting)
        finally:
            gate.open.set()


@pytest.mark.thorough
def test_who_compiles_keeps_nobody_from_tracing(gate: Gate, slow_to_compile: None) -> None:
    run = JitOnce(slow)
    with ThreadPoolExecutor(2) as pool:
        waiting = [pool.submit(run, np.ones(3)) for _ in range(2)]
        keeps_nobody_from_tracing(gate, *waiting)
        assert all(np.array_equal(each.result(60.0), np.full(3, 2.0)) for each in waiting)


@pytest.mark.thorough
def test_who_runs_for_the_first_time_keeps_nobody_from_tracing(gate: Gate) -> None:
    def wait(x: np.ndarray) -> np.ndarray:
        gate.wait()
        return x

    run = JitOnce(lambda x: jax.pure_callback(wait, jax.ShapeDtypeStruct(x.shape, x.dtype), x))
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(run, np.ones(3))
        keeps_nobody_from_tracing(gate, waiting)
        assert np.array_equal(waiting.result(60.0), np.ones(3))


@pytest.mark.thorough
def test_what_waits_in_the_queue_is_compiled_by_who_needs_it(gate, slow_to_compile):
    """A compilation that nobody waits for any more holds up no other one."""
    JitOnce(slow).begin(np.ones(3))
    keeps_nobody_from_tracing(gate, begun=True)


def test_two_threads_never_trace_at_once_and_compile_a_program_once(programs: list[str]) -> None:
    inside: list[int] = []
    most: list[int] = []

    def telling() -> JitOnce:
        def told(x: jax.Array) -> jax.Array:
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.05)
            inside.pop()
            return x + 1.0

        return JitOnce(told)

    first, second = telling(), telling()
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda run: run(np.ones(3)), [first, second, first, second]))
    assert most == [1, 1]
    assert programs.count("jit(told)") == 2


# --- memory ---------------------------------------------------------------------------------------


def test_a_program_that_the_memory_cannot_hold_is_refused_and_not_run(monkeypatch):
    def many(x: jax.Array) -> jax.Array:
        return jnp.sort(jnp.broadcast_to(x, (10**12, 3)), axis=0)

    run = JitOnce(many)
    said = r"memory: this fit would need 2\d{4}\.\d GB at once, of \d+\.\d GB; average neighb"
    for _ in range(2):  # nor later
        with pytest.raises(pb.FitError, match=said):
            run(jnp.ones(3))
    monkeypatch.setattr(compile, "memory_limit", lambda: None)  # where nobody knows, nobody refuses
    outer = JitOnce(lambda x: jnp.outer(x, x))
    assert outer(jnp.ones(1000))[0, 0] == 1.0
    assert 8.0e6 <= bytes_of(outer.program(jnp.ones(1000))) <= 1.7e7  # known before it runs


@pytest.mark.thorough
@each("method", ["point", "laplace", pb.methods.Importance()])
def test_a_fit_is_refused_in_one_line_where_memory_is_short(method, monkeypatch):
    asked = {"model": line, "links": {"q": pb.links.StokesLink()}}
    views = np.linspace(20.0, 70.0, 9)  # a layout of its own: no other test has its programs
    readings = plate_capture(views, 0.05, seed=0)
    said = r"memory: this fit would need .*; average neighboring"
    monkeypatch.setattr(compile, "memory_limit", lambda: 1000)
    with pytest.raises(pb.FitError, match=said):  # what is described of draws would not fit
        pb.fit(readings, method=method, **asked)
    monkeypatch.setattr(fitting, "_check_room", lambda *_: None)
    with pytest.raises(pb.FitError, match=said):  # nor would the programs
        pb.fit(readings, method=method, **asked)


def test_the_limit_is_that_of_the_container_where_it_is_lower(tmp_path, monkeypatch):
    machine = compile.memory_limit()
    assert machine is not None
    assert machine > 1e8
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(compile, "CONTAINER_LIMITS", (str(limit),))
    for text, found in (("max\n", None), ("1000000\n", 1_000_000)):
        limit.write_text(text)
        assert compile.memory_limit() == (found or machine)
