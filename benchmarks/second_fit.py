"""Cost of the first fit of a layout, and of the next fit of other readings.

    python benchmarks/second_fit.py
    python benchmarks/second_fit.py "map, nothing shared"

Smooth plates: one by each method, four by the hierarchical model, one in three colors; then maps of
24 x 24 rough materials before a camera, alone and with the polarizer that they share. Prints
seconds of a first and of a second fit with the default settings, and how many programs JAX compiled
in each. With JAX_ENABLE_COMPILATION_CACHE=false in the environment no program comes from the disk.
"""

import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import xarray as xr
from compilations import compilations
from map_coverage import camera_image
from plates import LINKS, PLATE, plate_capture, plates
from spectral_plates import spectral_plate

import polar_bayes as pb

COLORS = {450.0: 1.52, 550.0: 1.51, 650.0: 1.505}


def one(seed: int) -> xr.Dataset:
    return plate_capture(np.linspace(20.0, 80.0, 12), 0.02, seed)


def four(seed: int) -> xr.Dataset:
    return plates([1.45, 1.5, 1.55, 1.6], 0.03, seed=seed)


def three_colors(seed: int) -> xr.Dataset:
    return spectral_plate(COLORS, error=0.01, seed=seed)


def camera(seed: int) -> xr.Dataset:
    return camera_image(1.0, seed).isel(y=slice(24), x=slice(24))


def fitted(model: Any, method: str) -> Callable[[xr.Dataset, int], Any]:
    """A fit of a capture of plates."""

    def fit(capture: xr.Dataset, seed: int) -> Any:
        return pb.fit(capture, model=model, method=method, scene=PLATE, links=LINKS, seed=seed)

    return fit


SPECTRAL = pb.models.GpSpectral(coupled=("refractive_index",))
FITS: dict[str, tuple[Callable[[int], xr.Dataset], Callable[[xr.Dataset, int], Any]]] = {
    "per_material, point": (one, fitted("per_material", "point")),
    "per_material, laplace": (one, fitted("per_material", "laplace")),
    "per_material, nuts": (one, fitted("per_material", "nuts")),
    "hierarchical, nuts": (four, fitted("hierarchical", "nuts")),
    "gp_spectral, nuts": (three_colors, fitted(SPECTRAL, "nuts")),
    "map, nothing shared": (camera, lambda image, _: pb.fit_pixels(image, shared=())),
    "map, as by default": (camera, lambda image, _: pb.fit_pixels(image)),
}


def main() -> None:
    asked = sys.argv[1:] or FITS
    print(f"{platform.machine()}, {os.cpu_count()} cores")
    print(f"{'':<24}{'first s':>9}{'programs':>10}{'second s':>10}{'programs':>10}")
    for title in asked:
        capture, fit = FITS[title]
        told = ""
        for seed in (1, 2):
            readings, start = capture(seed), time.perf_counter()
            with compilations() as compiled:
                fit(readings, seed)
            told += f"{time.perf_counter() - start:>{9 if seed == 1 else 10}.1f}{len(compiled):>10}"
        print(f"{title:<24}{told}", flush=True)


if __name__ == "__main__":
    main()
