"""Bars for whoever watches a long run; not a byte for a file."""

import contextlib
import io
import sys
import time
import types

import pytest

from polar_bayes import interrupts, progress
from polar_bayes.progress import counts, stages, with_counter, with_progress


@with_progress
def two_steps(*, progress=None) -> list[str]:
    progress("climbing", 0.5)
    progress("climbing", 1.0)
    return ["done"]


@with_counter("pixels")
def two_pixels(*, progress=None) -> None:
    progress(1, 2)
    progress(2, 2)


class Handle:
    """Stands in for what IPython gives back of a display."""

    def __init__(self, seen) -> None:
        self.seen = seen

    def update(self, picture, *, raw) -> None:
        assert raw
        self.seen.append(picture)


@pytest.fixture
def notebook(monkeypatch) -> list[dict[str, str]]:
    """A process that looks like the kernel of a notebook, and what it shows."""
    seen: list[dict[str, str]] = []

    def display(picture, *, raw, display_id) -> Handle:
        assert (raw, display_id) == (True, True)
        seen.append(picture)
        return Handle(seen)

    shell = types.SimpleNamespace(kernel=object())
    ipython = types.SimpleNamespace(get_ipython=lambda: shell)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", types.SimpleNamespace(display=display))
    monkeypatch.setattr(progress, "REFRESH_SECONDS", 0.0)
    return seen


def test_a_log_holds_no_bar() -> None:
    log = io.StringIO()
    with contextlib.redirect_stderr(log), contextlib.redirect_stdout(log):
        assert two_steps() == ["done"]
        two_pixels()
    assert log.getvalue() == ""


def test_a_command_tells_long_stages_in_lines(monkeypatch) -> None:
    """Before the first stage, within one, and after it, when the next is compiled."""
    lines: list[str] = []
    monkeypatch.setattr(progress, "_write_line", [])
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.05)
    progress.write_lines(lines.append)

    def wait_for(words: str) -> None:
        limit = time.monotonic() + 20.0
        while not any(line.endswith(words) for line in lines):
            assert time.monotonic() < limit, lines
            time.sleep(0.01)

    with stages() as show:
        wait_for("s: compiling")
        show("climbing", 0.5)
        wait_for("s: climbing, 50%")
        show("climbing", 1.0)
        wait_for("s: compiling, after climbing")
    count = len(lines)
    time.sleep(0.2)
    assert len(lines) == count


def test_a_terminal_shows_bars_and_takes_them_back(monkeypatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # what makes a stream count as a terminal
    monkeypatch.setenv("TERM", "xterm")
    screen = io.StringIO()
    with contextlib.redirect_stderr(screen):
        two_steps()
        two_pixels()
    assert "climbing" in screen.getvalue()
    assert "pixels" in screen.getvalue()
    assert screen.getvalue().endswith("\x1b[2K")  # the line is wiped


def test_an_interrupt_gives_the_cursor_of_a_terminal_back(monkeypatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    screen = io.StringIO()
    shown = "\x1b[?25h"
    with contextlib.redirect_stderr(screen), stages() as show:
        show("climbing", 0.5)
        assert shown not in screen.getvalue()
        interrupts.clean_up()
        assert shown in screen.getvalue()


def test_a_notebook_shows_bars_and_keeps_none(notebook) -> None:
    two_steps()
    first, half, full, last = notebook
    for picture, share in ((first, "0%"), (half, "50%"), (full, "100%")):
        assert "climbing" in picture["text/plain"]
        assert share in picture["text/plain"]
        assert share in picture["text/html"]
    assert last["text/plain"] == ""
    assert notebook[-1]["text/html"] == ""


def test_a_counting_bar_names_what_it_counts(notebook) -> None:
    two_pixels()
    assert "pixels" in notebook[1]["text/plain"]
    assert "1/2" in notebook[1]["text/plain"]


@pytest.mark.thorough
def test_a_stage_is_text_and_nothing_else(notebook) -> None:
    with stages() as show:
        show("<script>alert(1)</script>", 0.5)
    assert "<script>" not in notebook[0]["text/html"]


def test_what_a_run_calls_adds_no_bars_of_its_own(notebook) -> None:
    with counts("fits") as show:
        two_steps()
        show(1, 2)
    assert not any("climbing" in picture["text/plain"] for picture in notebook)
    two_steps()
    assert any("climbing" in picture["text/plain"] for picture in notebook)


@pytest.mark.thorough
def test_bars_go_where_a_run_breaks_off(notebook) -> None:
    @with_progress
    def breaks(*, progress=None) -> None:
        progress("climbing", 0.5)
        raise KeyError

    with pytest.raises(KeyError):
        breaks()
    assert notebook[-1]["text/plain"] == ""
    two_steps()  # and the next run has its own again
    assert "100%" in notebook[-2]["text/plain"]


def test_a_progress_of_ones_own_is_called_instead(notebook) -> None:
    seen = []
    two_steps(progress=lambda stage, share: seen.append((stage, share)))
    assert seen == [("climbing", 0.5), ("climbing", 1.0)]
    assert notebook == []
