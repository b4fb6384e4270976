"""Work in blocks, on threads or workers of a cluster, and resumable after an interruption.

A resumable run has a ledger, which one process at a time locks. Its first line is the fingerprint
of the run, and each further line a finished block, added when the files of the block are on the
disk. Every line has a checksum. A resume requires the same fingerprint, and fits a block again
where it has no line or its files are not those of the line.
"""

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import inspect
import json
import os
import re
import types
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import lazy_loader
import numpy as np
from numpyro import distributions as dist
from numpyro.primitives import Messenger

from polar_bayes.errors import FitError, OutputError, PolarBayesError
from polar_bayes.paths import output_error, sync
from polar_bayes.priors import describe_prior

portalocker = lazy_loader.load("portalocker")  # only resumable runs need it

# --- Threads of this process, or workers of a cluster ---------------------------------------------

AHEAD = 2
"""Blocks that wait for each that is being fitted: none idles, and memory stays small."""


BLOCK_THREADS = "polar_bayes blocks"
"""Prefix of the names of threads that fit blocks."""


@contextlib.contextmanager
def workers(scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """Something that runs functions, and how many at a time."""
    if scheduler is None:
        threads = os.cpu_count() or 1
        pool = ThreadPoolExecutor(threads, BLOCK_THREADS)
        try:
            yield pool, threads
        except BaseException:  # an interrupt must not wait for blocks that take minutes
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()
        return
    where = f"scheduler={scheduler}"
    try:
        client = importlib.import_module("distributed").Client(scheduler, timeout="5s")
    except ImportError as error:
        hint = "pip install 'polar_bayes[cluster]', or leave the scheduler out"
        what = "the library for clusters is not installed"
        raise FitError(what, where=where, hint=hint) from error
    except (OSError, ValueError) as error:
        hint = "give the address that `dask scheduler` prints, such as tcp://10.0.0.1:8786"
        raise FitError("no scheduler answers there", where=where, hint=hint) from error
    with client:
        yield client.get_executor(), max(1, len(client.scheduler_info()["workers"]))


def as_completed(
    executor: Executor, count: int, function: Callable, tasks: Iterable[tuple]
) -> Iterator[tuple[tuple, Any]]:
    """Results as they come, with few tasks on their way at any time."""
    waiting, left = {}, iter(tasks)
    try:
        while True:
            for task in left:
                waiting[executor.submit(function, *task)] = task
                if len(waiting) >= AHEAD * count:
                    break
            if not waiting:
                return
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield waiting.pop(future), future.result()
    finally:
        for future in waiting:
            future.cancel()


# --- Digests that are the same in every process ---------------------------------------------------

ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")


def digest(*parts: Any) -> str:
    """SHA-256 of arrays, numbers, texts and functions, nested in any way."""
    return hashlib.sha256(_text(parts).encode()).hexdigest()


def digest_files(files: Iterable[Path]) -> str:
    """SHA-256 of the contents of files, one after the other."""
    found = hashlib.sha256()
    for file in files:
        found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()


def _text(part: Any) -> str:
    if isinstance(part, np.ndarray | np.generic | jax.Array):
        array = np.asarray(part)
        if array.dtype.kind not in "biufcSU":  # texts of other types are pointers
            return _text(array.tolist())
        values = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        return f"{array.dtype}{array.shape}{values}"
    if isinstance(part, Mapping):
        return f"{{{', '.join(f'{key}: {_text(part[key])}' for key in sorted(part, key=str))}}}"
    if isinstance(part, tuple | list):
        return f"[{', '.join(map(_text, part))}]"
    if isinstance(part, set | frozenset):
        return f"<{', '.join(sorted(map(_text, part)))}>"
    if isinstance(part, dist.Distribution):  # the order of its arrays differs between processes
        leaves = sorted(_text(np.asarray(leaf)) for leaf in jax.tree.leaves(part))
        return f"{describe_prior(part)}{leaves}"
    if isinstance(part, types.CodeType):
        return _text([part.co_code.hex(), part.co_names, part.co_varnames, part.co_consts])
    return _text_of_callable(part) if callable(part) else ADDRESS.sub("", repr(part))


def _text_of_callable(part: Callable) -> str:
    """The code and values of a function, or of a callable object."""
    if isinstance(part, functools.partial):
        return _text([part.func, part.args, part.keywords])
    if isinstance(part, types.MethodType):
        return _text([part.__func__, part.__self__])
    if isinstance(part, types.FunctionType):
        # One that calls itself encloses itself.
        cells = inspect.getclosurevars(part).nonlocals
        closed = {name: x for name, x in cells.items() if x is not part}
        given = [part.__defaults__, part.__kwdefaults__ or {}]
        return f"{part.__qualname__}{_text([part.__code__, closed, given])}"
    if isinstance(part, Messenger):
        return f"{type(part).__name__}{_text(vars(part))}"
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        own = {each.name: getattr(part, each.name) for each in dataclasses.fields(part)}
        return f"{type(part).__qualname__}{_text([own, type(part).__call__])}"
    return ADDRESS.sub("", repr(part))


# --- The ledger of a resumable run: which blocks are on the disk ----------------------------------

OTHER_OUT = "give another --out"
REPEAT = f"repeat the command as it was, or {OTHER_OUT}"
VERSIONS = "versions"
"""Topic of a fingerprint: the versions of the libraries."""


def begun_with_another(topics: Iterable[str]) -> str:
    """What differs between a run that is resumed and the one that was begun."""
    return f"it was begun with another {', another '.join(topics)}".replace(
        f"another {VERSIONS}", "other versions of the libraries"
    )


class Entry(NamedTuple):
    """A finished block: digests of what it was made from, and of its files."""

    inputs: str
    files: str


class Ledger:
    """A file with the fingerprint of a run in its head, and a line per finished block."""

    # A line without an end was cut off by a crash and is ignored; any other line that fails its
    # checksum is an error.

    def __init__(
        self, opened: BinaryIO, file: Path, store: Path, kind: str, fingerprint: Mapping[str, str]
    ) -> None:
        self._opened, self._file, self._store, self._size = opened, file, store, 0
        self._kind, self._fingerprint = kind, fingerprint
        self._magic = f"polar_bayes {kind} ".encode()
        self._head = self._magic + json.dumps(fingerprint, sort_keys=True).encode() + b"\n"
        self.entries: dict[str, Entry] = {}

    def read(self) -> None:
        """Read the entries; a file that holds anything else is refused and left as it is."""
        where = str(self._file)
        content = self._opened.read()
        if self._head.startswith(content):  # empty, or cut off within the head
            return
        if not content.startswith(self._magic):
            hint = f"move that file away, or {OTHER_OUT}"
            raise OutputError(f"it is not the ledger of a {self._kind}", where=where, hint=hint)
        if not content.startswith(self._head):
            raise FitError(begun_with_another(self._differing(content)), where=where, hint=REPEAT)
        *lines, rest = content[len(self._head) :].split(b"\n")
        self._size = len(content) - len(rest)
        for number, line in enumerate(lines, 2):
            body, _, checksum = line.rpartition(b" ")
            fields = body.rsplit(b" ", 2)
            if len(fields) != 3 or checksum != _checksum(body):
                hint = f"remove that file to fit all blocks again, or {OTHER_OUT}"
                raise OutputError(f"line {number} is damaged", where=where, hint=hint)
            label, inputs, files = (field.decode("ascii") for field in fields)
            self.entries[label] = Entry(inputs, files)

    def _differing(self, content: bytes) -> list[str]:
        """Topics whose texts are not those of the head; all where it cannot be read."""
        begun: Any = None
        with contextlib.suppress(ValueError):
            begun = json.loads(content[len(self._magic) :].partition(b"\n")[0])
        begun = begun if isinstance(begun, dict) else {}
        topics = {**self._fingerprint, **begun}
        differing = [name for name in topics if self._fingerprint.get(name) != begun.get(name)]
        return differing or list(topics)

    def begin(self) -> None:
        """Cut off an incomplete last line; write the head where there is none."""
        self._opened.truncate(self._size)
        if self._size == 0:
            self._append(self._head)
            sync(self._file.parent)

    def add(self, label: str, entry: Entry) -> None:
        """Record a block that is on the disk."""
        if not self.is_in_place():
            raise taken_over(self._store)
        body = f"{label} {entry.inputs} {entry.files}".encode()
        self._append(body + b" " + _checksum(body) + b"\n")
        self.entries[label] = entry

    def holds(self, label: str, files: Iterable[Path]) -> bool:
        """Whether a block is finished and its files are as they were written."""
        entry, files = self.entries.get(label), list(files)
        if entry is None or not all(file.is_file() for file in files):
            return False
        with written(self._store):
            return digest_files(files) == entry.files

    def end(self) -> None:
        """Remove the ledger of a finished run."""
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
def locked_ledger(
    file: Path, store: Path, kind: str, fingerprint: Mapping[str, str], *, resume: bool
) -> Iterator[Ledger]:
    """The ledger of a store, locked: the lock ends with the block, or with the process."""
    # A ledger that was made here and in which nothing was written is removed again.
    opened, is_new = _open(file, kind, resume=resume)
    try:
        _lock(opened, file, store)
        ledger = Ledger(opened, file, store, kind, fingerprint)
        if not ledger.is_in_place():
            raise taken_over(store)
        yield ledger
    except BaseException:
        if is_new and os.fstat(opened.fileno()).st_size == 0:
            file.unlink(missing_ok=True)
        raise
    finally:
        opened.close()


def _open(file: Path, kind: str, *, resume: bool) -> tuple[BinaryIO, bool]:
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
    raise OutputError(f"it is not the ledger of a {kind}", where=str(file), hint=hint)


def _lock(opened: BinaryIO, file: Path, store: Path) -> None:
    flags = portalocker.LockFlags.EXCLUSIVE | portalocker.LockFlags.NON_BLOCKING
    try:
        portalocker.lock(opened, flags)
    except portalocker.AlreadyLocked as error:
        what, hint = "another process is writing it", f"wait until it has finished, or {OTHER_OUT}"
        raise OutputError(what, where=str(store), hint=hint) from error
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


@contextlib.contextmanager
def written(store: Path, kind: type[PolarBayesError] = OutputError) -> Iterator[None]:
    """Errors of the system or the libraries below, as one line."""
    try:
        yield
    except PolarBayesError:
        raise
    except Exception as error:  # Zarr raises nearly every type for a store that is not as it was
        reason = (getattr(error, "strerror", None) or "").lower() or str(error)
        what = f"it could not be written ({reason or type(error).__name__})"
        hint = "make room or give another --out; --resume goes on where it stopped"
        raise kind(what, where=str(store), hint=hint) from error
