"""Coverage of the intervals of a map, with and without the correction by weights.

    python benchmarks/map_coverage.py plates camera shared setup

    plates    ten thousand smooth plates drawn from the priors, with noise from .005 to .08
    camera    900 rough materials before a camera in a perfect set-up, by roughness: each pixel
              infers its own exposure, noise and polarizer; then images that share these, with a
              usual and a perfect one, and one that shares a perfect polarizer alone
    shared    100 images of ten thousand plates, each with a noise of its own, which all of its
              pixels share; beside maps whose pixels each infer it, and maps that are told; means
              of 25 regions of each
    setup     900 rough materials in set-ups with errors, each pixel with its own: maps that take
              the set-up for perfect, and maps that carry its errors; then ten camera images, each
              with one set-up and one polarizer, and the means of all their pixels: maps that share
              the zenith of the lamp, as by default, and maps that carry its error

Without a part, all of them are run.
"""

import dataclasses
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
from polar_bayes.physics.scene import MATERIAL_PARAMETERS

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
    perfect, polarizer = dataclasses.replace(pb.setups.SETUPS["camera"], known=()), ("dolp_gain",)
    for gain, shared in ((None, ()), (0.93, SHARED), (1.0, SHARED), (1.0, polarizer), (1.0, ())):
        image, begun = camera_image(gain), time.perf_counter()
        maps = pb.fit_pixels(image, scene=perfect, shared=shared)
        asked = ", ".join(shared) or "nothing"
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
    maps = pb.fit_pixels(rows, scene=perfect, method="importance")
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


ONE_SETUP, ONE_SIDE = 10, 24
"""Images whose pixels share the errors of the set-up, and rows of each."""


def image_with_errors(name: str, side: int, seed: int, *, of_pixels: bool) -> xr.Dataset:
    """Rough materials in an imperfect set-up; its errors and gain are those of a pixel, or not."""
    setup = pb.setups.SETUPS[name]
    scene, priors = setup.scene.known_to(setup.known), {**pb.PRIORS, **setup.priors}
    keys = jax.random.split(jax.random.key(seed), len(scene.parameters))
    size, every = (side, side), zip(scene.parameters, keys, strict=True)
    own = {"roughness", "subsurface_fraction", "refractive_index"}
    drawn = [each for each in every if each[0] not in ("absorption", "concentration_scale")]
    truth = {
        name: np.asarray(priors[name].sample(key, size if of_pixels or name in own else ()), float)
        for name, key in drawn
    }
    protocol = pb.simulation.Protocol(views=12, wavelengths=(), largest_view_zenith=75.0)
    if name == "picture":
        protocol = pb.simulation.MirrorScan(views=8, wavelengths=(), largest_view_zenith=70.0)
    asked = {"scene": scene, "links": setup.links, "protocol": protocol, "parameters": truth}
    return pb.simulate("plastic", **asked, seed=seed)


def setup() -> None:
    """Print the coverage of intervals in set-ups with errors."""
    for name in ("camera", "polarimeter", "picture"):
        usual = pb.setups.SETUPS[name]
        image = image_with_errors(name, CAMERA_SIDE, 3, of_pixels=True)
        for title, asked in (
            ("taken for perfect", dataclasses.replace(usual, known=())),
            ("errors carried", usual),
        ):
            begun = time.perf_counter()
            maps = pb.fit_pixels(image, scene=asked, shared=())
            print(f"{name}, {title}: {time.perf_counter() - begun:.0f} s with compilation")
            print(pb.maps.count_pixels(maps), pb.maps.setup_sentences(maps))
            print(pb.diagnostics.map_coverage(maps, image)[["answered", "held_95"]].round(3))
    one_setup("by default", None)
    one_setup("zenith of the lamp carried", ("dolp_gain",))


def one_setup(title: str, shared: tuple[str, ...] | None) -> None:
    """Print the coverage in images whose pixels share the errors of one set-up."""
    scores, held, gains = [], [], []
    for seed in range(ONE_SETUP):
        image = image_with_errors("camera", ONE_SIDE, 100 + seed, of_pixels=False)
        maps = pb.fit_pixels(image, scene="camera", shared=shared)
        held.append(pb.diagnostics.map_coverage(maps, image)["held_95"])
        good = maps["status"].to_numpy() == 0
        means = pb.maps.region_means(maps, good).isel(region=0)
        names = [name for name in MATERIAL_PARAMETERS if name in means]
        apart = {n: float(means[n]) - image[f"true_{n}"].to_numpy()[good].mean() for n in names}
        scores.append({n: apart[n] / float(means[f"{n}_sd"]) for n in names})
        rows = pb.maps.shared_parameters(maps)
        rows["true"] = [float(image[f"true_{name}"]) for name in rows.index]
        gains.append(rows["true"].between(rows["q2.5"], rows["q97.5"]).to_dict())
        print(f"seed {100 + seed}", rows.round(3), sep="\n")
    print(f"one set-up, {title}: pixels held", pd.DataFrame(held).mean().round(3).to_dict())
    print("means of all pixels, in standard deviations of their intervals")
    print(pd.DataFrame(scores).round(2))
    print("what is shared held", gains)


def plates() -> None:
    """Print the coverage of intervals of smooth plates."""
    noise = np.exp(np.random.default_rng(2).uniform(np.log(0.005), np.log(0.08), (SIDE, SIDE)))
    image = plate_image(SIDE, SIDE, noise=noise, seed=12)
    for name, method in METHODS.items():
        maps = pb.fit_pixels(image, method=method, **ASKED)
        print(f"{name}: {pb.maps.count_pixels(maps)}")
        print(pb.diagnostics.map_coverage(maps, image)[["held_50", "held_80", "held_95"]].round(3))


PARTS = {"plates": plates, "camera": camera, "shared": shared, "setup": setup}


def main() -> None:
    for name in sys.argv[1:] or PARTS:
        PARTS[name]()


if __name__ == "__main__":
    main()
