"""Finished blocks in a folder: what a calibration that is broken off does not lose."""

import contextlib
import json
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from polar_bayes.calibration.block import Block
from polar_bayes.calibration.question import differing
from polar_bayes.errors import FitError
from polar_bayes.interrupts import resume_hint
from polar_bayes.paths import UNFINISHED, move_into_place, unfinished_folder
from polar_bayes.pixels.outcome import Outcome

QUESTION, BLOCKS = "question.json", "*.npz"


class Store:
    """Blocks on the disk, each in a file that is there whole or not at all."""

    # A file is moved to its place when it is on the disk, and its archive holds a checksum of each
    # array. What a crash left unfinished, or what cannot be read, counts as not there: its
    # simulations are fitted again, to the same bits.

    def __init__(self, folder: Path, question: Mapping[str, str]) -> None:
        self._folder, self._question = folder, dict(question)

    def begin(self, *, resume: bool) -> list[Block]:
        """Make the folder, or find what is in it."""
        where, head = str(self._folder), self._folder / QUESTION
        if not resume and self._folder.exists():
            raise FitError(
                "it is there already", where=where, mend="give another --out, or --resume"
            )
        with self._written():
            self._folder.mkdir(exist_ok=resume)
            names = [path.name for path in self._folder.iterdir()]
        if head.name in names:
            self._check(head)
        elif any(not name.startswith(UNFINISHED) for name in names):
            raise FitError("it holds no calibration", where=where, mend="give another --out")
        else:  # new, or broken off before it said what is asked
            told = json.dumps(self._question, indent=1, sort_keys=True).encode()
            with self._whole(QUESTION) as unfinished:
                unfinished.write_bytes(told)
        found = (read_block(path) for path in sorted(self._folder.glob(BLOCKS)))
        return [block for block in found if block is not None]

    def add(self, block: Block) -> None:
        """Keep a block."""
        first, last = int(block.numbers.min()), int(block.numbers.max())
        with self._whole(f"{first:08d}-{last:08d}.npz") as unfinished:
            with unfinished.open("wb") as file:
                np.savez(file, allow_pickle=False, **_flat(block._asdict()))

    def resume_hint(self) -> str:
        """What an interrupt leaves, for the user."""
        return resume_hint(self._folder)

    def _check(self, head: Path) -> None:
        try:
            begun = json.loads(head.read_text())
        except (OSError, ValueError) as error:
            raise FitError(
                "it cannot be read", where=str(head), mend="give another --out"
            ) from error
        others = differing(self._question, begun)
        if others:
            raise FitError(
                f"it was begun with another {', another '.join(others)}".replace(
                    "another versions", "other versions of the libraries"
                ),
                where=str(self._folder),
                mend="repeat the command as it was, or give another --out",
            )

    @contextlib.contextmanager
    def _whole(self, name: str) -> Iterator[Path]:
        """A file to write to, which then takes its place at once."""
        with self._written(), unfinished_folder(self._folder) as unfinished:
            yield unfinished / name
            move_into_place(unfinished / name, self._folder / name)

    @contextlib.contextmanager
    def _written(self) -> Iterator[None]:
        """What the operating system says, as one line."""
        try:
            yield
        except OSError as error:
            raise FitError(
                f"it could not be written ({error.strerror})",
                where=str(self._folder),
                mend="make room or give another --out; --resume goes on where it stopped",
            ) from error


def read_block(path: Path) -> Block | None:
    """A block from a file."""
    try:
        # NumPy does not close a file that it opens and cannot read.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            flat = {name: file[name] for name in file.files}
        return _block(flat)
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def _flat(values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Arrays by path, such as `pit/roughness`."""
    found: dict[str, np.ndarray] = {}
    for name, value in values.items():
        value = value._asdict() if isinstance(value, Outcome) else value
        if isinstance(value, Mapping):
            found |= {f"{name}/{key}": np.asarray(each) for key, each in value.items()}
        else:
            found[name] = np.asarray(value)
    return found


def _block(flat: Mapping[str, np.ndarray]) -> Block:
    parts: dict[str, Any] = {name: {} for name in Block._fields}
    for path, array in flat.items():
        name, _, key = path.partition("/")
        if key:
            parts[name][key] = array
        else:
            parts[name] = array
    return Block(**{**parts, "outcome": Outcome(**parts["outcome"])})
