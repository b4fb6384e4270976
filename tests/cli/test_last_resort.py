"""What no command expects is one line too, and libraries write nothing to the user."""

import errno
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from cases import each

import polar_bayes as pb
from polar_bayes.cli import main

DEFECT = "this is a defect of polar_bayes: set POLAR_BAYES_TRACEBACK=1 for the traceback"

LESS = "give it less at a time: readings, pixels or draws"


class XlaRuntimeError(RuntimeError):
    """Stands in for that of JAX."""


ERRORS = {
    "ours": (TypeError("no\nsuch"), f"internal error (TypeError: no); {DEFECT} and report it"),
    "empty": (KeyError(), f"internal error (KeyError: ); {DEFECT} and report it"),
    "long": (ValueError("x" * 999), f"internal error (ValueError: {'x' * 200}); {DEFECT} and"),
    "recursion": (RecursionError("deep"), "internal error (RecursionError: deep); this is"),
    "xla": (XlaRuntimeError("INTERNAL: x"), "internal error (XlaRuntimeError: INTERNAL: x)"),
    "memory": (MemoryError("8 GiB"), f"out of memory (MemoryError: 8 GiB); {LESS}"),
    "device memory": (
        XlaRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes.\nAt:\n  x"),
        "out of memory (XlaRuntimeError: RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes.); "
        + LESS,
    ),
    "disk": (
        OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/data/x.nc"),
        "/data/x.nc: no space left on device; check the path, its rights and the disk",
    ),
}


@each("name", ERRORS)
@each("traced", ["", "1"])
def test_an_error_that_no_command_expects_is_one_line(name, traced, tmp_path, capsys, monkeypatch):
    error, says = ERRORS[name]

    def simulate(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(pb, "simulate", simulate)
    monkeypatch.setenv("POLAR_BAYES_TRACEBACK", traced)
    assert main(["simulate", "--out", str(tmp_path / "x.nc")]) == 1
    said = capsys.readouterr().err
    *before, line = said.splitlines()
    assert line.startswith(f"polar-bayes: {says}")
    assert bool(before) == bool(traced)
    assert ("Traceback (most recent call last)" in said) == bool(traced)


def python(text: str, folder: Path, *, stdout: int = subprocess.PIPE, **environment: str):
    """A process that runs Python as the program `polar-bayes`."""
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(text)],
        cwd=folder,
        env={**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), **environment},
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60.0,
        check=False,
    )


HELP = """
    import sys
    from polar_bayes.cli import console
    sys.argv = ["polar-bayes", "--help"]
    console()
"""


def test_output_that_nobody_reads_ends_quietly(tmp_path: Path) -> None:
    """As `polar-bayes --help | head -0` does."""
    reading, writing = os.pipe()
    os.close(reading)
    done = python(HELP, tmp_path, stdout=writing)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.thorough
def test_output_that_has_no_room_is_one_line(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = python(HELP, tmp_path, stdout=full.fileno())
    assert done.returncode == 1
    assert done.stderr.startswith("polar-bayes: the operating system: no space left on device; ")
    assert done.stderr.count("\n") == 1


NOISY = """
    import logging, sys, warnings
    import polar_bayes as pb
    from polar_bayes.cli import console

    def simulate(*_, **__):
        logging.getLogger("asyncio").error("Task exception was never retrieved")
        warnings.warn("consolidated metadata is not part of the specification")
        for name in ("jit_a", "jit_b"):
            warnings.warn(f"Error reading persistent compilation cache entry for '{name}': x")
        raise pb.CaptureError("it is broken", where="x.nc", hint="give another")

    pb.simulate = simulate
    sys.argv = ["polar-bayes", "simulate", "--out", "x.nc"]
    console()
"""


@pytest.mark.thorough
def test_libraries_say_nothing_and_damaged_compiled_programs_are_one_line(tmp_path: Path) -> None:
    done = python(NOISY, tmp_path)
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        f"{tmp_path}/cache/polar_bayes/compiled: compiled programs there are damaged and are "
        "compiled again; delete the folder to have them kept",
        "x.nc: it is broken; give another",
    ]
    loud = python(NOISY, tmp_path, POLAR_BAYES_TRACEBACK="1").stderr
    assert "Task exception was never retrieved" in loud
    assert "consolidated metadata" in loud
    assert "'jit_b'" in loud


def test_a_command_that_python_calls_leaves_logs_warnings_and_environment_alone(tmp_path) -> None:
    done = python(
        """
        import logging, os, warnings
        from polar_bayes.cli import main
        before = dict(os.environ), warnings.showwarning, list(logging.getLogger().handlers)
        assert main(["--version"]) == 0
        assert (os.environ, warnings.showwarning, logging.getLogger().handlers) == before
        """,
        tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, "")
