"""Layers between air and the body on one facet: bare, or under coats and films.

A coat describes itself by layers (`polar_bayes.physics.coat`); this file stacks them. Thick layers
add powers, thin ones add fields. Without layers it is one Fresnel boundary and nothing else.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from polar_bayes.physics import boundary
from polar_bayes.physics.boundary import EVANESCENT, Diattenuation, Film, Medium
from polar_bayes.physics.geometry import per_ray, resolved_cosine
from polar_bayes.physics.part import like, squared_rule, unit_rule

# Shares and weights for the integral of a bare body's reflectance over the hemisphere.
BARE_SHARES, BARE_WEIGHTS = unit_rule(24)

# Cosines and weights of that integral for layers: Gauss-Legendre nodes in the square root of the
# cosine, because reflection gathers at grazing.
HEMISPHERE_RULE = squared_rule(24)

# More of them where films make fringes over the angle: the integral is then right to 2e-4 up to a
# thickness of 1e4 nm, where 24 nodes were off by 5 %, to 2e-3 at 2e4 nm and to 2 % at 1e5 nm.
FRINGE_RULE = squared_rule(96)

# Squared sines of inner angles that reach a coat but not the air, crowded towards grazing.
_FROM_END, TRAPPED_WEIGHT = squared_rule(24)
TRAPPED_SHARE = 1.0 - _FROM_END


class Layer(NamedTuple):
    """One layer on the body; its arrays broadcast with (..., view).

    Args:
        refractive_index: Refractive index, 1, >= 1.
        absorbance: Minus the log of what passes at normal incidence; None for a clear layer.
        wavenumber: 4 pi thickness/wavelength for a film thin enough for interference, so that
            the phase of a round trip is wavenumber times Q; None for a thick layer.
    """

    refractive_index: Array
    absorbance: Array | None = None
    wavenumber: Array | None = None


class Stack(NamedTuple):
    """Layers on a body.

    Args:
        refractive_index: Refractive index of the body. Broadcasts with (..., view), 1, >= 1.
        layers: From the top down; none for a bare surface.
    """

    refractive_index: Array
    layers: tuple[Layer, ...] = ()

    def reflection(self, cos_incidence: Array, sin_squared: Array) -> Diattenuation:
        """Share of light that the whole stack reflects."""
        if not self.layers:
            air, body = self._bare(cos_incidence)
            return boundary.reflection(air, body, sin_squared)
        return self._respond(cos_incidence, sin_squared)[0]

    def relative_reflection(self, cos_incidence: Array, sin_squared: Array) -> Diattenuation:
        """Reflectance over `scale`, so that ratios exist for a body that reflects nothing."""
        if not self.layers:
            air, body = self._bare(cos_incidence)
            return boundary.relative_reflection(air, body, sin_squared)
        power = self._respond(cos_incidence, sin_squared)[0]
        # A trace, far below any reading: layers like air on a body like air reflect nothing.
        trace = jnp.finfo(power.mean.dtype).eps ** 1.75
        return power._replace(mean=jnp.maximum(power.mean, trace))

    def mirror(self, cos_incidence: Array, sin_squared: Array) -> tuple[Array, Diattenuation]:
        """Mean reflectance of s and p, and reflection up to a factor, of size near 1."""
        if not self.layers:
            air, body = self._bare(cos_incidence)
            mean = boundary.reflection(air, body, sin_squared).mean
            return mean, boundary.reflection_shape(air, body, sin_squared)
        power = self.relative_reflection(cos_incidence, sin_squared)
        return power.mean, power.scaled(1.0 / jax.lax.stop_gradient(power.mean))

    @property
    def scale(self) -> Array:
        """Factor that `relative_reflection` leaves out, shape of the index."""
        if not self.layers:
            return ((self.refractive_index - 1.0) * (self.refractive_index + 1.0)) ** 2
        return jnp.ones_like(self.refractive_index)

    def transmission(self, cos_incidence: Array, sin_squared: Array) -> Diattenuation:
        """Share of light that the whole stack transmits, equal in both directions."""
        if not self.layers:
            air, body = self._bare(cos_incidence)
            return boundary.transmission(air, body, sin_squared)
        return self._respond(cos_incidence, sin_squared)[1]

    def hemispherical_transmission(self) -> Array:
        r"""Share of diffuse light from outside that reaches the body, shape of the index.

        $$ 1 - F_e = \int_0^1 2\mu T_+(\mu)\, d\mu $$
        """
        if not self.layers:
            return 1.0 - _hemispherical_reflection(self.refractive_index)
        cosine, weight = self._hemisphere()
        through = per_ray(self).transmission(cosine, (1.0 - cosine) * (1.0 + cosine))
        # A sum, since matrix products of accelerators drop digits in single precision.
        return jnp.sum(weight * through.mean, axis=-1)

    def escape(self) -> Array:
        r"""Share of diffuse light in the body that the stack does not reflect back, 1 - F_i.

        $$ 1 - F_i = \frac{1}{n^2}\int_0^{n^2} (1 - R'(B))\, dB $$

        over the squared sine B in air: up to 1 light leaves, beyond it a coat may absorb it. A bare
        interface is the same both ways: 1 - F_i = (1 - F_e)/n^2.
        """
        if not self.layers:
            return self.hemispherical_transmission() / self.refractive_index**2
        cosine, weight = self._hemisphere()
        left = per_ray(self)._not_returned(cosine**2, (1.0 - cosine) * (1.0 + cosine))
        lost = jnp.sum(weight * left, axis=-1)
        if any(layer.absorbance is not None for layer in self.layers):
            lost = lost + self._absorbed_under_total_reflection()
        return lost / self.refractive_index**2

    def _absorbed_under_total_reflection(self) -> Array:
        """Part of that integral over angles that reach the lowest coat but not the air."""
        lowest = [layer for layer in self.layers if layer.wavenumber is None][-1]
        end = jnp.minimum(self.refractive_index, lowest.refractive_index) ** 2
        beyond = (end - 1.0)[..., None] * like(TRAPPED_SHARE, self.refractive_index)
        absorbed = per_ray(self)._not_returned(-beyond, 1.0 + beyond, reaches_air=False)
        weight = like(TRAPPED_WEIGHT, self.refractive_index)
        return (end - 1.0) * jnp.sum(weight * absorbed, axis=-1)

    def _bare(self, cos_incidence: Array) -> tuple[Medium, Medium]:
        """Media of a bare interface: air and body."""
        return _air(cos_incidence), boundary.medium(self.refractive_index, cos_incidence**2)

    def _hemisphere(self) -> tuple[Array, Array]:
        """Cosines in air, and weights that average diffuse light over them."""
        has_film = any(layer.wavenumber is not None for layer in self.layers)
        cosine, weight = FRINGE_RULE if has_film else HEMISPHERE_RULE
        index = self.refractive_index
        return resolved_cosine(like(cosine, index)), like(2.0 * cosine * weight, index)

    def _respond(
        self, cos_incidence: Array, sin_squared: Array
    ) -> tuple[Diattenuation, Diattenuation]:
        """Reflectance and transmittance, computed layer by layer from the body upwards."""
        cos_squared = cos_incidence**2
        sections = self._sections()
        powers = _boundaries(sections, _air(cos_incidence), cos_squared, sin_squared)
        back, passed = powers[-1]
        for (mirrored, through), (_, coat) in zip(powers[-2::-1], sections[-2::-1], strict=True):
            below = back
            if coat.absorbance is not None:
                # Light darker than any reading, e^-13 or e^-106, still has a polarization.
                darkest = -0.15 * np.log(np.finfo(cos_squared.dtype).tiny).item()
                depth = coat.absorbance * _slant(coat, cos_squared)
                remaining = jnp.exp(-jnp.minimum(depth, darkest))
                below, passed = back.scaled(remaining**2), passed.scaled(remaining)
            trips = mirrored.times(below).repeated()
            back = mirrored.plus(through.times(through).times(below).times(trips))
            passed = through.times(passed).times(trips)
        return back, passed

    def _not_returned(
        self, cos_squared: Array, sin_squared: Array, *, reaches_air: bool = True
    ) -> Array:
        """1 - R' for light from the body, mean of s and p; beyond 1 its sine in air is formal."""
        sections = self._sections()
        air = Medium(jnp.ones_like(sin_squared), jnp.sqrt(jnp.maximum(cos_squared, EVANESCENT)))
        powers = _boundaries(sections, air, cos_squared, sin_squared)
        lost = _s_and_p(powers[0][1]) if reaches_air else jnp.zeros_like(_s_and_p(powers[0][1]))
        for (back, through), (_, coat) in zip(powers[1:], sections[:-1], strict=True):
            if coat.absorbance is not None:
                twice = (2.0 * coat.absorbance * _slant(coat, cos_squared))[..., None]
                lost = jnp.exp(-twice) * lost - jnp.expm1(-twice)
            passed, reflected = _s_and_p(through), _s_and_p(back)
            lost = passed * lost / (passed + reflected * lost)
        return jnp.mean(lost, axis=-1)

    def _sections(self) -> list[tuple[tuple[Layer, ...], Layer]]:
        """Boundaries from the top down: films on each, and the coat or body below it."""
        sections: list[tuple[tuple[Layer, ...], Layer]] = []
        films: list[Layer] = []
        for layer in (*self.layers, Layer(self.refractive_index)):
            if layer.wavenumber is not None:
                films.append(layer)
            else:
                sections.append((tuple(films), layer))
                films = []
        return sections


def _hemispherical_reflection(refractive_index: Array) -> Array:
    r"""Share of diffuse light that a bare body reflects, F_e.

    $$ F_e = N^2 W \int_0^1 \tfrac12 (s - s^3) \frac{A^2 + B^2}{(A+B)^2} dh, \qquad
       \mu = N \sinh w,\; N^2 = n^2 - 1,\; w = W h,\; s = e^{-2w} $$

    where W = asinh(1/N): for s light the reflectance is then s^2 exactly, and however close n comes
    to 1 the nodes follow the angles at which light is reflected. The error is 1e-15.
    """
    # A step that rounding does not swallow: it counts as an index that is higher by 4 eps.
    eps = jnp.finfo(refractive_index.dtype).eps
    step = (refractive_index - 1.0) * (refractive_index + 1.0) + 8.0 * eps
    end = jnp.log1p(jnp.sqrt(1.0 + step)) - 0.5 * jnp.log(step)
    share, weight = like(BARE_SHARES, step), like(BARE_WEIGHTS, step)
    s = jnp.exp(-2.0 * end[..., None] * share)
    quarter = 0.25 * step[..., None]
    a, b = quarter * (1.0 / s - s), 1.0 - quarter * (1.0 / s + s - 2.0)
    # A sum, since matrix products of accelerators drop digits in single precision.
    total = jnp.sum(0.5 * weight * (s - s**3) * (a**2 + b**2) / (a + b) ** 2, axis=-1)
    return step * end * total


def _air(cos_incidence: Array) -> Medium:
    return Medium(jnp.ones((), cos_incidence.dtype), cos_incidence)


def _boundaries(
    sections: list[tuple[tuple[Layer, ...], Layer]],
    air: Medium,
    cos_squared: Array,
    sin_squared: Array,
) -> list[tuple[Diattenuation, Diattenuation]]:
    """Reflectance and transmittance of every boundary, from the top down."""
    powers, above = [], air
    for films, layer in sections:
        below = boundary.medium(layer.refractive_index, cos_squared)
        if films:
            thin = tuple(_film(film, cos_squared) for film in films)
            powers.append(boundary.filmed(above, thin, below, sin_squared))
        else:
            mirrored = boundary.reflection(above, below, sin_squared)
            powers.append((mirrored, boundary.transmission(above, below, sin_squared)))
        above = below
    return powers


def _film(layer: Layer, cos_squared: Array) -> Film:
    inside = boundary.medium(layer.refractive_index, cos_squared)
    phase = jnp.asarray(layer.wavenumber) * inside.normal
    return Film(inside, jax.lax.complex(jnp.cos(phase), jnp.sin(phase)))


def _slant(coat: Layer, cos_squared: Array) -> Array:
    """Path length through a coat, in units of its thickness."""
    inside = boundary.medium(coat.refractive_index, cos_squared)
    return inside.refractive_index / inside.normal


def _s_and_p(power: Diattenuation) -> Array:
    """Powers of s and p, on a new last axis."""
    difference = power.contrast * power.sin_squared
    both = jnp.broadcast_arrays(power.mean + difference, power.mean - difference)
    return jnp.stack(both, axis=-1)
