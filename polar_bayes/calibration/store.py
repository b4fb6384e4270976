"""Finished blocks in a folder: what a calibration that is broken off does not lose."""

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import json
import re
import types
import zipfile
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpyro import distributions as dist
from numpyro.primitives import Messenger

from polar_bayes.calibration.runner import Block, Plan
from polar_bayes.errors import FitError
from polar_bayes.inference.batch_result import Outcome
from polar_bayes.inference.request import Request
from polar_bayes.interrupts import resume_hint
from polar_bayes.paths import UNFINISHED, move_into_place, unfinished_folder
from polar_bayes.priors import describe_prior

# --- What a calibration asks, in texts that are the same in every process: who resumes must ask it


ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
LIBRARIES = ("polar_bayes", "jax", "jaxlib", "numpyro", "numpy", "scipy")


def fingerprint_of(plan: Plan) -> dict[str, str]:
    """All that fixes the numbers of a calibration, but how many simulations there are."""
    told = _asked(plan.generative_request) if plan.generative_request is not None else {}
    return {
        "capture": digest(jax.tree.leaves(plan.data), plan.data.dims, tuple(plan.data.readings)),
        **_asked(plan.request),
        "truth": " ".join(f"{topic}: {text}" for topic, text in told.items()),
        "method": repr(plan.settings),
        "seed": str(plan.request.seed),
        "readings": str(plan.readings),
        "versions": " ".join(f"{name} {version(name)}" for name in LIBRARIES),
    }


def differing(asked: Mapping[str, str], begun: Mapping[str, str]) -> list[str]:
    """Topics in which two questions differ."""
    return [topic for topic in {**asked, **begun} if asked.get(topic) != begun.get(topic)]


def digest(*parts: Any) -> str:
    """A short text of arrays, numbers, texts and functions, nested in any way."""
    return hashlib.sha256(_told(parts).encode()).hexdigest()[:16]


def _asked(request: Request) -> dict[str, str]:
    priors = (
        f"{name}={describe_prior(prior)} {digest(_values(prior))}"
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


def _values(prior: dist.Distribution) -> list[str]:
    """What it holds; in which order changes from process to process."""
    return sorted(_told(np.asarray(leaf)) for leaf in jax.tree.leaves(prior))


def _told(part: Any) -> str:
    if isinstance(part, np.ndarray | np.generic | jax.Array):
        array = np.asarray(part)
        said = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        return f"{array.dtype}{array.shape}{said}"
    if isinstance(part, Mapping):
        return f"{{{', '.join(f'{key}: {_told(part[key])}' for key in sorted(part, key=str))}}}"
    if isinstance(part, tuple | list):
        return f"[{', '.join(map(_told, part))}]"
    if isinstance(part, set | frozenset):
        return f"<{', '.join(sorted(map(_told, part)))}>"
    if isinstance(part, dist.Distribution):
        return f"{describe_prior(part)}{_told(_values(part))}"
    if isinstance(part, types.CodeType):
        return _told([part.co_code.hex(), part.co_names, part.co_varnames, part.co_consts])
    return _told_callable(part) if callable(part) else ADDRESS.sub("", repr(part))


def _told_callable(part: Callable) -> str:
    """What a function, or an object that acts as one, is made of."""
    kind = type(part)
    if isinstance(part, functools.partial):
        return _told([part.func, part.args, part.keywords])
    if isinstance(part, types.MethodType):
        return _told([part.__func__, part.__self__])
    if isinstance(part, types.FunctionType):
        # One that calls itself encloses itself.
        cells = inspect.getclosurevars(part).nonlocals
        closed = {name: x for name, x in cells.items() if x is not part}
        given = [part.__defaults__, part.__kwdefaults__ or {}]
        return f"{part.__qualname__}{_told([part.__code__, closed, given])}"
    if isinstance(part, Messenger):
        return f"{kind.__name__}{_told(vars(part))}"
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        own = {each.name: getattr(part, each.name) for each in dataclasses.fields(part)}
        return f"{kind.__qualname__}{_told([own, kind.__call__])}"
    return ADDRESS.sub("", repr(part))


# --- Finished blocks in a folder: what a calibration that is broken off does not lose -------------


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
                "it is there already", where=where, hint="give another --out, or --resume"
            )
        with self._written():
            self._folder.mkdir(exist_ok=resume)
            names = [path.name for path in self._folder.iterdir()]
        if head.name in names:
            self._check(head)
        elif any(not name.startswith(UNFINISHED) for name in names):
            raise FitError("it holds no calibration", where=where, hint="give another --out")
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
                "it cannot be read", where=str(head), hint="give another --out"
            ) from error
        others = differing(self._question, begun)
        if others:
            raise FitError(
                f"it was begun with another {', another '.join(others)}".replace(
                    "another versions", "other versions of the libraries"
                ),
                where=str(self._folder),
                hint="repeat the command as it was, or give another --out",
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
                hint="make room or give another --out; --resume goes on where it stopped",
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
