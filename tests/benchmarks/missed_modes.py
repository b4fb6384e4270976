"""Which extreme ranks are those of a missed mode: suspicious fits again, by a larger crowd.

    python tests/benchmarks/missed_modes.py 3000 --keep FOLDER     those of so many simulations
    python tests/benchmarks/missed_modes.py 3000 --keep FOLDER --only 35,231,932

The simulations of `calibration_models.py material`, kept in the same folder. A fit is suspicious
where the true roughness stands in the lowest or highest thousandth of its posterior; one in 500
does so by right. Each is made again with 16 times the crowd and the draws. Where the truth
then stands elsewhere, the first crowd had missed a mode.
"""

import argparse
from pathlib import Path

import numpy as np
import xarray as xr
from one_material import SCENE, layout

import polar_bayes as pb
from polar_bayes.calibration.block import Plan, fit_block
from polar_bayes.calibration.calibrate import planned
from polar_bayes.inference.request import resolve

SUSPICIOUS = 1e-3
LARGE = pb.PixelTempering(walks=4096, draws=16384)


def large(seed: int) -> Plan:
    """The same simulations, fitted by the larger crowd."""
    request = resolve(layout(), "per_material", "laplace", SCENE, None, None, None, seed, "double")
    return planned(request, None, LARGE, readings=False)


def suspicious(found: xr.DataTree) -> np.ndarray:
    """Numbers of simulations whose true roughness stands at an end."""
    ranks = found["prior_sbc"]["roughness"].to_numpy()
    return np.flatnonzero((ranks < SUSPICIOUS) | (ranks > 1.0 - SUSPICIOUS))


def main(count: int, keep: Path, only: list[int]) -> None:
    store = keep / "one-material-40-views"
    found = pb.calibrate(
        layout(),
        simulations=count,
        method="tempered",
        scene=SCENE,
        seed=1,
        store=store,
        resume=True,
    )
    marginals, ranks = found["marginals"].to_dataset(), found["prior_sbc"]["roughness"].to_numpy()
    numbers = np.array(only) if only else suspicious(found)
    again = fit_block(large(1), numbers)
    print("number  truth    rank      mean    sd      rank again  mean    sd      ESS    Pareto k")
    for at, number in enumerate(numbers):
        mean, sd = (float(marginals[name][number]) for name in ("roughness", "roughness_sd"))
        print(
            f"{number:6d}  {again.truth['roughness'][at].item():.5f}  {ranks[number]:.5f}  "
            f"{mean:.4f}  {sd:.4f}  {again.pit['roughness'][at].item():.5f}     "
            f"{again.mean['roughness'][at].item():.4f}  {again.sd['roughness'][at].item():.4f}  "
            f"{again.outcome.effective_draws[at]:6.0f} {again.outcome.pareto_k[at]:6.2f}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int)
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--only", default="", help="numbers of simulations, with commas")
    given = parser.parse_args()
    main(given.count, given.keep, [int(part) for part in given.only.split(",") if part])
