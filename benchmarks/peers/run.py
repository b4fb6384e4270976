"""One posterior by ours and by its peers: time to R-hat <= 1.01 and 400 effective draws.

    pip install '.[peers]'
    python benchmarks/peers/run.py                  all of them
    python benchmarks/peers/run.py numpyro emcee    some
    python benchmarks/peers/run.py --limit 300      seconds that each may take, twice
    python benchmarks/peers/run.py --colors 3       the capture of `polar-bayes demo`

The per-material model of one color: 40 views of the degree of polarization and of intensity by the
paper's scene with four facets on the way out; four parameters of the material, three of the noise.
Or that of the three colors of `polar-bayes demo`, with eight parameters of the material. A peer
samples in rounds until R-hat is at most 1.01, and the bulk and the tail of every number are worth
400 draws, or until its time is up. The time that this takes to judge does not count.

Each runs in a process of its own without a cache of compiled programs. "cold" counts from the start
of the process, imports and compilation included; "warm" is a second run with another seed. Error is
of means and of standard deviations, the largest of all parameters, in standard deviations of a long
run, whose own Monte Carlo error the first line says. Evaluations are of the density or of its
gradient, whichever a peer asks for.
"""

import argparse
import importlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np
from one_material import SCENE, layout
from posterior import CHAINS, Posterior

import polar_bayes as pb
from polar_bayes.methods.method import flatten
from polar_bayes.numerics.mcse import measure, standard_errors

PEERS = (
    "polar_bayes", "numpyro", "blackjax", "pymc", "emcee", "bumps", "scipy",
)  # fmt: skip
DEVICE_EACH = ("numpyro", "blackjax")
"""Peers whose guides ask for a device per chain, which is set before JAX is imported."""
LARGEST_R_HAT, LEAST_WORTH = 1.01, 400.0
PATIENCE = 4
"""Limits after which a process is stopped: a round that has begun may take longer than its time."""
SCENES = {1: SCENE, 3: None}
"""By number of colors; None is the scene that the demo's capture names."""
LONG = 20_000
"""Number of draws of the reference, per chain."""


def judge(found: Any, reference: dict[str, Any]) -> dict[str, Any]:
    """Return diagnostics and errors of the draws of one round."""
    rows, draws = [], flatten({name: found.parameters[name] for name in reference["names"]})
    for drawn, (mean, sd, _) in zip(draws, reference["numbers"], strict=True):
        weights = np.ones(drawn.shape) if found.weights is None else found.weights
        own = np.average(drawn, weights=weights)
        own_sd = np.sqrt(np.average((drawn - own) ** 2, weights=weights))
        rows.append((abs(own - mean) / sd, abs(own_sd / sd - 1.0)))
    told = {"mean": max(row[0] for row in rows), "sd": max(row[1] for row in rows)}
    told["evaluations"] = found.evaluations
    if found.worth is not None:
        return told | {"worth": found.worth, "r_hat": None, "done": found.worth >= LEAST_WORTH}
    bulk, tail, r_hat = measure(draws)
    worth, worst = float(min(bulk.min(), tail.min())), float(r_hat.max())
    done = worth >= LEAST_WORTH and worst <= LARGEST_R_HAT
    return told | {"worth": worth, "r_hat": worst, "done": done}


def sample_one(name: str, folder: Path, began: float, limit: float, colors: int) -> None:
    """Both runs of one peer, in this process; one line of JSON."""
    peers = importlib.import_module(f"by_{name}")
    reference = json.loads((folder / "reference.json").read_text())
    peer = peers.Peer(Posterior(pb.load_capture(folder / "capture.nc"), SCENES[colors]))
    told: dict[str, Any] = {"versions": peer.versions}
    for run in ("cold", "warm"):
        start, judging, judged = (began if run == "cold" else time.time()), 0.0, {}
        for found in peer.rounds(seed=len(run) + ord(run[0])):
            stop = time.time()
            judged = judge(found, reference)
            judged["seconds"] = stop - start - judging
            judging += time.time() - stop
            if judged["done"] or judged["seconds"] > limit:
                break
        told[run] = judged
    print(json.dumps(told, default=float))


def reference_of(folder: Path, colors: int) -> dict[str, Any]:
    """The capture, and a long run: mean, sd and Monte Carlo error of the mean of each number."""
    capture = layout() if colors == 1 else pb.simulate("plastic", seed=0)
    pb.save_capture(capture, folder / "capture.nc")
    method = pb.methods.Nuts(draws=LONG, most_draws=LONG, ess=1.0)
    found = pb.fit(capture, method=method, scene=SCENES[colors], seed=99)
    names = list(found["prior"].data_vars)
    draws = flatten({name: found["posterior"][name].values for name in names})
    sd = draws.std(axis=(1, 2))
    numbers = np.stack([draws.mean(axis=(1, 2)), sd, sd * standard_errors(draws)[0]], axis=1)
    long = {"names": names, "numbers": numbers.tolist()}
    (folder / "reference.json").write_text(json.dumps(long))
    return long


def table_line(name: str, told: dict[str, Any]) -> str:
    """A peer's row of the table."""
    cold, warm = told["cold"], told["warm"]

    def seconds(run: dict[str, Any]) -> str:
        return f"{run['seconds']:8.1f}{' ' if run['done'] else '*'}"

    r_hat = "       -" if warm["r_hat"] is None else f"{warm['r_hat']:8.4f}"
    asked = "         -" if warm["evaluations"] is None else f"{warm['evaluations']:10d}"
    return (
        f"{name:<12}{seconds(cold)}{seconds(warm)}{asked}{warm['worth']:8.0f}{r_hat}"
        f"{warm['worth'] / warm['seconds']:10.1f}{warm['mean']:8.3f}{warm['sd']:8.3f}"
        f"   {told['versions']}"
    )


def main(names: list[str], limit: float, colors: int) -> None:
    print(f"{platform.machine()}, {os.cpu_count()} cores, colors: {colors}")
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        long = reference_of(folder, colors)
        error = max(own / sd for _, sd, own in long["numbers"])
        print(f"reference: Monte Carlo error of the means at most {error:.4f} sd")
        print(f"{'':<12}{'cold s':>8} {'warm s':>8} {'evaluated':>9}{'ESS':>8}{'R-hat':>8}", end="")
        print(f"{'ESS/s':>10}{'mean':>8}{'sd':>8}   * its time was up", flush=True)
        for name in names:
            command = [sys.executable, __file__, "--one", name, "--folder", path]
            command += ["--limit", str(limit), "--colors", str(colors), "--began", str(time.time())]
            quiet = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
            quiet |= {"JAX_NUM_CPU_DEVICES": str(CHAINS)} if name in DEVICE_EACH else {}
            try:
                done = subprocess.run(
                    command, env=quiet, capture_output=True, text=True, timeout=PATIENCE * limit
                )
            except subprocess.TimeoutExpired:
                print(f"{name:<12} no answer in {PATIENCE * limit:.0f} s", flush=True)
                continue
            if done.returncode:
                print(f"{name:<12} failed: {done.stderr.strip().splitlines()[-1]}", flush=True)
            else:
                print(table_line(name, json.loads(done.stdout.splitlines()[-1])), flush=True)


if __name__ == "__main__":
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("names", nargs="*", metavar="PEER", help=", ".join(PEERS))
    asked.add_argument("--limit", type=float, default=300.0, help="seconds of each run")
    asked.add_argument("--colors", type=int, choices=tuple(SCENES), default=1, help="1 or 3")
    for hidden in ("--one", "--folder", "--began"):
        asked.add_argument(hidden, help=argparse.SUPPRESS)
    given = asked.parse_args()
    jax.config.update("jax_enable_x64", True)
    if given.one is None:
        main(given.names or list(PEERS), given.limit, given.colors)
    else:
        folder, began = Path(given.folder), float(given.began)
        sample_one(given.one, folder, began, given.limit, given.colors)
