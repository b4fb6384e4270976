"""Maps of images that do not fit into memory: block by block from file to file, resumable.

A map is a Zarr store that appears whole, without values, under a fingerprint of its request
(`lazy.REQUEST`). Each block is on the disk before its line is in the ledger next to the store. The
attribute `lazy.FINISHED` is written last. Nothing is written to a store that does not hold the
fingerprint, and nothing is removed but the ledger and unfinished folders of this package.
"""

import contextlib
import hashlib
import inspect
import json
import math
import os
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import portalocker
import xarray as xr
from zarr.codecs import Crc32cCodec, ZstdCodec

from polar_bayes.capture.schema import CONTRACT, LABELS, WAVELENGTH
from polar_bayes.errors import CaptureError, FitError, OutputError, PolarBayesError
from polar_bayes.inference.batching import IMAGE, Status, cut
from polar_bayes.interrupts import on_interrupt, resume_hint
from polar_bayes.maps.blocks import Plan, as_completed, fit_block, workers
from polar_bayes.maps.fit_map import (
    blank,
    fit_pixels,
    plan_map,
    provenance_json,
    with_pixel_numbers,
)
from polar_bayes.maps.lazy import FINISHED, LEDGER, REQUEST, check_whole, open_image, open_map
from polar_bayes.paths import (
    as_path,
    is_same_file,
    output_error,
    replace_file,
    sync,
    temporary_folder,
)
from polar_bayes.progress import Counter, with_counter

# --- The ledger of an unfinished map: which blocks are on the disk, and of which readings ---------


MAGIC = b"polar_bayes map "
BEGUN_OTHERWISE = "it was begun with another capture or other settings"
OTHER_OUT = "give another --out"
REPEAT = f"repeat the command as it was, or {OTHER_OUT}"


class Entry(NamedTuple):
    """A finished block: digests of its readings and of its chunks."""

    readings: str
    chunks: str


class Ledger:
    """A file next to the store: a head with the request's fingerprint, then a line per block."""

    # A line is added after the chunks of its block are on the disk. A line without an end was cut
    # off by a crash and is ignored; any other line that fails its checksum is an error.

    def __init__(self, opened: BinaryIO, file: Path, request: str) -> None:
        self._opened, self._file, self._size = opened, file, 0
        self._head = MAGIC + request.encode() + b"\n"
        self.entries: dict[str, Entry] = {}

    def read(self) -> None:
        """Read the entries; a file that holds anything else is refused and left as it is."""
        where = str(self._file)
        content = self._opened.read()
        if self._head.startswith(content):  # empty, or cut off within the head
            return
        if not content.startswith(MAGIC):
            hint = f"move that file away, or {OTHER_OUT}"
            raise OutputError("it is not the ledger of a map", where=where, hint=hint)
        if not content.startswith(self._head):
            raise FitError(BEGUN_OTHERWISE, where=where, hint=REPEAT)
        *lines, rest = content[len(self._head) :].split(b"\n")
        self._size = len(content) - len(rest)
        for number, line in enumerate(lines, 2):
            body, _, checksum = line.rpartition(b" ")
            fields = body.rsplit(b" ", 2)
            if len(fields) != 3 or checksum != _checksum(body):
                hint = f"remove that file to fit all blocks again, or {OTHER_OUT}"
                raise OutputError(f"line {number} is damaged", where=where, hint=hint)
            label, readings, chunks = (field.decode("ascii") for field in fields)
            self.entries[label] = Entry(readings, chunks)

    def begin(self) -> None:
        """Cut off an incomplete last line; write the head where there is none."""
        self._opened.truncate(self._size)
        if self._size == 0:
            self._append(self._head)
            sync(self._file.parent)

    def add(self, label: str, entry: Entry) -> None:
        """Record a block that is on the disk."""
        if not self.is_in_place():
            raise taken_over(self._file.with_suffix(""))
        body = f"{label} {entry.readings} {entry.chunks}".encode()
        self._append(body + b" " + _checksum(body) + b"\n")
        self.entries[label] = entry

    def end(self) -> None:
        """Remove the ledger of a finished map."""
        if self.is_in_place():
            self._file.unlink()
            sync(self._file.parent)

    def is_in_place(self) -> bool:
        """Whether the file is still the one that was opened."""
        try:
            return os.path.samestat(os.fstat(self._opened.fileno()), os.stat(self._file))
        except FileNotFoundError:
            return False

    def _append(self, text: bytes) -> None:
        self._opened.seek(0, os.SEEK_END)
        while text:  # an unbuffered file may take less than it is given
            text = text[self._opened.write(text) :]
        os.fsync(self._opened.fileno())


@contextlib.contextmanager
def locked_ledger(file: Path, request: str, *, resume: bool) -> Iterator[Ledger]:
    """The ledger of a map, locked: the lock ends with the block, or with the process."""
    # A ledger that was made here and in which nothing was written is removed again.
    opened, is_new = _open(file, resume=resume)
    try:
        _lock(opened, file)
        ledger = Ledger(opened, file, request)
        if not ledger.is_in_place():
            raise taken_over(file.with_suffix(""))
        yield ledger
    except BaseException:
        if is_new and os.fstat(opened.fileno()).st_size == 0:
            file.unlink(missing_ok=True)
        raise
    finally:
        opened.close()


def _open(file: Path, *, resume: bool) -> tuple[BinaryIO, bool]:
    """The file, and whether it was made here."""
    try:
        with contextlib.suppress(FileExistsError):
            return file.open("x+b", buffering=0), True
        if not resume:
            hint = f"{OTHER_OUT}, or --resume"
            raise OutputError("it is there already", where=str(file), hint=hint)
        if file.is_file():
            return file.open("r+b", buffering=0), False
    except OSError as error:
        raise output_error(error, file) from error
    hint = f"move it away, or {OTHER_OUT}"
    raise OutputError("it is not the ledger of a map", where=str(file), hint=hint)


def _lock(opened: BinaryIO, file: Path) -> None:
    flags = portalocker.LockFlags.EXCLUSIVE | portalocker.LockFlags.NON_BLOCKING
    try:
        portalocker.lock(opened, flags)
    except portalocker.AlreadyLocked as error:
        what, hint = "another process is writing it", f"wait until it has finished, or {OTHER_OUT}"
        raise OutputError(what, where=str(file.with_suffix("")), hint=hint) from error
    except portalocker.LockException as error:
        hint = "give an --out on a file system that has locks"
        raise OutputError(f"it cannot be locked ({error})", where=str(file), hint=hint) from error


def _checksum(body: bytes) -> bytes:
    return f"{zlib.crc32(body):08x}".encode()


def taken_over(store: Path) -> OutputError:
    """The error of a process that finds the store or its ledger no longer there."""
    return OutputError(
        "another process has finished, moved or removed it",
        where=str(store),
        hint="let one process at a time write it, and repeat the command with --resume",
    )


# --- Maps of images that do not fit into memory: block by block from file to file, resumable ------


BLOCK = 65536
"""Most pixels of a block, and of a chunk on the disk: few files, little memory."""

PARTS, LEAST = 4, 1024
"""Blocks of a smaller image, so that every core has work, and the fewest pixels of one."""

READ = frozenset((*(row.name for row in CONTRACT), WAVELENGTH.name, *LABELS))
"""Variables of a capture that a fit reads; known truths and other variables are not among them."""

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
        resume: Go on with a map that was broken off; what is done stays. Blocks whose files are
            missing or altered are fitted again. A finished map of the same capture is returned.
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
    image = open_image(source)
    check_whole(source)
    with _in_capture(source):
        plan = plan_map(image, **(DEFAULTS | settings))
    target = _MapStore(store, image, plan)
    file = store.with_name(f"{store.name}{LEDGER}")
    with locked_ledger(file, target.request, resume=resume) as ledger:
        is_finished = target.is_finished(resume=resume)
        with _written(store):
            ledger.read()
        if is_finished:
            target.check_finished()
        else:
            target.check_readings(ledger)
            target.begin(ledger)
            with on_interrupt(lambda: resume_hint(store)):
                target.run(ledger, source, scheduler, progress)
            target.finish(ledger)
        with _written(store):
            ledger.end()
    return open_map(store)


def check_apart(source: Path, store: Path) -> None:
    """Refuse a store that is the source, inside it or around it, or whose folder is missing."""
    where = str(store)
    with _written(store):
        one, other = source.resolve(), store.resolve()
        is_nested = other.is_relative_to(one) or one.is_relative_to(other)
        if is_nested or is_same_file(source, store):
            what = "it is the capture, inside it, or around it"
            raise OutputError(what, where=where, hint=OTHER_OUT)
        if not store.parent.is_dir():
            raise OutputError("its folder is not there", where=where, hint="make the folder first")


def fit_file_block(
    source: Path, region: Region, plan: Plan, opened: xr.Dataset | None = None
) -> tuple[xr.Dataset, str]:
    """Fit one block of a capture, which a worker opens: its maps, and a digest of its readings."""
    image = open_image(source) if opened is None else opened
    block = _read(image, region)
    with _in_capture(source, region):
        return fit_block(with_pixel_numbers(block, region, image.sizes["x"]), plan), _digest(block)


@contextlib.contextmanager
def _in_capture(source: Path, region: Region | None = None) -> Iterator[None]:
    """Errors of a capture, with its name and the block."""
    where = str(source) if region is None else f"{source}: block {_label(region)}"
    try:
        yield
    except CaptureError as error:
        if error.where.startswith(str(source)):
            raise
        raise CaptureError(error.what, where=f"{where}: {error.where}", hint=error.hint) from error


def _read(image: xr.Dataset, region: Region) -> xr.Dataset:
    """The variables of a block of a capture that a fit reads, in memory."""
    return image[[name for name in image.data_vars if name in READ]].isel(region).load()


def _digest(block: xr.Dataset) -> str:
    """SHA-256 of names, axes, types and values."""
    found = hashlib.sha256()
    for name in sorted(READ & set(block.variables)):
        variable = block.variables[name]
        values = variable.to_numpy()
        head = [name, variable.dims, values.shape, values.dtype.str]
        found.update(json.dumps(head).encode())
        is_plain = values.dtype.kind in "biuf"
        found.update(values.tobytes() if is_plain else json.dumps(values.tolist()).encode())
    return found.hexdigest()


class _MapStore:
    """An unfinished map: its request, its blocks, and the files of its store."""

    def __init__(self, store: Path, image: xr.Dataset, plan: Plan) -> None:
        self._store, self._image, self._plan = store, image, plan
        self._maps = blank(image, plan)
        self._regions = list(cut(image, _block(image)))
        self._chunks = {dim: part.stop for dim, part in self._regions[0].items()}
        pixel = plan.request.capture.drop_attrs(deep=False)
        read = pixel[sorted(READ & set(pixel.data_vars))].to_dict()
        parts = [provenance_json(plan), dict(image.sizes), self._chunks, read]
        text = json.dumps(parts, sort_keys=True, default=str)
        self.request = hashlib.sha256(text.encode()).hexdigest()

    def is_finished(self, *, resume: bool) -> bool:
        """Whether the store is a finished map; a store of another request is refused."""
        where = str(self._store)
        if not os.path.lexists(self._store):
            return False
        if not resume:
            hint = f"{OTHER_OUT}, or --resume"
            raise OutputError("it is there already", where=where, hint=hint)
        attributes = _metadata(self._store)["attributes"]
        if REQUEST not in attributes:
            what = "it is not a map that can be resumed"
            raise OutputError(what, where=where, hint=OTHER_OUT)
        if attributes[REQUEST] != self.request:
            raise FitError(BEGUN_OTHERWISE, where=where, hint=REPEAT)
        return FINISHED in attributes

    def check_finished(self) -> None:
        """Refuse a finished map of readings that have changed, or with missing chunks."""
        where = str(self._store)
        readings = [_digest(_read(self._image, region)) for region in self._regions]
        if _metadata(self._store)["attributes"][FINISHED] != self._combined(readings):
            what = "the capture has changed since it was made"
            raise FitError(what, where=where, hint=OTHER_OUT)
        files = [file for region in self._regions for file in self._files(region)]
        if missing := sum(not file.is_file() for file in files):
            what = f"{missing} of {len(files)} chunks are missing"
            raise OutputError(what, where=where, hint=f"copy the store again, or {OTHER_OUT}")

    def check_readings(self, ledger: Ledger) -> None:
        """Refuse to resume where the readings of a finished block have changed."""
        for region in self._regions:
            entry = ledger.entries.get(_label(region))
            if entry is not None and _digest(_read(self._image, region)) != entry.readings:
                what = f"the capture has changed since block {_label(region)} was fitted"
                raise FitError(what, where=str(self._store), hint=OTHER_OUT)

    def begin(self, ledger: Ledger) -> None:
        """Put the store without values in its place, or check that it is as it was put there."""
        with _written(self._store), temporary_folder(self._store.parent) as folder:
            empty = folder / self._store.name
            self._write_blank(empty)
            files = sorted(path.relative_to(empty) for path in empty.rglob("*") if path.is_file())
            if self._store.exists():
                for file in files:
                    self._check_same(empty, file)
                ledger.begin()
                return
            for path in (*empty.rglob("*"), empty):
                sync(path)
            ledger.begin()
            empty.rename(self._store)
            sync(self._store.parent)

    def _write_blank(self, path: Path) -> None:
        """The store with names, axes and attributes; chunks not yet written read as not fitted."""
        compressors = (ZstdCodec(), Crc32cCodec())
        encoding: dict = {str(name): {"compressors": compressors} for name in self._maps.variables}
        encoding["status"]["fill_value"] = int(Status.NOT_FITTED)
        self._maps.chunk(self._chunks).assign_attrs({REQUEST: self.request}).to_zarr(
            path,
            mode="w-",
            encoding=encoding,
            compute=False,
            consolidated=False,
            zarr_format=3,
            write_empty_chunks=True,
        )

    def _check_same(self, empty: Path, file: Path) -> None:
        """Refuse a store whose metadata or axes are not those that were written."""
        found = self._store / file
        if not found.is_file() or found.read_bytes() != (empty / file).read_bytes():
            what, where = "it is missing, or not as it was written", f"{self._store}: {file}"
            raise OutputError(what, where=where, hint=OTHER_OUT)

    def run(
        self, ledger: Ledger, source: Path, scheduler: str | None, progress: Counter | None
    ) -> None:
        """Fit and write every block that the ledger does not hold or whose files have changed."""
        regions = [region for region in self._regions if not self._is_done(ledger, region)]
        every = sum(map(_size, self._regions))
        done = every - sum(map(_size, regions))
        with workers(scheduler) as (executor, count):
            opened = self._image if scheduler is None else None  # a cluster opens it for itself
            tasks = ((source, region, self._plan, opened) for region in regions)
            for (_, region, *_), (block, readings) in as_completed(
                executor, count, fit_file_block, tasks
            ):
                with _written(self._store):
                    self._write(block, region)
                    entry = Entry(readings, _contents(self._files(region)))
                    ledger.add(_label(region), entry)
                done += _size(region)
                if progress is not None:
                    progress(done, every)

    def _is_done(self, ledger: Ledger, region: Region) -> bool:
        entry, files = ledger.entries.get(_label(region)), self._files(region)
        if entry is None or not all(file.is_file() for file in files):
            return False
        with _written(self._store):
            return _contents(files) == entry.chunks

    def _write(self, block: xr.Dataset, region: Region) -> None:
        """Write a block and wait until it is on the disk."""
        values = block.drop_vars(list(block.coords))
        values.to_zarr(self._store, region=region, consolidated=False, write_empty_chunks=True)
        files = self._files(region)
        folders = {up for file in files for up in file.parents if up.is_relative_to(self._store)}
        for path in (*files, *sorted(folders)):
            sync(path)

    def _files(self, region: Region) -> list[Path]:
        """Chunk files of a block: one of each array, as the default names of Zarr have it."""
        found = []
        for name, variable in self._maps.data_vars.items():
            at = [region[d].start // self._chunks[d] if d in IMAGE else 0 for d in variable.dims]
            found.append(self._store.joinpath(str(name), "c", *map(str, at)))
        return found

    def finish(self, ledger: Ledger) -> None:
        """Mark the store as finished, with a digest of the readings."""
        readings = [ledger.entries[_label(region)].readings for region in self._regions]
        with _written(self._store), temporary_folder(self._store.parent) as folder:
            metadata = _metadata(self._store)
            if metadata["attributes"].get(REQUEST) != self.request:
                raise taken_over(self._store)
            metadata["attributes"][FINISHED] = self._combined(readings)
            unfinished = folder / METADATA
            unfinished.write_text(json.dumps(metadata, indent=2))
            replace_file(unfinished, self._store / METADATA)

    def _combined(self, readings: Iterable[str]) -> str:
        """Digest of the readings of all blocks."""
        labels = map(_label, self._regions)
        text = "\n".join(f"{label} {one}" for label, one in zip(labels, readings, strict=True))
        return hashlib.sha256(text.encode()).hexdigest()


def _contents(files: Iterable[Path]) -> str:
    """SHA-256 of files, one after the other."""
    found = hashlib.sha256()
    for file in files:
        found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()


def _metadata(store: Path) -> dict[str, Any]:
    """Metadata of a store, without attributes where they cannot be read."""
    found: Any = {}
    with contextlib.suppress(OSError, ValueError):
        found = json.loads((store / METADATA).read_text())
    found = found if isinstance(found, dict) else {}
    return found if isinstance(found.get("attributes"), dict) else {**found, "attributes": {}}


def _label(region: Region) -> str:
    return " ".join(f"{dim}={part.start}:{part.stop}" for dim, part in region.items())


def _size(region: Region) -> int:
    return math.prod(part.stop - part.start for part in region.values())


def _block(image: xr.Dataset) -> int:
    """Most pixels of a block; it depends on the image alone, so resumed maps have the same."""
    return min(BLOCK, max(LEAST, image.sizes["y"] * image.sizes["x"] // PARTS))


@contextlib.contextmanager
def _written(store: Path) -> Iterator[None]:
    """Errors of the system or the libraries below, as one line."""
    try:
        yield
    except PolarBayesError:
        raise
    except Exception as error:  # Zarr raises nearly every type for a store that is not as it was
        reason = (getattr(error, "strerror", None) or "").lower() or str(error)
        raise OutputError(
            f"it could not be written ({reason or type(error).__name__})",
            where=str(store),
            hint="make room or give another --out; --resume goes on where it stopped",
        ) from error
