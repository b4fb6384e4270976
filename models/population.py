"""Pooling: a parameter of many patches drawn from one population (the paper's section 2).

The population is normal on the natural scale of the parameter: log for what is positive, log odds
for a share, the plain scale for an index, cut to its physical range. Its `location` is the median
in the parameter's own unit (before the cut), its `spread` the standard deviation on that scale.
"""

import abc
import dataclasses
import math
from collections.abc import Mapping
from typing import override

import jax
import jax.numpy as jnp
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist
from polar_bayes.models.axes import drop_view, over_axes
from polar_bayes.models.truncation import onto_interval

from polar_bayes.errors import FitError
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.priors import RANGES, support_bounds


@dataclasses.dataclass(frozen=True)
class AbstractScale(abc.ABC):
    """The scale on which a population is normal."""

    @abc.abstractmethod
    def center(self, location: Array) -> Array:
        """The population's mean on this scale."""

    @abc.abstractmethod
    def value(self, base: Array, location: Array, spread: Array) -> Array:
        """A member of the population in the parameter's unit, from its place on this scale."""


@dataclasses.dataclass(frozen=True)
class LogScale(AbstractScale):
    """For positive parameters: roughness, absorption."""

    @override
    def center(self, location: Array) -> Array:
        return jnp.log(location)

    @override
    def value(self, base: Array, location: Array, spread: Array) -> Array:
        return jnp.exp(base)


@dataclasses.dataclass(frozen=True)
class LogitScale(AbstractScale):
    """For shares: the subsurface fraction."""

    @override
    def center(self, location: Array) -> Array:
        return jnp.log(location) - jnp.log1p(-location)

    @override
    def value(self, base: Array, location: Array, spread: Array) -> Array:
        return jax.nn.sigmoid(base)


@dataclasses.dataclass(frozen=True)
class CutScale(AbstractScale):
    """The plain scale between bounds: the refractive index.

    Args:
        low: Lower bound, or -inf.
        high: Upper bound, or inf.
    """

    low: float
    high: float

    @override
    def center(self, location: Array) -> Array:
        return location

    @override
    def value(self, base: Array, location: Array, spread: Array) -> Array:
        if math.isinf(self.low) and math.isinf(self.high):
            return base
        return onto_interval(base, location, spread, self.low, self.high)


def natural_scale(name: str, location: dist.Distribution) -> AbstractScale:
    """The scale of a parameter, by its physical range.

    Args:
        name: The parameter.
        location: The prior of its population's location; its bounds cut an index.

    Returns:
        The scale.

    Raises:
        Nothing.
    """
    limits = RANGES.get(name, (-math.inf, math.inf))
    if limits == (0.0, math.inf):
        return LogScale()
    if limits == (0.0, 1.0):
        return LogitScale()
    return CutScale(*support_bounds(location))


def draw_pooled(
    name: str,
    data: Observations,
    priors: Mapping[str, dist.Distribution],
    *,
    without: tuple[str, ...],
) -> Float[Array, "..."]:
    r"""Sample one parameter of every patch from a common population.

    $$ g(x_m) \sim Normal(g(\text{location}), \text{spread}) $$

    Over wavelengths, each has its own location; they share the spread.

    Args:
        name: The parameter.
        data: The capture; its leading axes are what is pooled over.
        priors: Priors of `<name>_location` and `<name>_spread`.
        without: Axes over which the parameter does not change.

    Returns:
        The parameter, (patch[, wavelength]), in its own unit.

    Raises:
        FitError: A prior is missing.

    Source:
        The paper, section 2 (hierarchical extension).
    """
    leading = tuple(axis for axis, _ in data.dims if axis not in ("wavelength", "view"))
    with over_axes(data, without=(*leading, *without)):
        location = numpyro.sample(f"{name}_location", priors[f"{name}_location"])
    spread = numpyro.sample(f"{name}_spread", priors[f"{name}_spread"])
    scale = natural_scale(name, priors[f"{name}_location"])
    with over_axes(data, without=without):
        # The place on the normal scale is a coordinate; the parameter is what it stands for.
        base = numpyro.sample(
            f"{name}_base", dist.Normal(scale.center(location), spread), infer={"auxiliary": True}
        )
        value = numpyro.deterministic(name, scale.value(base, location, spread))
    return drop_view(value, data)


def check_pooled(pooled: object, *, where: str) -> None:
    """Refuse a choice of pooled parameters that is no tuple of parameters of a material."""
    if not isinstance(pooled, tuple) or not all(isinstance(name, str) for name in pooled):
        raise FitError(
            f"pooled={pooled!r} is no tuple of names",
            where=where,
            mend="write pooled=('refractive_index',), with the comma",
        )
    for name in pooled:
        if name not in MATERIAL_PARAMETERS:
            raise FitError(
                f"{name!r} is no parameter of a material",
                where=f"{where}: pooled",
                mend=f"name any of {', '.join(MATERIAL_PARAMETERS)}",
            )


def check_members(pooled: tuple[str, ...], data: Observations, scene: Scene) -> None:
    """Refuse to pool what the scene does not read, or a capture with a single member."""
    possible = [name for name in MATERIAL_PARAMETERS if name in scene.parameters]
    missing = [name for name in pooled if name not in possible]
    if missing:
        raise FitError(
            f"the scene does not read {', '.join(missing)}",
            where="pooled",
            mend=f"pool any of {', '.join(possible)}",
        )
    if pooled and not any(axis not in ("wavelength", "view") for axis, _ in data.dims):
        raise FitError(
            "a population needs several members, and the capture has no axis patch or material",
            where="model",
            mend="give captures joined by polar_bayes.combine, or use model='per_material'",
        )
