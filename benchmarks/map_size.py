"""Pixels per second and memory from ten thousand pixels to ten million, from file to file.

    python benchmarks/map_size.py                      10^4, 10^5 and 10^6 pixels
    python benchmarks/map_size.py 10000000             another size, or several
    python benchmarks/map_size.py 200000 --workers 1   on so many processes of a local cluster

Smooth plates of two unknowns, six views of q with stated errors. Each size has a process of its
own, whose programs are compiled by a small map first; memory is the process's largest resident set,
compilation included. Images repeat one tile of 256 x 256 different pixels.
"""

import argparse
import contextlib
import multiprocessing
import os
import platform
import resource
import sys
import tempfile
import time
from pathlib import Path

import dask.array as da
import distributed

import polar_bayes as pb
from polar_bayes.cli.entry import limit_arenas

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from plate_images import ASKED, plate_image

TILE = 256
SIZES = (10_000, 100_000, 1_000_000)


def image(count: int, path: Path) -> Path:
    """About so many pixels in a Zarr store, written chunk by chunk."""
    side = round(count**0.5)
    tile = plate_image(TILE, TILE, seed=3).drop_vars(
        ["true_refractive_index", "true_subsurface_fraction"]
    )
    times = -(-side // TILE)
    whole = tile[[name for name in tile if "y" not in tile[name].dims]]
    for name in ("q", "q_error"):
        repeated = da.tile(da.from_array(tile[name].to_numpy()), (times, times, 1))
        whole[name] = (("y", "x", "view"), repeated[:side, :side])
    whole.chunk(y=TILE, x=TILE).to_zarr(path, consolidated=False)
    return path


def timed(count: int, workers: int) -> tuple[float, float]:
    """Pixels per second of a warm map, and the largest memory of this process in GB."""
    limit_arenas()  # as the command does
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        small, large = image(4 * TILE**2, here / "small.zarr"), image(count, here / "large.zarr")
        with contextlib.ExitStack() as stack:
            address = None
            if workers:
                cluster = distributed.LocalCluster(n_workers=workers, threads_per_worker=1)
                address = stack.enter_context(cluster).scheduler_address
            pb.maps.map_file(small, here / "first.zarr", scheduler=address, **ASKED)
            start = time.perf_counter()
            maps = pb.maps.map_file(large, here / "map.zarr", scheduler=address, **ASKED)
            seconds = time.perf_counter() - start
        pixels = maps.sizes["y"] * maps.sizes["x"]
        good = int((maps["status"] == 0).sum())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"{pixels:10d} {seconds:9.1f} {pixels / seconds:11.0f} {memory:9.2f} {good / pixels:8.4f}"
    )
    return pixels / seconds, memory


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("sizes", type=int, nargs="*", default=SIZES)
    parser.add_argument("--workers", type=int, default=0, help="0: threads of one process")
    asked = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores; workers: {asked.workers or 'threads'}")
    print("    pixels   seconds    pixels/s memory/GB     good", flush=True)
    for size in asked.sizes:
        process = multiprocessing.get_context("spawn").Process(
            target=timed, args=(size, asked.workers)
        )
        process.start()
        process.join()


if __name__ == "__main__":
    main()
