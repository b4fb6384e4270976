"""Weighted draws beside chains on right captures: how far adaptation may go.

    python benchmarks/weights_and_chains.py --setup camera --captures 24

Truths are drawn from the priors of a set-up. Each capture is fitted by importance sampling, and by
NUTS. Prints a row for each: rounds, Pareto k and effective draws of the weights; the largest
difference of the means and the smallest ratio of the standard deviations of the material, in those
of the chains; the largest R-hat of the chains; and seconds of both, of which the first holds what
is compiled.
"""

import argparse
import time

import jax
import numpy as np
from model_criticism import RIGHT, drawn_from_priors

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of
from polar_bayes.physics.scene import MATERIAL_PARAMETERS
from polar_bayes.setups import SETUPS

METHODS = pb.methods.Importance(), pb.methods.Nuts()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--setup", choices=list(dict(RIGHT)), default="camera")
    parser.add_argument("--captures", type=int, default=24)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    scene = SETUPS[asked.setup].scene.known_to(SETUPS[asked.setup].known)
    print("| capture | rounds | Pareto k | ess | shift | width | R-hat | seconds | of chains |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for seed in range(asked.captures):
        capture, _ = drawn_from_priors(asked.setup, scene, dict(RIGHT)[asked.setup], seed)
        fits, seconds = [], []
        for method in METHODS:
            begun = time.perf_counter()
            fits.append(pb.fit(capture, scene=asked.setup, method=method, seed=seed))
            seconds.append(time.perf_counter() - begun)
        known = provenance_of(fits[0])
        weighted, chains = (pb.summary(fit) for fit in fits)
        rows = [name for name in chains.index if name.split("[")[0] in MATERIAL_PARAMETERS]
        shift = np.abs(weighted["mean"] - chains["mean"])[rows] / chains["sd"][rows]
        width = (weighted["sd"] / chains["sd"])[rows]
        print(
            f"| {seed} | {known['rounds']} | {known['pareto_k']:.2f} | {known['ess']:.0f} "
            f"| {shift.max():.2f} | {width.min():.2f} | {chains['r_hat'].max():.3f} "
            f"| {seconds[0]:.1f} | {seconds[1]:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
