"""A trial in a process of its own: nothing is compiled yet, nothing else takes memory.

    python -m polar_bayes.budget.fresh TRIAL MEASURED

runs what one file holds and writes what came of it to the other.
"""

import os
import pickle
import subprocess
import sys
import tempfile
from pathlib import Path
from subprocess import PIPE

import cloudpickle

from polar_bayes.budget.trial import Measured, Trial, run_trial
from polar_bayes.errors import FitError, PolarBayesError
from polar_bayes.interrupts import on_interrupt
from polar_bayes.paths import unfinished_folder

LAST_WORDS = 300
"""Characters of what a process that broke down has said."""


def run_fresh(trial: Trial) -> Measured:
    """Run a trial in a new process, with compiled programs of earlier ones out of reach."""
    with unfinished_folder(Path(tempfile.gettempdir())) as folder:
        given, made = folder / "trial", folder / "measured"
        given.write_bytes(cloudpickle.dumps(trial))
        words = [sys.executable, "-m", "polar_bayes.budget.fresh", str(given), str(made)]
        with subprocess.Popen(
            words, env=_environment(), stdout=PIPE, stderr=PIPE, text=True
        ) as process:
            with on_interrupt(process.kill):
                try:
                    _, said = process.communicate()
                finally:
                    process.kill()  # an exception must not wait for it
        if not made.exists():
            raise FitError(
                f"its process ended with {process.returncode}: {said[-LAST_WORDS:].strip()}",
                where="accuracy",
                mend="try the same method with polar_bayes.fit, or a smaller capture",
            )
        # Written by the process that this one has just started.
        found = pickle.loads(made.read_bytes())
    if isinstance(found, PolarBayesError):
        raise found
    return found


def _environment() -> dict[str, str]:
    """That of this process, without its store of compiled programs."""
    kept = {name: value for name, value in os.environ.items() if "COMPILATION_CACHE" not in name}
    path = os.pathsep.join(part or os.getcwd() for part in sys.path)
    return kept | {"PYTHONPATH": path, "JAX_ENABLE_COMPILATION_CACHE": "false"}


def _work(given: Path, made: Path) -> None:
    trial = pickle.loads(given.read_bytes())
    try:
        found: Measured | PolarBayesError = run_trial(trial)
    except PolarBayesError as error:
        found = error
    made.write_bytes(cloudpickle.dumps(found))


if __name__ == "__main__":
    _work(*map(Path, sys.argv[1:]))
