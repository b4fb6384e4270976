"""Power of simulation-based calibration: how often it detects models broken on purpose.

    python benchmarks/power.py                    1000 simulations of each model
    python benchmarks/power.py 400                fewer
    python benchmarks/power.py 400 right index    some of the models
    python benchmarks/power.py 400 --keep FOLDER  fits are kept there, and gone on with

The layout is that of benchmarks/one_material.py: 40 views of the degree of polarization and
of intensity, seven parameters, fitted by weighted draws. Captures are simulated by one model and
fitted by another; the first row fits what it simulates, and its shares are false alarms.

Repetitions are disjoint subsets of one calibration: of 1000 simulations 20 subsets of 50, 5 of 200
and one of 1000. They are independent of each other, since simulations are; but there are few, and a
share of so few is known no better than the binomial error beside it, sqrt((x + 1/2) (n - x + 1/2) /
(n + 1)^3) for x of n (Jeffreys). Each of the two tests (parameters, readings) fails a right model
at most 5% of the time.
"""

import argparse
import dataclasses
import math
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpyro import distributions as dist
from one_material import SCENE, layout

import polar_bayes as pb

SIZES = (50, 200, 1000)
BROKEN: dict[str, tuple[str, dict[str, Any]]] = {
    "right": ("nothing: what is fitted is what is simulated", {}),
    "kappa": (
        "concentration of DoP half as large",
        {"priors": {"concentration_scale": dist.LogNormal(math.log(100.0), 1.0)}},
    ),
    "index": (
        "index spread evenly from 1.2 to 2",
        {"priors": {"refractive_index": dist.Uniform(1.2, 2.0)}},
    ),
    "link": (
        "DoP with normal noise on the log odds",
        {"links": {"dop": pb.links.LogitNormalLink(), "intensity": pb.links.StudentTLink()}},
    ),
    "tails": (
        "intensity with longer tails (3 degrees of freedom, not 5)",
        {
            "links": {
                "dop": pb.links.BetaLink(),
                "intensity": pb.links.StudentTLink(degrees_of_freedom=3.0),
            }
        },
    ),
    "gain": (
        "an instrument that records DoP too low or too high",
        {
            "scene": dataclasses.replace(
                SCENE, instrument=pb.instrument.Instrument((pb.instrument.DolpGain(),))
            )
        },
    ),
    "coat": (
        "a clear coat that the fit does not know",
        {"scene": dataclasses.replace(SCENE, coat=pb.ClearCoat())},
    ),
}


def fails(calibration: xr.DataTree) -> tuple[bool, bool]:
    """Return whether the test of the parameters fails, and that of the readings."""
    tables = (
        pb.summary(calibration),
        pb.calibration.calibration_readings(calibration),
    )
    return not pb.calibration.is_calibrated(tables[0]), not pb.calibration.is_calibrated(tables[1])


def subsets(calibration: xr.DataTree, size: int) -> Iterator[xr.DataTree]:
    """Disjoint parts of a calibration, each of so many simulations."""
    for begin in range(0, calibration["fits"].sizes["simulation"] - size + 1, size):
        yield calibration.isel(simulation=slice(begin, begin + size))


def share(failed: np.ndarray) -> str:
    """Share that failed, and its error."""
    count, found = len(failed), int(failed.sum())
    error = math.sqrt((found + 0.5) * (count - found + 0.5) / (count + 1.0) ** 3)
    return f"{found:3d} of {count:<3d} ({found / count:4.0%} +-{error:4.0%})"


def main(count: int, names: list[str], keep: Path | None) -> None:
    capture = layout()
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
    print(f"{platform.machine()}, {os.cpu_count()} cores; {count} simulations of each model")
    print(f"{'model':<7} {'size':>5}  {'parameters fail':<22} {'readings fail':<22}")
    for name in names:
        said, truth = BROKEN[name]
        start = time.perf_counter()
        store = None if keep is None else keep / name
        calibration = pb.calibrate(
            capture,
            simulations=count,
            method="importance",
            scene=SCENE,
            truth=truth,
            store=store,
            resume=store is not None,
        )
        for size in SIZES:
            told = np.array([fails(each) for each in subsets(calibration, size)])
            if len(told):
                print(f"{name:<7} {size:5d}  {share(told[:, 0]):<22} {share(told[:, 1]):<22}")
        fits = calibration["fits"]["status"].to_numpy()
        seconds = time.perf_counter() - start
        print(f"        {said}; {int(np.sum(fits != 0))} fits failed, {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int, nargs="?", default=1000)
    parser.add_argument("names", nargs="*", metavar="model")
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    strange = set(given.names) - set(BROKEN)
    if strange:
        sys.exit(f"no such model: {', '.join(strange)}; give some of {', '.join(BROKEN)}")
    main(given.count, given.names or list(BROKEN), given.keep)
