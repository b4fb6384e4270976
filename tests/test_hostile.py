"""Malformed input of every kind through the public doors: a sample of `benchmarks/fuzz.py`."""

import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).parents[1] / "benchmarks" / "fuzz.py"


@pytest.mark.thorough
def test_no_malformed_input_gets_a_traceback_or_passes_for_good() -> None:
    words = [sys.executable, str(FUZZ), "--share", "0.05", "--seed", "20"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1,000 cases, 0 bad" in done.stdout


@pytest.mark.thorough
def test_captures_tables_frames_and_options_are_refused_or_right() -> None:
    families = ["memory", "tables", "frames", "options"]
    words = [sys.executable, str(FUZZ), *families, "--share", "0.01", "--seed", "21"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "140 cases, 0 bad" in done.stdout
