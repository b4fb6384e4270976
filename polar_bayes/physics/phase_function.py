r"""How a body scatters, and how bright a half space of it is: closed forms, without polarization.

The brightness is the radiance inside over that of a white diffuser,

$$ r(l, v) + \frac{F_i\, r_0(l, t)\, r_0(t, v)}{1 - F_i\, r_0(t, t)}, \qquad
   r_0(l, v) = \frac{w}{4} \frac{H_l H_v}{\mu_l + \mu_v}, \qquad w = \frac{1}{1 + a} $$

with r = r_0 for isotropic scattering. The interface turns back F_i = 1 - escape of diffuse light:
all beyond the critical angle, whose cosine is $\mu_c$, and some of the rest. It enters again at
one cosine, its mean,

$$ \mu_t = \frac{2}{3} [1 - (1 - \mu_c) \mu_c^2 / F_i], \qquad \mu_c^2 = 1 - 1/n^2 $$

The absorption a is relative to *reduced* scattering, (1 - g) times scattering, which diffuse light
has in common whatever the anisotropy g (similarity).

Source:
    Chandrasekhar 1960, Radiative transfer, sections 46 and 47.
"""

import abc
import dataclasses
import math
from typing import Annotated, NamedTuple, override

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.geometry import cos_degrees
from polar_bayes.physics.half_space import CLEAREST, GRAZING, Ray, critical_cosine_squared
from polar_bayes.physics.part import (
    Parameters,
    Part,
    Range,
    Setting,
    at_least,
    quotient,
    value_of,
)

# Mean cosine of diffuse light.
MEAN_COSINE = 2.0 / 3.0

# Cosines of azimuths whose mean is that of a phase function at steep directions.
AZIMUTHS = tuple(math.cos(math.pi * (k + 0.5) / 4) for k in range(4))


@dataclasses.dataclass(frozen=True)
class AbstractPhaseFunction(Part):
    """The directions into which a body scatters light once."""

    @abc.abstractmethod
    def reflectance(
        self, parameters: Parameters, light: Ray, view: Ray, azimuth: Array, escape: Array
    ) -> Array:
        """Radiance inside, over that of a white diffuser, of a half space that scatters so.

        Args:
            parameters: `absorption`, `refractive_index` and those of this part; they broadcast
                with the rays.
            light: Direction from which light comes, in the body. Any shape.
            view: Direction into which it leaves, in the body. Broadcasts.
            azimuth: Between both directions; 180 is the mirror side. Broadcasts, degree.
            escape: Share of diffuse light that the interface lets out. Broadcasts, 1, 0 to 1.

        Returns:
            Broadcast shape, 1, > 0.
        """


@dataclasses.dataclass(frozen=True)
class Isotropic(AbstractPhaseFunction):
    """Light is scattered into all directions alike."""

    @override
    def reflectance(
        self, parameters: Parameters, light: Ray, view: Ray, azimuth: Array, escape: Array
    ) -> Array:
        absorption = at_least(parameters["absorption"], CLEAREST)
        w, g = 1.0 / (1.0 + absorption), jnp.sqrt(absorption / (1.0 + absorption))
        cos_light, cos_view = (jnp.maximum(ray.cosine, GRAZING) for ray in (light, view))
        trapped, turned = 1.0 - escape, _mean_cosine(parameters["refractive_index"], escape)
        above_t, below_t = _isotropic_h(turned, g)
        again = 0.25 * w * (above_t / below_t) ** 2 * trapped
        again = again / (1.0 - 0.5 * again / turned)
        # Spread over the views once, so that their uses sum derivatives over the views in one loop.
        cos_light, cos_view, w, g, turned, again = jnp.broadcast_arrays(
            cos_light, cos_view, w, g, turned, again
        )
        (above_l, below_l), (above_v, below_v) = (_isotropic_h(x, g) for x in (cos_light, cos_view))
        three = (cos_light + turned) * (turned + cos_view)
        above = 0.25 * w * above_l * above_v * (three + again * (cos_light + cos_view))
        return quotient(above, below_l * below_v * three * (cos_light + cos_view))


@dataclasses.dataclass(frozen=True)
class HenyeyGreenstein(AbstractPhaseFunction):
    r"""Light is scattered forwards for the most part, as by particles that are not small.

    $$ p = \frac{1 - g^2}{(1 + g^2 - 2 g \cos\Theta)^{3/2}} $$

    The first order of scattering is exact. For higher ones a share $g^2$, the forward peak, counts
    as not scattered, and the rest follows $1 + x \cos\Theta$, whose H functions are known:

    $$ r = \frac{w}{4 (\mu_l + \mu_v)} (A + B + C), \qquad w = \frac{1 + g}{1 + g + a} $$

    $$ A = H_l H_v [1 - c (\mu_l + \mu_v) - y \mu_l \mu_v] - 1, \qquad
       B = x [(\cos\Theta + \mu_l \mu_v) K_l K_v - \cos\Theta] $$

    $$ C = (1 + g^2 - 2 g \cos\Theta)^{-3/2}, \qquad
       c = \frac{w y \alpha_1}{2 \gamma + w y \alpha_2} $$

    $$ x = \frac{3 g}{1 + g}, \qquad y = x (1 - w), \qquad
       \gamma = \frac{\sqrt{a (1 + a)}}{1 + g + a} $$

    H and its moments $\alpha_1, \alpha_2$ belong to the characteristic function
    $(w/2) (1 + y \mu^2)$, K to $(w x/4) (1 - \mu^2)$; $r_0$ is the mean of r over azimuth.

    Args:
        anisotropy: g, the mean cosine of the angle by which light turns, 1, 0 to 0.9; a name fits
            it.

    Raises:
        SceneError: It is neither such a number nor a name.

    Source:
        Henyey & Greenstein 1941, Astrophys. J. 93, 70; Joseph, Wiscombe & Weinman 1976, J. Atmos.
        Sci. 33, 2452 (the forward peak); Nakajima & Tanaka 1988, J. Quant. Spectrosc. Radiat.
        Transfer 40, 51 (the first order).
    """

    anisotropy: Annotated[Setting, Range(0.0, 0.9)] = 0.8

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (Isotropic(),)

    @override
    def reflectance(
        self, parameters: Parameters, light: Ray, view: Ray, azimuth: Array, escape: Array
    ) -> Array:
        a = at_least(parameters["absorption"], CLEAREST)
        g = value_of(self.anisotropy, parameters)
        w, x = (1.0 + g) / (1.0 + g + a), 3.0 * g / (1.0 + g)
        y, gamma = x * a / (1.0 + g + a), jnp.sqrt(a * (1.0 + a)) / (1.0 + g + a)
        first, second = (
            level * (1.0 + gamma * (b + gamma * (c + gamma * d))) for level, b, c, d in MOMENTS
        )
        c = w * y * first / (2.0 * gamma + w * y * second)
        trapped, turned = 1.0 - escape, _mean_cosine(parameters["refractive_index"], escape)
        cos_light, cos_view = (jnp.maximum(ray.cosine, GRAZING) for ray in (light, view))
        incident, leaving, back = (
            _Direction(cosine, sine, _linear_h(cosine, gamma, y))
            for cosine, sine in (
                (cos_light, light.sine),
                (cos_view, view.sine),
                (turned, jnp.sqrt(1.0 - turned**2)),
            )
        )

        def peak(one: _Direction, other: _Direction, around: Array | float) -> Array:
            cosine = one.cosine * other.cosine + one.sine * other.sine * around  # -cos(Theta)
            return (1.0 + g * (g + 2.0 * cosine)) ** -1.5

        def reflectance(one: _Direction, other: _Direction, of_azimuth: Array) -> Array:
            product, total = one.cosine * other.cosine, one.cosine + other.cosine
            of_both = one.h * other.h * (1.0 - c * total - y * product) - 1.0 + x * product
            return quotient(0.25 * w * (of_both + of_azimuth), total)

        def mean(one: _Direction, other: _Direction) -> Array:
            peaks = jnp.stack([peak(one, other, node) for node in AZIMUTHS])
            return reflectance(one, other, jnp.mean(peaks, axis=0))

        around = cos_degrees(azimuth)
        k = _once_around(cos_light, 0.25 * w * x) * _once_around(cos_view, 0.25 * w * x)
        once_around = x * light.sine * view.sine * around * (1.0 - k)
        direct = reflectance(incident, leaving, once_around + peak(incident, leaving, around))
        again = trapped * mean(incident, back) * mean(back, leaving)
        return direct + again / (1.0 - trapped * mean(back, back))


# --- H functions and what follows from them -------------------------------------------------------


class _Direction(NamedTuple):
    """A direction inside the body, and H there."""

    cosine: Array
    sine: Array
    h: Array


def _mean_cosine(refractive_index: Array, escape: Array) -> Array:
    """Of light that the interface turns back."""
    critical = critical_cosine_squared(refractive_index)
    beyond = critical / jnp.maximum(1.0 - escape, critical)
    return MEAN_COSINE * (1.0 - (1.0 - jnp.sqrt(critical)) * beyond)


def _isotropic_h(cosine: Array, g: Array) -> tuple[Array, Array]:
    """Numerator and denominator of H."""
    # A fit to H by iteration on 200 nodes, within .25 % of H and of the plane albedo 1 - g H, for g
    # up to .99 and cosines from .003. Exact for a black body (g = 1) and at grazing: H = 1.
    (level, rise, bend), off = _coefficients(g), cosine + 0.04
    q = cosine * (off * (level + rise * cosine) + bend)
    return off + q, off + g * q


def _coefficients(g: Array) -> tuple[Array, Array, Array]:
    """Of q/mu = level + rise mu + bend/(mu + .04)."""
    return 1.9613 + g * (0.4670 - 0.1275 * g), -0.1313 - 0.0334 * g, 0.0743 + 0.0473 * g


def _linear_h(cosine: Array, g: Array, y: Array) -> Array:
    """H of the characteristic function (w/2) (1 + y mu^2); for y = 0 that of `_isotropic_h`."""
    # Fitted likewise, within .4 %, with g = (1 - 2 int of it)^(1/2), for y up to 1.5.
    level, rise, bend = _coefficients(g)
    level = level + y * (-0.2773 - 0.0780 * g + 0.0775 * y)
    rise = rise + y * (-0.0032 + 0.0171 * g + 0.0087 * y)
    bend = bend + y * (-0.0209 - 0.0148 * g + 0.0074 * y)
    q = cosine * (level + rise * cosine + bend / (cosine + 0.04))
    return (1.0 + q) / (1.0 + g * q)


# Of alpha_1 and alpha_2, the integrals of mu H and mu^2 H: value at gamma = 0, and the coefficients
# of its powers over that; fitted within 2 % for y up to 1.5.
MOMENTS = ((1.14, -1.16, 0.91, -0.32), (0.81, -1.23, 0.99, -0.35))


def _once_around(cosine: Array, strength: Array) -> Array:
    """H of the characteristic function strength (1 - mu^2), within .4 % up to 3/8."""
    level = 0.4457 + 0.1121 * cosine + strength * (0.1750 + 0.1092 * cosine)
    return 1.0 / (1.0 - strength * cosine * level / (cosine + 0.1299))
