"""Work in blocks on threads or cluster workers, resumable after an interruption.

A store of blocks (a map, the fits of a calibration) has a journal, which one process at a time
locks. Its first line states the request by topic, and each further line a block, added when the
block is on the disk. A resume requires the same request, and fits a block again where it has no
line or cannot be read: what is read has checksums, those of Zarr or of
`polar_bayes.capture.files.write_netcdf`.
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
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, BinaryIO

import jax
import lazy_loader
import numpy as np
from numpyro import distributions as dist
from numpyro.primitives import Messenger

from polar_bayes.errors import FitError, OutputError, PolarBayesError
from polar_bayes.inference.request import Request
from polar_bayes.interrupts import on_interrupt, resume_hint
from polar_bayes.paths import output_error, sync
from polar_bayes.priors import describe_prior

portalocker = lazy_loader.load("portalocker")  # only resumable runs need it

# --- Threads of this process, or workers of a cluster ---------------------------------------------

AHEAD = 2
"""Queued blocks per worker: enough that no worker is idle, few enough to save memory."""


BLOCK_THREADS = "polar_bayes blocks"
"""Prefix of the names of threads that fit blocks."""


@contextlib.contextmanager
def workers(scheduler: str | None) -> Iterator[tuple[Executor, int]]:
    """Yield an executor and its number of workers: threads, or workers of a cluster."""
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
    """Yield tasks with their results as they complete, with a short queue of tasks."""
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
    """Return the SHA-256 digest of nested arrays, numbers, texts and functions."""
    return hashlib.sha256(_text(parts).encode()).hexdigest()


def request_topics(request: Request) -> dict[str, str]:
    """Return a text for each argument in which two requests may differ."""
    priors = (
        f"{name}={describe_prior(prior)} {digest(prior)}"
        for name, prior in sorted(request.priors.items())
    )
    links = (f"{name}={link!r}" for name, link in sorted(request.links.items()))
    return {
        "model": f"{request.model_name} {digest(request.model, request.fixed)}",
        "scene": ADDRESS.sub("", repr(request.scene)),
        "priors": ", ".join(priors),
        "links": ADDRESS.sub("", ", ".join(links)),
        "largest_view_zenith": repr(request.largest_view_zenith),
    }


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
    """Return the code and values of a function, or of a callable object, as text."""
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


# --- The journal of a store: which blocks are on the disk -----------------------------------------

OTHER_OUT = "give another --out"
REPEAT = f"repeat the command as it was, or {OTHER_OUT}"
RESUME = f"{OTHER_OUT}, or --resume"
VERSIONS = "versions"
"""Topic of a request that holds the versions of the libraries."""


class Journal:
    """Resume journal of a store: its request in the first line, then a line per finished block."""

    def __init__(
        self, opened: BinaryIO, file: Path, store: Path, kind: str, topics: Mapping[str, str]
    ) -> None:
        self._opened, self._file, self._store, self._size = opened, file, store, 0
        self._kind, self._topics = kind, topics
        self._magic = f"polar_bayes journal of a {kind} ".encode()
        self._head = self._magic + json.dumps(topics, sort_keys=True).encode() + b"\n"
        self.done: dict[str, str] = {}
        """Digests of what the finished blocks were made from, by name of the block."""

    def read(self) -> None:
        """Read which blocks are finished; refuse a file that is not a journal."""
        content = self._opened.read()
        if self._head.startswith(content):  # empty, or cut off within the first line
            return
        where = str(self._file)
        if not content.startswith(self._magic):
            what = f"it is not the journal of a {self._kind} that this version can resume"
            raise OutputError(what, where=where, hint=f"move that file away, or {OTHER_OUT}")
        if not content.startswith(self._head):
            raise FitError(self._difference(content), where=where, hint=REPEAT)
        # The last line was cut off by a crash where it has no end. A damaged name is that of no
        # block, so its block is fitted again.
        *lines, rest = content[len(self._head) :].split(b"\n")
        self._size = len(content) - len(rest)
        parts = (line.decode("ascii", "replace").rpartition(" ") for line in lines)
        self.done = {name: made_from for name, _, made_from in parts}

    def _difference(self, content: bytes) -> str:
        """Describe how this request differs from that of the file."""
        begun: Any = None
        with contextlib.suppress(ValueError):
            begun = json.loads(content[len(self._magic) :].partition(b"\n")[0])
        begun = begun if isinstance(begun, dict) else {}
        topics = {**self._topics, **begun}
        differing = [name for name in topics if self._topics.get(name) != begun.get(name)]
        names = ", another ".join(differing or topics)
        return f"it was begun with another {names}".replace(
            f"another {VERSIONS}", "other versions of the libraries"
        )

    def begin(self) -> None:
        """Remove an incomplete last line, and write the request to an empty file."""
        self._opened.truncate(self._size)
        if self._size == 0:
            self._append(self._head)
            sync(self._file.parent)

    def add(self, name: str, made_from: str = "") -> None:
        """Record a block that has been written to the disk."""
        if not self.is_in_place():
            raise taken_over(self._store)
        self._append(f"{name} {made_from}\n".encode())
        self.done[name] = made_from

    def end(self) -> None:
        """Remove the journal of a finished store."""
        if self.is_in_place():
            self._file.unlink()
            sync(self._file.parent)

    def is_in_place(self) -> bool:
        """Return whether the file is still the one that was opened."""
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
def open_journal(
    file: Path, store: Path, kind: str, topics: Mapping[str, str], *, resume: bool
) -> Iterator[Journal]:
    """Open and lock the journal of a store for the duration of a block."""
    # A journal that was made here and in which nothing was written is removed again.
    opened, is_new = _open(file, kind, resume=resume)
    try:
        _lock(opened, file, store)
        journal = Journal(opened, file, store, kind, topics)
        if not journal.is_in_place():
            raise taken_over(store)
        with on_interrupt(lambda: resume_hint(store)):
            yield journal
    except BaseException:
        if is_new and os.fstat(opened.fileno()).st_size == 0:
            file.unlink(missing_ok=True)
        raise
    finally:
        opened.close()


def _open(file: Path, kind: str, *, resume: bool) -> tuple[BinaryIO, bool]:
    """Return the opened file, and whether it is new."""
    try:
        with contextlib.suppress(FileExistsError):
            return file.open("x+b", buffering=0), True
        if not resume:
            raise OutputError("it is there already", where=str(file), hint=RESUME)
        if file.is_file():
            return file.open("r+b", buffering=0), False
    except OSError as error:
        raise output_error(error, file) from error
    hint = f"move it away, or {OTHER_OUT}"
    raise OutputError(f"it is not the journal of a {kind}", where=str(file), hint=hint)


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


def taken_over(store: Path) -> OutputError:
    """Return the error for a store or journal that another process has removed."""
    return OutputError(
        "another process has finished, moved or removed it",
        where=str(store),
        hint="let one process at a time write it, and repeat the command with --resume",
    )


@contextlib.contextmanager
def written(store: Path) -> Iterator[None]:
    """Convert errors of the system and of Zarr to errors of one line."""
    try:
        yield
    except PolarBayesError:
        raise
    except Exception as error:  # Zarr raises nearly every type for a store that is not as it was
        reason = (getattr(error, "strerror", None) or "").lower() or str(error)
        what = f"it could not be written ({reason or type(error).__name__})"
        hint = "make room or give another --out; --resume goes on where it stopped"
        raise OutputError(what, where=str(store), hint=hint) from error
