"""Plates for the axes of a capture, so that a model file can read like the paper."""

import contextlib
from collections.abc import Iterator

import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.observation.data import Observations


@contextlib.contextmanager
def over_axes(data: Observations, *, without: tuple[str, ...] = ()) -> Iterator[None]:
    """Repeat what is declared inside over every axis of the capture except those named."""
    with contextlib.ExitStack() as stack:
        for position, (name, length) in enumerate(data.dims):
            if name not in without:
                stack.enter_context(numpyro.plate(name, length, dim=position - len(data.dims)))
        yield


def draw(name: str, prior: dist.Distribution, data: Observations) -> Float[Array, "..."]:
    """Sample a parameter inside `over_axes(data, without=("view", ...))`; drops the view axis."""
    value = numpyro.sample(name, prior)
    return value[..., 0] if len(data.dims) > 1 and value.ndim == len(data.dims) else value
