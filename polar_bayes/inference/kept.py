"""What was compiled is kept for the next fit that is the same but for its readings."""

import dataclasses
import sys
import sysconfig
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
from dask.base import tokenize
from numpyro import distributions as dist

from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene

INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib")})


class Kept[T]:
    """The last few things that were made, by key; safe to ask from several threads."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._found: dict[Any, T] = {}
        self._lock = threading.RLock()

    def of(self, key: Any, make: Callable[[], T]) -> T:
        """What has that key, made now if it is not kept."""
        with self._lock:
            found = self._found.pop(key) if key in self._found else make()
            self._found[key] = found
            while len(self._found) > self._most:
                del self._found[next(iter(self._found))]
            return found


def key_of_story(
    model: Callable,
    scene: Scene,
    priors: Mapping[str, dist.Distribution],
    links: Mapping[str, AbstractLink],
    *further: Any,
) -> str:
    """A text that is the same for stories whose programs are the same."""
    parts = [
        model,
        dataclasses.replace(scene),  # without its ledger
        # Not the priors themselves: distributions keep what they have computed.
        *(
            (name, jax.tree.leaves(prior), str(jax.tree.structure(prior)))
            for name, prior in priors.items()
        ),
        links,
        last_edit(),
        *further,
    ]
    # One by one: a token depends on which objects of what it is made of are the same one.
    return tokenize([tokenize(part) for part in parts])


def layout_of(data: Observations) -> tuple[str, ...]:
    """What programs know of a capture: variables, axes, lengths and types, and no reading."""
    return (str(jax.tree.structure(data)), *(f"{x.dtype}{x.shape}" for x in jax.tree.leaves(data)))


def last_edit() -> int:
    """When a module that is not installed was edited last, in ns."""
    # A model, link or part of the user's own that is edited and loaded again has the name that it
    # had before. What was compiled of the old one must not answer for it.
    edits = [0]
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if file and not file.startswith(INSTALLED):
            try:
                edits.append(Path(file).stat().st_mtime_ns)
            except OSError:  # in an archive, or gone
                continue
    return max(edits)
