"""Compiled programs are native code: they are loaded from no folder that others can write to."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from polar_bayes.cli.entry import FOLDER, keep_compiled_programs

NAMES = (
    FOLDER,
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
)


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder of caches, in an environment that is put back."""
    for name in NAMES:
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def modes(base: Path) -> list[int]:
    folders = (base, base / "polar_bayes", base / "polar_bayes" / "compiled")
    return [folder.stat().st_mode & 0o7777 for folder in folders]


def test_new_folders_are_for_the_user_alone(base: Path, capsys) -> None:
    umask = os.umask(0o002)
    try:
        keep_compiled_programs()
    finally:
        os.umask(umask)
    assert modes(base) == [0o700] * 3
    assert os.environ[FOLDER] == str(base / "polar_bayes" / "compiled")
    assert capsys.readouterr().err == ""
    (base / "polar_bayes").chmod(0o755)  # who may read may not write
    del os.environ[FOLDER]
    keep_compiled_programs()
    assert FOLDER in os.environ


@pytest.mark.parametrize(
    ("part", "mode"), [("", 0o777), ("polar_bayes", 0o770), ("polar_bayes/compiled", 0o1777)]
)
def test_a_folder_that_others_can_write_to_is_not_used(base, capsys, part, mode) -> None:
    compiled = base / "polar_bayes" / "compiled"
    compiled.mkdir(parents=True, mode=0o700)
    (base / part).chmod(mode)
    keep_compiled_programs()
    assert not set(NAMES) & set(os.environ)
    assert capsys.readouterr().err == (
        f"{compiled}: compiled programs are not kept: other users can write to {base / part}; "
        f"change that, or set {FOLDER} to a folder of your own\n"
    )


@pytest.mark.thorough
def test_a_folder_of_another_user_is_not_used(base: Path, capsys, monkeypatch) -> None:
    (base / "polar_bayes").mkdir(parents=True)
    base.chmod(0o1777)  # as /tmp, where anybody could have made the folder in it
    monkeypatch.setattr(os, "getuid", lambda: (base / "polar_bayes").stat().st_uid + 1)
    keep_compiled_programs()
    assert FOLDER not in os.environ
    assert "belongs to another user" in capsys.readouterr().err


@pytest.mark.thorough
def test_a_folder_that_cannot_be_made_is_said(base: Path, capsys) -> None:
    base.write_text("a file")
    keep_compiled_programs()
    assert FOLDER not in os.environ
    said = capsys.readouterr().err
    assert "compiled programs are not kept: it cannot be used (" in said
    assert said.count("\n") == 1


def test_a_folder_that_the_user_gives_is_used_as_it_is(base: Path, capsys, monkeypatch) -> None:
    monkeypatch.setenv(FOLDER, "/nowhere")
    keep_compiled_programs()
    assert os.environ[FOLDER] == "/nowhere"
    assert not base.exists()
    assert capsys.readouterr().err == ""


COMPILES = """
import sys
import polar_bayes as pb
from polar_bayes.cli import console

def simulate(*_, **__):
    import jax  # which reads the environment now
    for shape in range(1, 4):
        jax.jit(lambda x: x + 1.0)(jax.numpy.ones(shape))
    raise pb.CaptureError("it is broken", where="x.nc", hint="give another")

pb.simulate = simulate
sys.argv = ["polar-bayes", "simulate", "--out", "x.nc"]
console()
"""


@pytest.mark.thorough
def test_damaged_entries_are_one_line_however_many_there_are(base: Path) -> None:
    base.mkdir(mode=0o700)
    compiled = base / "polar_bayes" / "compiled"
    clean = {name: value for name, value in os.environ.items() if "COMPILATION_CACHE" not in name}

    def said() -> list[str]:
        words = [sys.executable, "-c", COMPILES]
        done = subprocess.run(words, env=clean, capture_output=True, text=True, check=False)
        return done.stderr.splitlines()

    assert said() == ["x.nc: it is broken; give another"]
    entries = list(compiled.glob("*-cache"))
    assert len(entries) > 3
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:50])
    assert said() == [
        f"{compiled}: compiled programs there are damaged and are compiled again; "
        "delete the folder to have them kept",
        "x.nc: it is broken; give another",
    ]
