"""Fits per second of simulation-based calibration, compared with a loop of `MCMC.run` and simuk.

    pip install '.[peers]'
    python benchmarks/calibration.py           1000 fits of ours by each method
    python benchmarks/calibration.py 200       fewer
    python benchmarks/calibration.py 200 nuts  by one method

The per-material model of one color: 40 views of the degree of polarization and of intensity by the
paper's scene with four facets on the way out; four parameters of the material, three of the noise.
Ours is timed three times: with compilation, without, and without ranking readings, which the others
do not do either; fits per second are of the last. The loop fits the same simulations, each by one
compiled chain of 500 warm-up and 500 kept draws with NumPyro's defaults; simuk simulates and fits
by such chains itself, and compiles each. A few fits stand for many there.
ESS is the least of all parameters of a fit, or what its weighted draws are worth: of all fits, the
5% quantile and the median. The last column is the least p-value of uniform ranks, of seven.
"""

import dataclasses
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
import simuk
import xarray as xr
from numpyro import handlers
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC, NUTS
from one_material import SCENE, layout

import polar_bayes as pb
from polar_bayes.calibration.runner import draw_captures
from polar_bayes.inference.program import compile_program
from polar_bayes.inference.request import resolve
from polar_bayes.observation.data import observe

LOOPED, SIMUK = 8, 2
LENGTHS = {"num_warmup": 500, "num_samples": 500}


def by_loop(capture: xr.Dataset, count: int) -> Iterator[tuple[float, float]]:
    """Seconds and least ESS of each fit by a chain of NumPyro's own, compiled once."""
    with jax.enable_x64(True):
        request = resolve(capture, "per_material", SCENE, None, None, None, 0, "double")
        data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
        model = request.bind()
        program = compile_program(model, data)
        drawn = draw_captures(program, data, np.arange(count), jax.random.key(1))
        chain = MCMC(NUTS(model), progress_bar=False, **LENGTHS)
        for number in range(-1, count):  # the first compiles
            start = time.perf_counter()
            chain.run(jax.random.key(number + 1), drawn.captures.pixel(max(number, 0)))
            draws = chain.get_samples(group_by_chain=True)
            names = [name for name in draws if name in program.supports]
            effective = min(float(np.min(effective_sample_size(draws[name]))) for name in names)
            if number >= 0:
                yield time.perf_counter() - start, effective


def by_simuk(capture: xr.Dataset, count: int) -> float:
    """Seconds of some fits by simuk."""
    with jax.enable_x64(True):
        request = resolve(capture, "per_material", SCENE, None, None, None, 0, "double")
        data = observe(request.capture, largest_view_zenith=request.largest_view_zenith)
        model = request.bind()

        def story(dop: Any = None, intensity: Any = None) -> None:
            if dop is None:
                handlers.uncondition(model)(data)
            else:
                model(dataclasses.replace(data, readings={"dop": dop, "intensity": intensity}))

        start = time.perf_counter()
        simuk.SBC(
            NUTS(story),
            num_simulations=count,
            sample_kwargs=dict(LENGTHS),
            data_dir={name: data.readings[name] for name in ("dop", "intensity")},
            progress_bar=False,
        ).run_simulations()
        return time.perf_counter() - start


def main(count: int, methods: Sequence[str]) -> None:
    capture = layout()
    print(f"{platform.machine()}, {os.cpu_count()} cores; {count} fits of 7 parameters")
    print(
        "method       cold s   warm s   bare s   fits/s   of loop   ESS 5%  median  failed  least p"
    )
    seconds, effective = np.array(list(by_loop(capture, LOOPED))).T
    loop = 1.0 / seconds.mean()

    def line(name: str, took: Sequence[float], rate: float, told: Any, end: str) -> None:
        least = "       -       -"
        if np.isfinite(told).any():
            least = f"{np.nanquantile(told, 0.05):8.0f} {np.nanmedian(told):7.0f}"
        print(
            f"{name:<11}{''.join(f'{each:9.1f}' for each in took)}"
            f"{rate:9.2f} {rate / loop:9.1f} {least} {end}",
            flush=True,
        )

    took: Sequence[float] = (np.nan, np.nan, seconds.sum())
    line("MCMC.run", took, loop, effective, f"   ({LOOPED} fits)")
    took_simuk = by_simuk(capture, SIMUK)
    took = (took_simuk, np.nan, np.nan)
    line("simuk", took, SIMUK / took_simuk, np.nan, f"   ({SIMUK} fits)")
    for method in methods:
        took = []
        for readings in (True, True, False):
            start = time.perf_counter()
            found = pb.calibrate(
                capture, simulations=count, method=method, scene=SCENE, readings=readings
            )
            took.append(time.perf_counter() - start)
        table, fits = pb.summary(found), found["fits"].to_dataset()
        end = f"{int(np.sum(fits['status'] != 0)):7d} {table['p_value'].min():8.4f}"
        line(method, took, count / took[-1], fits["ess"].to_numpy(), end)


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 else 1000,
        sys.argv[2:] or ("nuts", "importance", "corrected-laplace", "laplace"),
    )
