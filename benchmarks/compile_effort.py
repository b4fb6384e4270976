"""Time of a first fit and of the next ones by XLA's optimization level.

    python benchmarks/compile_effort.py

The per-material model of one color, 40 views, NUTS with the default settings, each level of
optimization in a process of its own without a cache of compiled programs: seconds of the first
`pb.fit` and the least of three further ones, of other readings. "all" is what XLA does unasked;
`polar_bayes.numerics.compile.COMPILER_OPTIONS` is what fits ask for.
"""

import os
import platform
import subprocess
import sys
import time

import jax
from one_material import SCENE

import polar_bayes as pb
from polar_bayes.numerics import compile

PROTOCOL = pb.simulation.Protocol(views=40, wavelengths=())
LEVELS = ("all", "2", "1", "0")


def one(level: str) -> None:
    """A first fit and three more, in this process."""
    compile.COMPILER_OPTIONS = (
        None if level == "all" else {"xla_backend_optimization_level": int(level)}
    )
    took = []
    for seed in range(4):
        capture = pb.simulate("leaf", seed=seed, protocol=PROTOCOL)
        start = time.perf_counter()
        pb.fit(capture, scene=SCENE, method="nuts", seed=seed)
        took.append(time.perf_counter() - start)
    print(f"{level:<8}{took[0]:8.1f}{min(took[1:]):8.2f}", flush=True)


def main() -> None:
    print(f"{platform.machine()}, {os.cpu_count()} cores; fits ask for {compile.COMPILER_OPTIONS}")
    print(f"{'level':<8}{'first s':>8}{'next s':>8}", flush=True)
    quiet = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    for level in LEVELS:
        subprocess.run([sys.executable, __file__, level], env=quiet, check=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    if len(sys.argv) > 1:
        one(sys.argv[1])
    else:
        main()
