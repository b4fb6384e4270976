"""What a calibration asks, in texts that are the same in every process: who resumes must ask it."""

import dataclasses
import functools
import hashlib
import inspect
import re
import types
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any

import jax
import numpy as np
from numpyro import distributions as dist
from numpyro.primitives import Messenger

from polar_bayes.calibration.block import Plan
from polar_bayes.inference.request import Request
from polar_bayes.priors import describe_prior

ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
LIBRARIES = ("polar_bayes", "jax", "jaxlib", "numpyro", "numpy", "scipy")


def question_of(plan: Plan) -> dict[str, str]:
    """All that fixes the numbers of a calibration, but how many simulations there are."""
    told = _asked(plan.told) if plan.told is not None else {}
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
