r"""Fresnel's laws at one plane boundary between two lossless media, bare or with thin films.

The light comes from air. `Diattenuation` holds the effect of one interface, or of many, in numbers
that lose no digits. Power reflected (or passed) is s along e_s and p across it, and the field
components multiply by x = Re(r_s r_p^*). All interfaces on one path share the squared sine B of the
angle in air, and

    s = mean + contrast B,    p = mean - contrast B,    x = mean - shortfall B^2

with contrast and shortfall regular at normal incidence. Sums, products and quotients of such
triples are triples again, so layers can be stacked without ever subtracting s from p.

With Q = n cos(angle inside) = sqrt((n-1)(n+1) + c^2) for each medium, A = Q_1 Q_2 and
rho = (n_2^2 - n_1^2)/(Q_1 + Q_2)^2, a bare boundary reflects

    r_s = -rho,    r_p = -rho (A-B)/(A+B)

in the sign that makes both alike at normal incidence. At Brewster's angle A = B. Everything is
regular at n_1 = n_2 and accurate up to grazing, in both precisions.

Source:
    Born and Wolf, Principles of Optics, on the Fresnel formulae.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

# Smallest squared cosine in a medium: light that cannot enter it is let in by 1e-6.
EVANESCENT = 1e-12


class Diattenuation(NamedTuple):
    """Effect of one interface, or of many, on light that keeps to one path.

    Args:
        mean: Half the sum of s and p. Shape (..., view[, facet]), 1, in [0, 1].
        contrast: Half their difference over B, the squared sine in air. Same shape, 1.
        shortfall: (mean - x)/B^2. Same shape, 1.
        sin_squared: B. Same shape, 1, in [0, 1].
    """

    mean: Array
    contrast: Array
    shortfall: Array
    sin_squared: Array

    @property
    def cross(self) -> Array:
        """x, the factor of light polarized at 45 degrees, signed as at normal incidence."""
        return self.mean - self.shortfall * self.sin_squared**2

    def scaled(self, factor: Array) -> "Diattenuation":
        """Append a filter that attenuates all light equally."""
        mean, contrast, shortfall = (factor * part for part in self[:3])
        return Diattenuation(mean, contrast, shortfall, self.sin_squared)

    def plus(self, other: "Diattenuation") -> "Diattenuation":
        """Add the light of another path."""
        mean, contrast, shortfall = map(jnp.add, self[:3], other[:3])
        return Diattenuation(mean, contrast, shortfall, self.sin_squared)

    def times(self, other: "Diattenuation") -> "Diattenuation":
        """Append another interface."""
        b = self.sin_squared
        return self._replace(
            mean=self.mean * other.mean + self.contrast * other.contrast * b**2,
            contrast=self.mean * other.contrast + self.contrast * other.mean,
            shortfall=self.contrast * other.contrast
            + self.shortfall * other.mean
            + self.mean * other.shortfall
            - self.shortfall * other.shortfall * b**2,
        )

    def repeated(self) -> "Diattenuation":
        """Sum all round trips, 1 + this + this^2 + ... = 1/(1 - this)."""
        b = self.sin_squared
        left = 1.0 - self.mean
        s_and_p = (left - self.contrast * b) * (left + self.contrast * b)
        crossed = left + self.shortfall * b**2
        return self._replace(
            mean=left / s_and_p,
            contrast=self.contrast / s_and_p,
            shortfall=(self.contrast**2 + left * self.shortfall) / (crossed * s_and_p),
        )


class Medium(NamedTuple):
    """A medium on the path of light, with Q, its index times the cosine inside."""

    refractive_index: Array
    normal: Array


class Film(NamedTuple):
    """A layer thin enough for interference, with the phase of one round trip, exp(2 i delta)."""

    medium: Medium
    phase: Array


class Amplitude(NamedTuple):
    """Reflected field along s and p, mean +- contrast B; real for a bare boundary."""

    mean: Array
    contrast: Array

    def times(self, other: "Amplitude", sin_squared: Array) -> "Amplitude":
        """Return the product with another amplitude."""
        return Amplitude(
            self.mean * other.mean + self.contrast * other.contrast * sin_squared**2,
            self.mean * other.contrast + self.contrast * other.mean,
        )

    def over(self, other: "Amplitude", sin_squared: Array) -> "Amplitude":
        """Return the quotient by another amplitude that vanishes neither along s nor along p."""
        difference = other.contrast * sin_squared
        product = (other.mean - difference) * (other.mean + difference)
        inverse = Amplitude(other.mean / product, -other.contrast / product)
        return self.times(inverse, sin_squared)

    def power(self, sin_squared: Array) -> Diattenuation:
        """Return squared moduli."""
        straight, crossed = _square(self.mean), _square(self.contrast)
        both = jnp.real(self.mean) * jnp.real(self.contrast)
        both = both + jnp.imag(self.mean) * jnp.imag(self.contrast)
        return Diattenuation(
            straight + crossed * sin_squared**2, 2.0 * both, 2.0 * crossed, sin_squared
        )


def medium(refractive_index: Array, cos_squared: Array) -> Medium:
    """The medium of an index, for light whose squared cosine in air is given."""
    # Below zero it belongs to light that is trapped and would not reach the air; where it does not
    # reach this medium either, next to nothing passes.
    normal_squared = (refractive_index - 1.0) * (refractive_index + 1.0) + cos_squared
    # Light from the air reaches every medium, however close to grazing it comes.
    least = jnp.where(cos_squared > 0.0, 0.0, EVANESCENT)
    return Medium(refractive_index, jnp.sqrt(jnp.maximum(normal_squared, least)))


def reflection(above: Medium, below: Medium, sin_squared: Array) -> Diattenuation:
    """Power that a bare boundary reflects."""
    return relative_reflection(above, below, sin_squared, _square_difference(above, below))


def relative_reflection(
    above: Medium, below: Medium, sin_squared: Array, step: Array | float = 1.0
) -> Diattenuation:
    """Reflected power without the factor (n_2^2 - n_1^2)^2, whose root is `step`."""
    a, b = above.normal * below.normal, sin_squared
    # Inverse by inverse, and squared last: near grazing, derivatives of the whole would overflow
    # single precision.
    inverse = 1.0 / (above.normal + below.normal)
    scale = (step * inverse * inverse / (a + b)) ** 2
    return reflection_shape(above, below, sin_squared).scaled(scale)


def reflection_shape(above: Medium, below: Medium, sin_squared: Array) -> Diattenuation:
    """Reflected power up to any factor, scaled to a size near 1."""
    a, b = above.normal * below.normal, sin_squared
    return Diattenuation(a**2 + b**2, 2.0 * a, 2.0 * jnp.ones_like(a), b)


def transmission(above: Medium, below: Medium, sin_squared: Array) -> Diattenuation:
    """Power that a bare boundary transmits, equal in both directions."""
    a, b, total = above.normal * below.normal, sin_squared, above.normal + below.normal
    inverse = 1.0 / total
    share = inverse / (a + b)
    p_like = above.refractive_index * below.refractive_index * share
    scale = (_square_difference(above, below) * inverse * share) ** 2
    # sqrt(s) - sqrt(p) of the transmittances, over B.
    ratio = (below.refractive_index - above.refractive_index) * inverse
    roots = 2.0 * ratio**2 * share / ((1.0 - ratio) * (1.0 + ratio))
    return Diattenuation(
        mean=2.0 * a * (inverse**2 + p_like**2),
        contrast=-2.0 * scale * a,
        shortfall=2.0 * a * roots**2,
        sin_squared=b,
    )


def filmed(
    above: Medium, films: tuple[Film, ...], below: Medium, sin_squared: Array
) -> tuple[Diattenuation, Diattenuation]:
    r"""Power that a boundary with thin films reflects and transmits (Airy's formulas).

    $$ r = \frac{r_1 + r_2 e^{2i\delta}}{1 + r_1 r_2 e^{2i\delta}}, \qquad
       T = \frac{T_1 T_2}{|1 + r_1 r_2 e^{2i\delta}|^2} $$

    from the deepest film upwards, where r_2 and T_2 are what lies below.

    Source:
        Born and Wolf, Principles of Optics, on a dielectric film; layers by recursion.
    """
    media = (above, *(film.medium for film in films), below)
    amplitude = _amplitude(media[-2], media[-1], sin_squared)
    passed = transmission(media[-2], media[-1], sin_squared)
    for upper, film in zip(reversed(media[:-2]), reversed(films), strict=True):
        first = _amplitude(upper, film.medium, sin_squared)
        later = Amplitude(amplitude.mean * film.phase, amplitude.contrast * film.phase)
        trip = first.times(later, sin_squared)
        trips = Amplitude(1.0 + trip.mean, trip.contrast)
        amplitude = Amplitude(first.mean + later.mean, first.contrast + later.contrast)
        amplitude = amplitude.over(trips, sin_squared)
        echoes = Amplitude(jnp.ones_like(trips.mean), jnp.zeros_like(trips.mean))
        echo = echoes.over(trips, sin_squared).power(sin_squared)
        passed = transmission(upper, film.medium, sin_squared).times(passed).times(echo)
    return amplitude.power(sin_squared), passed


def _rho(above: Medium, below: Medium) -> Array:
    """Field reflected along s, without its sign."""
    inverse = 1.0 / (above.normal + below.normal)
    return _square_difference(above, below) * inverse * inverse


def _square_difference(above: Medium, below: Medium) -> Array:
    """Difference of squared indices, n_2^2 - n_1^2."""
    first, second = above.refractive_index, below.refractive_index
    return (second - first) * (second + first)


def _amplitude(above: Medium, below: Medium, sin_squared: Array) -> Amplitude:
    """Field reflected by a bare boundary."""
    a = above.normal * below.normal
    share = -_rho(above, below) / (a + sin_squared)
    return Amplitude(share * a, share)


def _square(number: Array) -> Array:
    """Squared modulus, smooth at zero."""
    return jnp.real(number) ** 2 + jnp.imag(number) ** 2
