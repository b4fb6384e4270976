"""Simulation-based calibration of whole models by `polar_bayes.fit`, on small layouts.

    python benchmarks/calibration_models.py material 3000        so many simulations
    python benchmarks/calibration_models.py hierarchical         200 of them
    python benchmarks/calibration_models.py spectral
    python benchmarks/calibration_models.py goniometer 40
    python benchmarks/calibration_models.py links --keep FOLDER  kept there, and gone on with

`material`: one material of the paper's scene, 40 views of the degree of polarization and of
intensity, by weighted draws. `links`: the same, 16 views, each way in which readings may scatter,
by weighted draws and by chains. `hierarchical`: 4 smooth plates, 6 views of q with stated errors,
indices and fractions from one population. `spectral`: a smooth plate in 4 colors, 6 views of q,
index a Gaussian process over wavelength. Both by `pb.methods.Nuts()`. `rough-hierarchical` and
`rough-spectral`: the same axes by the paper's scene, 16 views; minutes for each fit. `goniometer`:
a plate by the scene of that name, 23 views of q, eleven unknowns, by both methods. The paper's
scene has four facets on the way out here; priors are the default ones. Prints the joint verdict,
the table, what became of the fits, and seconds.
"""

import argparse
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import pandas as pd
import xarray as xr
from one_material import SCENE, layout
from patches import patch_capture
from plates import GONIOMETER, GONIOMETER_VIEWS, LINKS, PLATE, plate_capture, plates
from spectral_plates import spectral_plate

import polar_bayes as pb
from polar_bayes.inference.batching import Status

VIEWS, COLORS, ERROR = 16, (450.0, 550.0, 650.0, 750.0), 0.02
FEW = np.linspace(35.0, 75.0, 6)
ROUGH: dict[str, Any] = {"method": pb.methods.Nuts(), "scene": SCENE}
SMOOTH: dict[str, Any] = {"method": pb.methods.Nuts(), "scene": PLATE, "links": LINKS}
DOP = {
    "Beta": pb.links.BetaLink(),
    "logit-normal": pb.links.LogitNormalLink(),
    "normal": pb.links.NormalLink(),
}
STOKES = {
    "Stokes, normal": pb.links.StokesLink(),
    "Stokes, Student-t": pb.links.StokesLink(degrees_of_freedom=5.0),
    "Stokes, stated errors": pb.links.StokesLink(stated_errors=True),
    "Stokes, normal of one scale": pb.links.NormalLink(),
}


def one_material(wavelengths: tuple[float, ...] = ()) -> xr.Dataset:
    protocol = pb.simulation.Protocol(views=VIEWS, wavelengths=wavelengths)
    return pb.simulate("leaf", seed=1, protocol=protocol)


def stokes() -> xr.Dataset:
    """Return the same views, read as q and u in addition to intensity."""
    capture = one_material()
    level = xr.zeros_like(capture["dop"])
    return capture.drop_vars("dop").assign(
        {name: level + value for name, value in {"q": 0.1, "u": 0.0}.items()}
        | {f"{name}_error": level + ERROR for name in ("q", "u")}
    )


Asked = Iterator[tuple[str, xr.Dataset, dict[str, Any]]]
"""Titles, layouts and the arguments of `pb.calibrate`."""


def material() -> Asked:
    yield "one material, 40 views", layout(), {"method": "importance", "scene": SCENE}


def links() -> Asked:
    intensity = pb.setups.SETUPS["paper"].links["intensity"]
    for ways, capture in ((DOP, one_material()), (STOKES, stokes())):
        read = [name for name in ("dop", "q", "u") if name in capture]
        for title, link in ways.items():
            chosen = {name: link for name in read} | {"intensity": intensity}
            for method in ("importance", "nuts"):
                arguments = {"links": chosen, "method": method, "scene": SCENE}
                yield f"{title}, {method}", capture, arguments


def hierarchical() -> Asked:
    capture = plates(np.full(4, 1.5), ERROR, views=FEW)
    yield "4 plates, 6 views", capture, SMOOTH | {"model": "hierarchical"}


def spectral() -> Asked:
    capture = spectral_plate(dict.fromkeys(COLORS, 1.5), error=ERROR, seed=0, views=FEW)
    yield "a plate in 4 colors, 6 views", capture, SMOOTH | {"model": "gp_spectral"}


def goniometer() -> Asked:
    capture = plate_capture(GONIOMETER_VIEWS, ERROR, seed=1)
    for name, method in {"importance": "importance", "nuts": "nuts"}.items():
        yield f"a plate on a goniometer, {name}", capture, GONIOMETER | {"method": method}


def rough_hierarchical() -> Asked:
    capture = patch_capture(np.full(4, 1.45), views=VIEWS)
    yield "4 patches, 16 views", capture, ROUGH | {"model": "hierarchical"}


def rough_spectral() -> Asked:
    yield "4 colors, 16 views", one_material(COLORS), ROUGH | {"model": "gp_spectral"}


EVERY = {
    "material": material,
    "links": links,
    "hierarchical": hierarchical,
    "spectral": spectral,
    "goniometer": goniometer,
    "rough-hierarchical": rough_hierarchical,
    "rough-spectral": rough_spectral,
}


def said(found: xr.DataTree) -> str:
    """Print table and verdict of one calibration."""
    table = pb.summary(found)
    shown = pd.DataFrame({"p": table["p_value"].map("{:.3f}".format)})
    for percent in (50, 80, 95):
        name = f"held_{percent}"
        shown[f"{percent}% hold (range)"] = [
            f"{row[name]:.3f} ({row[f'{name}_low']:.3f}-{row[f'{name}_high']:.3f})"
            for _, row in table.iterrows()
        ]
    shown["rank mean"] = table["rank_mean"].map("{:.3f}".format)
    shown["spread"] = table["rank_spread"].map("{:.3f}".format)
    shown["answered"] = table["answered"]
    fits = found["fits"].to_dataset()
    statuses = fits["status"].to_numpy()
    counts = {each.name.lower(): int(np.sum(statuses == each)) for each in Status}
    worth = fits["ess"].to_numpy()
    worth = worth[np.isfinite(worth)]
    lines = [
        *pb.verdict(found).sentences,
        shown.to_string(),
        f"fits: {', '.join(f'{count} {name}' for name, count in counts.items() if count)}",
    ]
    if worth.size:
        lines.append(f"least ESS of a fit: 5% {np.quantile(worth, 0.05):.0f}, median "
                     f"{np.median(worth):.0f}")  # fmt: skip
    return "\n".join(lines)


def main(what: str, count: int, keep: Path | None, seed: int, only: str) -> None:
    print(f"{platform.machine()}, {os.cpu_count()} cores; {count} simulations each", flush=True)
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
    for title, capture, arguments in EVERY[what]():
        if only not in title:
            continue
        store = None if keep is None else keep / title.replace(",", "").replace(" ", "-")
        start = time.perf_counter()
        found = pb.calibrate(
            capture,
            simulations=count,
            seed=seed,
            store=store,
            resume=store is not None,
            **arguments,
        )
        seconds = time.perf_counter() - start
        print(f"\n{title}: {seconds:.0f} s, {count / seconds:.3f} fits/s with compilation")
        print(said(found), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=list(EVERY))
    parser.add_argument("count", type=int, nargs="?", default=200)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="titles that hold this text")
    given = parser.parse_args()
    main(given.what, given.count, given.keep, given.seed, given.only)
