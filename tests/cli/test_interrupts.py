"""Signals end a command within seconds, in real processes: nothing is left behind but one line."""

import contextlib
import contextvars
import itertools
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest
from cases import each
from plate_images import plate_image

import polar_bayes as pb
from polar_bayes import interrupts
from polar_bayes.benchmark import run
from polar_bayes.cli.entry import SIGNALS, run_until_signal
from polar_bayes.paths import temporary_folder

LIMIT = 5.0
"""Seconds that a command may take to end."""

BOTH = (signal.SIGINT, signal.SIGTERM)


# Jobs in the background of a shell ignore Ctrl-C, and so do the processes that they start.
FOREGROUND = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
COMMAND = "import runpy; runpy.run_module('polar_bayes.cli', run_name='__main__')"


def started(code: str, *words: str, folder: Path) -> subprocess.Popen:
    """A process that runs Python in an empty folder, as a shell in the foreground starts it."""
    return subprocess.Popen(
        [sys.executable, "-c", FOREGROUND + code, *words],
        cwd=folder,
        env={
            **os.environ,
            "JAX_ENABLE_COMPILATION_CACHE": "false",
            "XDG_CACHE_HOME": str(folder / "cache"),
            "TMPDIR": str(folder),
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def command(words: list[str], folder: Path) -> subprocess.Popen:
    """A command whose signal handlers are there."""
    process = started(COMMAND, *words, folder=folder)
    status = Path(f"/proc/{process.pid}/status")
    while not is_caught(status.read_text(), signal.SIGTERM):
        assert process.poll() is None
        time.sleep(0.01)
    return process


def is_caught(status: str, number: int) -> bool:
    mask = re.search(r"^SigCgt:\s*(\w+)", status, re.MULTILINE)
    return mask is not None and bool(int(mask[1], 16) >> (number - 1) & 1)


def stopped(process: subprocess.Popen, number: int) -> str:
    """Return stderr of a process after a signal; it must end in time, with the right status."""
    assert process.poll() is None, process.communicate()
    begin = time.monotonic()
    process.send_signal(number)
    output, said = process.communicate(timeout=60.0)
    assert time.monotonic() - begin < LIMIT
    assert process.returncode == 128 + number
    assert not output
    return said


def left_in(folder: Path) -> list[str]:
    """Temporary files and folders that are still there."""
    names = (path.name for path in folder.rglob("*"))
    return [name for name in names if name.startswith(".polar-bayes-") or "tmp" in name]


# --- commands -------------------------------------------------------------------------------------

linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc to see handlers installed")


@linux
@each("number", BOTH)
def test_a_signal_ends_a_fit_that_imports_or_compiles(plate, tmp_path, number) -> None:
    process = command(["fit", str(plate), "--out", "fit.nc"], tmp_path)
    time.sleep(0.0 if number == signal.SIGINT else 4.0)
    assert stopped(process, number) == "polar-bayes: stopped\n"
    assert not left_in(tmp_path)
    assert not (tmp_path / "fit.nc").exists()


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("image") / "plates.zarr"
    plate_image(64, 96, noise=0.08, seed=5).chunk(y=16, x=32).to_zarr(file, consolidated=False)
    return file


@linux
@pytest.mark.thorough
@each("number", BOTH)
@each("moment", [0.0, 2.0, 10.0, 40.0])
@each("name", ["fit", "map", "calibrate"])
def test_a_signal_ends_every_long_command_at_any_moment(
    plate: Path, image: Path, tmp_path: Path, name: str, moment: float, number: int
) -> None:
    """Imports, tracing, compilation and, where the machine is quick, sampling."""
    words = {
        "fit": ["fit", str(plate), "--out", "fit.nc"],
        "map": ["map", str(image), "--scene", "goniometer", "--out", "map.zarr"],
        "calibrate": ["calibrate", str(plate), "--simulations", "100000", "--out", "sbc.nc"],
    }[name]
    process = command(words, tmp_path)
    time.sleep(moment)
    if name != "calibrate" and process.poll() is not None:
        process.communicate()
        pytest.skip(f"{name} was done before {moment} s")
    *progress, said = stopped(process, number).splitlines()
    assert said.startswith("polar-bayes: stopped")
    others = [line for line in progress if not re.match(r"\d+ s: ", line)]
    assert all(name == "fit" and "Ctrl-C keeps the fit" in line for line in others)
    assert (tmp_path / "fit.nc").exists() == bool(others)
    if name == "calibrate":
        assert ("--resume to continue" in said) == (tmp_path / "sbc.nc.fits").exists()
    assert not left_in(tmp_path)


# --- what happens in the process ------------------------------------------------------------------


def script(text: str, folder: Path) -> subprocess.Popen:
    """A process that runs Python, once it has printed `ready`."""
    head = """
        import threading, time
        from pathlib import Path
        from polar_bayes.cli import entry as process
        from polar_bayes.interrupts import on_interrupt
        from polar_bayes.paths import temporary_folder

        def ready():
            print("ready", flush=True)
            time.sleep(600.0)
    """
    begun = started(textwrap.dedent(head) + textwrap.dedent(text), folder=folder)
    assert begun.stdout is not None
    assert begun.stdout.readline() == "ready\n"
    return begun


@pytest.mark.thorough
def test_cleanups_run_and_their_sentences_are_said_in_one_line(tmp_path: Path) -> None:
    text = """
        def work():
            with temporary_folder(Path()) as folder, on_interrupt(lambda: "out: --resume goes on"):
                (folder / "half").write_text("a part")
                with on_interrupt(lambda: 1 / 0):  # a cleanup that fails spoils no other
                    ready()
        process.run_until_signal(work)
    """
    said = stopped(script(text, tmp_path), signal.SIGTERM)
    assert said == "polar-bayes: stopped. out: --resume goes on\n"
    assert not left_in(tmp_path)


@pytest.mark.thorough
def test_a_thread_that_still_writes_leaves_nothing_behind(tmp_path: Path) -> None:
    ends = threading.Event()

    def write() -> None:
        with contextlib.suppress(OSError), temporary_folder(tmp_path) as folder:
            for number in itertools.count():
                (folder / f"{number}").write_text("a part")
                if ends.is_set():
                    return

    writing = threading.Thread(target=write)
    writing.start()
    try:
        time.sleep(0.2)
        interrupts.clean_up()
        assert not list(tmp_path.iterdir())
        writing.join(5.0)
        assert not writing.is_alive()
    finally:
        ends.set()


def hanging(limit: float) -> str:
    return f"""
        process.CLEAN_UP = {limit}
        def hang():
            print("cleaning", flush=True)
            time.sleep(600.0)
        def work():
            with on_interrupt(hang):
                ready()
        process.run_until_signal(work)
    """


@pytest.mark.thorough
@each("number", BOTH)
def test_a_second_signal_ends_at_once_what_hangs_while_it_cleans_up(tmp_path, number) -> None:
    process = script(hanging(600.0), tmp_path)
    process.send_signal(signal.SIGTERM)
    assert process.stdout is not None
    assert process.stdout.readline() == "cleaning\n"
    assert stopped(process, number) == ""


@pytest.mark.thorough
def test_a_cleanup_that_hangs_is_given_up(tmp_path: Path) -> None:
    process = script(hanging(0.2), tmp_path)
    process.send_signal(signal.SIGTERM)
    output, said = process.communicate(timeout=30.0)
    assert (output, said, process.returncode) == ("cleaning\n", "", 143)


@pytest.mark.thorough
def test_a_signal_that_the_process_was_started_to_ignore_stays_ignored(tmp_path: Path) -> None:
    text = """
        import signal
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
        process.run_until_signal(ready)
    """
    process = script(text, tmp_path)
    process.send_signal(signal.SIGHUP)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(timeout=0.5)
    stopped(process, signal.SIGINT)


@pytest.mark.thorough
def test_the_process_ends_though_a_thread_is_still_busy(tmp_path: Path) -> None:
    text = """
        import sys, threading, time
        from polar_bayes.cli import console
        threading.Thread(target=time.sleep, args=(600.0,)).start()
        sys.argv = ["polar-bayes", "--version"]
        console()
    """
    process = started(textwrap.dedent(text), folder=tmp_path)
    output, said = process.communicate(timeout=30.0)
    assert (process.returncode, said) == (0, "")
    assert output.startswith("polar-bayes, version ")


def test_what_the_command_returns_or_raises_is_passed_on_and_handlers_are_put_back() -> None:
    before = [signal.getsignal(number) for number in SIGNALS]
    variable = contextvars.ContextVar("variable", default=0)
    variable.set(7)
    assert run_until_signal(variable.get) == 7
    with pytest.raises(ZeroDivisionError):
        run_until_signal(lambda: 1 // 0)
    assert [signal.getsignal(number) for number in SIGNALS] == before


@pytest.mark.thorough
def test_an_interrupt_ends_the_process_of_a_trial(tmp_path, monkeypatch) -> None:
    children: list[subprocess.Popen] = []

    class Sleeping(subprocess.Popen):
        def __init__(self, words: list[str], **settings) -> None:
            super().__init__([sys.executable, "-c", "import time; time.sleep(600)"], **settings)
            children.append(self)

    def interrupt() -> None:
        while not any(child.poll() is None for child in children):
            time.sleep(0.01)
        time.sleep(0.2)
        interrupts.clean_up()

    monkeypatch.setattr(run.subprocess, "Popen", Sleeping)
    monkeypatch.setattr(run.tempfile, "tempdir", str(tmp_path))
    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(pb.FitError, match="its process ended with -9"):
        run.run_in_subprocess(None)
    thread.join()
    assert not list(tmp_path.iterdir())
