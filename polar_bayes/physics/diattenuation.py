r"""What an interface does to polarized light, in numbers that lose no digits.

Power reflected (or passed) is s along e_s and p across it, and the field components multiply by
x = Re(r_s r_p^*). All interfaces met on one path share the squared sine B of the angle in air, and

    s = mean + contrast B,    p = mean - contrast B,    x = mean - shortfall B^2

with contrast and shortfall regular at normal incidence. Sums, products and quotients of such
triples are triples again, so layers can be stacked without ever subtracting s from p.
"""

from typing import NamedTuple

from jaxtyping import Array


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
        """x, the factor of light polarized at 45 degrees, in the sign of normal incidence."""
        return self.mean - self.shortfall * self.sin_squared**2

    def scaled(self, factor: Array) -> "Diattenuation":
        """Followed by a filter that treats all light alike."""
        return self._replace(
            mean=factor * self.mean,
            contrast=factor * self.contrast,
            shortfall=factor * self.shortfall,
        )

    def plus(self, other: "Diattenuation") -> "Diattenuation":
        """Both paths together."""
        return self._replace(
            mean=self.mean + other.mean,
            contrast=self.contrast + other.contrast,
            shortfall=self.shortfall + other.shortfall,
        )

    def times(self, other: "Diattenuation") -> "Diattenuation":
        """One after the other."""
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
        """All round trips together, 1 + this + this^2 + ... = 1/(1 - this)."""
        b = self.sin_squared
        left = 1.0 - self.mean
        s_and_p = (left - self.contrast * b) * (left + self.contrast * b)
        crossed = left + self.shortfall * b**2
        return self._replace(
            mean=left / s_and_p,
            contrast=self.contrast / s_and_p,
            shortfall=(self.contrast**2 + left * self.shortfall) / (crossed * s_and_p),
        )
