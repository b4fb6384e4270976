"""How often the intervals of a map hold the truth, with and without the correction by weights.

    python benchmarks/map_coverage.py

Ten thousand smooth plates drawn from the priors, with noise from .005 to .08; then 900 rough
materials before a camera, by roughness: each pixel infers its own exposure, noise and polarizer.
"""

import itertools
import sys
import time
from pathlib import Path

import jax
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

CAMERA_SIDE = 30
BANDS = (0.0, 0.03, 0.1, 0.2, 0.4, np.inf)
ONE_BY_ONE = 4
"""Rows of the image that are also fitted by the slowest way alone."""


def by_roughness() -> None:
    """Print how often intervals of good pixels hold the truth, by the true roughness."""
    keys = jax.random.split(jax.random.key(3), 4)
    names = ("roughness", "subsurface_fraction", "refractive_index", "dolp_gain")
    truth = {
        name: np.asarray(pb.PRIORS[name].sample(key, (CAMERA_SIDE, CAMERA_SIDE)), float)
        for name, key in zip(names, keys, strict=True)
    }
    protocol = pb.simulation.Protocol(views=12, wavelengths=(), largest_view_zenith=75.0)
    image = pb.simulate("plastic", scene="camera", protocol=protocol, parameters=truth, seed=1)
    maps = pb.fit_pixels(image)
    print(f"camera: {pb.maps.count_pixels(maps)}")
    roughness = image["true_roughness"]
    for low, high in itertools.pairwise(BANDS):
        # Pixels of other bands have no known truth, and are not counted.
        in_band = image.where((roughness >= low) & (roughness < high))
        print(f"roughness {low} to {high}")
        print(pb.diagnostics.map_coverage(maps, in_band)[["answered", "held_95"]].round(3))
    rows = image.isel(y=slice(ONE_BY_ONE))
    begun = time.perf_counter()
    maps = pb.fit_pixels(rows, method=pb.methods.PixelByPixel())
    seconds = time.perf_counter() - begun
    print(f"one by one, {ONE_BY_ONE * CAMERA_SIDE} pixels: {seconds:.0f} s with compilation")
    print(pb.diagnostics.map_coverage(maps, rows)[["answered", "held_95"]].round(3))


def main() -> None:
    noise = np.exp(np.random.default_rng(2).uniform(np.log(0.005), np.log(0.08), (SIDE, SIDE)))
    image = plate_image(SIDE, SIDE, noise=noise, seed=12)
    for name, method in METHODS.items():
        maps = pb.fit_pixels(image, method=method, **ASKED)
        print(f"{name}: {pb.maps.count_pixels(maps)}")
        print(pb.diagnostics.map_coverage(maps, image)[["held_50", "held_80", "held_95"]].round(3))
    by_roughness()


if __name__ == "__main__":
    main()
