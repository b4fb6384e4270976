r"""Phase functions of bodies, and the brightness of a half space without polarization.

The brightness is the radiance inside over that of a white diffuser,

$$ r(l, v) + \frac{F_i\, r_0(l, t)\, r_0(t, v)}{1 - F_i\, r_0(t, t)}, \qquad
   r_0(l, v) = \frac{w}{4} \frac{H_l H_v}{\mu_l + \mu_v}, \qquad w = \frac{1}{1 + a} $$

with r = r_0 for isotropic scattering. The interface turns back F_i = 1 - escape of diffuse light:
all beyond the critical angle, whose cosine is $\mu_c$, and some of the rest. It enters again at
one cosine, its mean,

$$ \mu_t = \frac{2}{3} [1 - (1 - \mu_c) \mu_c^2 / F_i], \qquad \mu_c^2 = 1 - 1/n^2 $$

The absorption is $a = \mu_a/\mu_s'$ over *reduced* scattering $\mu_s' = (1 - g) \mu_s$, which
diffuse light has in common whatever the anisotropy g (similarity).

Source:
    Chandrasekhar 1960, Radiative transfer, sections 46 and 47.
"""

import abc
import dataclasses
import functools
import importlib.resources
import io
from collections.abc import Sequence
from typing import Annotated, ClassVar, NamedTuple, override

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from polar_bayes.physics.geometry import cos_degrees
from polar_bayes.physics.half_space import CLEAREST, GRAZING, Ray, critical_cosine_squared
from polar_bayes.physics.illumination import FOUR_TURNS, Turns
from polar_bayes.physics.part import (
    Parameters,
    Part,
    Range,
    Setting,
    at_least,
    like,
    quotient,
    value_of,
)

MOST_ANISOTROPY = 0.9

# Of the table of multiple scattering: orders in azimuth, and polynomials of each variable.
ORDERS, DEGREES = 3, 5

# Azimuths whose mean is that of all, at the directions of light that is turned back. Unit degree.
AZIMUTHS = (22.5, 67.5, 112.5, 157.5)


def _forward_turns(count: int, narrowed: float) -> Turns:
    """Azimuths from the viewer's, denser near the mirror side, and their weights."""
    # Equal steps of an angle t where tan(turn/2) = narrowed tan(t/2), turn from the mirror side.
    t = (np.arange(count) + 0.5) * np.pi / count - 0.5 * np.pi
    share = narrowed / (np.cos(t) ** 2 + (narrowed * np.sin(t)) ** 2) / count
    turn = np.degrees(2.0 * np.arctan(narrowed * np.tan(t)))
    return tuple((180.0 + float(a), float(b)) for a, b in zip(turn, share, strict=True))


@dataclasses.dataclass(frozen=True)
class AbstractPhaseFunction(Part):
    """The directions into which a body scatters light once.

    Args:
        turns: Azimuths whose mean is that of all where light comes from all around, and shares.
    """

    turns: ClassVar[Turns] = FOUR_TURNS

    @abc.abstractmethod
    def reflectance(
        self, parameters: Parameters, light: Ray, view: Ray, azimuth: Array, escape: Array
    ) -> Array:
        """Radiance inside of a half space, over that of a white diffuser.

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
    """Isotropic scattering: equal in all directions."""

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
    r"""Henyey-Greenstein scattering, mostly forward, as by particles that are not small.

    $$ p = \frac{1 - g^2}{(1 + g^2 - 2 g \cos\Theta)^{3/2}} $$

    The first order of scattering is exact. Higher ones follow those of isotropic scattering with
    the same a,

    $$ r = \frac{w}{4 (\mu_l + \mu_v)} [p + (H_l H_v - 1) \exp \sum_{m=0}^{2}
       (g^2 \sin\theta_l \sin\theta_v)^m P_m \cos m\varphi],
       \qquad w = \frac{1}{1 + (1 - g)\, a} $$

    with $\varphi$ from the plane of the mirror side. The $P_m$ are sums of Chebyshev
    polynomials of g, of $\sqrt{a/(1 + a)}$ and of the roots of both cosines, fitted to the solution
    of the half space (`benchmarks/henyey_greenstein.py`). $r_0$ is the mean of r over azimuth.

    Args:
        anisotropy: g, the mean cosine of the angle by which light turns, 1, 0 to 0.9; a name fits
            it.

    Raises:
        SceneError: It is neither such a number nor a name.

    Source:
        Henyey & Greenstein 1941, Astrophys. J. 93, 70; Chandrasekhar 1960, Radiative transfer,
        section 29 (the equation of the half space).
    """

    anisotropy: Annotated[Setting, Range(0.0, MOST_ANISOTROPY)] = 0.8

    turns: ClassVar[Turns] = _forward_turns(12, 0.35)

    @override
    def simpler(self) -> tuple[Part | None, ...]:
        return (Isotropic(),)

    @override
    def reflectance(
        self, parameters: Parameters, light: Ray, view: Ray, azimuth: Array, escape: Array
    ) -> Array:
        a = at_least(parameters["absorption"], CLEAREST)
        g = value_of(self.anisotropy, parameters)
        w, gamma = 1.0 / (1.0 + (1.0 - g) * a), jnp.sqrt(a / (1.0 + a))
        of_orders = _of_orders(g, gamma)
        trapped, turned = 1.0 - escape, _mean_cosine(parameters["refractive_index"], escape)
        incident, leaving, back = (
            _direction(jnp.maximum(ray.cosine, GRAZING), ray.sine, gamma)
            for ray in (light, view, Ray(turned, jnp.sqrt(1.0 - turned**2)))
        )

        def mean(one: _Direction, other: _Direction, azimuths: Sequence[ArrayLike]) -> Array:
            """Return the mean of r over azimuths from the mirror side."""
            sines = one.sine * other.sine
            pair = one.basis[..., :, None] * other.basis[..., None, :]
            orders = [
                jnp.sum(each * pair, axis=(-2, -1)) * (g**2 * sines) ** order
                for order, each in enumerate(of_orders)
            ]
            scattered = []
            for azimuth in azimuths:
                around = [cos_degrees(like(azimuth, g) * order) for order in range(ORDERS)]
                turn = sines * around[1] - one.cosine * other.cosine  # cos(Theta)
                once = (1.0 - g**2) * (1.0 + g * (g - 2.0 * turn)) ** -1.5
                exponent = sum(p * cosine for p, cosine in zip(orders, around, strict=True))
                scattered.append(once + (one.h * other.h - 1.0) * jnp.exp(exponent))
            radiance = 0.25 * w * sum(scattered) / len(scattered)
            return quotient(radiance, one.cosine + other.cosine)

        again = trapped * mean(incident, back, AZIMUTHS) * mean(back, leaving, AZIMUTHS)
        again = again / (1.0 - trapped * mean(back, back, AZIMUTHS))
        return mean(incident, leaving, [180.0 - azimuth]) + again


# --- H functions and what follows from them -------------------------------------------------------


class _Direction(NamedTuple):
    """A direction inside the body, with H and polynomials of its cosine on a last axis."""

    cosine: Array
    sine: Array
    h: Array
    basis: Array


def _direction(cosine: Array, sine: Array, gamma: Array) -> _Direction:
    above, below = _isotropic_h(cosine, gamma)
    return _Direction(cosine, sine, above / below, _chebyshev(jnp.sqrt(cosine)))


@functools.cache
def _table() -> np.ndarray:
    """Coefficients of P_m, (order, g, gamma, cosine, cosine)."""
    file = importlib.resources.files("polar_bayes.physics") / "henyey_greenstein.csv"
    values = np.loadtxt(io.StringIO(file.read_text()), delimiter=",")
    return values.reshape(ORDERS, *(4 * (DEGREES,)))


def _of_orders(g: Array, gamma: Array) -> list[Array]:
    """Coefficients of the polynomials of both cosines, of each P_m, on two last axes."""
    share = g / MOST_ANISOTROPY
    of_g, of_gamma = _chebyshev(share), _chebyshev(gamma)
    # That of order 0 vanishes with g, where scattering is isotropic.
    of_order = (of_g * share[..., None], *((ORDERS - 1) * (of_g,)))
    return [
        jnp.einsum("...g,...s,gsij->...ij", each, of_gamma, like(table, g), precision="highest")
        for each, table in zip(of_order, _table(), strict=True)
    ]


def _chebyshev(share: Array) -> Array:
    """Chebyshev polynomials of a number from 0 to 1, on a last axis."""
    x = 2.0 * share - 1.0
    terms = [jnp.ones_like(x), x]
    while len(terms) < DEGREES:
        terms.append(2.0 * x * terms[-1] - terms[-2])
    return jnp.stack(terms, axis=-1)


def _mean_cosine(refractive_index: Array, escape: Array) -> Array:
    """Mean cosine of light that the interface reflects back."""
    critical = critical_cosine_squared(refractive_index)
    beyond = critical / jnp.maximum(1.0 - escape, critical)
    return 2.0 / 3.0 * (1.0 - (1.0 - jnp.sqrt(critical)) * beyond)


def _isotropic_h(cosine: Array, g: Array) -> tuple[Array, Array]:
    """Numerator and denominator of H of isotropic scattering."""
    # A fit to H by iteration on 200 nodes, within .25 % of H and of the plane albedo 1 - g H, for g
    # up to .99 and cosines from .003. Exact for a black body (g = 1) and at grazing: H = 1.
    level = 1.9613 + g * (0.4670 - 0.1275 * g)
    rise, bend, off = -0.1313 - 0.0334 * g, 0.0743 + 0.0473 * g, cosine + 0.04
    q = cosine * (off * (level + rise * cosine) + bend)
    return off + q, off + g * q
