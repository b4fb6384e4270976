"""The optics once more, in 50 digits and in the textbook's forms: an independent twin.

Nothing here is arranged to avoid cancellation; 50 digits forgive that. Directions are vectors.
"""

from typing import NamedTuple

import mpmath as mp

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


def hemispherical_reflection(n: mp.mpf) -> mp.mpf:
    """Walsh's closed form (1926), in Duntley's writing (1942)."""
    if n == 1:
        return mp.mpf(0)
    square = n**2
    return (
        mp.mpf(1) / 2
        + (n - 1) * (3 * n + 1) / (6 * (n + 1) ** 2)
        + square * (square - 1) ** 2 / (square + 1) ** 3 * mp.log((n - 1) / (n + 1))
        - 2 * n**3 * (square + 2 * n - 1) / ((square + 1) * (square**2 - 1))
        + 8 * square**2 * (square**2 + 1) / ((square + 1) * (square**2 - 1) ** 2) * mp.log(n)
    )


class Boundary(NamedTuple):
    """Fields and powers at a boundary, with or without films: s, then p."""

    reflected: tuple[mp.mpc, mp.mpc]
    passed: tuple[mp.mpf, mp.mpf]
    cross_passed: mp.mpf


def boundary(sin_squared: mp.mpf, above: mp.mpf, films: list, below: mp.mpf) -> Boundary:
    """Powers by characteristic matrices; films are (index, 2 pi thickness/wavelength), top down."""

    def admittances(n: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        inside = mp.sqrt(1 - sin_squared / n**2)
        return n * inside, n / inside

    fields, passed, through = [], [], []
    for k in (0, 1):
        electric, magnetic = mp.mpc(1), mp.mpc(admittances(below)[k])
        for n, wavenumber in reversed(films):
            y = admittances(n)[k]
            delta = wavenumber * mp.sqrt(n**2 - sin_squared)
            electric, magnetic = (
                mp.cos(delta) * electric - 1j * mp.sin(delta) / y * magnetic,
                mp.cos(delta) * magnetic - 1j * mp.sin(delta) * y * electric,
            )
        first, last = admittances(above)[k], admittances(below)[k]
        total = first * electric + magnetic
        fields.append((first * electric - magnetic) / total)
        through.append(2 * first / total * mp.sqrt(last / first))
        passed.append(abs(through[-1]) ** 2)
    cross = mp.re(through[0] * mp.conj(through[1]))
    return Boundary(tuple(fields), tuple(passed), cross)


class Powers(NamedTuple):
    """Factors of a stack on power along s, along p, and on the product of their fields."""

    s: mp.mpf
    p: mp.mpf
    cross: mp.mpf


def coated(sin_squared, films, coat, absorbance, n):
    """Reflectance and transmittance of films on a thick coat on a body: the sum of all bounces."""
    top = boundary(sin_squared, mp.mpf(1), films, coat)
    # From below the films stand in the other order; the same power passes.
    under = boundary(sin_squared, coat, films[::-1], mp.mpf(1))
    base = boundary(sin_squared, coat, [], n)
    kept = mp.exp(-absorbance / mp.sqrt(1 - sin_squared / coat**2))

    def both(one: mp.mpc, other: mp.mpc) -> mp.mpf:
        return mp.re(one * mp.conj(other))

    back, through = [], []
    for i, j, first, last in (
        (0, 0, top.passed[0], base.passed[0]),
        (1, 1, top.passed[1], base.passed[1]),
        (0, 1, top.cross_passed, base.cross_passed),
    ):
        trip = both(base.reflected[i], base.reflected[j]) * kept**2
        trips = 1 / (1 - trip * both(under.reflected[i], under.reflected[j]))
        back.append(both(top.reflected[i], top.reflected[j]) + first**2 * trip * trips)
        through.append(first * kept * last * trips)
    return Powers(*back), Powers(*through)


def ray(zenith: float, azimuth: float) -> mp.matrix:
    return mp.matrix([sine(zenith) * cosine(azimuth), sine(zenith) * sine(azimuth), cosine(zenith)])


def cross_product(a: mp.matrix, b: mp.matrix) -> mp.matrix:
    return mp.matrix(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def mirrored(powers, view, light, q, u):
    """Stokes vector that a facet sends to the viewer, from fields along explicit axes."""
    towards, from_ = ray(*view), ray(*light)
    frames = []
    for direction, (_, azimuth) in ((towards, view), (from_, light)):
        s = mp.matrix([-sine(azimuth), cosine(azimuth), 0])
        frames.append((s, cross_product(direction, s)))
    half = towards + from_
    axis = cross_product(half, from_)
    axis = axis / mp.norm(axis) if mp.norm(axis) > mp.mpf("1e-40") else frames[1][0]
    arriving = [[dot(a, b) for b in frames[1]] for a in (axis, cross_product(from_, axis))]
    leaving = [[dot(a, b) for b in (axis, cross_product(towards, axis))] for a in frames[0]]
    into, out = mp.matrix(arriving), mp.matrix(leaving)
    fields = into * mp.matrix([[1 + q, u], [u, 1 - q]]) * into.T / 2
    factor = mp.matrix([[powers.s, powers.cross], [powers.cross, powers.p]])
    for i in (0, 1):
        for j in (0, 1):
            fields[i, j] *= factor[i, j]
    fields = out * fields * out.T
    return fields[0, 0] + fields[1, 1], fields[0, 0] - fields[1, 1], 2 * fields[0, 1]


def groove_density(kind: str, x: mp.mpf, y: mp.mpf, along: mp.mpf, across: mp.mpf) -> mp.mpf:
    """Facet area per steradian, from slopes along and across the grooves' azimuth."""
    along, across = max(along, SMOOTHEST), max(across, SMOOTHEST)
    square = (x / along) ** 2 + (y / across) ** 2
    bell = mp.exp(-square) if kind == "beckmann" else (1 + square) ** -2
    return bell * (1 + x**2 + y**2) ** 2 / (mp.pi * along * across)
