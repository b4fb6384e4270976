"""Cost of a fit of one material: the next one in a session, and a separate command.

    python benchmarks/single_fit.py                  four fits, three commands
    python benchmarks/single_fit.py --fits 10 --commands 0

The per-material model of one color, 40 views, seven parameters, NUTS with the default settings.
"warm" are fits in one session after a first one, which compiles: seconds of all, of the search for
modes, of the draws and of the predictions; gradients in the search, the warm-up and the draws;
the worst effective sample size and R-hat of a parameter.

"command" is `polar-bayes fit` of a capture by the paper's scene, whose programs an earlier one has
left in the cache: seconds, also those of all cores; and what is left without the seconds that the
same chains take in a session.
"""

import argparse
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
from one_material import SCENE, layout

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of

PROTOCOL = pb.simulation.Protocol(views=40, wavelengths=())
CACHE: dict[str, Any] = {
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


def warm(count: int) -> None:
    """Fits of other readings, one after the other."""
    pb.fit(layout(), method=pb.methods.Nuts(), scene=SCENE)
    print(f"{'warm':<10}{'s':>7}{'modes':>7}{'draws':>7}{'predict':>8}", end="")
    print(f"{'gradients of each':>22}{'ESS':>7}{'R-hat':>8}{'diverged':>9}")
    for seed in range(1, count + 1):
        capture = pb.simulate("leaf", seed=seed + 1, protocol=PROTOCOL)
        start = time.perf_counter()
        found = pb.fit(capture, method=pb.methods.Nuts(), scene=SCENE, seed=seed)
        seconds = time.perf_counter() - start
        said, rows = provenance_of(found), pb.diagnostics.json_summary(found)["parameters"].values()
        stats, took = found["sample_stats"], said["timings"]
        before = int(stats["warmup_steps"].isel(draw=0).sum())
        gradients = f"{said['modes']['gradients']} {before} {int(stats['n_steps'].sum())}"
        worth, worst = min(row["ess_bulk"] for row in rows), max(row["r_hat"] for row in rows)
        print(f"{seed:<10}{seconds:7.2f}{took['modes']:7.2f}{took['draws']:7.2f}", end="")
        print(f"{took['prediction']:8.2f}{gradients:>22}{worth:7.0f}{worst:8.4f}", end="")
        print(f"{int(stats['diverging'].sum()):9d}", flush=True)


def commands(count: int) -> None:
    """The command, first with an empty cache."""
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        capture = pb.simulate("leaf", seed=2, protocol=PROTOCOL)
        pb.save_capture(capture, folder / "capture.nc")
        cache = CACHE | {"jax_compilation_cache_dir": path}
        quiet = os.environ | {name.upper(): str(value) for name, value in cache.items()}
        words = [sys.executable, "-m", "polar_bayes.cli", "fit", str(folder / "capture.nc")]
        words += ["--method", "nuts"]
        print(f"{'command':<10}{'s':>7}{'of cores':>10}{'without chains':>16}")
        for seed in range(count + 1):
            before, start = _of_children(), time.perf_counter()
            asked = [*words, "--seed", str(seed), "--out", str(folder / "fit.nc")]
            subprocess.run(asked, env=quiet, check=True, capture_output=True)
            seconds, of_cores = time.perf_counter() - start, _of_children() - before
            if not seed:
                for name, value in cache.items():
                    jax.config.update(name, value)
                pb.fit(capture, method="nuts")
                print(f"{'cold':<10}{seconds:7.2f}{of_cores:10.2f}", flush=True)
                continue
            found = pb.fit(capture, method="nuts", seed=seed)
            chains = provenance_of(found)["timings"]["draws"]
            print(f"{seed:<10}{seconds:7.2f}{of_cores:10.2f}{seconds - chains:16.2f}", flush=True)


def _of_children() -> float:
    """Seconds of processor time of all processes that have ended."""
    used: Any = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--fits", type=int, default=4)
    asked.add_argument("--commands", type=int, default=3)
    wanted = asked.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores")
    if wanted.fits:
        warm(wanted.fits)
    if wanted.commands:
        commands(wanted.commands)
