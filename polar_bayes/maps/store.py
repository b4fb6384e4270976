"""Maps of images that do not fit into memory: written block by block, resumable.

A map is a Zarr store that appears whole, without values, with the digest of its request in the
attribute `lazy.REQUEST`. Each block is on the disk before its line is in the journal next to the
store (`blocks.Journal`). The attribute `lazy.FINISHED` is written last. Nothing is written to a
store that does not hold the digest, and nothing is removed but the journal and unfinished folders
of this package.
"""

import contextlib
import inspect
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import xarray as xr
from zarr.codecs import Crc32cCodec, ZstdCodec

from polar_bayes.capture.schema import CONTRACT, LABELS, WAVELENGTH
from polar_bayes.errors import CaptureError, FitError, OutputError
from polar_bayes.inference.batching import IMAGE, cut
from polar_bayes.maps.blocks import (
    OTHER_OUT,
    REPEAT,
    RESUME,
    Journal,
    as_completed,
    digest,
    open_journal,
    request_topics,
    taken_over,
    workers,
    written,
)
from polar_bayes.maps.fit_map import (
    FILL_VALUES,
    MapPlan,
    blank,
    estimate_plan,
    fit_block,
    fit_pixels,
    plan_map,
    with_pixel_numbers,
)
from polar_bayes.maps.lazy import FINISHED, REQUEST, check_whole, open_capture, open_map
from polar_bayes.paths import as_path, is_same_file, replace_file, sync, temporary_folder
from polar_bayes.progress import Counter, no_progress, with_counter

BLOCK = 65536
"""Most pixels of a block, and of a chunk on the disk, which limits files and memory."""

PARTS, LEAST = 4, 1024
"""Number of blocks of a smaller image, so that every core has work; fewest pixels of a block."""

READ = frozenset((*(row.name for row in CONTRACT), WAVELENGTH.name, *LABELS))
"""Variables of a capture that a fit reads; known truths are not among them."""

JOURNAL = ".progress"
"""Suffix of the journal's name, which lies next to an unfinished map."""

METADATA = "zarr.json"

Region = dict[str, slice]

DEFAULTS: dict[str, Any] = {
    name: parameter.default
    for name, parameter in inspect.signature(fit_pixels).parameters.items()
    if name not in ("capture", "progress")
}


@with_counter("pixels")
def map_file(
    capture: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Counter | None = None,
    **settings: Any,
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
        resume: Go on with a map that was broken off; what is done stays. Blocks that are missing or
            damaged are fitted again. A finished map of the same capture is returned.
        progress: Called with the pixels that are done, and all.
        settings: Arguments of `polar_bayes.fit_pixels`.

    Returns:
        The maps, opened lazily.

    Raises:
        CaptureError: The capture cannot be read, or is not what a fit needs.
        FitError: A setting cannot be used; or, to resume, the map was begun with others or
            the capture has changed since.
        OutputError: The store cannot be written, is there already, is (to resume) not a map of
            this package or not as it was written, or another process is writing it.
    """
    source, store = as_path(capture, "capture"), as_path(out, "out")
    check_apart(source, store)
    image = _open(source)
    check_whole(source)
    with _in_capture(source):
        plan = plan_map(image, **(DEFAULTS | settings))
    target = _MapStore(store, image, plan)
    journal_of_map = store.with_name(f"{store.name}{JOURNAL}"), store, "map", target.topics
    with open_journal(*journal_of_map, resume=resume) as journal:
        with written(store):
            journal.read()
        if target.is_finished(resume=resume):
            target.check_finished()
        else:
            target.check_readings(journal)
            with _in_capture(source):
                target.estimate()
            target.begin(journal)
            target.run(journal, source, scheduler, progress or no_progress)
            target.finish(journal)
        with written(store):
            journal.end()
    return open_map(store)


def check_apart(source: Path, store: Path) -> None:
    """Refuse a store that contains, or lies in, its source, or whose folder is missing."""
    where = str(store)
    with written(store):
        one, other = source.resolve(), store.resolve()
        is_nested = other.is_relative_to(one) or one.is_relative_to(other)
        if is_nested or is_same_file(source, store):
            what = "it is the capture, inside it, or around it"
            raise OutputError(what, where=where, hint=OTHER_OUT)
        if not store.parent.is_dir():
            raise OutputError("its folder is not there", where=where, hint="make the folder first")


def fit_file_block(
    source: Path, region: Region, plan: MapPlan, opened: xr.Dataset | None = None
) -> tuple[xr.Dataset, str]:
    """Fit one block of a capture in a worker; return its maps and a digest of readings."""
    image = _open(source) if opened is None else opened
    block = with_pixel_numbers(image, region).load()
    with _in_capture(source, region):
        return fit_block(block, plan), _digest(block)


def _open(source: Path) -> xr.Dataset:
    """Open a capture with the variables that a fit reads."""
    image = open_capture(source)
    return image[[name for name in image.data_vars if name in READ]]


@contextlib.contextmanager
def _in_capture(source: Path, region: Region | None = None) -> Iterator[None]:
    """Add the name of the capture and the block to errors."""
    where = str(source) if region is None else f"{source}: block {_label(region)}"
    try:
        yield
    except CaptureError as error:
        if error.where.startswith(str(source)):
            raise
        raise CaptureError(error.what, where=f"{where}: {error.where}", hint=error.hint) from error


def _digest(block: xr.Dataset) -> str:
    """Return a digest of what a fit reads of a block."""
    names = sorted(READ & set(block.variables))
    return digest([(n, block[n].dims, block[n].to_numpy()) for n in names])


class _MapStore:
    """An unfinished map: its request, its blocks, and the files of its store."""

    def __init__(self, store: Path, image: xr.Dataset, plan: MapPlan) -> None:
        self._store, self._image, self._plan = store, image, plan
        # The size of blocks depends on the image alone, so resumed maps have the same blocks.
        size = min(BLOCK, max(LEAST, image.sizes["y"] * image.sizes["x"] // PARTS))
        self._regions = {_label(region): region for region in cut(image, size)}
        self._chunks = {dim: part.stop for dim, part in next(iter(self._regions.values())).items()}
        request = plan.request
        pixel = _digest(request.capture), plan.intensity_unit
        self.topics = {
            "capture": digest(pixel, dict(image.sizes), self._chunks),
            **request_topics(request),
            "method": digest(plan.settings),
            "seed": str(request.seed),
            "precision": request.precision,
            "shared": f"{[each.name for each in plan.shared]}, {plan.shares_by_default}",
            "set-up": repr(plan.carried),
        }
        self.request = digest(self.topics)

    def is_finished(self, *, resume: bool) -> bool:
        """Return whether the map is finished; refuse a store of another request."""
        where = str(self._store)
        if not os.path.lexists(self._store):
            return False
        if not resume:
            raise OutputError("it is there already", where=where, hint=RESUME)
        attributes = _metadata(self._store)["attributes"]
        if REQUEST not in attributes:
            what = "it is not a map that can be resumed"
            raise OutputError(what, where=where, hint=OTHER_OUT)
        if attributes[REQUEST] != self.request:
            what = "it was begun with another capture or other settings, or by another version"
            raise FitError(what, where=where, hint=REPEAT)
        return FINISHED in attributes

    def estimate(self) -> None:
        """Complete the plan from the image; the result depends on the image alone."""
        self._plan = estimate_plan(self._plan, self._image)
        self._maps = blank(self._image, self._plan)

    def check_finished(self) -> None:
        """Refuse a finished map with changed readings or missing chunks."""
        where = str(self._store)
        readings = [_digest(self._image.isel(region)) for region in self._regions.values()]
        if _metadata(self._store)["attributes"][FINISHED] != digest(list(self._regions), readings):
            what = "the capture has changed since it was made"
            raise FitError(what, where=where, hint=OTHER_OUT)
        self._maps = open_map(self._store)  # what pixels share was estimated, and has no map
        files = [file for region in self._regions.values() for file in self._files(region)]
        if missing := sum(not file.is_file() for file in files):
            what = f"{missing} of {len(files)} chunks are missing"
            raise OutputError(what, where=where, hint=f"copy the store again, or {OTHER_OUT}")

    def check_readings(self, journal: Journal) -> None:
        """Refuse to resume if the readings of a finished block have changed."""
        for name, region in self._regions.items():
            if journal.done.get(name) not in (None, _digest(self._image.isel(region))):
                what = f"the capture has changed since block {name} was fitted"
                hint = f"{OTHER_OUT}, or remove {self._store.name}{JOURNAL} to fit all blocks again"
                raise FitError(what, where=str(self._store), hint=hint)

    def begin(self, journal: Journal) -> None:
        """Create the store without values, or check that it is unchanged."""
        with written(self._store), temporary_folder(self._store.parent) as folder:
            empty = folder / self._store.name
            self._write_blank(empty)
            files = sorted(path.relative_to(empty) for path in empty.rglob("*") if path.is_file())
            is_there = self._store.exists()
            for file in files if is_there else ():
                found, expected = self._store / file, (empty / file).read_bytes()
                if not found.is_file() or found.read_bytes() != expected:
                    what = "it is missing or not as written, or the capture has changed since"
                    raise OutputError(what, where=f"{self._store}: {file}", hint=OTHER_OUT)
            journal.begin()
            if not is_there:
                for path in (*empty.rglob("*"), empty):
                    sync(path)
                empty.rename(self._store)
                sync(self._store.parent)

    def _write_blank(self, path: Path) -> None:
        """Write names, axes and attributes; missing chunks mean that pixels are not fitted."""
        compressors = (ZstdCodec(), Crc32cCodec())
        encoding: dict = {str(name): {"compressors": compressors} for name in self._maps.variables}
        for name, value in FILL_VALUES.items():
            encoding[name]["fill_value"] = value
        self._maps.chunk(self._chunks).assign_attrs({REQUEST: self.request}).to_zarr(
            path,
            mode="w-",
            encoding=encoding,
            compute=False,
            consolidated=False,
            zarr_format=3,
            write_empty_chunks=True,
        )

    def run(self, journal: Journal, source: Path, scheduler: str | None, progress: Counter) -> None:
        """Fit and write every block that has not been written."""
        stored = xr.open_zarr(self._store, chunks=None, consolidated=False)
        regions = [
            region
            for name, region in self._regions.items()
            if name not in journal.done or not self._is_whole(stored, region)
        ]
        every = sum(map(_size, self._regions.values()))
        done = every - sum(map(_size, regions))
        with workers(scheduler) as (executor, count):
            opened = self._image if scheduler is None else None  # a cluster opens it for itself
            tasks = ((source, region, self._plan, opened) for region in regions)
            for (_, region, *_), (block, readings) in as_completed(
                executor, count, fit_file_block, tasks
            ):
                with written(self._store):
                    self._write(block, region)
                    journal.add(_label(region), readings)
                done += _size(region)
                progress(done, every)

    def _is_whole(self, stored: xr.Dataset, region: Region) -> bool:
        """Return whether every chunk of a block exists and has its recorded checksum."""
        if not all(file.is_file() for file in self._files(region)):
            return False  # it would be read as not fitted
        try:
            stored[list(self._maps.data_vars)].isel(region).load()
        except Exception:  # codecs raise nearly every type for a broken chunk
            return False
        return True

    def _write(self, block: xr.Dataset, region: Region) -> None:
        """Write a block, and wait until it is on the disk."""
        values = block.drop_vars(list(block.coords))
        values.to_zarr(self._store, region=region, consolidated=False, write_empty_chunks=True)
        files = self._files(region)
        folders = {up for file in files for up in file.parents if up.is_relative_to(self._store)}
        for path in (*files, *sorted(folders)):
            sync(path)

    def _files(self, region: Region) -> list[Path]:
        """Return the chunk files of a block, one per array, by Zarr's default names."""
        found = []
        for name, variable in self._maps.data_vars.items():
            at = [region[d].start // self._chunks[d] if d in IMAGE else 0 for d in variable.dims]
            found.append(self._store.joinpath(str(name), "c", *map(str, at)))
        return found

    def finish(self, journal: Journal) -> None:
        """Mark the store as finished, with a digest of the readings."""
        readings = [journal.done[name] for name in self._regions]
        with written(self._store), temporary_folder(self._store.parent) as folder:
            metadata = _metadata(self._store)
            if metadata["attributes"].get(REQUEST) != self.request:
                raise taken_over(self._store)
            metadata["attributes"][FINISHED] = digest(list(self._regions), readings)
            unfinished = folder / METADATA
            unfinished.write_text(json.dumps(metadata, indent=2))
            replace_file(unfinished, self._store / METADATA)


def _metadata(store: Path) -> dict[str, Any]:
    """Return the metadata of a store; empty if they cannot be read."""
    found: Any = {}
    with contextlib.suppress(OSError, ValueError):
        found = json.loads((store / METADATA).read_text())
    found = found if isinstance(found, dict) else {}
    return found if isinstance(found.get("attributes"), dict) else {**found, "attributes": {}}


def _label(region: Region) -> str:
    return " ".join(f"{dim}={part.start}:{part.stop}" for dim, part in region.items())


def _size(region: Region) -> int:
    return math.prod(part.stop - part.start for part in region.values())
