"""The ledger of an unfinished map: which blocks are on the disk, and of which readings."""

import contextlib
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import portalocker

from polar_bayes.errors import FitError, OutputError
from polar_bayes.paths import output_error, sync

MAGIC = b"polar_bayes map "
BEGUN_OTHERWISE = "it was begun with another capture or other settings"
REPEAT = "repeat the command as it was, or give another --out"


class Entry(NamedTuple):
    """A block that is done."""

    readings: str
    chunks: str


class Ledger:
    """A file beside the store: a head with the fingerprint of the request, then a line per block."""

    # A line is added after the chunks of its block are on the disk. A line without an end was cut
    # off by a crash and counts as not there; any other line that fails its checksum is an error.

    def __init__(self, opened: BinaryIO, file: Path, request: str) -> None:
        self._opened, self._file, self._size = opened, file, 0
        self._head = MAGIC + request.encode() + b"\n"
        self.entries: dict[str, Entry] = {}

    def read(self) -> None:
        """Read what is there; a file that holds anything else is refused and left as it is."""
        where = str(self._file)
        content = self._opened.read()
        if self._head.startswith(content):  # empty, or cut off within the head
            return
        if not content.startswith(MAGIC):
            mend = "move that file away, or give another --out"
            raise OutputError("it is not the ledger of a map", where=where, mend=mend)
        if not content.startswith(self._head):
            raise FitError(BEGUN_OTHERWISE, where=where, mend=REPEAT)
        *lines, rest = content[len(self._head) :].split(b"\n")
        self._size = len(content) - len(rest)
        for number, line in enumerate(lines, 2):
            body, _, checksum = line.rpartition(b" ")
            fields = body.rsplit(b" ", 2)
            if len(fields) != 3 or checksum != _checksum(body):
                raise OutputError(
                    f"line {number} is damaged",
                    where=where,
                    mend="remove that file to fit all blocks again, or give another --out",
                )
            label, readings, chunks = (field.decode("ascii") for field in fields)
            self.entries[label] = Entry(readings, chunks)

    def begin(self) -> None:
        """Cut off what a crash left of a line; write the head where there is none."""
        self._opened.truncate(self._size)
        if self._size == 0:
            self._append(self._head)
            sync(self._file.parent)

    def add(self, label: str, entry: Entry) -> None:
        """A block is on the disk."""
        if not self._is_in_place():
            raise taken_over(_store_of(self._file))
        self._append(_line(label, entry))
        self.entries[label] = entry

    def end(self) -> None:
        """Nothing is left to do."""
        if self._is_in_place():
            self._file.unlink()
            sync(self._file.parent)

    def _append(self, text: bytes) -> None:
        self._opened.seek(0, os.SEEK_END)
        while text:  # an unbuffered file may take less than it is given
            text = text[self._opened.write(text) :]
        os.fsync(self._opened.fileno())

    def _is_in_place(self) -> bool:
        try:
            return os.path.samestat(os.fstat(self._opened.fileno()), os.stat(self._file))
        except FileNotFoundError:
            return False


@contextlib.contextmanager
def locked_ledger(file: Path, request: str, *, resume: bool) -> Iterator[Ledger]:
    """The ledger of a map, locked: the lock ends with the block, or with the process."""
    # A ledger that was made here and in which nothing was written is removed again.
    opened, is_new = _open(file, resume=resume)
    try:
        _lock(opened, file)
        ledger = Ledger(opened, file, request)
        if not ledger._is_in_place():
            raise taken_over(_store_of(file))
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
            mend = "give another --out, or --resume"
            raise OutputError("it is there already", where=str(file), mend=mend)
        if file.is_file():
            return file.open("r+b", buffering=0), False
    except OSError as error:
        raise output_error(error, file) from error
    mend = "move it away, or give another --out"
    raise OutputError("it is not the ledger of a map", where=str(file), mend=mend)


def _lock(opened: BinaryIO, file: Path) -> None:
    try:
        portalocker.lock(
            opened, portalocker.LockFlags.EXCLUSIVE | portalocker.LockFlags.NON_BLOCKING
        )
    except portalocker.AlreadyLocked as error:
        mend = "wait until it has finished, or give another --out"
        raise OutputError(
            "another process is writing it", where=str(_store_of(file)), mend=mend
        ) from error
    except portalocker.LockException as error:
        raise OutputError(
            f"it cannot be locked ({error})",
            where=str(file),
            mend="give an --out on a file system that has locks",
        ) from error


def taken_over(store: Path) -> OutputError:
    """The error of a process that finds the store or its ledger no longer there."""
    return OutputError(
        "another process has finished, moved or removed it",
        where=str(store),
        mend="let one process at a time write it, and repeat the command with --resume",
    )


def _store_of(file: Path) -> Path:
    return file.with_suffix("")


def _line(label: str, entry: Entry) -> bytes:
    body = f"{label} {entry.readings} {entry.chunks}".encode()
    return body + b" " + _checksum(body) + b"\n"


def _checksum(body: bytes) -> bytes:
    return f"{zlib.crc32(body):08x}".encode()
