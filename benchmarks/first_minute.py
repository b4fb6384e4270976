"""A new user with the demo and three kinds of input, from an empty folder to reports, by steps.

    python benchmarks/first_minute.py DATA

DATA holds a goniometer's tables (`glass_fresnel`), a frame of a polarization camera
(`fruit_mosaic`) and a table of degrees of polarization (`river_water`). Every step is a command in
a process of its own. Nothing is compiled before; "again" repeats a step with its programs on the
disk. Prints a table in markdown: seconds, and their ratio to a yardstick of the same run, the time
to import the libraries in a new process; and the load of the machine, on which times depend.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FRUIT = ("--sphere", "632", "732", "552", "--sphere", "536", "1804", "400")
TABLE = (
    *("--column", "view_zenith", "aoi", "--column", "light_zenith", "aoi"),
    *("--column", "dop", "DoLP", "--column", "dop_error", "err"),
    *("--constant", "view_azimuth", "180", "--constant", "light_azimuth", "0"),
)


FEWER = """
import polar_bayes as pb
capture = pb.load_capture("glass.nc")
pb.save_capture(capture.isel(view=slice(0, -1)), "fewer.nc")
"""
"""The plate with another number of readings."""

YARDSTICK = "import jax, numpyro, xarray, arviz_stats"


def yardstick() -> float:
    """Seconds in which a new process imports the libraries, the shortest of three."""
    times = []
    for _ in range(3):
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", YARDSTICK], check=True)
        times.append(time.perf_counter() - begun)
    return min(times)


def steps(data: Path) -> dict[str, list[list[str]]]:
    """The commands of each input."""
    glass, frame = data / "glass_fresnel", data / "fruit_mosaic" / "fruits_IMX250MZR.png"
    incident = ["--s-incident", "1910", "--p-incident", "1630", "--angle-set-by", "hand"]
    tables = ["--s", str(glass / "s1.txt"), "--p", str(glass / "p1.txt"), *incident]
    return {
        "demo": [["demo", "--out", "demo"]],
        "goniometer table": [
            ["import", "goniometer", *tables, "--out", "glass.nc"],
            ["fit", "glass.nc", "--out", "glass_fit.nc"],
            ["report", "glass_fit.nc", "--out", "glass_report"],
            ["scenes", "glass.nc", "--out", "glass_scenes.nc"],
            ["python", FEWER],
            ["fit", "fewer.nc", "--out", "fewer_fit.nc"],
        ],
        "camera frame": [
            ["import", "mosaic", str(frame), *FRUIT, "--surroundings", "--bin", "32",
             "--out", "fruit.nc"],
            ["map", "fruit.nc", "--draws", "128", "--out", "fruit.zarr"],
            ["report", "fruit.zarr", "--out", "fruit_report"],
        ],
        "table of degrees of polarization": [
            ["import", "table", str(data / "river_water" / "river_water_dolp.csv"),
             *TABLE, "--out", "river.nc"],
            ["fit", "river.nc", "--out", "river_fit.nc"],
            ["report", "river_fit.nc", "--out", "river_report"],
        ],
    }  # fmt: skip


def run(words: list[str], folder: Path, cache: Path) -> tuple[float, int]:
    """Seconds and exit status of a command whose compiled programs are in a folder of their own."""
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    program = ["-c", words[1]] if words[0] == "python" else ["-m", "polar_bayes.cli", *words]
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *program],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode not in (0, 2):
        raise SystemExit(f"{' '.join(words)}: {done.stderr}")
    return time.perf_counter() - begun, done.returncode


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data.resolve()
    unit = yardstick()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before; yardstick {unit:.1f} s\n")
    print("| input | step | first [s] | again [s] | first | again | exit status |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for title, commands in steps(data).items():
        with tempfile.TemporaryDirectory() as name:
            cache = Path(name) / "cache"
            cache.mkdir(mode=0o700)
            folders = Path(name) / "first", Path(name) / "again"
            times = []
            for folder in folders:
                folder.mkdir()
                times.append([run(words, folder, cache) for words in commands])
            for words, (first, status), (again, _) in zip(commands, *times, strict=True):
                step = " ".join(words[: 2 if words[0] in ("import", "fit") else 1])
                ratios = f"{first / unit:.1f} | {again / unit:.1f}"
                row = f"| {title} | {step} | {first:.1f} | {again:.1f} | {ratios} | {status} |"
                print(row, flush=True)
    print(f"\nload {os.getloadavg()[0]:.1f} after")


if __name__ == "__main__":
    main()
