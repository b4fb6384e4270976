"""How often the intervals of a map hold the truth, with and without the correction by weights.

    python benchmarks/map_coverage.py

Ten thousand smooth plates drawn from the priors, with noise from .005 to .08.
"""

import sys
from pathlib import Path

import numpy as np

import polar_bayes as pb

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from plate_images import ASKED, plate_image

SIDE = 100
METHODS = {
    "normal approximation": pb.methods.PixelLaplace(weighted=False),
    "corrected, 256 draws": pb.methods.PixelLaplace(),
    "corrected, 1024 draws": pb.methods.PixelLaplace(draws=1024),
}


def main() -> None:
    noise = np.exp(np.random.default_rng(2).uniform(np.log(0.005), np.log(0.08), (SIDE, SIDE)))
    image = plate_image(SIDE, SIDE, noise=noise, seed=12)
    for name, method in METHODS.items():
        maps = pb.fit_pixels(image, method=method, **ASKED)
        print(f"{name}: {pb.maps.count_pixels(maps)}")
        print(pb.diagnostics.map_coverage(maps, image)[["held_50", "held_80", "held_95"]].round(3))


if __name__ == "__main__":
    main()
