"""Effect of a shorter warm-up of NUTS: six scenes and two populations.

    python benchmarks/warmup.py                      300 (the default), 200 and 100 draws
    python benchmarks/warmup.py --lengths 300 250 --cases "leaf, 40 views"
    python benchmarks/warmup.py --lengths 300 600 --seeds 8 --cases "goniometer, 23 views"

The scenes are those of `accuracy_scenes.py`, each with other readings for every seed; then glass
plates of two and of four materials by the hierarchical model, one on a goniometer with all that is
unknown there, and a leaf in three colors. A row is of all seeds together:
parameters, gradients of the warm-up and of the draws (in thousands, mean), draws a chain (mean),
effective draws for a thousand gradients (least of all parameters, warm-up included, mean), the
worst R-hat, bulk and tail effective sample size, all divergences, fits whose goals were not
reached, the mean acceptance (least and largest chain), and the largest step from the means and
standard deviations of the first length, in Monte Carlo standard errors of both.
"""

import argparse
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import xarray as xr
from accuracy_scenes import CASES
from plates import GONIOMETER, GONIOMETER_VIEWS, LINKS, PLATE, plate_capture, plates

import polar_bayes as pb
from polar_bayes.inference.result import provenance_of
from polar_bayes.numerics.mcse import measure, standard_errors

TWO, FOUR = (1.45, 1.55), (1.45, 1.5, 1.55, 1.6)
Asked = tuple[Callable[[int], xr.Dataset], dict[str, Any]]


def population(indices: Sequence[float]) -> Asked:
    asked = {"model": "hierarchical", "scene": PLATE, "links": LINKS}
    return lambda seed: plates(list(indices), 0.03, seed=seed), asked


FITS: Mapping[str, Asked] = {
    **{
        name: (case.capture, {"scene": case.scene, "links": case.links})
        for name, case in CASES.items()
    },
    "goniometer, 23 views": (
        lambda seed: plate_capture(GONIOMETER_VIEWS, 0.02, seed=seed),
        GONIOMETER,
    ),
    "leaf in three colors": (lambda seed: pb.simulate("leaf", seed=seed), {}),
    "two glasses": population(TWO),
    "four glasses": population(FOUR),
}


def chains_of(result: xr.DataTree) -> np.ndarray:
    """Draws of every parameter, (parameter, chain, draw)."""
    found = [x.values.reshape(*x.shape[:2], -1) for x in result["posterior"].data_vars.values()]
    return np.moveaxis(np.concatenate(found, axis=-1), -1, 0)


def look(result: xr.DataTree) -> dict[str, float | np.ndarray]:
    """Return diagnostics of one fit."""
    draws, stats = chains_of(result), result["sample_stats"]
    mixing, steps = measure(draws), stats["n_steps"].values
    before = int(stats["warmup_steps"].isel(draw=0).sum())
    worth = min(mixing.bulk.min(), mixing.tail.min())
    accepted = stats["acceptance_rate"].mean("draw").values
    flat = draws.reshape(len(draws), -1)
    return {
        "size": len(draws),
        "before": before,
        "after": steps.sum(),
        "draws": draws.shape[-1],
        "efficiency": 1e3 * worth / (before + steps.sum()),
        "r_hat": mixing.r_hat.max(),
        "bulk": mixing.bulk.min(),
        "tail": mixing.tail.min(),
        "diverged": stats["diverging"].sum().item(),
        "short": float(not provenance_of(result)["goals_reached"]),
        "accepted": accepted,
        "mean": flat.mean(axis=1),
        "sd": flat.std(axis=1),
        "errors": np.stack(standard_errors(draws)),
    }


def step(first: list[dict[str, Any]], other: list[dict[str, Any]]) -> float:
    """Largest step between two lengths, seed by seed, in standard errors of both."""
    steps = [0.0]
    for a, b in zip(first, other, strict=True):
        errors = np.hypot(a["errors"], b["errors"]) * a["sd"]
        apart = np.stack([a["mean"] - b["mean"], a["sd"] - b["sd"]])
        steps.append(float(np.max(np.abs(apart) / errors)))
    return max(steps)


def main(names: list[str], lengths: list[int], seeds: int) -> None:
    print(f"{platform.machine()}, {os.cpu_count()} cores, {seeds} seeds")
    print(
        f"{'':<32}{'warm-up':>8}{'size':>5}{'k grad.':>13}{'draws':>6}{'ESS/k':>7}{'R-hat':>8}",
        end="",
    )
    print(f"{'bulk':>6}{'tail':>6}{'div.':>5}{'short':>6}{'accepted':>11}{'step':>6}{'s':>6}")
    for name in names:
        make, asked = FITS[name]
        first: list[dict[str, Any]] = []
        for length in lengths:
            start = time.perf_counter()
            found = [
                look(pb.fit(make(seed), method=pb.methods.Nuts(warmup=length), seed=seed, **asked))
                for seed in range(1, seeds + 1)
            ]
            first = first or found
            mean = {
                key: np.mean([one[key] for one in found])
                for key in ("before", "after", "draws", "efficiency")
            }
            accepted = np.concatenate([one["accepted"] for one in found])
            print(
                f"{name:<32}{length:>8}{found[0]['size']:5d}"
                f"{mean['before'] / 1e3:6.1f} {mean['after'] / 1e3:6.1f}{mean['draws']:6.0f}"
                f"{mean['efficiency']:7.1f}{max(one['r_hat'] for one in found):8.4f}"
                f"{min(one['bulk'] for one in found):6.0f}{min(one['tail'] for one in found):6.0f}"
                f"{sum(one['diverged'] for one in found):5d}"
                f"{sum(one['short'] for one in found):6.0f}"
                f"{accepted.min():6.2f} {accepted.max():.2f}{step(first, found):6.1f}"
                f"{time.perf_counter() - start:6.0f}",
                flush=True,
            )


if __name__ == "__main__":
    told = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    told.add_argument("--lengths", type=int, nargs="*", default=[300, 200, 100])
    told.add_argument("--seeds", type=int, default=4)
    told.add_argument("--cases", nargs="*", default=list(FITS), metavar="CASE")
    wanted = told.parse_args()
    main(wanted.cases, wanted.lengths, wanted.seeds)
