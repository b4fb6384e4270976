"""Maps of images that do not fit into memory: block by block from file to file, resumable."""

import contextlib
import hashlib
import inspect
import json
import math
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import xarray as xr
import zarr

from polar_bayes.capture.files import load_capture
from polar_bayes.errors import CaptureError, FitError
from polar_bayes.observation.data import READINGS
from polar_bayes.paths import as_path
from polar_bayes.pixels.blocks import Plan, fit_block
from polar_bayes.pixels.executors import as_completed, workers
from polar_bayes.pixels.maps import blank, cut, fit_pixels, numbered_block, plan_map, said_of
from polar_bayes.progress import Counter, counted

BLOCK = 65536
"""Most pixels of a block, and of a chunk on the disk: few files, little memory."""

PARTS, LEAST = 4, 1024
"""Blocks of a smaller image, so that every core has work; but none has fewer pixels."""

Place = dict[str, slice]

DEFAULTS: dict[str, Any] = {
    name: parameter.default
    for name, parameter in inspect.signature(fit_pixels).parameters.items()
    if name not in ("capture", "progress")
}


@counted("pixels")
def map_file(
    capture: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Counter | None = None,
    **asked: Any,
) -> xr.Dataset:
    """Fit every pixel of an image in a file, and write the maps to another.

    Blocks are read, fitted and written one by one, so memory does not grow with the image. What is
    written does not depend on the order of the blocks or on how often the work was broken off, as
    long as the compiler makes the same programs in every process (see the limits in docs/maps.md).

    Args:
        capture: A capture with dims y and x, netCDF (read whole) or Zarr (read block by block).
        out: The folder of a Zarr store to write.
        scheduler: Address of a `dask.distributed` scheduler whose workers can read `capture`; by
            default threads of this process.
        resume: Go on with a map that was broken off; what is done stays.
        progress: Called with the pixels that are done, and all.
        asked: Arguments of `polar_bayes.fit_pixels`.

    Returns:
        The maps, opened lazily.

    Raises:
        CaptureError: The capture cannot be read, or is not what a fit needs.
        FitError: Something asked for cannot be used, the store is there already (or, to resume,
            is finished or was begun otherwise), or it cannot be written.
    """
    source, store = as_path(capture, "capture"), as_path(out, "out")
    image = open_image(source)
    _check_whole(source)
    plan = plan_map(image, **(DEFAULTS | asked))
    ledger = _Ledger(store, image, plan)
    if ledger.begin(resume=resume):
        _write_blank(image, plan, store)
        ledger.open()
    places = [place for place in cut(image, _block(image)) if not ledger.has(place)]
    every = image.sizes["y"] * image.sizes["x"]
    done = every - sum(_size(place) for place in places)
    with workers(scheduler) as (executor, count):
        tasks = ((source, place, plan) for place in places)
        for (_, place, _), block in as_completed(executor, count, fit_file_block, tasks):
            _write(block, store, place)
            ledger.add(place)
            done += _size(place)
            if progress is not None:
                progress(done, every)
    ledger.end()
    return xr.open_zarr(store, chunks=None, consolidated=False)


def open_image(path: Path) -> xr.Dataset:
    """A capture from a file, its values read when they are needed where it is a Zarr store.

    Args:
        path: A netCDF file or the folder of a Zarr store.

    Returns:
        The capture; of a Zarr store it is validated block by block, later.

    Raises:
        CaptureError: It cannot be read.
    """
    if path.suffix != ".zarr":
        return load_capture(path)
    where = str(path)
    if not path.is_dir():
        raise CaptureError("there is no such store", where=where, mend="check the path")
    try:
        image = xr.open_zarr(path, chunks=None, decode_times=False, consolidated=False)
    except Exception as error:  # the libraries below raise nearly every type for a broken store
        raise CaptureError(
            "it cannot be read as Zarr", where=where, mend="write it again with to_zarr"
        ) from error
    image.attrs.setdefault("name", path.stem)
    return image


def _check_whole(path: Path) -> None:
    """Refuse a store with holes, which would read as missing readings; once for the whole map."""
    for name in READINGS:
        if path.suffix != ".zarr" or not (path / name).is_dir():
            continue
        array = zarr.open_array(path / name, mode="r")
        missing = array.nchunks - array.nchunks_initialized
        if missing:
            raise CaptureError(
                f"{missing} of {array.nchunks} chunks are missing",
                where=f"{path}: {name}",
                mend="copy the store again, or write it again with to_zarr",
            )


def fit_file_block(source: Path, place: Place, plan: Plan) -> xr.Dataset:
    """Fit one block of a capture in a file; this is what a worker is sent.

    Args:
        source: The capture.
        place: Slices of y and x.
        plan: What is done.

    Returns:
        The maps of the block.

    Raises:
        CaptureError: The block cannot be read or is not what the contract of captures allows.
    """
    return fit_block(numbered_block(open_image(source), place), plan)


class _Ledger:
    """Which blocks are written: a line for each, in a file beside the store.

    A line is added after its block is on the disk. A line that was cut off by a crash counts as
    not there, and its block is fitted again, to the same bits.
    """

    def __init__(self, store: Path, image: xr.Dataset, plan: Plan) -> None:
        self._store = store
        self._file = store.with_name(f"{store.name}.progress")
        pixel = plan.request.capture.to_dict()
        told = json.dumps([said_of(plan), dict(image.sizes), pixel], sort_keys=True, default=str)
        self._head = hashlib.sha256(told.encode()).hexdigest()
        self._done: set[str] = set()

    def begin(self, *, resume: bool) -> bool:
        """True where nothing is there yet; then a file says that something was begun."""
        where = str(self._store)
        if not resume:
            if self._store.exists() or self._file.exists():
                raise FitError(
                    "it is there already", where=where, mend="give another --out, or --resume"
                )
            return self._start()
        if self._store.exists() and not self._file.exists():
            raise FitError("nothing is left to resume", where=where, mend="give another --out")
        lines = self._file.read_text().split("\n") if self._file.exists() else [""]
        if len(lines) < 2:  # broken off before the store was whole
            shutil.rmtree(self._store, ignore_errors=True)
            return self._start()
        if lines[0] != self._head:
            raise FitError(
                "it was begun with another capture or other settings",
                where=where,
                mend="repeat the command as it was, or give another --out",
            )
        self._done = set(lines[1:-1])
        return False

    def _start(self) -> bool:
        """Before the store: whoever is stopped between the two can go on."""
        with _written(self._store):
            self._file.touch()
        return True

    def open(self) -> None:
        """The store is there: from now on there is something to resume."""
        self._append(self._head)

    def has(self, place: Place) -> bool:
        return _label(place) in self._done

    def add(self, place: Place) -> None:
        self._append(_label(place))

    def end(self) -> None:
        """Nothing is left to do."""
        self._file.unlink()

    def _append(self, line: str) -> None:
        with _written(self._store), self._file.open("a") as file:
            file.write(f"{line}\n")
            file.flush()
            os.fsync(file.fileno())


def _label(place: Place) -> str:
    return " ".join(f"{dim}={part.start}:{part.stop}" for dim, part in place.items())


def _size(place: Place) -> int:
    return math.prod(part.stop - part.start for part in place.values())


def _block(image: xr.Dataset) -> int:
    """Most pixels of a block; it follows from the image alone, so that work can be resumed."""
    return min(BLOCK, max(LEAST, image.sizes["y"] * image.sizes["x"] // PARTS))


def _write_blank(image: xr.Dataset, plan: Plan, store: Path) -> None:
    """The store with names, axes and attributes, and no values."""
    first = next(cut(image, _block(image)))
    chunks = {dim: part.stop - part.start for dim, part in first.items()}
    maps = blank(image, plan).chunk(chunks)
    with _written(store):
        maps.to_zarr(store, mode="w-", compute=False, consolidated=False, zarr_format=3)


def _write(block: xr.Dataset, store: Path, place: Place) -> None:
    values = block.drop_vars(list(block.coords))
    with _written(store):
        values.to_zarr(store, region={**place}, consolidated=False)


@contextlib.contextmanager
def _written(store: Path) -> Iterator[None]:
    """What the operating system says of a store, as one line."""
    try:
        yield
    except OSError as error:
        raise FitError(
            f"it could not be written ({error.strerror})",
            where=str(store),
            mend="make room or give another --out; --resume goes on where it stopped",
        ) from error
