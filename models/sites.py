"""Plates for the axes of a capture, so that a model file can read like the paper."""

import contextlib
import math
from collections.abc import Iterator, Mapping
from typing import Any, override

import jax
import jax.numpy as jnp
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro.distributions import constraints
from numpyro.distributions.transforms import Transform

from polar_bayes.observation.data import Observations
from polar_bayes.observation.links import AbstractLink, noise_parameters
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


# --- A coordinate without bounds for a parameter that has some ------------------------------------


BEND = 80.0
"""The bend at a bound is this many times narrower than the interval."""


class Bent(Transform):
    r"""The identity inside an interval, bent at its ends.

    $$ y = l + s \log\frac{1 + e^{(x-l)/s}}{1 + e^{(x-h)/s}}, \qquad s = (h-l)/80 $$

    Away from the ends y = x, so what is normal stays normal, and what readings know of y they know
    of x. NumPyro's own map onto an interval bends everywhere.

    Args:
        low: l, finite.
        high: h, or inf.
    """

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high

    @property
    def scale(self) -> float:
        """s, in the unit of the parameter."""
        return (self.high - self.low) / BEND if math.isfinite(self.high) else 1.0 / BEND

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
    def log_abs_det_jacobian(self, x: Array, y: Array, intermediates: Any = None) -> Array:
        slope = jax.nn.log_sigmoid((x - self.low) / self.scale)
        if math.isinf(self.high):
            return slope
        constant = math.log1p(-math.exp(-BEND))
        return slope + jax.nn.log_sigmoid((self.high - x) / self.scale) + constant

    @override
    def tree_flatten(self) -> tuple[tuple, tuple]:
        return (), ((), {"low": self.low, "high": self.high})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Bent) and (self.low, self.high) == (other.low, other.high)

    def __hash__(self) -> int:
        return hash((self.low, self.high))


# --- The second half of every model: from the parameters of a material to the readings ------------


def declare_readings(
    parameters: Mapping[str, Array],
    data: Observations,
    scene: Scene,
    priors: Mapping[str, dist.Distribution],
    links: Mapping[str, AbstractLink],
) -> None:
    """Declare the instrument, the noise, and how the readings scatter around eq. 1."""
    # The instrument and the noise: one value for the whole capture, shared by all its patches.
    instrument = {
        name: numpyro.sample(name, priors[name])
        for name in scene.parameters
        if name not in parameters
    }
    noise = {name: numpyro.sample(name, priors[name]) for name in noise_parameters(links)}

    parameters = {**parameters, **instrument}
    if scene.dispersion is not None and data.geometry.wavelength is not None:
        # The law's coefficients are what is sampled; the index is what is asked for.
        wavelength = data.geometry.wavelength[..., 0]
        with over_axes(data, without=("view",)):
            index = scene.dispersion.index(parameters, wavelength)
            numpyro.deterministic("refractive_index", index[..., None])

    # What would be recorded without noise (eq. 1), and how the readings scatter around it.
    prediction = scene.predict(parameters, data.geometry)
    with over_axes(data):
        for name, link in links.items():
            numpyro.deterministic(f"{name}_mean", link.center(name, prediction, noise))
            likelihood = link.distribution(name, prediction, data, noise).mask(data.valid)
            numpyro.sample(name, likelihood, obs=link.reading(data.readings[name]))
