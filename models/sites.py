"""Sample sites that all models share: plates, bounded coordinates, and the likelihood."""

import contextlib
import math
from collections.abc import Iterator, Mapping
from typing import override

import jax
import jax.numpy as jnp
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro.distributions import constraints
from numpyro.distributions.transforms import Transform

from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink, noise_parameters
from polar_bayes.physics.part import UNPOLARIZED, at_least
from polar_bayes.physics.scene import MATERIAL_PARAMETERS, Scene
from polar_bayes.physics.stokes import Light
from polar_bayes.priors import CONTRAST, Metered

Priors = Mapping[str, dist.Distribution]
Links = Mapping[str, AbstractLink]

SPECTRAL = ("absorption", "refractive_index")
"""Parameters with one value per wavelength."""


@contextlib.contextmanager
def over_axes(data: Observations, *, without: tuple[str, ...] = ()) -> Iterator[None]:
    """Enter plates over every axis of the capture except those named."""
    with contextlib.ExitStack() as stack:
        for position, (name, length) in enumerate(data.dims):
            if name not in without:
                stack.enter_context(numpyro.plate(name, length, dim=position - len(data.dims)))
        yield


def material_parameters(scene: Scene) -> tuple[str, ...]:
    """Return the material parameters that a scene reads; no others are sampled."""
    return tuple(name for name in MATERIAL_PARAMETERS if name in scene.parameters)


def draw_independent(name: str, data: Observations, priors: Priors) -> Float[Array, "..."]:
    """Sample a parameter of the material independently for each patch, or wavelength."""
    with over_axes(data, without=constant_axes(name)):
        return draw(name, priors[name], data)


def draw(name: str, prior: dist.Distribution, data: Observations) -> Float[Array, "..."]:
    """Sample a parameter inside `over_axes(data, without=("view", ...))`; drops the view axis."""
    return drop_view(_sample(name, prior), data)


def _sample(name: str, prior: dist.Distribution) -> Array:
    """Sample a parameter, marked if readings determine only a sum that contains it."""
    return numpyro.sample(name, prior, infer={"summed": name in UNPOLARIZED})


def drop_view(value: Float[Array, "..."], data: Observations) -> Float[Array, "..."]:
    """Remove the view axis of length 1 that plates added."""
    return value[..., 0] if len(data.dims) > 1 and value.ndim == len(data.dims) else value


def constant_axes(name: str) -> tuple[str, ...]:
    """Return the axes of a capture along which a material parameter is constant."""
    return ("view",) if name in SPECTRAL else ("wavelength", "view")


# --- An unbounded coordinate of a bounded parameter -----------------------------------------------


HINGES = 80.0
"""Ratio of the width of the interval to that of the bend at a bound."""


class SoftClip(Transform):
    r"""Transform that is the identity inside an interval and bends at its ends.

    $$ y = l + s \log\frac{1 + e^{(x-l)/s}}{1 + e^{(x-h)/s}}, \qquad s = (h-l)/80 $$

    Away from the ends y = x, so a normal density stays normal. NumPyro's own transform onto an
    interval is nonlinear everywhere.

    Args:
        low: l, finite.
        high: h, or inf.
    """

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high

    @property
    def scale(self) -> float:
        """Scale s of the bend, in the unit of the parameter."""
        return (self.high - self.low) / HINGES if math.isfinite(self.high) else 1.0 / HINGES

    @property
    @override
    def domain(self) -> constraints.Constraint:
        return constraints.real

    @property
    @override
    def codomain(self) -> constraints.Constraint:
        return constraints.interval(self.low, self.high)

    @override
    def __call__(self, x: Array) -> Array:
        above = self.low + self.scale * jax.nn.softplus((x - self.low) / self.scale)
        if math.isinf(self.high):
            return above
        bent = above - self.scale * jax.nn.softplus((x - self.high) / self.scale)
        return jnp.clip(bent, self.low, self.high)  # a rounding error may lie outside

    @override
    def _inverse(self, y: Array) -> Array:
        # The nearest number inside: at a bound itself the coordinate is infinite.
        least = jnp.finfo(y.dtype).eps
        above = jnp.maximum((y - self.low) / self.scale, least)
        x = self.low + self.scale * (above + jnp.log(-jnp.expm1(-above)))
        if math.isinf(self.high):
            return x
        below = jnp.maximum((self.high - y) / self.scale, least)
        return x - self.scale * jnp.log(-jnp.expm1(-below))

    @override
    def log_abs_det_jacobian(self, x: Array, y: Array, intermediates: object = None) -> Array:
        slope = jax.nn.log_sigmoid((x - self.low) / self.scale)
        if math.isinf(self.high):
            return slope
        constant = math.log1p(-math.exp(-HINGES))
        return slope + jax.nn.log_sigmoid((self.high - x) / self.scale) + constant

    @override
    def tree_flatten(self) -> tuple[tuple, tuple]:
        return (), ((), {"low": self.low, "high": self.high})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SoftClip) and (self.low, self.high) == (other.low, other.high)

    def __hash__(self) -> int:
        return hash((self.low, self.high))


# --- Readings -------------------------------------------------------------------------------------


def declare_readings(
    parameters: Mapping[str, Array], data: Observations, scene: Scene, priors: Priors, links: Links
) -> None:
    """Declare instrument, noise, and the likelihood of the readings around eq. 1."""
    # The instrument and the noise: one value for the whole capture, shared by all its patches.
    rest = [name for name in scene.parameters if name not in parameters]
    instrument = {name: _sample(name, priors[name]) for name in rest}
    parameters = {**parameters, **instrument}
    if scene.dispersion is not None and data.geometry.wavelength is not None:
        # The coefficients of the law are sampled; the index is deterministic.
        wavelength = data.geometry.wavelength[..., 0]
        with over_axes(data, without=("view",)):
            index = scene.dispersion.index(parameters, wavelength)
            numpyro.deterministic("refractive_index", index[..., None])

    # Readings without noise (eq. 1), and the likelihood.
    light = scene.arriving(parameters, data.geometry)
    noise = {name: _draw_noise(name, priors, light, data) for name in noise_parameters(links)}
    prediction = scene.record(parameters | noise, data.geometry, light)
    with over_axes(data):
        for name, link in links.items():
            numpyro.deterministic(f"{name}_mean", link.center(name, prediction, noise))
            likelihood = link.distribution(name, prediction, data, noise).mask(data.fitted(name))
            numpyro.sample(name, likelihood, obs=link.reading(data.readings[name]))


def _draw_noise(name: str, priors: Priors, light: Light, data: Observations) -> Array:
    """Sample a parameter of the noise, or the share from which an exposure follows."""
    if not isinstance(priors[name], Metered):
        return numpyro.sample(name, priors[name])
    share = numpyro.sample(f"{name}_share", priors[f"{name}_share"])
    return numpyro.deterministic(name, share * jnp.exp(-_log_average(light, data)))


def _log_average(light: Light, data: Observations) -> Array:
    """Return the mean log intensity of the measured views, black ones included."""
    metered = data.valid & data.is_measured
    seen = jnp.broadcast_to(light.intensity, data.shape)
    dark = jnp.max(seen, where=metered, initial=0.0) / CONTRAST
    logs = jnp.log(at_least(seen + dark, float(jnp.finfo(seen.dtype).tiny)))
    return jnp.sum(logs, where=metered) / jnp.maximum(jnp.sum(metered), 1)
