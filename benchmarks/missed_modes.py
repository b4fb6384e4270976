"""Which extreme ranks are those of a missed mode: suspicious fits again, by a larger crowd.

    python benchmarks/missed_modes.py 3000 --keep FOLDER     those of so many simulations
    python benchmarks/missed_modes.py 3000 --keep FOLDER --only 35,231,932
    python benchmarks/missed_modes.py 1000 --keep FOLDER --parameter exposure --share .005

The simulations of `calibration_models.py material`, kept in the same folder. A fit is suspicious
where the truth (of the roughness) stands in the lowest or highest share (a thousandth) of its
posterior; one in 500 does so by right. Each is made again with 16 times the crowd and the draws.
Where the truth then stands elsewhere, the first crowd had missed a mode.
"""

import argparse
from pathlib import Path

import numpy as np
from one_material import SCENE, layout

import polar_bayes as pb
from polar_bayes.calibration.calibrate import make_plan
from polar_bayes.calibration.runner import CalibrationPlan, fit_block
from polar_bayes.inference.request import resolve

LARGE = pb.methods.PixelSMC(num_chains=4096, draws=16384)


def large(seed: int) -> CalibrationPlan:
    """The same simulations, fitted by the larger crowd."""
    request = resolve(layout(), "per_material", SCENE, None, None, None, seed, "double")
    return make_plan(request, None, LARGE, readings=False)


def main(count: int, keep: Path, name: str, share: float, seed: int, only: list[int]) -> None:
    store = keep / "one-material-40-views"
    found = pb.calibrate(
        layout(),
        simulations=count,
        method="tempered",
        scene=SCENE,
        seed=seed,
        store=store,
        resume=True,
    )
    marginals, ranks = found["marginals"].to_dataset(), found["prior_sbc"][name].to_numpy()
    suspicious = np.flatnonzero((ranks < share) | (ranks > 1.0 - share))
    numbers = np.array(only) if only else suspicious
    again = fit_block(large(seed), numbers)
    print("number  truth    rank      mean    sd      rank again  mean    sd      ESS    Pareto k")
    for at, number in enumerate(numbers):
        mean, sd = (float(marginals[column][number]) for column in (name, f"{name}_sd"))
        print(
            f"{number:6d}  {again.truth[name][at].item():.5f}  {ranks[number]:.5f}  "
            f"{mean:.4f}  {sd:.4f}  {again.pit[name][at].item():.5f}     "
            f"{again.mean[name][at].item():.4f}  {again.sd[name][at].item():.4f}  "
            f"{again.outcome.effective_draws[at]:6.0f} {again.outcome.pareto_k[at]:6.2f}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("count", type=int)
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--parameter", default="roughness")
    parser.add_argument("--share", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="numbers of simulations, with commas")
    given = parser.parse_args()
    only = [int(part) for part in given.only.split(",") if part]
    main(given.count, given.keep, given.parameter, given.share, given.seed, only)
