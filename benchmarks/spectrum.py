"""Real materials at colors that were not measured, and the cost of many colors.

    python benchmarks/spectrum.py [bands] [coverage] [colors]

Prints Markdown tables; takes some ten minutes.
"""

import sys
import time
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
import xarray as xr

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from spectral_plates import LINKS, PLATE, spectral_plate, tabulated

MODEL = pb.models.GpSpectral(coupled=("refractive_index",))
VIEWS = np.linspace(30.0, 78.0, 24)
ERROR = 0.002
HELD_OUT = (550.0, 633.0)
REPLICATES = 8


def band(material: Mapping[float, float], held: float, method: str, seed: int) -> np.ndarray:
    """95% band of a color from the three others."""
    measured = {color: index for color, index in material.items() if color != held}
    capture = spectral_plate(measured, error=ERROR, seed=seed, views=VIEWS)
    result = pb.fit(capture, model=MODEL, scene=PLATE, links=LINKS, method=method, seed=seed)
    if method == "nuts" and not pb.verdict(result).passed:
        print("not converged:", pb.verdict(result).problems)
    draws = pb.inference.predict_spectrum(result, held, seed=seed)["refractive_index"].to_numpy()
    return np.quantile(draws, (0.025, 0.975))


def alone(index: float, held: float, seed: int) -> np.ndarray:
    """95% interval of a color that was measured, from its own views."""
    capture = spectral_plate({held: index}, error=ERROR, seed=seed, views=VIEWS)
    result = pb.fit(capture, scene=PLATE, links=LINKS, method="nuts", seed=seed)
    return np.quantile(result["posterior"]["refractive_index"].to_numpy(), (0.025, 0.975))


def bands() -> None:
    """The table of real materials."""
    print("| material | nm | true n | band from other colors | inside | width | measured alone |")
    print("|---|---|---|---|---|---|---|")
    for number, (name, material) in enumerate(tabulated().items()):
        for held in HELD_OUT:
            low, high = band(material, held, "nuts", number)
            own = np.diff(alone(material[held], held, number))[0]
            inside = low < material[held] < high
            print(
                f"| {name} | {held:.0f} | {material[held]:.4f} | {low:.4f} to {high:.4f} | "
                f"{'yes' if inside else 'NO'} | {high - low:.4f} | {own:.4f} |",
                flush=True,
            )


def coverage() -> None:
    """Count the bands of many replicates that contain the truth."""
    inside = []
    for seed in range(100, 100 + REPLICATES):
        for material in tabulated().values():
            for held in HELD_OUT:
                low, high = band(material, held, "laplace", seed)
                inside.append(low < material[held] < high)
    error = np.sqrt(0.05 * 0.95 / len(inside))
    print(f"{np.mean(inside):.3f} of {len(inside)} bands hold the truth (.95 +- {error:.3f})")


def colors() -> None:
    """Seconds of a fit by the number of colors."""
    print("| colors | coordinates of the process | fit (s) | of which compiling and search | ESS |")
    print("|---|---|---|---|---|")
    for count in (3, 20, 200):
        wavelength = np.linspace(400.0, 800.0, count)
        index = 1.5046 + 4200.0 / wavelength**2
        capture = spectral_plate((wavelength, index), error=0.01, seed=1, views=VIEWS[::4])
        start = time.perf_counter()
        result = pb.fit(capture, model=MODEL, scene=PLATE, links=LINKS, method="nuts", seed=1)
        seconds = time.perf_counter() - start
        table = pb.summary(result)
        drawing = seconds - timings_of(result)["draws"]
        print(
            f"| {count} | {min(count, 20)} | {seconds:.0f} | {drawing:.0f} | "
            f"{table['ess_bulk'].min():.0f} |",
            flush=True,
        )
        print(pb.verdict(result).problems or "converged", file=sys.stderr)


def timings_of(result: xr.DataTree) -> dict[str, float]:
    """Seconds of every stage."""
    return provenance_of(result)["timings"]


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for task in sys.argv[1:] or ("bands", "coverage", "colors"):
        {"bands": bands, "coverage": coverage, "colors": colors}[task]()
