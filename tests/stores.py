"""A map and a calibration in stores of a few small blocks, for tests of both kinds of store."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override

import jax
import numpy as np
import plate_images
import pytest
import xarray as xr
from plates import PLATE, plate_capture

import polar_bayes as pb
from polar_bayes.maps import store as map_store

ROOT = Path(__file__).parents[1]


class BrokenOff(BaseException):
    """Stands in for a crash or an interrupt."""


class Stored(ABC):
    """One kind of store: what is asked for, in how many blocks, and where its files are."""

    name: str
    total: int
    block: int

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @abstractmethod
    def run(self, store: Path, **asked: Any) -> xr.Dataset | xr.DataTree:
        """Make it, or with `resume=True` go on with it."""

    @abstractmethod
    def journal(self, store: Path) -> Path:
        """The journal of a store that is not finished."""

    @abstractmethod
    def files(self, store: Path, name: str) -> list[Path]:
        """The files of a block, by its name in the journal."""

    @contextlib.contextmanager
    @abstractmethod
    def small_blocks(self) -> Iterator[None]:
        """Blocks of this process are small."""

    def first_done(self, store: Path) -> str:
        """The block that the first line of the journal names."""
        return self.journal(store).read_text().splitlines()[1].rpartition(" ")[0]

    def break_off(self, store: Path) -> Path:
        """Begin a store, and break off when two blocks are done."""

        def progress(done: int, every: int) -> None:
            assert every == self.total
            if done >= 2 * self.block:
                raise BrokenOff

        with pytest.raises(BrokenOff):
            self.run(store, progress=progress)
        return store

    def start(self, store: Path, **asked: Any) -> subprocess.Popen:
        """Run it in a process of its own, which prints how much is done after each block."""
        script = "from stores import main; main()"
        paths = [str(ROOT), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]
        return subprocess.Popen(
            [sys.executable, "-c", script, self.name, self.folder, store, json.dumps(asked)],
            stdout=subprocess.PIPE,
            text=True,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join(paths),
                "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
                "JAX_ENABLE_COMPILATION_CACHE": "false",
            },
        )


class StoredMap(Stored):
    """A map of 180 pixels in blocks of two rows."""

    name, total, block = "map", 180, 40
    method = pb.methods.CorrectedLaplace(draws=64, sampler=None)

    @property
    def capture(self) -> Path:
        """An image in a file, written where it is not there."""
        file = self.folder / "plates.zarr"
        if not file.exists():
            image = plate_images.plate_image(9, 20).assign_coords(y=np.arange(1.0, 10.0))
            image.chunk(y=3, x=20).to_zarr(file, consolidated=False)
        return file

    @override
    def run(self, store: Path, **asked: Any) -> xr.Dataset:
        given = {"method": self.method, **plate_images.ASKED, **asked}
        return pb.maps.map_file(given.pop("capture", self.capture), store, **given).load()

    @override
    def journal(self, store: Path) -> Path:
        return store.with_name(f"{store.name}.progress")

    @override
    def files(self, store: Path, name: str) -> list[Path]:
        row = int(name.removeprefix("y=").partition(":")[0]) // 2
        names = [path.parent for path in sorted(store.glob("*/c"))]
        chunks = [path / "c" / str(row) / "0" for path in names]
        cubes = [path / "c" / "0" / str(row) / "0" for path in names]
        return [path for path in (*chunks, *cubes) if path.is_file()]

    @override
    @contextlib.contextmanager
    def small_blocks(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(map_store, "BLOCK", self.block)
            yield


class StoredCalibration(Stored):
    """A calibration of 40 simulations in blocks of twelve."""

    name, total, block = "calibration", 40, 12

    @override
    def run(self, store: Path | None, **asked: Any) -> xr.DataTree:
        capture = plate_capture(np.array([30.0, 42.0, 68.0, 80.0]), 0.03, seed=0)
        given = {"capture": capture, "simulations": self.total, "method": "importance"}
        given |= plate_images.ASKED | {"scene": PLATE} | asked
        return pb.calibrate(store=store, **given)

    @override
    def journal(self, store: Path) -> Path:
        return store / "journal"

    @override
    def files(self, store: Path, name: str) -> list[Path]:
        return [store / f"{name}.nc"]

    @override
    @contextlib.contextmanager
    def small_blocks(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(pb.methods.Importance, "group_size", self.block)
            yield


KINDS = {kind.name: kind for kind in (StoredMap, StoredCalibration)}


@contextlib.contextmanager
def stored(name: str, folder: Path) -> Iterator[Stored]:
    """A kind of store, compiled in haste: compilation is what so few fits cost."""
    kind = KINDS[name](folder)
    jax.config.update("jax_disable_most_optimizations", True)
    with kind.small_blocks():
        yield kind
    jax.config.update("jax_disable_most_optimizations", False)


def copied(store: Path, folder: Path) -> Path:
    """A copy of a store and of what lies next to it."""
    shutil.copytree(store.parent, folder, dirs_exist_ok=True)
    return folder / store.name


def assert_same_bits(found: xr.Dataset | xr.DataTree, expected: xr.Dataset | xr.DataTree) -> None:
    if isinstance(expected, xr.DataTree):  # its attributes hold the time that it took
        assert set(found.children) == set(expected.children)
        for name in expected.children:
            xr.testing.assert_identical(found[name].to_dataset(), expected[name].to_dataset())
    else:
        xr.testing.assert_identical(found, expected)


def main() -> None:
    """Run `Stored.start` in a process."""
    name, folder, store, asked = sys.argv[1:]

    def progress(done: int, every: int) -> None:
        print(done, flush=True)

    with stored(name, Path(folder)) as kind:
        kind.run(Path(store), progress=progress, **json.loads(asked))
