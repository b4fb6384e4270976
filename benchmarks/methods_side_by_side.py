"""Comparison of methods for many captures: the same captures from the priors, fitted by each.

    python benchmarks/methods_side_by_side.py --simulations 300
    python benchmarks/methods_side_by_side.py --only camera --simulations 100

Truths and readings are drawn from the priors of four set-ups. For each method: the share of fits
that it calls good itself, coverage of its 95% intervals in those, the share of them that are wrong
(an interval that misses the truth by more than 2 posterior sds), median effective draws, the
p-value of uniform ranks, and captures per second, compilation included. The last lines of a
set-up count the captures on which one method is good and another is not.
"""

import argparse
import platform
import time

import numpy as np
import pandas as pd
import xarray as xr
from model_criticism import MATERIAL, RIGHT

import polar_bayes as pb
from polar_bayes.inference.batching import Status
from polar_bayes.setups import SETUPS

METHODS = ("importance", "corrected-laplace", "laplace")
MISS, ENDS = 2.0, (0.025, 0.975)


def judged(found: xr.DataTree, seconds: float) -> tuple[dict[str, float], np.ndarray]:
    """A row of the table, and which fits are good."""
    marginals, truth = found["marginals"].to_dataset(), found["truth"].to_dataset()
    good = found["fits"]["status"].to_numpy() == Status.GOOD
    held, wrong = [], np.zeros(good.size, bool)
    for name in (n for n in MATERIAL if n in truth):
        low, high = (marginals[f"{name}_quantile"].sel(quantile=q).to_numpy() for q in ENDS)
        value, sd = truth[name].to_numpy(), marginals[f"{name}_sd"].to_numpy()
        held.append(((low <= value) & (value <= high))[good])
        wrong |= good & (np.maximum(low - value, value - high) > MISS * sd)
    return {
        "good": good.mean(),
        "coverage": np.concatenate(held).mean(),
        "numbers": np.concatenate(held).size,
        "wrong": wrong.sum(),
        "draws": np.nanmedian(found["fits"]["ess"].to_numpy()[good]),
        "p": pb.summary(found)["p_value"].min(),
        "per second": good.size / seconds,
    }, good


def main() -> None:
    """Print a table for each set-up."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--simulations", type=int, default=300)
    parser.add_argument("--only", default="", help="a set-up")
    asked = parser.parse_args()
    for setup, layout in RIGHT:
        if asked.only not in setup:
            continue
        capture = pb.simulate(
            "plastic", scene=SETUPS[setup].scene, links=SETUPS[setup].links, protocol=layout
        )
        rows, good = {}, {}
        for method in METHODS:
            begun = time.perf_counter()
            found = pb.calibrate(
                capture,
                scene=setup,
                method=method,
                simulations=asked.simulations,
                readings=False,
            )
            rows[method], good[method] = judged(found, time.perf_counter() - begun)
        print(setup)
        print(pd.DataFrame(rows).T.to_string(float_format="{:.3f}".format))
        first, *others = METHODS
        for other in others:
            alone = np.sum(good[first] & ~good[other]), np.sum(good[other] & ~good[first])
            print(f"good by {first} and not by {other}: {alone[0]}; the other way: {alone[1]}")
    print("machine:", platform.machine(), "python", platform.python_version())


if __name__ == "__main__":
    main()
