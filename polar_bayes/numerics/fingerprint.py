"""Fingerprints of what a program is compiled from: values, and code of the user's functions.

A function or class that is edited and loaded again keeps its name, by which it is pickled. Programs
compiled from the old code must not serve the new one.
"""

import dataclasses
import functools
import gc
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType, ModuleType

import jax
import numpy as np
from dask.base import tokenize
from numpyro.primitives import Messenger


def fingerprint(*parts: object, code: Iterable[object]) -> str:
    """Return a text that is equal for equal values whose functions have the same code."""
    # One by one: a token depends on which of the objects inside it are identical.
    return tokenize([tokenize(part) for part in (*map(_plain, parts), *_code_of(*code))])


def uses_own_code(*roots: object) -> bool:
    """Return whether the roots refer to any function of the user's."""
    return any(isinstance(each, CodeType) for each in _code_of(*roots))


CONSTANTS = (str, bytes, int, float, complex, np.ndarray, np.generic, jax.Array)


def _plain(value: object, above: tuple[object, ...] = ()) -> object:
    """Replace functions and classes in a value by their names; the value may contain itself."""
    # A token is made of a pickle that is read again. That of a class of a notebook would give the
    # class new methods, which no longer see what is edited there.
    is_handler = isinstance(value, Messenger)  # it has the name of what it wraps
    if callable(value) and hasattr(value, "__qualname__") and not is_handler:
        return f"{value.__module__}.{value.__qualname__}"
    if any(value is each for each in above):
        return _plain(type(value))
    parts: object
    if isinstance(value, Mapping):
        parts = tuple(value.items())
    elif isinstance(value, tuple | list):
        return [_plain(type(value)), *(_plain(own, (*above, value)) for own in value)]
    elif isinstance(value, functools.partial):
        parts = (value.func, value.args, value.keywords)
    elif dataclasses.is_dataclass(value):
        parts = tuple((each.name, getattr(value, each.name)) for each in dataclasses.fields(value))
    elif is_handler or not _is_installed(type(value).__module__):
        parts = {n: x for n, x in getattr(value, "__dict__", {}).items() if n[:2] != "__"}
    else:
        return value
    return [_plain(type(value)), _plain(parts, (*above, value))]


def _code_of(*roots: object) -> Iterator[object]:
    """Return byte code of the user's functions below the roots, and the constants they read."""
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
    """Return objects whose code may run when a value is used."""
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
    """Return values of a function's global names, and attributes of the user's modules."""
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
    """Return whether a module is part of Python, of this package or of an installed one."""
    package = (module or "").partition(".")[0]
    if package == "__main__":  # a notebook's cells, whichever installed program runs them
        return False
    if package in sys.stdlib_module_names or package == "polar_bayes":
        return True
    file = getattr(sys.modules.get(module or ""), "__file__", None) or ""
    return not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)
