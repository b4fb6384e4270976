"""Finished blocks of a calibration in a folder, from which an interrupted one resumes."""

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
from polar_bayes.inference.batching import Outcome
from polar_bayes.inference.request import Request
from polar_bayes.interrupts import resume_hint
from polar_bayes.paths import TEMPORARY_PREFIX, replace_file, temporary_folder
from polar_bayes.priors import describe_prior

# --- Fingerprint of a calibration: one text per topic, the same in every process ------------------


ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
LIBRARIES = ("polar_bayes", "jax", "jaxlib", "numpyro", "numpy", "scipy")


def fingerprint_of(plan: Plan) -> dict[str, str]:
    """One text per topic that determines the fits; their number may differ between runs."""
    truth = _topics(plan.generative_request) if plan.generative_request is not None else {}
    return {
        "capture": digest(jax.tree.leaves(plan.data), plan.data.dims, tuple(plan.data.readings)),
        **_topics(plan.request),
        "truth": " ".join(f"{topic}: {text}" for topic, text in truth.items()),
        "method": repr(plan.settings),
        "seed": str(plan.request.seed),
        "readings": str(plan.readings),
        "versions": " ".join(f"{name} {version(name)}" for name in LIBRARIES),
    }


def digest(*parts: Any) -> str:
    """A short hash of arrays, numbers, texts and functions, nested in any way."""
    return hashlib.sha256(_text(parts).encode()).hexdigest()[:16]


def _topics(request: Request) -> dict[str, str]:
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
    """The arrays that a distribution holds; their order differs between processes."""
    return sorted(_text(np.asarray(leaf)) for leaf in jax.tree.leaves(prior))


def _text(part: Any) -> str:
    if isinstance(part, np.ndarray | np.generic | jax.Array):
        array = np.asarray(part)
        values = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        return f"{array.dtype}{array.shape}{values}"
    if isinstance(part, Mapping):
        return f"{{{', '.join(f'{key}: {_text(part[key])}' for key in sorted(part, key=str))}}}"
    if isinstance(part, tuple | list):
        return f"[{', '.join(map(_text, part))}]"
    if isinstance(part, set | frozenset):
        return f"<{', '.join(sorted(map(_text, part)))}>"
    if isinstance(part, dist.Distribution):
        return f"{describe_prior(part)}{_text(_values(part))}"
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


# --- Blocks on the disk ---------------------------------------------------------------------------


QUESTION = "question.json"


class BlockStore:
    """A folder of blocks, each in a file that is there whole or not at all."""

    # A file is moved to its place when it is on the disk, and its archive holds a checksum of each
    # array. An unfinished or damaged file is ignored: its simulations are fitted again, to the same
    # bits.

    def __init__(self, folder: Path, fingerprint: Mapping[str, str]) -> None:
        self._folder, self._fingerprint = folder, dict(fingerprint)

    def begin(self, *, resume: bool) -> list[Block]:
        """Make the folder, or read the blocks in it."""
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
        elif any(not name.startswith(TEMPORARY_PREFIX) for name in names):
            raise FitError("it holds no calibration", where=where, hint="give another --out")
        else:  # new, or interrupted before the fingerprint was written
            text = json.dumps(self._fingerprint, indent=1, sort_keys=True).encode()
            with self._whole(QUESTION) as unfinished:
                unfinished.write_bytes(text)
        found = (read_block(path) for path in sorted(self._folder.glob("*.npz")))
        return [block for block in found if block is not None]

    def add(self, block: Block) -> None:
        """Write a block; arrays are named by their path, such as `pit/roughness`."""
        first, last = int(block.numbers.min()), int(block.numbers.max())
        arrays = {
            jax.tree_util.keystr(path, simple=True, separator="/"): np.asarray(x)
            for path, x in jax.tree_util.tree_leaves_with_path(block)
        }
        with (
            self._whole(f"{first:08d}-{last:08d}.npz") as unfinished,
            unfinished.open("wb") as file,
        ):
            np.savez(file, allow_pickle=False, **arrays)

    def resume_hint(self) -> str:
        """The sentence that an interrupt leaves for the user."""
        return resume_hint(self._folder)

    def _check(self, head: Path) -> None:
        """Refuse a folder of another fingerprint."""
        try:
            begun = json.loads(head.read_text())
        except (OSError, ValueError) as error:
            raise FitError(
                "it cannot be read", where=str(head), hint="give another --out"
            ) from error
        topics = {**self._fingerprint, **begun}
        others = [topic for topic in topics if self._fingerprint.get(topic) != begun.get(topic)]
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
        """A file to write to, which is then moved into its place."""
        with self._written(), temporary_folder(self._folder) as unfinished:
            yield unfinished / name
            replace_file(unfinished / name, self._folder / name)

    @contextlib.contextmanager
    def _written(self) -> Iterator[None]:
        """Errors of the operating system, as one line."""
        try:
            yield
        except OSError as error:
            raise FitError(
                f"it could not be written ({error.strerror})",
                where=str(self._folder),
                hint="make room or give another --out; --resume goes on where it stopped",
            ) from error


def read_block(path: Path) -> Block | None:
    """A block from a file; None where the file is damaged."""
    parts: dict[str, Any] = {name: {} for name in Block._fields}
    try:
        # NumPy does not close a file that it opens and cannot read.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            for key in file.files:
                name, _, entry = key.partition("/")
                if entry:
                    parts[name][entry] = file[key]
                else:
                    parts[name] = file[key]
        return Block(**{**parts, "outcome": Outcome(**parts["outcome"])})
    except (OSError, ValueError, TypeError, EOFError, KeyError, zipfile.BadZipFile):
        return None
