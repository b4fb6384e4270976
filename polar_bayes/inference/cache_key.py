"""What requests have in common whose compiled programs are the same: their key in a cache."""

import dataclasses
import gc
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType, ModuleType

import jax
import numpy as np
from dask.base import tokenize
from numpyro import distributions as dist

from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink
from polar_bayes.physics.scene import Scene


def cache_key(
    model: Callable,
    scene: Scene,
    priors: Mapping[str, dist.Distribution],
    links: Mapping[str, AbstractLink],
    *further: object,
) -> str:
    """A text that is equal for requests whose compiled programs are the same."""
    scene = dataclasses.replace(scene)  # without its ledger
    parts = [
        model,
        scene,
        # Not the priors themselves: distributions store what they have computed.
        *(
            (name, jax.tree.leaves(prior), str(jax.tree.structure(prior)))
            for name, prior in priors.items()
        ),
        links,
        *_code_of(model, scene, links, *map(type, priors.values())),
        *further,
    ]
    # One by one: a token depends on which of the objects inside it are identical.
    return tokenize([tokenize(part) for part in parts])


def layout_of(data: Observations) -> tuple[str, ...]:
    """What programs depend on in a capture: variables, axes, lengths and types, not readings."""
    return (str(jax.tree.structure(data)), *(f"{x.dtype}{x.shape}" for x in jax.tree.leaves(data)))


CONSTANTS = (str, bytes, int, float, complex, np.ndarray, np.generic, jax.Array)


def _code_of(*roots: object) -> Iterator[object]:
    """Byte code of the user's functions that the roots refer to, and the constants they read."""
    # A function or class that is edited and loaded again keeps its name, by which it is pickled.
    # Programs compiled from the old code must not serve the new one.
    seen: dict[int, object] = {}  # holds the objects, so that no other one gets the same id
    pending = list(roots)
    while pending:
        value = pending.pop()
        if isinstance(value, CONSTANTS):
            yield value
        elif id(value) not in seen:
            seen[id(value)] = value
            if isinstance(value, FunctionType) and not _is_installed(value.__module__):
                yield value.__code__
            pending.extend(_references(value))


def _references(value: object) -> Iterable[object]:
    """Objects whose code may run when a value is used."""
    if isinstance(value, ModuleType):
        return ()
    if isinstance(value, FunctionType):
        attached = (value.__closure__, value.__dict__)
        if _is_installed(value.__module__):
            return attached
        return (*attached, value.__defaults__, value.__kwdefaults__, *_globals_of(value))
    if isinstance(value, type):
        return () if _is_installed(value.__module__) else (*vars(value).values(), *value.__bases__)
    if type(value).__module__ in ("builtins", "functools"):  # containers, cells, methods, partials
        return gc.get_referents(value)
    return (type(value), *getattr(value, "__dict__", {}).values())


def _globals_of(function: FunctionType) -> Iterator[object]:
    """Values of the global names in a function, and of attributes of the user's own modules."""
    codes = [function.__code__]
    names: list[str] = []
    for code in codes:
        names.extend(code.co_names)
        codes.extend(constant for constant in code.co_consts if isinstance(constant, CodeType))
    for name in names:
        value = function.__globals__.get(name)
        yield value
        if isinstance(value, ModuleType) and not _is_installed(value.__name__):
            yield from (getattr(value, attribute, None) for attribute in names)


def _is_installed(module: str | None) -> bool:
    """Whether a module is part of Python, of this package or of another installed one."""
    package = (module or "").partition(".")[0]
    if package in sys.stdlib_module_names or package == "polar_bayes":
        return True
    file = getattr(sys.modules.get(module or ""), "__file__", None) or ""
    return not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)
