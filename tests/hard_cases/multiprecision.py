"""The optics once more, in 50 digits and in the textbook's forms: an independent twin.

Nothing here is arranged to avoid cancellation; 50 digits forgive that. Directions are vectors.
"""

from typing import NamedTuple

import mpmath as mp

DIGITS = 50

# The floors of the package, which are part of its definition.
SMOOTHEST = mp.mpf(1e-5)
CLEAREST = mp.mpf(1e-4)


class Interface(NamedTuple):
    """Fresnel's results at one angle."""

    mean: mp.mpf
    difference: mp.mpf
    transmitted: mp.mpf
    reflected_polarization: mp.mpf
    exit_polarization: mp.mpf


def cosine(degrees: float) -> mp.mpf:
    return mp.cos(mp.radians(mp.mpf(float(degrees))))


def sine(degrees: float) -> mp.mpf:
    return mp.sin(mp.radians(mp.mpf(float(degrees))))


def interface(c: mp.mpf, n: mp.mpf) -> Interface:
    """Fresnel's laws from amplitudes; polarization as a limit where nothing is reflected."""
    inner = mp.sqrt(1 - (1 - c**2) / n**2)
    s = ((c - n * inner) / (c + n * inner)) ** 2
    p = ((n * c - inner) / (n * c + inner)) ** 2
    exists = s + p > mp.mpf("1e-60")  # not only the rounding of 50 digits
    reflected = (s - p) / (s + p) if exists else 2 * c**2 * (1 - c**2) / (c**4 + (1 - c**2) ** 2)
    return Interface((s + p) / 2, (s - p) / 2, 1 - (s + p) / 2, reflected, (s - p) / (2 - s - p))


class Facet(NamedTuple):
    """The facet that mirrors light to viewer."""

    cos_incidence: mp.mpf
    sin_squared: mp.mpf
    tan_squared_tilt: mp.mpf
    along_s: mp.mpf
    across_s: mp.mpf


def facet(view_zenith: float, light_zenith: float, azimuth: float) -> Facet:
    """Half vector, its angle to the viewer, and the turn of its s axis, from vectors."""
    view = mp.matrix([sine(view_zenith), 0, cosine(view_zenith)])
    light = mp.matrix(
        [
            sine(light_zenith) * cosine(azimuth),
            sine(light_zenith) * sine(azimuth),
            cosine(light_zenith),
        ]
    )
    half = view + light
    half /= mp.norm(half)
    c = dot(view, half)
    # The half vector in the viewer's frame: e_s is y, the other axis completes it with v.
    in_plane = half[2] * view[0] - half[0] * view[2]
    return Facet(
        c,
        1 - c**2,
        (half[0] ** 2 + half[1] ** 2) / half[2] ** 2,
        in_plane**2 - half[1] ** 2,
        2 * in_plane * half[1],
    )


def dot(a: mp.matrix, b: mp.matrix) -> mp.mpf:
    return mp.fsum(a[i] * b[i] for i in range(3))


def beckmann_density(tan_squared: mp.mpf, roughness: mp.mpf) -> mp.mpf:
    alpha = max(roughness, SMOOTHEST)
    return mp.exp(-tan_squared / alpha**2) * (1 + tan_squared) ** 2 / (mp.pi * alpha**2)


def beckmann_shadowing(tan_squared: mp.mpf, roughness: mp.mpf) -> mp.mpf:
    y = max(roughness, SMOOTHEST) * mp.sqrt(tan_squared)
    if y <= mp.mpf("0.625"):
        return mp.mpf(1)
    a = 1 / y
    return (mp.mpf("3.535") * a + mp.mpf("2.181") * a**2) / (
        1 + mp.mpf("2.276") * a + mp.mpf("2.577") * a**2
    )


def ggx_density(tan_squared: mp.mpf, roughness: mp.mpf) -> mp.mpf:
    alpha = max(roughness, SMOOTHEST)
    cos_squared = 1 / (1 + tan_squared)
    return alpha**2 / (mp.pi * (cos_squared * (alpha**2 - 1) + 1) ** 2)


def ggx_shadowing(tan_squared: mp.mpf, roughness: mp.mpf) -> mp.mpf:
    return 2 / (1 + mp.sqrt(1 + max(roughness, SMOOTHEST) ** 2 * tan_squared))


def half_space_albedo(absorption: mp.mpf) -> mp.mpf:
    absorption = max(absorption, CLEAREST)
    g = mp.sqrt(1 - 1 / (1 + absorption))
    return (1 - g) * (1 - mp.mpf("0.139") * g) / (1 + mp.mpf("1.170") * g)


def hemispherical_reflection(n: mp.mpf, nodes: list, weights: list) -> mp.mpf:
    return mp.fsum(2 * w * x * interface(x, n).mean for x, w in zip(nodes, weights, strict=True))
