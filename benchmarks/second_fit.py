"""What the first fit of a layout costs, and what the next one of other readings does.

    python benchmarks/second_fit.py

Smooth plates: one by each method, four by the hierarchical model, one in three colors. Prints
seconds of a first and of a second `pb.fit` with the default settings of each method, and how many
programs JAX compiled in each.
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


SPECTRAL = pb.models.GpSpectral(coupled=("refractive_index",))
FITS: dict[str, tuple[Callable[[int], xr.Dataset], Any, str]] = {
    "per_material, point": (one, "per_material", "point"),
    "per_material, laplace": (one, "per_material", "laplace"),
    "per_material, nuts": (one, "per_material", "nuts"),
    "hierarchical, nuts": (four, "hierarchical", "nuts"),
    "gp_spectral, nuts": (three_colors, SPECTRAL, "nuts"),
}


def main() -> None:
    print(f"{platform.machine()}, {os.cpu_count()} cores")
    print(f"{'':<24}{'first s':>9}{'programs':>10}{'second s':>10}{'programs':>10}")
    for title, (capture, model, method) in FITS.items():
        told = ""
        for seed in (1, 2):
            readings, start = capture(seed), time.perf_counter()
            with compilations() as compiled:
                pb.fit(readings, model=model, method=method, scene=PLATE, links=LINKS, seed=seed)
            told += f"{time.perf_counter() - start:>{9 if seed == 1 else 10}.1f}{len(compiled):>10}"
        print(f"{title:<24}{told}", flush=True)


if __name__ == "__main__":
    main()
