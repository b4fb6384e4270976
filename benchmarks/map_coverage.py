"""Coverage of the intervals of a map, with and without the correction by weights.

    python benchmarks/map_coverage.py plates camera shared

    plates    ten thousand smooth plates drawn from the priors, with noise from .005 to .08
    camera    900 rough materials before a camera, by roughness: each pixel infers its own exposure,
              noise and polarizer; then images that share these, with a usual and a perfect one,
              and one with a perfect polarizer as by default
    shared    100 images of ten thousand plates, each with a noise of its own, which all of its
              pixels share; beside maps whose pixels each infer it, and maps that are told; means
              of 25 regions of each

Without a part, all of them are run.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import xarray as xr
from numpyro import handlers
from scipy import stats

import polar_bayes as pb
from polar_bayes.models.per_material import per_material

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from plate_images import ASKED, plate_image

SIDE = 100
METHODS = {
    "normal approximation": pb.methods.Laplace(draws=256, chains=1),
    "corrected, 256 draws": pb.methods.CorrectedLaplace(),
    "corrected, 1024 draws": pb.methods.CorrectedLaplace(draws=1024),
}

CAMERA_SIDE = 30
BANDS = ((0.0, np.inf), (0.0, 0.03), (0.03, 0.1), (0.1, 0.2), (0.2, 0.4), (0.4, np.inf))
MIXTURES = 4
"""Rows of the image that are also fitted by mixtures alone."""


SHARED = ("stokes_scale", "intensity_scale", "dolp_gain", "exposure")


def camera_image(gain: float | None, seed: int = 1) -> xr.Dataset:
    """Rough materials drawn from the priors, each with a polarizer of its own or all with one."""
    names = ("roughness", "subsurface_fraction", "refractive_index", "dolp_gain")
    keys = jax.random.split(jax.random.key(3), 4)
    truth = {
        name: np.asarray(pb.PRIORS[name].sample(key, (CAMERA_SIDE, CAMERA_SIDE)), float)
        for name, key in zip(names, keys, strict=True)
    }
    truth |= {} if gain is None else {"dolp_gain": np.asarray(gain)}
    protocol = pb.simulation.Protocol(views=12, wavelengths=(), largest_view_zenith=75.0)
    return pb.simulate("plastic", scene="camera", protocol=protocol, parameters=truth, seed=seed)


def camera() -> None:
    """Print the coverage of good pixels by true roughness."""
    for gain, shared in ((None, ()), (0.93, SHARED), (1.0, SHARED), (1.0, None), (1.0, ())):
        image, begun = camera_image(gain), time.perf_counter()
        maps = pb.fit_pixels(image, shared=shared)
        asked = "by default" if shared is None else ", ".join(shared) or "nothing"
        print(f"shared: {asked}; {time.perf_counter() - begun:.0f} s")
        print(pb.maps.count_pixels(maps))
        print(pb.maps.shared_parameters(maps))
        roughness = image["true_roughness"]
        for low, high in BANDS:
            # Pixels of other bands have no known truth, and are not counted.
            in_band = image.where((roughness >= low) & (roughness < high))
            print(f"roughness {low} to {high}")
            print(pb.diagnostics.map_coverage(maps, in_band)[["answered", "held_95"]].round(3))
    rows = camera_image(None).isel(y=slice(MIXTURES))
    begun = time.perf_counter()
    maps = pb.fit_pixels(rows, method="importance")
    seconds = time.perf_counter() - begun
    print(f"by mixtures, {MIXTURES * CAMERA_SIDE} pixels: {seconds:.0f} s with compilation")
    print(pb.diagnostics.map_coverage(maps, rows)[["answered", "held_95"]].round(3))


IMAGES, BLOCKS = 100, 5
FACTOR = "stokes_error_factor"


def hold_means(maps: xr.Dataset, image: xr.Dataset) -> dict[str, int]:
    """Count the square regions whose means lie within their intervals."""
    at = np.arange(SIDE) * BLOCKS // SIDE
    labels = 1 + BLOCKS * at[:, None] + at
    found = pb.maps.region_means(maps, labels)
    is_good = maps["status"].to_numpy() == 0
    hits = {}
    for name in ("refractive_index", "subsurface_fraction"):
        true = image[f"true_{name}"].to_numpy()
        means = [true[(labels == k) & is_good].mean() for k in found["region"].to_numpy()]
        low, high = found[f"{name}_interval"].to_numpy()
        hits[name] = int(np.sum((low <= means) & (means <= high)))
    return hits


def shared() -> None:
    """Print the coverage of intervals of the noise and of n, over many images."""
    random, links = np.random.default_rng(5), {"q": pb.links.StokesLink(stated_errors=True)}
    asked = {"scene": ASKED["scene"], "links": links}
    held, scores, pixels, regions, widths = [], [], [], [], []
    for seed in range(IMAGES):
        factor = float(np.exp(np.log(1.5) + 0.7 * random.normal()))
        image = plate_image(SIDE, SIDE, noise=0.01 * factor, seed=seed)
        image = image.assign(q_error=xr.full_like(image["q_error"], 0.01))
        maps = pb.fit_pixels(image, shared=(FACTOR,), **asked)
        row = pb.maps.shared_parameters(maps).loc[FACTOR]
        held.append(row["q2.5"] <= factor <= row["q97.5"])
        scores.append(3.92 * np.log(factor / row["q50"]) / np.log(row["q97.5"] / row["q2.5"]))
        pixels.append(pb.diagnostics.map_coverage(maps, image)["held_95"])
        regions.append(hold_means(maps, image))
        if seed < 3:  # sds of n over those of a map that is told the noise
            model = handlers.condition(per_material, data={FACTOR: factor})
            told = pb.fit_pixels(image, model=model, **asked)["refractive_index_sd"]
            own = pb.fit_pixels(image, **asked)["refractive_index_sd"]
            widths.append([float((x / told).median()) for x in (maps["refractive_index_sd"], own)])
    interval = stats.binomtest(sum(held), IMAGES).proportion_ci(method="wilson")
    print(f"noise held in {sum(held)} of {IMAGES} images [{interval.low:.1%}, {interval.high:.1%}]")
    print(f"standard scores: mean {np.mean(scores):.2f}, sd {np.std(scores):.2f}")
    print(pd.DataFrame(pixels).describe().loc[["mean", "min", "max"]].round(3))
    for name, hits in pd.DataFrame(regions).sum().items():
        count = IMAGES * BLOCKS**2
        low, high = stats.binomtest(int(hits), count).proportion_ci(method="wilson")
        print(f"means of {name} held in {hits} of {count} regions [{low:.1%}, {high:.1%}]")
    print("sd of n over that of a map that is told the noise: shared, each its own", widths)


def plates() -> None:
    """Print the coverage of intervals of smooth plates."""
    noise = np.exp(np.random.default_rng(2).uniform(np.log(0.005), np.log(0.08), (SIDE, SIDE)))
    image = plate_image(SIDE, SIDE, noise=noise, seed=12)
    for name, method in METHODS.items():
        maps = pb.fit_pixels(image, method=method, **ASKED)
        print(f"{name}: {pb.maps.count_pixels(maps)}")
        print(pb.diagnostics.map_coverage(maps, image)[["held_50", "held_80", "held_95"]].round(3))


PARTS = {"plates": plates, "camera": camera, "shared": shared}


def main() -> None:
    for name in sys.argv[1:] or PARTS:
        PARTS[name]()


if __name__ == "__main__":
    main()
