"""Plates for the axes of a capture, so that a model file can read like the paper."""

import contextlib
from collections.abc import Iterator, Mapping

import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene

SPECTRAL = ("absorption", "refractive_index")
"""What has a value of its own at every wavelength."""


@contextlib.contextmanager
def over_axes(data: Observations, *, without: tuple[str, ...] = ()) -> Iterator[None]:
    """Repeat what is declared inside over every axis of the capture except those named."""
    with contextlib.ExitStack() as stack:
        for position, (name, length) in enumerate(data.dims):
            if name not in without:
                stack.enter_context(numpyro.plate(name, length, dim=position - len(data.dims)))
        yield


def material_parameters(scene: Scene) -> tuple[str, ...]:
    """What a scene reads of the material; nothing else is sampled."""
    return tuple(name for name in MATERIAL_PARAMETERS if name in scene.parameters)


def draw_own(
    name: str, data: Observations, priors: Mapping[str, dist.Distribution]
) -> Float[Array, "..."]:
    """Sample a parameter of the material that each patch, or color, has for itself."""
    with over_axes(data, without=unchanging(name)):
        return draw(name, priors[name], data)


def draw(name: str, prior: dist.Distribution, data: Observations) -> Float[Array, "..."]:
    """Sample a parameter inside `over_axes(data, without=("view", ...))`; drops the view axis."""
    return drop_view(numpyro.sample(name, prior), data)


def drop_view(value: Float[Array, "..."], data: Observations) -> Float[Array, "..."]:
    """A parameter without the view axis of length 1 that plates left behind."""
    return value[..., 0] if len(data.dims) > 1 and value.ndim == len(data.dims) else value


def unchanging(name: str) -> tuple[str, ...]:
    """The axes of a capture over which a parameter of a material stays the same."""
    return ("view",) if name in SPECTRAL else ("wavelength", "view")
