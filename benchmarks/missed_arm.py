"""A long tail of the posterior that chains miss: river water under a sky, by NUTS and importance.

    POLAR_BAYES_DATA=FOLDER python benchmarks/missed_arm.py --seeds 4

FOLDER holds `river_water/river_water_q.csv`. For each seed and method: the share of draws whose
roughness is above 0.08, their mean index, the 95% interval of the index, R-hat or Pareto k,
and the seconds of the fit, the first of which compiles.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of
from polar_bayes.scenes import scene_library

ARM = 0.08
METHODS = {
    "nuts": pb.methods.Nuts(),
    "importance": pb.methods.Importance(draws=2048, rounds=6),
}


def main(seeds: int, methods: list[str]) -> None:
    water = pb.from_table(
        Path(os.environ["POLAR_BAYES_DATA"]) / "river_water" / "river_water_q.csv",
        columns={"view_zenith": "aoi", "light_zenith": "aoi", "q_error": "err"},
        constants={"view_azimuth": 180.0, "light_azimuth": 0.0},
        ignored=["u"],
    )
    scene = scene_library(water).scene(("sky", "Lambertian body", "systematic errors"))
    links = {"q": pb.links.StokesLink(degrees_of_freedom=4.0, stated_errors=True)}
    for name, method in ((name, METHODS[name]) for name in methods):
        for seed in range(seeds):
            begun = time.perf_counter()
            result = pb.fit(water, scene=scene, links=links, method=method, seed=seed)
            seconds = time.perf_counter() - begun
            stated = provenance_of(result)
            posterior = result["posterior"].to_dataset()
            index = posterior["refractive_index"].to_numpy().ravel()
            above = posterior["roughness"].to_numpy().ravel() > ARM
            low, high = np.quantile(index, (0.025, 0.975))
            measure = (
                f"R-hat {stated['r_hat']:.3f}" if name == "nuts" else f"k {stated['pareto_k']:.2f}"
            )
            print(
                f"{name:11}seed {seed}  arm {above.mean():6.1%}, n "
                f"{index[above].mean() if above.any() else np.nan:.3f}"
                f"  n [{low:.3f}, {high:.3f}]  {measure}  {seconds:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS))
    given = parser.parse_args()
    main(given.seeds, given.methods)
