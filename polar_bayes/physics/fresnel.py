r"""Fresnel's laws for a lossless dielectric, written without cancellation.

With c the cosine of incidence, B = (1-c)(1+c) its squared sine (both are given, because the caller
knows them to full precision), Q = sqrt((n-1)(n+1) + c^2) and A = c Q:

    R_s = ((n^2-1)/(c+Q)^2)^2     R+ = R_s (A^2+B^2)/(A+B)^2     R- = K B,  K = 2 R_s A/(A+B)^2

R+ and R- are half the sum and half the difference of the reflectances for s and p. At Brewster's
angle A = B. Everything is regular at n = 1 and accurate up to grazing, in both precisions.
"""

import jax.numpy as jnp
from jaxtyping import Array

from polar_bayes.physics.part import like, squared_rule

# Cosines and weights for integrals over the hemisphere: 24 Gauss-Legendre nodes in the square root
# of the cosine, because near n = 1 all reflection gathers at grazing. The error of Fe is 1e-15 from
# n = 1.1 on, 2e-14 at 1.01 and at most 3e-9 anywhere.
HEMISPHERE_COSINES, HEMISPHERE_WEIGHTS = squared_rule(24)


def reflection(
    cos_incidence: Array, sin_squared: Array, refractive_index: Array
) -> tuple[Array, Array]:
    """Mean reflectance R+ and contrast K, where K times the squared sine is R-."""
    c, b, n = cos_incidence, sin_squared, refractive_index
    root = _inner(c, n)
    a = c * root
    s_reflectance = ((n - 1.0) * (n + 1.0) / (c + root) ** 2) ** 2
    mean = s_reflectance * (a**2 + b**2) / (a + b) ** 2
    contrast = 2.0 * s_reflectance * a / (a + b) ** 2
    return mean, contrast


def index_step(refractive_index: Array) -> Array:
    """Factor (n^2-1)^2 of every reflectance. Any shape, 1, >= 0; zero where the index is 1."""
    return ((refractive_index - 1.0) * (refractive_index + 1.0)) ** 2


def relative_reflection(
    cos_incidence: Array, sin_squared: Array, refractive_index: Array
) -> tuple[Array, Array]:
    """R+ and K without the factor (n^2-1)^2, so that their ratio of sums exists at n = 1."""
    c, b = cos_incidence, sin_squared
    root = _inner(c, refractive_index)
    a = c * root
    s_reflectance = 1.0 / (c + root) ** 4
    mean = s_reflectance * (a**2 + b**2) / (a + b) ** 2
    contrast = 2.0 * s_reflectance * a / (a + b) ** 2
    return mean, contrast


def polarizance(cos_incidence: Array, sin_squared: Array, refractive_index: Array) -> Array:
    """Degree of polarization of reflected light divided by the squared sine: 2A/(A^2+B^2)."""
    a = cos_incidence * _inner(cos_incidence, refractive_index)
    return 2.0 * a / (a**2 + sin_squared**2)


def reflection_polarization(
    cos_incidence: Array, sin_squared: Array, refractive_index: Array
) -> Array:
    """Degree of polarization of reflected light, 2AB/(A^2+B^2); exactly 1 at Brewster's angle."""
    return polarizance(cos_incidence, sin_squared, refractive_index) * sin_squared


def transmission(cos_incidence: Array, refractive_index: Array) -> Array:
    """Mean transmittance T+ = 2cQ [1/(c+Q)^2 + n^2/(n^2 c+Q)^2], the same inwards and outwards."""
    c, n = cos_incidence, refractive_index
    root = _inner(c, n)
    return 2.0 * c * root * (1.0 / (c + root) ** 2 + (n / (n**2 * c + root)) ** 2)


def exit_polarization(cos_exit: Array, sin_squared: Array, refractive_index: Array) -> Array:
    """Degree of polarization, along p, of unpolarized light that leaves through the interface."""
    # u(2-u)/(1+(1-u)^2) with u = (n-1)^2 (n+1) B/[n (c+Q)(Q+nc)]; at grazing (n^2-1)/(n^2+1).
    c, n = cos_exit, refractive_index
    root = _inner(c, n)
    lost = (n - 1.0) ** 2 * (n + 1.0) * sin_squared / (n * (c + root) * (root + n * c))
    return lost * (2.0 - lost) / (1.0 + (1.0 - lost) ** 2)


def hemispherical_reflection(refractive_index: Array) -> Array:
    """Share of diffuse light that the interface reflects outside: Fe = int_0^1 2 mu R+(mu) dmu."""
    cosine = HEMISPHERE_COSINES
    sin_squared = (1.0 - cosine) * (1.0 + cosine)
    mean, _ = reflection(
        like(cosine, refractive_index),
        like(sin_squared, refractive_index),
        refractive_index[..., None],
    )
    # A sum, since matrix products of accelerators drop digits in single precision.
    return jnp.sum(mean * like(2.0 * cosine * HEMISPHERE_WEIGHTS, refractive_index), axis=-1)


def escape(refractive_index: Array) -> Array:
    """Share of diffuse light inside that leaves: 1 - Fi = (1 - Fe)/n^2. Same shape, in (0, 1]."""
    return (1.0 - hemispherical_reflection(refractive_index)) / refractive_index**2


def internal_reflection(refractive_index: Array) -> Array:
    """Share of diffuse light inside that is turned back: Fi = ((n-1)(n+1) + Fe)/n^2, in [0, 1)."""
    n = refractive_index
    return ((n - 1.0) * (n + 1.0) + hemispherical_reflection(n)) / n**2


def _inner(cos_incidence: Array, refractive_index: Array) -> Array:
    """Q, the index times the cosine inside."""
    n = refractive_index
    return jnp.sqrt((n - 1.0) * (n + 1.0) + cos_incidence**2)
