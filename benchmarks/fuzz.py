"""Outcomes of malformed input of every kind, counted.

    python benchmarks/fuzz.py                   20,000 cases of seven families
    python benchmarks/fuzz.py --share 0.02      a fiftieth of them
    python benchmarks/fuzz.py zarr results      some families
    python benchmarks/fuzz.py --seed 7          other cases

Each case comes from the seed, its family and its number. Outcomes:

    refused      one line: a PolarBayesError, or exit status 1 of a command
    accepted     everything that is read is inside the contract, and what is missing is counted
    ALTERED      a file that this package wrote was damaged, and other values were read from it
    IMPOSSIBLE   numbers outside the contract were taken, and nothing says so
    TRACEBACK    any other exception, or more than one line
    crash, hang  of a subprocess: inside the HDF5 library, which no reader above it can stop

It ends with status 1 where any outcome in capital letters occurs.
"""

import argparse
import collections
import contextlib
import io
import json
import logging
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from PIL import Image

import polar_bayes as pb

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from mutations import (
    ODD_NAMES,
    ODD_NUMBERS,
    assert_inside_contract,
    damage_text,
    mutate,
    mutate_tree,
    pick,
    table_text,
)
from plate_images import ASKED, plate_image
from plates import plate_capture
from synthetic_results import make_result

from polar_bayes.cli import main as command

PATIENCE = 20.0
"""Seconds after which a subprocess counts as hanging."""

BAD = ("ALTERED", "IMPOSSIBLE", "TRACEBACK")
Random = np.random.Generator
Case = Callable[[Random], str]


def contract(capture: xr.Dataset) -> str:
    """Check accepted input once more, independently of the package's checks."""
    try:
        assert_inside_contract(capture)
    except AssertionError:
        return "IMPOSSIBLE"
    return "accepted"


def judged(case: Case, random: Random) -> tuple[str, str]:
    """Return the outcome of a case, and the end of the traceback if there is one."""
    try:
        return case(random), ""
    except pb.PolarBayesError as error:
        return ("refused", "") if str(error).isprintable() else ("TRACEBACK", "several lines")
    except Exception:
        lines = traceback.format_exc().strip().splitlines()
        return "TRACEBACK", " | ".join([*lines[-3:-1], lines[-1]])[:400]


def damaged(content: bytes, random: Random) -> bytes:
    """Bytes with a few bits flipped, cut short, or with a piece put in, left out or repeated."""
    found = bytearray(content)
    for _ in range(random.integers(1, 4)):
        place, length = int(random.integers(len(found) + 1)), int(random.integers(1, 65))
        match random.integers(6):
            case 0:
                found = found[: max(place, 1)]
            case 1:
                del found[place : place + length]
            case 2:
                found[place:place] = random.bytes(length)
            case _ if place < len(found):
                found[place] ^= 1 << int(random.integers(8))
    return bytes(found)


# --- families: each gives one case, which takes a random generator --------------------------------


def memory(folder: Path) -> Case:
    """Captures in memory."""

    def case(random: Random) -> str:
        whole = plate_capture(np.linspace(20.0, 75.0, 6), 0.01, seed=int(random.integers(99)))
        return contract(pb.capture.validate(mutate(whole, random)))

    return case


def tables(folder: Path) -> Case:
    """Tables of readings, as goniometers write them and listed a line each."""
    file = folder / "table.csv"
    constants = {"light_zenith": 45.0, "light_azimuth": 0.0, "view_azimuth": 180.0}
    listed = "view_zenith,dop,intensity,patch\n" + "".join(f"{a},0.1,3,{a % 2}\n" for a in range(9))

    def case(random: Random) -> str:
        if random.random() < 0.5:
            file.write_bytes(damage_text(table_text(random), random))
            return contract(pb.from_goniometer("s", "p", table=file, angle="angle"))
        file.write_bytes(damage_text(listed, random))
        odd = pick(random, [*constants, "patch", "wavelength", "dop_error", *ODD_NAMES[:8]])
        given = constants | ({odd: pick(random, ODD_NUMBERS)} if random.random() < 0.5 else {})
        return contract(pb.from_table(file, constants=given))

    return case


def frames(folder: Path) -> Case:
    """Frames of a camera: .npy, PNG and TIFF."""
    counts = np.random.default_rng(0).integers(1, 200, (8, 8))
    whole: dict[str, bytes] = {}
    for name in ("frame.npy", "frame.png", "frame.tiff"):
        if name.endswith("npy"):
            np.save(folder / name, counts.astype(np.uint16))
        else:
            Image.fromarray(counts.astype(np.uint8)).save(folder / name)
        whole[name] = (folder / name).read_bytes()
    headers = ["(8, 8)", "(8000000000000, 8)", "(-1, 8)", "()", "(8,", "'<u2'", "'|O'", "True"]

    def case(random: Random) -> str:
        name = pick(random, list(whole))
        content = damaged(whole[name], random)
        if name.endswith("npy") and random.random() < 0.5:
            old, new = (pick(random, headers).encode() for _ in range(2))
            content = whole[name].replace(old, new)
        (folder / name).write_bytes(content)
        capture = pb.from_mosaic(
            folder / name,
            shape=pb.importers.Sphere(4.0, 4.0, 4.0),
            light=pb.importers.Direction(0.0, 0.0, 1.0),
            detector=pb.importers.Detector(saturation_level=4095.0),
        )
        return contract(capture)

    return case


FILES = ("capture.nc", "result.nc", "foreign.nc")


def netcdf(folder: Path) -> Case:
    """Captures and results in netCDF, a bit flipped or more, read by a subprocess."""
    capture = plate_capture(np.linspace(20.0, 75.0, 40), 0.01, seed=1)
    pb.save_capture(capture, folder / "capture.nc")
    pb.save(make_result(views=12, chains=2, draws=30), folder / "result.nc")
    capture.to_netcdf(folder / "foreign.nc")  # by another program: without a checksum
    whole = {name: (folder / name).read_bytes() for name in FILES}
    reader = Reader(folder)
    numbers = iter(range(10**9))

    def case(random: Random) -> str:
        name = pick(random, list(whole))
        # A name of its own: HDF5 keeps damaged files open and would see the old one.
        file = folder / f"{next(numbers)}-{name}"
        if random.random() < 0.7:
            content = bytearray(whole[name])
            content[random.integers(len(content))] ^= 1 << int(random.integers(8))
        else:
            content = damaged(whole[name], random)
        file.write_bytes(content)
        try:
            return reader.ask(file)
        finally:
            file.unlink()

    return case


def zarr(folder: Path) -> Case:
    """Stores: captures by others, and maps of ours; files damaged, emptied, removed or swapped."""
    source, maps = folder / "capture.zarr", folder / "maps.zarr"
    image = plate_image(8, 8, seed=3)
    image.chunk({"y": 4, "x": 4}).to_zarr(source, zarr_format=3, consolidated=False)
    pb.maps.map_file(source, maps, **ASKED)
    good = pb.maps.open_map(maps).load()
    place = folder / "case.zarr"

    def case(random: Random) -> str:
        which = source if random.random() < 0.5 else maps
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(which, place)
        for _ in range(random.integers(1, 3)):
            files = sorted(path for path in place.rglob("*") if path.is_file())
            file, other = pick(random, files), pick(random, files)
            match random.integers(5):
                case 0:
                    file.unlink()
                case 1:
                    file.write_bytes(b"")
                case 2:
                    file.write_bytes(other.read_bytes())
                case _:
                    file.write_bytes(damaged(file.read_bytes(), random))
        return of_source(place) if which is source else of_maps(place, good)

    return case


def of_source(store: Path) -> str:
    """A capture block by block, as a map reads it."""
    out = store.with_name("out.zarr")
    shutil.rmtree(out, ignore_errors=True)
    out.with_name("out.zarr.progress").unlink(missing_ok=True)
    return of_maps(out, None) if pb.maps.map_file(store, out, **ASKED) is not None else "refused"


def of_maps(store: Path, good: xr.Dataset | None) -> str:
    """A map: every pixel that is counted as good has finite numbers, the right ones if known."""
    found = pb.maps.open_map(store)
    counts = pb.maps.count_pixels(found)
    found = found.load()
    names = [str(name) for name in found if f"{name}_sd" in found]
    finite = np.all([np.isfinite(found[name].to_numpy()) for name in names], axis=0)
    if counts["good"] > finite.sum() or sum(counts.values()) != finite.size:
        return "IMPOSSIBLE"
    if good is not None:
        for name in names:
            mine, right = found[name].to_numpy(), good[name].to_numpy()
            if (np.isfinite(mine) & (mine != right)).any():
                return "ALTERED"
    return "accepted"


def results(folder: Path) -> Case:
    """Results tampered with in memory: groups, variables, numbers and provenance."""
    whole = make_result(views=12, chains=2, draws=60)

    def case(random: Random) -> str:
        tree, impossible = mutate_tree(whole, random), False
        if "posterior" in tree.children and random.random() < 0.1:
            posterior = tree["posterior"]
            name = pick(random, sorted(map(str, posterior.data_vars)) or [""])
            if name:
                value = pick(random, [-1.0, 1.7, np.nan, np.inf])
                posterior[name] = xr.full_like(posterior[name], value)
                impossible = True
        pb.summary(tree)
        json.dumps(pb.diagnostics.json_summary(tree), allow_nan=False)
        str(pb.show(tree))
        pb.inference.auto_sentences(tree)
        return "IMPOSSIBLE" if impossible and pb.verdict(tree).passed else "accepted"

    return case


def options(folder: Path) -> Case:
    """Command lines: odd words, options without values, values out of range."""
    capture = folder / "plate.nc"
    pb.save_capture(plate_capture(np.linspace(20.0, 75.0, 6), 0.01, seed=1), capture)
    (folder / "t.csv").write_text("angle,s,p\n20,3,2\n30,3,2\n40,4,2\n")
    odd = ["", "nan", "-1", "1e999", "x", "\0", "../..", "--", "-", "\udcff", "9" * 30, "/dev/null"]
    odd += ["<b>", "a\nb", str(capture), str(folder / "t.csv"), str(folder)]
    start = {
        "simulate": ["--out", "--preset", "--scene", "--views", "--largest-view-zenith"],
        "combine": ["--out", "--dim", "--drop"],
        "import": ["goniometer", "table", "mosaic", "polarizer", "--out", "--table", "--column"],
        "fit": ["--out", "--method", "--scene", "--model", "--seed", "--tolerance"],
        "map": ["--out", "--draws", "--precision", "--resume", "--scheduler"],
        "report": ["--out", "--truth", "--beside"],
        "calibrate": ["--out", "--method", "--simulations", "--resume"],
        "effects": ["--keep", "--tolerance", "--scene"],
        "identify": ["--profile", "--next-views", "--criterion"],
        "accuracy": ["--method", "--out", "--tolerance"],
        "compare": ["--out"],
    }

    def case(random: Random) -> str:
        name = pick(random, [*start, *start, "frob", ""])
        words = [name]
        for _ in range(random.integers(0, 6)):
            words.append(pick(random, [*odd, *start.get(name, ["--x"])]))
        if name in ("fit", "calibrate", "effects", "identify", "accuracy", "map"):
            words += ["--largest-view-zenith", pick(random, ["0", "-1", "nan", "x", "200"])]
        errors = io.StringIO()
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
            status = command(words)
        lines = errors.getvalue().strip("\n").count("\n") + 1
        if "Traceback" in errors.getvalue() or "internal error" in errors.getvalue():
            return "TRACEBACK"
        if status == 0:
            return "accepted"
        return "refused" if status in (1, 2) and lines == 1 else "TRACEBACK"

    return case


FAMILIES: dict[str, tuple[int, Callable[[Path], Case]]] = {
    "memory": (6000, memory),
    "tables": (3500, tables),
    "frames": (2500, frames),
    "netcdf": (3000, netcdf),
    "zarr": (500, zarr),
    "results": (2500, results),
    "options": (2000, options),
}


# --- files that may end their reader --------------------------------------------------------------


class Reader:
    """A subprocess that reads files by the netCDF library and reports the outcome of each."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: subprocess.Popen | None = None

    def ask(self, file: Path) -> str:
        """The outcome of reading a file; another process takes over after a crash or a hang."""
        if self._process is None:
            words = [sys.executable, __file__, "--reader", str(self._folder)]
            self._process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                text=True, bufsize=1,
            )  # fmt: skip
            self._answer(10 * PATIENCE)
        assert self._process.stdin is not None
        self._process.stdin.write(f"{file}\n")
        return self._answer(PATIENCE)

    def _answer(self, patience: float) -> str:
        assert self._process is not None
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], patience)
        line = self._process.stdout.readline() if ready else ""
        if line:
            return line.strip()
        self._process.kill()
        self._process.wait()
        self._process = None
        return "crash" if ready else "hang"


def read_on(folder: Path) -> None:
    """Read the files that standard input names, in the subprocess."""
    reads = dict(zip(FILES, (pb.load_capture, pb.load, pb.load_capture), strict=True))
    whole = {name: read(folder / name) for name, read in reads.items()}
    print("ready", flush=True)
    for line in sys.stdin:
        file = Path(line.strip())
        name = file.name.partition("-")[2]

        def case(_: Random, name: str = name, file: Path = file) -> str:
            found, right = reads[name](file), whole[name]
            if name == "foreign.nc":
                return contract(found)
            if name == "capture.nc":  # a capture without a name has that of its file
                found = found.assign_attrs(name=right.attrs["name"])
            return "accepted" if found.identical(right) else "ALTERED"

        print(judged(case, np.random.default_rng(0))[0], flush=True)


# --- counting -------------------------------------------------------------------------------------


def run(name: str, count: int, seed: int) -> tuple[collections.Counter, dict[str, str]]:
    """Outcomes of so many cases of a family, and one example of each bad one."""
    tally: collections.Counter = collections.Counter()
    examples: dict[str, str] = {}
    number = list(FAMILIES).index(name)
    with tempfile.TemporaryDirectory() as folder, inside(Path(folder)):
        case = FAMILIES[name][1](Path(folder))
        for at in range(count):
            outcome, what = judged(case, np.random.default_rng([seed, number, at]))
            tally[outcome] += 1
            if outcome not in ("refused", "accepted"):
                examples.setdefault(f"{outcome} {what}", f"{name} {at}")
    return tally, examples


@contextlib.contextmanager
def inside(folder: Path) -> Iterator[None]:
    """Work in a folder: what a command writes by a relative path stays there."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of xarray, about the odd datasets made here
            yield
    finally:
        os.chdir(before)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("families", nargs="*", metavar="family", help=", ".join(FAMILIES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--share", type=float, default=1.0, help="of the cases")
    parser.add_argument("--reader", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.reader:
        read_on(asked.reader)
        return 0
    # Zarr leaves exceptions of its own tasks to asyncio, as the command line knows.
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    bad, every = 0, 0
    columns = ("refused", "accepted", *BAD, "crash", "hang")
    print(f"{'family':<10}" + "".join(f"{name:>11}" for name in (*columns, "seconds")), flush=True)
    lines: list[str] = []
    for name in asked.families or FAMILIES:
        begin = time.perf_counter()
        tally, examples = run(name, max(1, round(FAMILIES[name][0] * asked.share)), asked.seed)
        cells = [tally[column] for column in columns] + [round(time.perf_counter() - begin)]
        print(f"{name:<10}" + "".join(f"{cell:>11,}" for cell in cells), flush=True)
        bad += sum(tally[outcome] for outcome in BAD)
        every += sum(tally.values())
        lines += [f"{where}: {what}" for what, where in examples.items()]
    print(f"\n{every:,} cases, {bad:,} bad")
    print("\n".join(lines))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
