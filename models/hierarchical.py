"""Hierarchical model of many patches or materials: partial pooling (the paper's section 2).

Each pooled parameter of a patch is drawn from a population whose location and spread are inferred
with it. A spread near zero pools completely, a large one not at all; the data decide.

The population is normal on the natural scale of the parameter: log for what is positive, log odds
for a share, the plain scale for an index, truncated to its physical range. Its `location` is the
median in the parameter's own unit (before truncation), its `spread` the standard deviation on that
scale.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist

from polar_bayes.errors import FitError
from polar_bayes.models.sites import (
    Links,
    Priors,
    SoftClip,
    constant_axes,
    declare_readings,
    draw_independent,
    drop_view,
    material_parameters,
    over_axes,
)
from polar_bayes.observation.data import Observations
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.priors import natural_scale, support_bounds
from polar_bayes.repr_html import HTMLRepr


class Scale(NamedTuple):
    """A scale on which a population is normal."""

    population: Callable[[Array, Array], dist.Distribution]
    """Function from location and spread to the distribution of a member's coordinate."""
    value: Callable[[Array], Array]
    """Function from the coordinate of a member to the parameter in its own unit."""


def scale_of(name: str, location: dist.Distribution) -> Scale:
    """Return the natural scale of a parameter; an index is truncated where its prior ends."""
    natural = natural_scale(name)
    if natural == "log":
        return Scale(lambda center, spread: dist.Normal(jnp.log(center), spread), jnp.exp)
    if natural == "log odds":
        return Scale(
            lambda center, spread: dist.Normal(jnp.log(center) - jnp.log1p(-center), spread),
            jax.nn.sigmoid,
        )
    low, high = support_bounds(location)
    if math.isinf(low):
        return Scale(dist.Normal, lambda coordinate: coordinate)
    clip = SoftClip(low, high)

    def truncated(center: Array, spread: Array) -> dist.Distribution:
        most = None if math.isinf(high) else high
        cut = dist.TruncatedNormal(center, spread, low=low, high=most)
        return dist.TransformedDistribution(cut, clip.inv)

    return Scale(truncated, clip)


def draw_pooled(
    name: str, data: Observations, priors: Priors, *, without: tuple[str, ...]
) -> Float[Array, "..."]:
    r"""Sample one parameter of every patch from a common population.

    $$ g(x_m) \sim Normal(g(\text{location}), \text{spread}) $$

    Over wavelengths, each has its own location; they share the spread.

    Source:
        The paper, section 2 (hierarchical extension).
    """
    leading = tuple(axis for axis, _ in data.dims if axis not in ("wavelength", "view"))
    with over_axes(data, without=(*leading, *without)):
        location = numpyro.sample(f"{name}_location", priors[f"{name}_location"])
    spread = numpyro.sample(f"{name}_spread", priors[f"{name}_spread"])
    scale = scale_of(name, priors[f"{name}_location"])
    with over_axes(data, without=without):
        population = scale.population(location, spread)
        coordinate = numpyro.sample(f"{name}_base", population, infer={"auxiliary": True})
        value = numpyro.deterministic(name, scale.value(coordinate))
    return drop_view(value, data)


def check_pooled(pooled: object, *, where: str) -> None:
    """Refuse a choice of pooled parameters that is not a tuple of material parameters."""
    if not isinstance(pooled, tuple) or not all(isinstance(name, str) for name in pooled):
        hint = "write pooled=('refractive_index',), with the comma"
        raise FitError(f"pooled={pooled!r} is no tuple of names", where=where, hint=hint)
    for name in pooled:
        if name not in MATERIAL_PARAMETERS:
            what = f"{name!r} is no parameter of a material"
            hint = f"name any of {', '.join(MATERIAL_PARAMETERS)}"
            raise FitError(what, where=f"{where}: pooled", hint=hint)


def check_members(pooled: tuple[str, ...], data: Observations, scene: Scene) -> None:
    """Refuse to pool parameters that the scene lacks, or a capture with a single member."""
    possible = [name for name in MATERIAL_PARAMETERS if name in scene.parameters]
    missing = [name for name in pooled if name not in possible]
    if missing:
        hint = f"pool any of {', '.join(possible)}"
        raise FitError(f"the scene does not read {', '.join(missing)}", where="pooled", hint=hint)
    if pooled and not any(axis not in ("wavelength", "view") for axis, _ in data.dims):
        what = "a population needs several members, and the capture has no axis patch or material"
        hint = "give captures joined by polar_bayes.capture.combine, or use model='per_material'"
        raise FitError(what, where="model", hint=hint)


# --- The model ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Hierarchical(HTMLRepr):
    """Parameters of all patches drawn from common populations.

    Args:
        pooled: The parameters that have a population; the others are each patch's own.

    Raises:
        FitError: A name is no parameter of a material, or there is none.
    """

    pooled: tuple[str, ...] = ("refractive_index",)

    def __post_init__(self) -> None:
        check_pooled(self.pooled, where="Hierarchical")
        if not self.pooled:
            hint = "name a parameter, or use model='per_material'"
            raise FitError("nothing is pooled", where="Hierarchical", hint=hint)

    def __call__(self, data: Observations, scene: Scene, priors: Priors, links: Links) -> None:
        """Declare the generative model of a capture with a leading axis (patch or material)."""
        check_members(self.pooled, data, scene)
        parameters = {}
        for name in material_parameters(scene):
            if name in self.pooled:
                parameters[name] = draw_pooled(name, data, priors, without=constant_axes(name))
            else:
                parameters[name] = draw_independent(name, data, priors)

        declare_readings(parameters, data, scene, priors, links)
